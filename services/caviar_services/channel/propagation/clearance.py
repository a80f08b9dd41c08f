"""Antennas at surfaces and next to each other, where a ray tracer in float32 sees nothing.

Sionna RT drops segments below 1 cm and lets rays leak through what is nearer than some millimetres: an
antenna on a roof would see its line of sight or not by rounding, and never the reflection. So an
antenna nearer than `CLEARANCE` to a surface is traced from that far off it, on its own side; exactly on
it, from the outside. Points, lengths and directions are then those of its true position.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from caviar_protocol.arrays import BoolArray, Complex128Array, Float64Array, Int64Array
from caviar_protocol.space.coordinates import rotation_matrix
from caviar_protocol.topics import Scene
from caviar_services.channel.paths import Antenna, PathTable


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
        """Whether each segment passes through each box; Shapes ``[Q, 3]``, ``[Q, 3]`` to ``[Q, N]``.

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

NEAR_PAIR = 0.05
"""[m]; pairs nearer than this have their line of sight by formula, not from the ray tracer."""

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
        """Whether a triangle stands on the segment between two points [m], its ends left out.

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
        """Whether a point [m], Shape ``[3]``, is inside of closed surfaces, which may lack a floor.

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
    boxes: Float64Array = np.stack([triangles.min(1).T, triangles.max(1).T], axis=-1)
    return boxes


def _met(triangles: Float64Array, origin: Float64Array, direction: Float64Array) -> Int64Array:
    """Rows of the triangles, Shape ``[F, 3, 3]``, that a ray meets, nearest first (Möller and Trumbore,
    "Fast, minimum storage ray/triangle intersection", 1997)."""
    first = triangles[:, 1] - triangles[:, 0]
    second = triangles[:, 2] - triangles[:, 0]
    across = np.cross(direction, second)
    volume = (first * across).sum(1)
    inverse = np.divide(1.0, volume, out=np.zeros_like(volume), where=volume != 0)
    offset = origin - triangles[:, 0]
    u = (offset * across).sum(1) * inverse
    turned = np.cross(offset, first)
    v = (turned @ direction) * inverse
    along = (second * turned).sum(1) * inverse
    met = np.flatnonzero((volume != 0) & (u >= 0) & (v >= 0) & (u + v <= 1) & (along > 0))
    nearest: Int64Array = met[np.argsort(along[met], kind="stable")]
    return nearest


def _covers(corners: Float64Array, normal: Float64Array, foot: Float64Array) -> bool:
    """Whether a point of its plane lies within a triangle."""
    for i in range(3):
        edge = corners[(i + 1) % 3] - corners[i]
        length = float(np.linalg.norm(edge))
        if length > 0 and float(np.cross(normal, edge / length) @ (foot - corners[i])) < -_MARGIN:
            return False
    return True


def spread_anew(
    transfer: Complex128Array, specular: BoolArray, traced: Float64Array, length: Float64Array
) -> Complex128Array:
    """Dyads of paths that were traced with one length and have another.

    Args:
        transfer: As traced, Shape ``[C, P, 3, 3]``.
        specular: Paths of reflections and transmissions, whose field falls as one over the length, ``[P]``.
        traced: Length as traced [m], Shape ``[P]``.
        length: Length of the path [m], Shape ``[P]``.

    Example:
        >>> dyads = np.ones((1, 1, 3, 3), np.complex128)
        >>> spread_anew(dyads, np.array([True]), np.array([10.0]), np.array([20.0]))[0, 0, 0, 0]
        np.complex128(0.5+0j)
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        factor = np.where(specular & (length > 0), traced / length, 1.0)
    scaled: Complex128Array = transfer * factor[None, :, None, None]
    return scaled


def with_near_pairs(
    table: PathTable,
    los: BoolArray,
    transmitters: Sequence[Antenna],
    receivers: Sequence[Antenna],
    wavelengths: Float64Array,
    surfaces: Surfaces,
) -> tuple[PathTable, int]:
    """Paths with the lines of sight of near pairs by formula.

    A pair closer than one wavelength of a carrier is outside of the far field in which λ/(4πd) holds, and has
    no direct path; paths by way of surfaces stay.

    Args:
        table: Paths of all pairs.
        los: Whether the line of sight of each pair is free, Shape ``[T·R]``; corrected in place.
        transmitters: T antennas.
        receivers: R antennas.
        wavelengths: Of the carriers [m], Shape ``[C]``.
        surfaces: Of the scene.

    Returns:
        The paths, and the number of pairs that are too close for a direct one.
    """
    start = np.array([antenna.position for antenna in transmitters]).reshape(-1, 1, 3)
    end = np.array([antenna.position for antenna in receivers]).reshape(1, -1, 3)
    distance = np.sqrt(((end - start) ** 2).sum(-1)).reshape(-1)
    near = np.flatnonzero(distance < max(NEAR_PAIR, wavelengths.max()))
    tx, rx = np.divmod(near, max(len(receivers), 1))
    other = [transmitters[t].name != receivers[r].name for t, r in zip(tx.tolist(), rx.tolist(), strict=True)]
    near, tx, rx = near[other], tx[other], rx[other]
    if not len(near):
        return table, 0
    los[near] = [
        not surfaces.between(transmitters[t].position, receivers[r].position)
        for t, r in zip(tx.tolist(), rx.tolist(), strict=True)
    ]
    far = distance[near] >= wavelengths.max()
    straight = (table.types == 0).all(1)
    free = los[near]
    if table.hidden is not None:  # elements beside the centres may see each other where these do not
        free |= np.isin(near, table.pair[straight & table.hidden])
    table = table.take(~(straight & np.isin(table.pair, near)))
    direct = near[far & free]
    made = with_direct(table, direct, ~los[direct], distance[direct], wavelengths)
    return made, int(np.count_nonzero(~far))


def with_direct(
    table: PathTable, pairs: Int64Array, hidden: BoolArray, distance: Float64Array, wavelengths: Float64Array
) -> PathTable:
    """Paths with a direct one for each of N more pairs.

    Args:
        table: Paths.
        pairs: Numbers of the pairs, Shape ``[N]``.
        hidden: Whether only elements beside the centres have the direct path, Shape ``[N]``.
        distance: Of each pair [m], Shape ``[N]``.
        wavelengths: Of the carriers [m], Shape ``[C]``.
    """
    depth = table.types.shape[1]
    spreading = wavelengths[:, None] / (4 * np.pi * distance)
    made = spreading[:, :, None, None] * np.eye(3, dtype=np.complex128)
    empty = np.zeros((len(pairs), depth), np.uint8)
    return replace(
        table,
        pair=np.concatenate([table.pair, pairs]),
        transfer=np.concatenate([table.transfer, made], axis=1),
        types=np.concatenate([table.types, empty]),
        objects=np.concatenate([table.objects, np.full((len(pairs), depth), -1, np.int32)]),
        points=np.concatenate([table.points, np.zeros((len(pairs), depth, 3))]),
        hidden=None if table.hidden is None else np.concatenate([table.hidden, hidden]),
        traced=None if table.traced is None else np.concatenate([table.traced, np.full(len(pairs), -1)]),
        faces=None if table.faces is None else np.concatenate([table.faces, empty.astype(np.int32)]),
    )
