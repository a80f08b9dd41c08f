"""AirSim's RPC: its messages and types, and what answers its calls from the frames of a run.

`caviar_bridges.airsim.agent` is the agent that serves it, `caviar_bridges.airsim.world` the world that
calls it. Positions and directions are NED (north, east, down) at this edge alone.
"""
