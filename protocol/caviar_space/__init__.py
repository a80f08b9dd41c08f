"""Geometry above the wire and below services: meshes, materials, scenery, obstacles, ground, engine axes."""
