"""The game engine Panda3D as a world: its level, its bodies, and the pictures of its renderer."""
