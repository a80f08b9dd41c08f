"""Places and directions: coordinates, scenes, arrays, beams, meshes."""
