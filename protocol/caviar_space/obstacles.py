"""Scenery as obstacles of flight: where a ball may go between its triangles.

Triangles lie in the cells of a horizontal grid. Those around the ball are kept until it has gone some way, so
that a step looks at few of them, and in free flight at none.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from caviar_protocol.arrays import Float64Array, Int64Array
from caviar_protocol.space.coordinates import Vector

# Side of a grid cell [m].
_CELL = 10.0

# Wider scenery has larger cells.
_MOST_CELLS = 1_000_000

# How far [m] beyond what a step needs is looked for triangles: the wider, the more triangles a look finds and
# the more steps pass until the next one.
_HORIZON = 20.0

# Way [m] for which the triangles beside a wall are kept.
_AROUND = 2.0

# Way [m] into a plane that counts as none.
_ROUNDING = 1e-9

# Clearance [m] that such ways may take away in all.
_WORN = 1e-6

_REST: Vector = (0.0, 0.0, 0.0)


class Obstacles:
    """Triangles that a ball must not come near.

    Args:
        triangles: Corners in world coordinates [m], Shape ``[T, 3, 3]``.

    Example:
        >>> wall = np.array([[[5.0, -9.0, 0.0], [5.0, 9.0, 0.0], [5.0, 0.0, 9.0]]])
        >>> obstacles = Obstacles(wall)
        >>> obstacles.distance((0.0, 0.0, 1.0))
        5.0
        >>> obstacles.in_the_way((0.0, 0.0, 1.0), [(4.5, 0.0, 0.0)], 1.0)[0]  # away from the wall
        -1.0
    """

    def __init__(self, triangles: Float64Array) -> None:
        self._corners = np.ascontiguousarray(triangles, dtype=np.float64).reshape(-1, 3, 3)
        self._grid = _Grid(self._corners) if len(self._corners) else None
        self._centre: Vector = _REST
        self._reach = -math.inf
        self._around: _Faces | None = None
        # Where distances and gaps were measured last, and what they were: a step tries several ways.
        self._seen_from: Vector | None = None
        self._seen: tuple[Float64Array, Float64Array]
        # Where the distance of the nearest triangle was measured last, and the distance.
        self._free_at: Vector = _REST
        self._free = 0.0

    @classmethod
    def none(cls) -> Obstacles:
        """Nothing in the way."""
        return cls(np.zeros((0, 3, 3)))

    def distance(self, point: Vector, within: float = math.inf) -> float:
        """Measure the distance of a point from the nearest triangle.

        Args:
            point: The point [m].
            within: Greatest distance of interest [m]; triangles farther away are not looked at.

        Returns:
            The distance [m]; ``within`` where every triangle is farther.
        """
        near = self._near(point, within)
        return min(float(_Faces(near).gaps(point)[0].min()), within) if len(near) else within

    def in_the_way(self, start: Vector, ways: Sequence[Vector], radius: float) -> Vector | None:
        """Find what a ball would touch on any of several straight ways.

        A triangle lies behind the plane through its point nearest to the start, across the line to the
        start. Where no way comes nearer than ``radius`` to any of these planes, the straight lines between
        the ends are free too. Beside an edge this asks for a little more than needed. Of several planes
        it is the one that a way goes into the farthest.

        Args:
            start: Centre of the ball [m].
            ways: Displacements from there [m].
            radius: Radius of the ball [m].

        Returns:
            Unit vector away from the triangle; None where every way is free.
        """
        need = radius + max(math.hypot(*way) for way in ways)
        if self._reach - math.dist(start, self._centre) < need:
            self._look_around(start, need)
        if self._around is None:
            return None
        if start != self._seen_from:
            self._seen_from, self._seen = start, self._around.gaps(start)
        distances, gaps = self._seen
        near = distances < need
        if not near.any():
            return None
        distance = distances[near]
        # A ball that slides along a wall stands at its radius but for rounding, either way: without this, one
        # rounding inwards would read as a collision and stop the slide.
        room = np.where(np.abs(distance - radius) < _WORN, 0.0, distance - radius)
        normals = gaps[near] / np.maximum(distance, _ROUNDING)[:, None]
        short = (normals @ np.array(ways).T).min(axis=1) + room
        worst = int(short.argmin())
        if short[worst] >= -_ROUNDING:
            return None
        x, y, z = normals[worst].tolist()
        return (x, y, z)

    def touched(self, point: Vector, radius: float) -> tuple[float, Vector] | None:
        """Find the triangle nearest to a ball that touches one.

        Args:
            point: Centre of the ball [m].
            radius: Radius of the ball [m].

        Returns:
            Distance [m] of the triangle and unit vector away from it; None where the ball touches none.

        Example:
            >>> wall = np.array([[[5.0, -9.0, 0.0], [5.0, 9.0, 0.0], [5.0, 0.0, 9.0]]])
            >>> Obstacles(wall).touched((4.75, 0.0, 1.0), 0.5)
            (0.25, (-1.0, 0.0, 0.0))
        """
        # As far as it was from touching anything it may go without another look.
        if math.dist(point, self._free_at) + radius < self._free:
            return None
        if self._reach - math.dist(point, self._centre) < radius:
            self._look_around(point, radius)
        if self._around is None:
            return None
        distances, gaps = self._around.gaps(point)
        nearest = int(distances.argmin())
        distance = float(distances[nearest])
        self._free_at, self._free = point, distance
        if distance >= radius:
            return None
        x, y, z = (gaps[nearest] / max(distance, _ROUNDING)).tolist()
        return distance, (x + 0.0, y + 0.0, z + 0.0)

    def _look_around(self, centre: Vector, need: float) -> None:
        """Keep the triangles that steps from places around this one can come near."""
        # Far from walls none is kept, and the reach is the distance of the nearest: until the ball has gone
        # that far, a step costs one distance of two points.
        corners = self._near(centre, need + _HORIZON)
        distances = _Faces(corners).gaps(centre)[0] if len(corners) else np.zeros(0)
        free = float(distances.min(initial=need + _HORIZON))
        self._centre, self._seen_from = centre, None
        self._reach = max(free, need + _AROUND)
        kept = corners[distances < self._reach]
        self._around = _Faces(kept) if len(kept) else None

    def _near(self, point: Vector, within: float) -> Float64Array:
        """Corners of the triangles of which some point may be ``within`` of a point."""
        if self._grid is None or math.isinf(within):
            return self._corners
        return self._corners[self._grid.find(point, within)]


class _Faces:
    """Some triangles, with what the distance from a point needs."""

    def __init__(self, corners: Float64Array) -> None:
        self._corners = corners
        self._edges = np.roll(corners, -1, axis=1) - corners
        squared = _dot(self._edges, self._edges)
        self._inverse = np.divide(1.0, squared, out=np.zeros_like(squared), where=squared > 0)
        normal = np.cross(self._edges[:, 0], self._edges[:, 1])
        size = np.sqrt(_dot(normal, normal))
        self._solid = size > 1e-12 * squared.max(axis=1, initial=0.0)
        self._normal = normal / np.where(self._solid, size, 1.0)[:, None]
        self._inward = np.cross(self._normal[:, None], self._edges)

    def gaps(self, point: Vector) -> tuple[Float64Array, Float64Array]:
        """Distances [m], Shape ``[T]``, and vectors from the nearest points to ``point``, ``[T, 3]``.

        The nearest point is the foot on the plane where that lies inside, else one of an edge
        (Ericson, "Real-Time Collision Detection", 2005, section 5.1.5).
        """
        ways = np.array(point) - self._corners
        t = np.clip(_dot(ways, self._edges) * self._inverse, 0.0, 1.0)
        gaps = ways - t[..., None] * self._edges
        squared = _dot(gaps, gaps)
        gap = gaps[np.arange(len(gaps)), squared.argmin(axis=1)]
        inside = self._solid & (_dot(ways, self._inward) >= 0).all(axis=1)
        height = _dot(ways[:, 0], self._normal)
        gap = np.where(inside[:, None], height[:, None] * self._normal, gap)
        return np.sqrt(_dot(gap, gap)), gap


class _Grid:
    """Numbers of triangles by horizontal cell, one cell after the other in one array."""

    def __init__(self, corners: Float64Array) -> None:
        self._low, self._high = corners.min(axis=1), corners.max(axis=1)
        self._origin = self._low[:, :2].min(axis=0)
        extent = self._high[:, :2].max(axis=0) - self._origin
        self._cell = max(_CELL, math.sqrt(float(extent[0] * extent[1]) / _MOST_CELLS), *(extent / 10_000))
        self._shape = (extent // self._cell).astype(np.int64) + 1
        first = ((self._low[:, :2] - self._origin) // self._cell).astype(np.int64)
        last = ((self._high[:, :2] - self._origin) // self._cell).astype(np.int64)
        columns, rows = (last - first + 1).T
        owners = np.repeat(np.arange(len(corners)), columns * rows)
        starts = np.cumsum(columns * rows) - columns * rows
        inside = np.arange(len(owners)) - starts[owners]
        column = first[owners, 0] + inside % columns[owners]
        row = first[owners, 1] + inside // columns[owners]
        cells = row * self._shape[0] + column
        order = np.argsort(cells, kind="stable")
        self._owners: Int64Array = owners[order].astype(np.int64)
        self._starts = np.searchsorted(cells[order], np.arange(int(self._shape.prod()) + 1))

    def find(self, point: Vector, within: float) -> Int64Array:
        """Triangles whose bounding box is ``within`` of a point along every axis, sorted."""
        low, high = np.array(point) - within, np.array(point) + within
        limits = (self._shape - 1).astype(np.float64)
        first = np.clip((low[:2] - self._origin) // self._cell, 0, limits).astype(np.int64)
        last = np.clip((high[:2] - self._origin) // self._cell, 0, limits).astype(np.int64)
        runs = [
            self._owners[self._starts[row + first[0]] : self._starts[row + last[0] + 1]]
            for row in np.arange(first[1], last[1] + 1) * self._shape[0]
        ]
        found = np.unique(np.concatenate(runs))
        inside = (self._low[found] <= high) & (self._high[found] >= low)
        near: Int64Array = found[inside.all(axis=1)]
        return near


def _dot(a: Float64Array, b: Float64Array) -> Float64Array:
    # Written out: the same order of operations on every processor.
    found: Float64Array = a[..., 0] * b[..., 0] + a[..., 1] * b[..., 1] + a[..., 2] * b[..., 2]
    return found
