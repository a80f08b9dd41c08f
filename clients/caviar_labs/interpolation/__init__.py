"""Channels at any time between two that were traced: path by path, with a bound on the error."""

from caviar_labs.interpolation.between import Between, Interpolation, Keyframe

__all__ = ["Between", "Interpolation", "Keyframe"]
