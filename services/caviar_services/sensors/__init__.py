"""Sensors: what a device sees of the scene, from the same meshes and poses as the channel."""
