"""Obstacles: triangles that a ball in flight must not touch, surfaces near antennas, boxes on lines of sight.

`Obstacles` says where a ball may go between triangles. These lie in the cells of a horizontal grid; those
around the ball are kept until it has gone some way, so that a step looks at few of them, and in free flight
at none.

`Surfaces` keeps antennas off triangles: a ray tracer in float32 drops segments below 1 cm (Sionna RT) and
lets rays leak through what is nearer than some millimetres, so that an antenna on a roof would see its line
of sight or not by rounding, and never the reflection. An antenna nearer than `CLEARANCE` to a surface is
traced from that far off it, on its own side; exactly on it, from the outside.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from caviar_protocol.arrays import BoolArray, Float64Array, Int64Array
from caviar_protocol.space.coordinates import Vector, rotation_matrix
from caviar_protocol.topics import Scene
from caviar_space.vectors import cross

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


@dataclass(frozen=True, eq=False)
class Boxes:
    """N boxes of any orientation.

    Example:
        >>> Boxes.aligned([((10, -1, 0), (12, 1, 3))]).centre.tolist()
        [[11.0, 0.0, 1.5]]
    """

    names: tuple[str, ...]
    centre: Float64Array
    """[m], Shape ``[N, 3]``."""
    rotation: Float64Array
    """Turns a box's axes into world axes, Shape ``[N, 3, 3]``."""
    half: Float64Array
    """Half of each edge [m], Shape ``[N, 3]``."""

    @classmethod
    def aligned(cls, corners: Sequence[tuple[Sequence[float], Sequence[float]]]) -> Boxes:
        """Boxes along the world's axes from their lowest and highest corners [m]."""
        low = np.array([low for low, _ in corners], np.float64).reshape(-1, 3)
        high = np.array([high for _, high in corners], np.float64).reshape(-1, 3)
        turned = np.broadcast_to(np.eye(3), (len(low), 3, 3))
        return cls(("",) * len(low), (low + high) / 2, turned, (high - low) / 2)

    @classmethod
    def of(cls, scene: Scene) -> Boxes:
        """The bounding boxes of a scene's objects."""
        turned = [rotation_matrix(q) for q in scene.orientation.tolist()]
        rotation = np.array(turned, np.float64).reshape(-1, 3, 3)
        return cls(scene.names, scene.position, rotation, scene.dimensions / 2)

    def block(self, start: Float64Array, end: Float64Array) -> BoolArray:
        """Test whether each segment passes through each box; Shapes ``[Q, 3]``, ``[Q, 3]`` to ``[Q, N]``.

        A segment that only touches a face or an edge is not blocked. By slabs (Kay and Kajiya 1986).

        Example:
            >>> boxes = Boxes.aligned([((10, -1, 0), (12, 1, 3))])
            >>> start, end = np.zeros((2, 3)), np.array([[20.0, 0.0, 2.0], [20.0, 0.0, 9.0]])
            >>> boxes.block(start, end).tolist()
            [[True], [False]]
        """
        # Shape [Q, N, 3], in the axes of each box
        origin = np.einsum("qni,nij->qnj", start[:, None] - self.centre, self.rotation)
        along = np.einsum("qi,nij->qnj", end - start, self.rotation)
        outside = (along == 0) & (np.abs(origin) >= self.half)
        with np.errstate(divide="ignore", invalid="ignore"):
            one, other = (-self.half - origin) / along, (self.half - origin) / along
        near = np.where(along == 0, -np.inf, np.minimum(one, other)).max(-1)
        far = np.where(along == 0, np.inf, np.maximum(one, other)).min(-1)
        blocked: BoolArray = (np.maximum(near, 0) < np.minimum(far, 1)) & ~outside.any(-1)
        return blocked


CLEARANCE = 0.02
"""[m] from a surface that an antenna is traced from at least."""


# [m]; nearer to a surface, rounding of the position decides which side an antenna is on.
_ON_SURFACE = 1e-6


# [m] beyond the edges of a triangle that still are at it.
_MARGIN = 1e-3


RISING_RAYS = 6


_RISES = np.radians(np.linspace(10.0, 85.0, RISING_RAYS))


_TURNS = 1.0 + 2.4 * np.arange(RISING_RAYS)


# Directions of the rays of `Surfaces.above`: upwards, from shallow to steep, each of another azimuth.
_RISING = np.stack([np.cos(_TURNS), np.sin(_TURNS), np.tan(_RISES)], axis=-1)


class Surfaces:
    """Triangles of a scene: which are near a point, on a segment, above a point.

    Args:
        triangles: Corners [m], Shape ``[F, 3, 3]``.
        outside: From the number of a triangle and its unit normal: whether the normal points outside.
    """

    def __init__(self, triangles: Float64Array, outside: Callable[[int, Float64Array], bool]) -> None:
        self._triangles = triangles.copy()
        self._outside = outside
        self._low, self._high = np.moveaxis(_boxes(self._triangles), -1, 0)

    def move(self, rows: Int64Array, triangles: Float64Array) -> None:
        """Replace the triangles of these numbers, Shape ``[N]``, by others [m], Shape ``[N, 3, 3]``."""
        self._triangles[rows] = triangles
        boxes = _boxes(triangles)
        self._low[:, rows], self._high[:, rows] = boxes[..., 0], boxes[..., 1]

    def near(self, positions: Float64Array) -> BoolArray:
        """Test whether boxes around triangles are within `CLEARANCE` of points [m], Shape ``[N, 3]``: only
        these `cleared` may move."""
        low, high = self._low - CLEARANCE, self._high + CLEARANCE
        point, index = np.nonzero((low[0] <= positions[:, :1]) & (high[0] >= positions[:, :1]))
        for axis in (1, 2):
            along = positions[point, axis]
            kept = (low[axis, index] <= along) & (high[axis, index] >= along)
            point, index = point[kept], index[kept]
        near = np.zeros(len(positions), np.bool_)
        near[point] = True
        return near

    def cleared(self, position: Float64Array) -> Float64Array:
        """A position [m], Shape ``[3]``, moved to `CLEARANCE` from surfaces that it is nearer to."""
        for index in self._within(position, position, CLEARANCE).tolist():
            corners = self._triangles[index]
            normal = np.cross(corners[1] - corners[0], corners[2] - corners[0])
            norm = float(np.linalg.norm(normal))
            if norm == 0:
                continue
            normal = normal / norm
            height = float((position - corners[0]) @ normal)
            if abs(height) >= CLEARANCE or not _covers(corners, normal, position - height * normal):
                continue
            side = np.sign(height)
            if abs(height) < _ON_SURFACE:
                side = 1.0 if self._outside(index, normal) else -1.0
            position = position + (side * CLEARANCE - height) * normal
        return position

    def between(self, start: Float64Array, end: Float64Array) -> bool:
        """Test whether a triangle stands on the segment between two points [m], its ends left out.

        Example:
            >>> wall = np.array([[[5.0, -9.0, 0.0], [5.0, 9.0, 0.0], [5.0, 0.0, 9.0]]])
            >>> surfaces = Surfaces(wall, outside=lambda number, normal: True)
            >>> surfaces.between(np.zeros(3), np.array([10.0, 0.0, 2.0]))
            True
        """
        line = end - start
        for index in self._within(np.minimum(start, end), np.maximum(start, end), 0.0).tolist():
            corners = self._triangles[index]
            normal = np.cross(corners[1] - corners[0], corners[2] - corners[0])
            across = float(line @ normal)
            if across == 0:  # the segment is parallel to the triangle
                continue
            along = float((corners[0] - start) @ normal) / across
            unit = normal / np.linalg.norm(normal)
            if 0 < along < 1 and _covers(corners, unit, start + along * line):
                return True
        return False

    def met_between(self, start: Float64Array, end: Float64Array) -> Int64Array:
        """Triangles on the segment between two points [m], nearest first, without a margin at their
        borders."""
        near = self._within(np.minimum(start, end), np.maximum(start, end), 0.0)
        behind = set(_met(self._triangles[near], end, end - start).tolist())
        met = [row for row in _met(self._triangles[near], start, end - start).tolist() if row not in behind]
        return near[np.array(met, np.int64)]

    def above(self, position: Float64Array) -> Iterator[Int64Array]:
        """Triangles that each of some rising rays from a point [m], Shape ``[3]``, meets, nearest first."""
        height = max(float(self._high[2].max(initial=position[2]) - position[2]), 0.0)
        for direction in _RISING:
            end = position + height / direction[2] * direction
            near = self._within(np.minimum(position, end), np.maximum(position, end), _MARGIN)
            yield near[_met(self._triangles[near], position, direction)]

    def encloses(self, position: Float64Array) -> bool:
        """Test whether a point [m], Shape ``[3]``, is inside of closed surfaces, which may lack a floor.

        All rising rays but one cross them an odd number of times then.
        """
        # A ray may graze an edge and be counted wrong: one dissenting ray is allowed.
        even = 0
        for met in self.above(position):
            even += len(met) % 2 == 0
            if even > 1:
                return False
        return True

    def _within(self, low: Float64Array, high: Float64Array, reach: float) -> Int64Array:
        """Triangles whose bounding box meets a box."""
        # Axis by axis, so that later comparisons see few triangles.
        found = np.flatnonzero((self._low[0] <= high[0] + reach) & (self._high[0] >= low[0] - reach))
        for axis in (1, 2):
            below = self._low[axis, found] <= high[axis] + reach
            found = found[below & (self._high[axis, found] >= low[axis] - reach)]
        return found


def _boxes(triangles: Float64Array) -> Float64Array:
    """Lowest and highest corners, Shape ``[3, F, 2]``."""
    a, b, c = triangles[:, 0].T, triangles[:, 1].T, triangles[:, 2].T
    low, high = np.minimum(np.minimum(a, b), c), np.maximum(np.maximum(a, b), c)
    return np.stack([low, high], axis=-1)


def _met(triangles: Float64Array, origin: Float64Array, direction: Float64Array) -> Int64Array:
    """Rows of the triangles, Shape ``[F, 3, 3]``, that a ray meets, nearest first (Möller and Trumbore,
    "Fast, minimum storage ray/triangle intersection", 1997)."""
    first = triangles[:, 1] - triangles[:, 0]
    second = triangles[:, 2] - triangles[:, 0]
    across = cross(np.broadcast_to(direction, second.shape), second)
    volume = (first * across).sum(1)
    inverse = np.divide(1.0, volume, out=np.zeros_like(volume), where=volume != 0)
    offset = origin - triangles[:, 0]
    u = (offset * across).sum(1) * inverse
    turned = cross(offset, first)
    v = (turned @ direction) * inverse
    along = (second * turned).sum(1) * inverse
    met = np.flatnonzero((volume != 0) & (u >= 0) & (v >= 0) & (u + v <= 1) & (along > 0))
    nearest: Int64Array = met[np.argsort(along[met], kind="stable")]
    return nearest


def _covers(corners: Float64Array, normal: Float64Array, foot: Float64Array) -> bool:
    """Test whether a point of its plane lies within a triangle."""
    for i in range(3):
        edge = corners[(i + 1) % 3] - corners[i]
        length = float(np.linalg.norm(edge))
        if length > 0 and float(np.cross(normal, edge / length) @ (foot - corners[i])) < -_MARGIN:
            return False
    return True
