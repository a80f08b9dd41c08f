"""Runs that a program steps: in its own process (`embedded`), or of a broker elsewhere (`connected`)."""
