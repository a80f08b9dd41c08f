"""Worlds: where everything is, frame by frame."""
