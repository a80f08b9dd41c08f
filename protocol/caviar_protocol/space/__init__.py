"""Where things are: coordinates, scenes, beams, meshes."""
