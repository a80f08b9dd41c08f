"""Where a flown object can be: a box, clear of the scenery and not inside of it."""

from __future__ import annotations

import copy
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from caviar_protocol.space.coordinates import Vector
from caviar_services.channel.propagation.clearance import Surfaces
from caviar_services.world.obstacles import Obstacles, scenery_triangles

TRIES = 10_000
"""Points that are drawn at most, until one is free."""


class Airspace:
    """Points that are free for an object.

    Parameters
    ----------
    low, high
        Corners [m] of the box that it keeps within.
    clearance
        Least distance [m] of its centre from scenery.
    scenery
        Files of the run's scenery, by asset name.
    """

    def __init__(self, low: Vector, high: Vector, clearance: float, scenery: Mapping[str, Path]) -> None:
        self.low, self.high = low, high
        self._clearance = clearance
        triangles = scenery_triangles(scenery)
        self._obstacles = Obstacles(triangles[triangles[..., 2].max(axis=1) > low[2]])
        self._surfaces = Surfaces(triangles, lambda triangle, normal: True)

    def within(self, low: Vector, high: Vector) -> Airspace:
        """The same scenery, and another box [m]."""
        other = copy.copy(self)
        other.low, other.high = low, high
        return other

    def is_free(self, point: Vector) -> bool:
        """Whether the object can be at a point [m]."""
        if not all(a <= x <= b for a, x, b in zip(self.low, point, self.high, strict=True)):
            return False
        if self._obstacles.distance(point, self._clearance) < self._clearance:
            return False
        return not self._surfaces.encloses(np.array(point))

    def draw(
        self,
        random: np.random.Generator,
        near: Vector | None = None,
        distance: tuple[float, float] = (0.0, np.inf),
    ) -> Vector | None:
        """A free point [m], uniform in the box, and, where ``near`` is given, as far from it [m] as
        ``distance`` says; None where none was found."""
        for _ in range(TRIES):
            x, y, z = random.uniform(self.low, self.high).tolist()
            far = 0.0 if near is None else float(np.linalg.norm(np.subtract((x, y, z), near)))
            if distance[0] <= far <= distance[1] and self.is_free((x, y, z)):
                return x, y, z
        return None
