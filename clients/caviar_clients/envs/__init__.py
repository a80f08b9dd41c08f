"""Environments of gymnasium: importing this registers them.

import gymnasium
import caviar_clients.envs

env = gymnasium.make("caviar/BeamSelection-v0", scenario="geometric")
"""

import gymnasium

gymnasium.register("caviar/BeamSelection-v0", "caviar_clients.envs.beam_selection:BeamSelectionEnv")
gymnasium.register("caviar/UavPath-v0", "caviar_clients.envs.uav_path:UavPathEnv")
