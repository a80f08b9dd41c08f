"""Geometry above the wire and below services: meshes, scenery, obstacles, ground, axes of engines."""
