"""Scenes of the radio world: import, check, repair, simplify, materials from pictures, towns."""
