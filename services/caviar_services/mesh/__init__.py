"""Triangle meshes: shapes of moving objects, and the scenery."""
