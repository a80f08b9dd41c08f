"""How fast objects turn about the vertical."""

from __future__ import annotations

from collections.abc import Sequence

_TURNS = 1e-9
"""[rad/s]; slower is the rounding of a straight line."""


def turning(rate: float) -> float:
    """A yaw rate [rad/s]; 0 where it is but rounding, so that a scene in which nothing turns says so."""
    return rate if abs(rate) > _TURNS else 0.0


def course_rate(velocity: Sequence[float], acceleration: Sequence[float]) -> float:
    """How fast [rad/s] the horizontal course of a velocity [m/s] turns with an acceleration [m/s²]."""
    (vx, vy, _), (ax, ay, _) = velocity, acceleration
    return turning((vx * ay - vy * ax) / (vx * vx + vy * vy))
