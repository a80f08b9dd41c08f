"""Recorders: what writes a run down."""
