"""A run in one process."""
