"""Repeating recorded runs, with some of their services replaced."""
