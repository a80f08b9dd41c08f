"""Bridges to other simulators and protocols: AirSim, MAVLink, Panda3D and MuJoCo, as plug-ins of the core.

They register by the entry points that other distributions use, and the core imports none of them.
"""
