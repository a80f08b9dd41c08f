"""Free airspace: points where a flown object may be, clear of scenery and outside of buildings."""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np

from caviar_protocol.space.coordinates import Vector
from caviar_space.obstacles import Obstacles, Surfaces
from caviar_space.scenery import scenery_triangles

TRIES = 10_000
"""Points that are drawn at most, until one is free."""


class Airspace:
    """The points of a box that are free for an object: clear of scenery, and outside of buildings.

    Args:
        low, high: Corners [m] of the box that it keeps within.
        clearance: Least distance [m] of its centre from scenery.
        scenery: Files of the run's scenery, by asset name.
        is_allowed: Tells of a point [m] whether the object may be there.
    """

    def __init__(
        self,
        low: Vector,
        high: Vector,
        clearance: float,
        scenery: Mapping[str, Path],
        is_allowed: Callable[[Vector], bool] = lambda point: True,
    ) -> None:
        self.low, self.high = low, high
        self._is_allowed = is_allowed
        self._clearance = clearance
        triangles = scenery_triangles(scenery)
        # What ends below the box is no obstacle: an object may fly low over the ground.
        self._obstacles = Obstacles(triangles[triangles[..., 2].max(axis=1) > low[2]])
        self._surfaces = Surfaces(triangles, lambda triangle, normal: True)

    def within(self, low: Vector, high: Vector) -> Airspace:
        """Take another box [m] in the same scenery, which is not loaded again."""
        other = copy.copy(self)
        other.low, other.high = low, high
        return other

    def is_free(self, point: Vector) -> bool:
        """Tell whether the object can be at a point [m]."""
        if not all(a <= x <= b for a, x, b in zip(self.low, point, self.high, strict=True)):
            return False
        if not self._is_allowed(point):
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
        """Draw a free point.

        Args:
            random: Generator of the draw.
            near: Point from which the distance is measured [m]; None: any distance is right.
            distance: Least and greatest distance [m].

        Returns:
            A point [m], uniform among those that fit; None where `TRIES` draws found none.
        """
        # By rejection, which needs no volume of what is free: a city leaves most of its air.
        for _ in range(TRIES):
            x, y, z = random.uniform(self.low, self.high).tolist()
            far = 0.0 if near is None else float(np.linalg.norm(np.subtract((x, y, z), near)))
            if distance[0] <= far <= distance[1] and self.is_free((x, y, z)):
                return x, y, z
        return None
