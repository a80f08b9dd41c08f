"""The most accurate model of a ladder that fits the time a frame has."""
