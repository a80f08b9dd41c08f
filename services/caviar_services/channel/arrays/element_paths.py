"""Paths between single antenna elements, from the paths between the arrays' centres, in float64.

A path is straightened by images: the transmitter is mirrored at one plane after the other, and the
length of the path is then that of a straight line to the receiver. That holds for every antenna element
with the same planes, so each element pair's length is exact, however near the arrays are.

Two kinds of path bend at a place that no plane gives. A diffracted path goes over the point of its edge
where it is shortest (Keller 1962: incident and diffracted ray make the same angle with the edge), so
turned about the edge into one plane it is straight again. A scattered path keeps the points where it
was scattered.

A path exists for a pair of elements (`visibility`) where every segment between its points is free and
every point lies on a face, those of one plane taken together. Both are asked of the ray tracer at once: a ray
along each segment must first meet something at the segment's end, or nothing if an antenna or an edge is
there. The points where a path's lines between two arrays cross a plane lie in the convex hull of those
between the outermost elements. So where all pairs of outermost elements have a path, all have it, unless a
hole or an obstacle is smaller than the array is. Of the other paths some elements are looked at, evenly
spaced, and between them, by the same reason, all pairs where these do not agree.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from enum import IntEnum

import numpy as np

from caviar_protocol.arrays import BoolArray, Float64Array, Int64Array, UInt8Array
from caviar_protocol.space.antenna_arrays import element_positions
from caviar_protocol.topics import AntennaArray, Interaction
from caviar_services.channel.paths import Antenna
from caviar_services.channel.propagation.image_method import image_points
from caviar_space.obstacles import CLEARANCE
from caviar_space.vectors import Rows


class Bend(IntEnum):
    """Kind of point that bends a path, beside planes."""

    NONE = 0
    EDGE = 1
    POINTS = 2


@dataclass(frozen=True, eq=False)
class Surfaces(Rows):
    """Surfaces that P paths of at most D interactions meet."""

    types: UInt8Array
    """`Interaction` at each point, Shape ``[P, D]``."""
    points: Float64Array
    """Interaction points [m] of the path between the arrays' centres, Shape ``[P, D, 3]``."""
    origin: Float64Array
    """A point [m] of the plane at each interaction, Shape ``[P, D, 3]``."""
    plane: Int64Array
    """Its number among the planes of the scene, Shape ``[P, D]``."""
    normal: Float64Array
    """Its normal, of any length, Shape ``[P, D, 3]``."""
    edge: Float64Array
    """Both ends [m] of the edge that a path is diffracted at, Shape ``[P, 2, 3]``; else anything."""
    outward: Float64Array
    """Direction away from the wedge at that edge, Shape ``[P, 3]``."""
    settled: BoolArray
    """Paths that all corners of both arrays are known to have, Shape ``[P]``."""


@dataclass(frozen=True, eq=False)
class Lengths:
    """Lengths of P paths between M receiving and N transmitting elements."""

    length: Float64Array
    """[m], Shape ``[P, M, N]``."""
    spreading: Float64Array
    """What the amplitude of the wave is proportional to [1/m], Shape ``[P, M, N]``: one over the length;
    over the root of s·s'·(s + s') after an edge; over both legs after scattering. Such legs count as
    `CLEARANCE` at least, which antennas are traced with. Elements at one place send each other nothing."""


class ElementPaths:
    """Lengths and points of paths between any elements, by the affine maps that straighten the paths.

    Args:
        surfaces: What the paths between the arrays' centres meet.
    """

    def __init__(self, surfaces: Surfaces) -> None:
        self.surfaces = surfaces
        types = surfaces.types
        depth = types.shape[1]
        place = np.arange(depth)
        bends = (types == Interaction.DIFFRACTION) | (types == Interaction.SCATTERING)
        bent = bends.any(1) if depth else np.zeros(len(types), bool)
        self.first = np.where(bent, np.argmax(bends, 1) if depth else 0, depth)
        """Interaction where the planes on the transmitter's side end, Shape ``[P]``."""
        self.last = np.where(bent, depth - 1 - np.argmax(bends[:, ::-1], 1) if depth else 0, depth)
        self.bend = np.where(
            (types == Interaction.DIFFRACTION).any(1), Bend.EDGE, np.where(bent, Bend.POINTS, Bend.NONE)
        )
        mirror = types == Interaction.REFLECTION
        # A path that bends is straightened from both ends up to the bend; another one from the transmitter's
        # end alone.
        self._sent = self._map(mirror & (place < self.first[:, None]), range(depth))
        self._taken = self._map(mirror & (place > self.last[:, None]), reversed(range(depth)))
        self._straight = bool((self.bend == Bend.NONE).all())

    def _map(self, mirror: BoolArray, order: Iterable[int]) -> tuple[Float64Array, Float64Array]:
        """Linear part and offset of mirroring at planes one after the other; ``[P, 3, 3]`` and ``[P, 3]``."""
        linear = np.tile(np.eye(3), (len(mirror), 1, 1))
        offset = np.zeros((len(mirror), 3))
        for d in order:
            # Householder: I − 2nnᵀ/n², the identity where nothing is mirrored.
            normal = np.where(mirror[:, d, None], self.surfaces.normal[:, d], 0.0)
            square = (normal**2).sum(-1)
            scaled = 2 * normal / np.where(square > 0, square, 1.0)[:, None]
            height = ((offset - self.surfaces.origin[:, d]) * normal).sum(-1)
            linear = linear - scaled[:, :, None] * np.einsum("pi,pij->pj", normal, linear)[:, None]
            offset = offset - scaled * height[:, None]
        return linear, offset

    def ends(self, start: Float64Array, end: Float64Array) -> tuple[Float64Array, Float64Array]:
        """Points that straight lines along paths lead to from both ends: the image of the other end, or of
        the point that bends the path.

        Args:
            start: Centre of the transmitter of each path [m], Shape ``[P, 3]``; ``end`` that of the receiver.
            end: See ``start``.

        Returns:
            Points [m] from the transmitters and from the receivers, Shape ``[P, 3]`` each.
        """
        rows = np.arange(len(start))
        points = self.surfaces.points
        bent = (self.bend != Bend.NONE)[:, None]
        straight = np.zeros_like(self.first) if not points.shape[1] else self.first
        from_tx, from_rx = end, _mapped(self._sent, rows, start[:, None])[:, 0]
        if bent.any():
            from_tx = np.where(bent, points[rows, np.minimum(straight, points.shape[1] - 1)], end)
            last = points[rows, np.minimum(self.last, points.shape[1] - 1)]
            from_rx = np.where(bent, _unmapped(self._taken, last), from_rx)
        return _unmapped(self._sent, from_tx), from_rx

    @property
    def image_turn(self) -> Float64Array:
        """Linear part of the map from a transmitter to its image at the receiver, Shape ``[P, 3, 3]``; 0 for
        paths that bend, whose last leg begins at the bend."""
        turn: Float64Array = self._sent[0] * (self.bend == Bend.NONE)[:, None, None]
        return turn

    def lengths(self, rows: slice, transmit: Float64Array, receive: Float64Array) -> Lengths:
        """Lengths of some paths between elements.

        Args:
            rows: Of the paths.
            transmit: Transmitting elements of each path [m], Shape ``[p, N, 3]``.
            receive: Receiving elements of each path [m], Shape ``[p, M, 3]``.
        """
        sent = _mapped(self._sent, rows, transmit)
        if self._straight:
            length = _distances(receive, sent)
            return Lengths(length, _one_over(length))
        taken = _mapped(self._taken, rows, receive)
        length = _distances(taken, sent)
        spreading = _one_over(length)
        bend = self.bend[rows]
        for which, kind in ((bend == Bend.EDGE, self._over_edge), (bend == Bend.POINTS, self._by_points)):
            some = np.flatnonzero(which)
            if len(some):
                length[some], spreading[some] = kind(some + (rows.start or 0), sent[some], taken[some])
        return Lengths(length, spreading)

    def _over_edge(
        self, paths: Int64Array, sent: Float64Array, taken: Float64Array
    ) -> tuple[Float64Array, Float64Array]:
        (z, rho), (height, radius) = (self._around_edge(paths, ends) for ends in (sent, taken))
        # Turned about the edge into one plane, both ends are on opposite sides of it.
        across = radius[:, :, None] + rho[:, None]
        length = np.hypot(across, height[:, :, None] - z[:, None])
        # s and s' share the length as the distances from the edge do
        share = length / np.where(across > 0, across, 1.0)
        sent_leg = np.maximum(rho[:, None] * share, CLEARANCE)
        taken_leg = np.maximum(radius[:, :, None] * share, CLEARANCE)
        return length, 1 / np.sqrt(sent_leg * taken_leg * (sent_leg + taken_leg))

    def _around_edge(self, paths: Int64Array, ends: Float64Array) -> tuple[Float64Array, Float64Array]:
        """Place along the edge and distance from it [m] of ends ``[p, N, 3]``, each of Shape ``[p, N]``."""
        edge = self.surfaces.edge[paths]
        axis = edge[:, 1] - edge[:, 0]
        length = np.sqrt((axis**2).sum(-1))
        axis = axis / np.where(length > 0, length, 1.0)[:, None]
        away = ends - edge[:, :1]
        along = (away * axis[:, None]).sum(-1)
        radius = np.sqrt(((away - along[..., None] * axis[:, None]) ** 2).sum(-1))
        return along, radius

    def _by_points(
        self, paths: Int64Array, sent: Float64Array, taken: Float64Array
    ) -> tuple[Float64Array, Float64Array]:
        points = self.surfaces.points[paths]
        rows = np.arange(len(paths))
        first, last = self.first[paths], self.last[paths]
        steps = np.sqrt((np.diff(points, axis=1) ** 2).sum(-1))
        place = np.arange(steps.shape[1])
        inner = (place >= first[:, None]) & (place < last[:, None])
        between = np.where(inner, steps, 0.0).sum(-1)
        out = np.sqrt(((sent - points[rows, first][:, None]) ** 2).sum(-1))[:, None]
        back = np.sqrt(((taken - points[rows, last][:, None]) ** 2).sum(-1))[:, :, None]
        spreading = 1 / (np.maximum(out, CLEARANCE) * np.maximum(back, CLEARANCE))
        return out + back + between[:, None, None], spreading

    def corners(self, paths: Int64Array, start: Float64Array, end: Float64Array) -> Float64Array:
        """Interaction points of paths between single elements.

        Args:
            paths: Which paths, Shape ``[Q]``.
            start: Position of the transmitting element of each [m], Shape ``[Q, 3]``; ``end`` of the
                receiving one.
            end: See ``start``.

        Returns:
            Points [m], Shape ``[Q, D, 3]``; not finite where a path has none (a plane seen edge-on).
        """
        surfaces = self.surfaces
        types, plane = surfaces.types[paths], (surfaces.origin[paths], surfaces.normal[paths])
        found = image_points(start, end, np.where(self.bend[paths, None] == Bend.NONE, types, 0), *plane)
        bent = np.flatnonzero(self.bend[paths] != Bend.NONE)
        if len(bent):
            found[bent] = self._bent_corners(paths[bent], start[bent], end[bent])
        return found

    def _bent_corners(self, paths: Int64Array, start: Float64Array, end: Float64Array) -> Float64Array:
        surfaces = self.surfaces
        types, plane = surfaces.types[paths], (surfaces.origin[paths], surfaces.normal[paths])
        rows, place = np.arange(len(paths)), np.arange(types.shape[1])
        points = surfaces.points[paths]
        over = np.flatnonzero(self.bend[paths] == Bend.EDGE)
        if len(over):
            points[over, self.first[paths[over]]] = self._edge_points(paths[over], start[over], end[over])
        first, last = self.first[paths], self.last[paths]
        before, behind = place < first[:, None], place > last[:, None]
        sent = image_points(start, points[rows, first], np.where(before, types, 0), *plane)
        taken = image_points(points[rows, last], end, np.where(behind, types, 0), *plane)
        return np.where(before[..., None], sent, np.where(behind[..., None], taken, points))

    def _edge_points(self, paths: Int64Array, start: Float64Array, end: Float64Array) -> Float64Array:
        sent = _mapped(self._sent, paths, start[:, None])
        taken = _mapped(self._taken, paths, end[:, None])
        (z, rho), (height, radius) = (self._around_edge(paths, ends) for ends in (sent, taken))
        apart = rho + radius
        along = ((z * radius + height * rho) / np.where(apart > 0, apart, 1.0))[:, 0]
        edge = self.surfaces.edge[paths]
        axis = edge[:, 1] - edge[:, 0]
        length = np.sqrt((axis**2).sum(-1))
        point: Float64Array = edge[:, 0] + axis * (along / np.where(length > 0, length, 1.0))[:, None]
        return point


def _mapped(
    affine: tuple[Float64Array, Float64Array], rows: slice | Int64Array, points: Float64Array
) -> Float64Array:
    linear, offset = affine[0][rows], affine[1][rows]
    mapped: Float64Array = points @ linear.transpose(0, 2, 1) + offset[:, None]
    return mapped


def _unmapped(affine: tuple[Float64Array, Float64Array], points: Float64Array) -> Float64Array:
    """Points before the maps; these are reflections, so that the transpose of each is its inverse."""
    back: Float64Array = np.einsum("pij,pi->pj", affine[0], points - affine[1])
    return back


def _one_over(length: Float64Array) -> Float64Array:
    """0 for no length."""
    return np.divide(1.0, length, out=np.zeros_like(length), where=length > 0)


def _distances(receive: Float64Array, transmit: Float64Array) -> Float64Array:
    """Shape ``[p, M, N]``."""
    # Axis by axis and in place: an array of differences of three axes would leave the cache.
    square = np.zeros((len(receive), receive.shape[1], transmit.shape[1]))
    for axis in range(3):
        apart = receive[:, :, None, axis] - transmit[:, None, :, axis]
        apart *= apart
        square += apart
    return np.sqrt(square, out=square)


@dataclass(frozen=True, eq=False)
class Look:
    """Questions that a scene answers by rays."""

    nearest: Callable[[Float64Array, Float64Array], tuple[Float64Array, Int64Array]]
    """Of segments ``[Q, 3]`` → ``[Q, 3]``: how much farther than its end the first surface along each is
    [m], infinite where there is none, and the plane that it lies in, anything where there is none."""
    reflected: Callable[[Int64Array, Float64Array, Float64Array], BoolArray]
    """Whether there are paths by way of planes ``[Q, D]``, −1 past the last, between ends ``[Q, 3]``."""


# [m]; rays from face to face start this far from the first face, whose points are known to some 1e-5 m.
_OFF_SURFACE = 2e-4

# [m]; rays to and from an edge pass this far outside of it.
_OFF_EDGE = 1e-3

# [m]; a surface this near a segment's end is what stands there.
_AT_END = 1e-2

# Elements along each side of the arrays that are tested first, at most, by the number of sides with more than
# one: for four sides 5⁴ = 625 pairs instead of all.
_NODES = (1, 33, 17, 7, 5)


# Memory [bytes] that the test of one pair of elements takes, for each segment that a path can have.
_LANE_BYTES = 320

# [bytes]; more at once is no faster.
_AT_ONCE = 1 << 28


@dataclass(frozen=True, eq=False)
class Elements:
    """Elements of the antennas at one end: all of them in one array."""

    arrays: tuple[AntennaArray, ...]
    first: Int64Array
    """Where each antenna's elements begin, Shape ``[antennas]``."""
    positions: Float64Array
    """[m], Shape ``[elements of all antennas, 3]``."""

    def positions_of(self, antenna: int) -> Float64Array:
        """Positions of one antenna's elements [m], Shape ``[N, 3]``."""
        begin = int(self.first[antenna])
        return self.positions[begin : begin + self.arrays[antenna].size]


def elements(antennas: Sequence[Antenna], wavelength: float) -> Elements:
    """Elements of antennas where they stand.

    Args:
        antennas: Of uniform arrays.
        wavelength: That arrays are given in [m].
    """
    sizes = np.array([antenna.array.size for antenna in antennas], np.int64)
    first = np.cumsum(sizes) - sizes
    positions = np.empty((int(sizes.sum()), 3))
    for array, alike in _by_array(antennas).items():
        rows = first[alike][:, None] + np.arange(array.size)
        positions[rows] = _placed(wavelength * element_positions(array), [antennas[i] for i in alike])
    return Elements(arrays=tuple(a.array for a in antennas), first=first, positions=positions)


def outermost(antennas: Sequence[Antenna], wavelength: float) -> Float64Array:
    """Elements at the corners of arrays.

    Args:
        antennas: A antennas.
        wavelength: That arrays are given in [m].

    Returns:
        Positions [m], Shape ``[A, L, 3]``. L is 1 for single elements, 2 for lines and else 4, for each
        subarray of the antenna that has most.
    """
    if any(not antenna.array.is_uniform for antenna in antennas):
        most = max(len(antenna.subarrays) for antenna in antennas)
        # What is missing repeats the last one.
        parts = [(antenna.subarrays + antenna.subarrays[-1:] * most)[:most] for antenna in antennas]
        found = outermost([part for of_antenna in parts for part in of_antenna], wavelength)
        return found.reshape(len(antennas), -1, 3)
    groups = _by_array(antennas)
    rows = max((array.rows > 1 for array in groups), default=False)
    columns = max((array.columns > 1 for array in groups), default=False)
    corners = np.empty((len(antennas), (1 + rows) * (1 + columns), 3))
    for array, alike in groups.items():
        index = [
            column * array.rows + row
            for column in (0, array.columns - 1)[: 1 + columns]
            for row in (0, array.rows - 1)[: 1 + rows]
        ]
        local = wavelength * element_positions(array)[index]
        corners[alike] = _placed(local, [antennas[i] for i in alike])
    return corners


def _by_array(antennas: Sequence[Antenna]) -> dict[AntennaArray, list[int]]:
    groups: dict[AntennaArray, list[int]] = {}
    for index, antenna in enumerate(antennas):
        groups.setdefault(antenna.array, []).append(index)
    return groups


def _placed(local: Float64Array, antennas: Sequence[Antenna]) -> Float64Array:
    """Points in the axes of each antenna [m] in the world, Shape ``[A, N, 3]``."""
    rotations = np.array([antenna.rotation for antenna in antennas])
    places: Float64Array = local @ rotations.transpose(0, 2, 1)
    places += np.array([antenna.position for antenna in antennas])[:, None]
    return places


@dataclass(frozen=True, eq=False)
class Visibility:
    """Pairs of elements that P paths exist for."""

    every: BoolArray
    """Paths that all pairs have, Shape ``[P]``."""
    some: dict[int, BoolArray]
    """Of the other paths: which pairs have them, Shape ``[M, N]``, M elements at RX and N at TX; none that is
    absent."""


def visibility(
    paths: ElementPaths,
    transmitter: Int64Array,
    receiver: Int64Array,
    transmit: Elements,
    receive: Elements,
    look: Look,
    memory: int = _AT_ONCE,
) -> Visibility:
    """Pairs of elements that each path exists for.

    Args:
        paths: The paths.
        transmitter: Index of the transmitter of each path, Shape ``[P]``.
        receiver: Index of the receiver of each path, Shape ``[P]``.
        transmit: Elements of all transmitters.
        receive: Elements of all receivers.
        look: Asks the scene.
        memory: For paths that are tested together [bytes]; one path is tested in any case.
    """
    every: BoolArray = paths.surfaces.settled.copy()
    some: dict[int, BoolArray] = {}
    # Paths between arrays of one kind are tested together, as many as memory allows.
    left = np.flatnonzero(~every)
    test = _Test(paths, transmitter, receiver, transmit, receive, look)
    while len(left):
        arrays = test.arrays(left[0])
        alike = np.array([test.arrays(path) == arrays for path in left.tolist()])
        segments = paths.surfaces.types.shape[1] + 1
        of_path = arrays[0].size * arrays[1].size * segments * _LANE_BYTES
        at_once = max(1, min(memory, _AT_ONCE) // of_path)
        of_arrays = left[alike]
        for begin in range(0, len(of_arrays), at_once):
            part = of_arrays[begin : begin + at_once]
            found = test.pairs(part, *arrays)
            every[part] = found.all((1, 2))
            mixed = np.flatnonzero(found.any((1, 2)) & ~every[part])
            some.update(zip(part[mixed].tolist(), found[mixed], strict=True))
        left = left[~alike]
    return Visibility(every, some)


@dataclass(frozen=True, eq=False)
class _Axis:
    """One side of an array: elements that are tested first, and the intervals between them."""

    size: int
    nodes: Int64Array
    """Elements that are tested first, Shape ``[K]``."""
    cell: Int64Array
    """Interval between nodes that each element is in, Shape ``[size]``."""

    @classmethod
    def of(cls, size: int, most: int) -> _Axis:
        nodes = np.unique(np.linspace(0, size - 1, most).round().astype(np.int64))
        cell = np.searchsorted(nodes, np.arange(size), side="right") - 1
        return cls(size, nodes, np.minimum(cell, max(len(nodes) - 2, 0)))


@dataclass(frozen=True, eq=False)
class _Test:
    paths: ElementPaths
    transmitter: Int64Array
    receiver: Int64Array
    transmit: Elements
    receive: Elements
    look: Look

    def arrays(self, path: int) -> tuple[AntennaArray, AntennaArray]:
        """Arrays of the receiver and of the transmitter of a path."""
        return self.receive.arrays[self.receiver[path]], self.transmit.arrays[self.transmitter[path]]

    def pairs(self, paths: Int64Array, receive: AntennaArray, transmit: AntennaArray) -> BoolArray:
        """Pairs of elements for which paths between arrays of these kinds exist, Shape ``[P, M, N]``.

        Tested are some elements of each side, then all elements of the cells between them whose corners
        differ.
        """
        # Element i is row i % rows of column i // rows.
        sizes = (receive.columns, receive.rows, transmit.columns, transmit.rows)
        most = _NODES[sum(size > 1 for size in sizes)]
        axes = [_Axis.of(size, most) for size in sizes]
        nodes = np.ix_(np.arange(len(paths)), *(axis.nodes for axis in axes))
        index = np.broadcast_arrays(*nodes)
        seen = self._at(paths, sizes, [part.ravel() for part in index]).reshape(index[0].shape)
        if all(len(axis.nodes) == axis.size for axis in axes):
            return seen.reshape(len(paths), receive.size, transmit.size)
        # A cell is full or empty where all of its corners agree; the rest is mixed.
        full, any_ = seen, seen
        for number, axis in enumerate(axes, start=1):
            if len(axis.nodes) > 1:
                low, high = ((slice(None),) * number + (part,) for part in (slice(None, -1), slice(1, None)))
                full, any_ = full[low] & full[high], any_[low] | any_[high]
        cells = np.ix_(np.arange(len(paths)), *(axis.cell for axis in axes))
        found = full[cells]
        mixed = np.nonzero(any_[cells] & ~found)
        if len(mixed[0]):
            found[mixed] = self._at(paths, sizes, list(mixed))
        return found.reshape(len(paths), receive.size, transmit.size)

    def _at(self, paths: Int64Array, sizes: tuple[int, ...], index: list[Int64Array]) -> BoolArray:
        """Mask of existing paths for pairs by path, column and row at RX, and column and row at TX."""
        path = paths[index[0]]
        taken = self.receive.first[self.receiver[path]] + index[1] * sizes[1] + index[2]
        sent = self.transmit.first[self.transmitter[path]] + index[3] * sizes[3] + index[4]
        return self.exists(path, self.transmit.positions[sent], self.receive.positions[taken])

    def exists(self, path: Int64Array, start: Float64Array, end: Float64Array) -> BoolArray:
        """Test whether the paths between single positions exist, Shape ``[Q]``."""
        good = np.zeros(len(path), bool)
        types = self.paths.surfaces.types
        # Chains of reflections are asked for as candidates of the tracer are, others by their segments.
        mirrored = ((types == 0) | (types == Interaction.REFLECTION)).all(1)[path]
        for which, ask in ((mirrored, self._mirrored), (~mirrored, self._others)):
            if which.any():
                good[which] = ask(path[which], start[which], end[which])
        return good

    def _mirrored(self, path: Int64Array, start: Float64Array, end: Float64Array) -> BoolArray:
        types, planes = self.paths.surfaces.types, self.paths.surfaces.plane
        return self.look.reflected(np.where(types == 0, -1, planes)[path], start, end)

    def _others(self, path: Int64Array, start: Float64Array, end: Float64Array) -> BoolArray:
        surfaces = self.paths.surfaces
        types, normal = surfaces.types[path], surfaces.normal[path]
        points = self.paths.corners(path, start, end)
        good: BoolArray = np.isfinite(points).all((1, 2)) & _sides(
            start, points, end, types, surfaces.origin[path], normal
        )
        good &= self._on_edge(path, points)
        rows = np.flatnonzero(good)
        outward = surfaces.outward[path[rows]]
        planes = surfaces.plane[path[rows]]
        first, last, wanted, lane = _segments(
            start[rows], points[rows], end[rows], types[rows], normal[rows], outward, planes
        )
        if len(lane):
            behind, plane = self.look.nearest(first, last)
            wrong = np.where(wanted < 0, behind < -_AT_END, ~np.isfinite(behind) | (plane != wanted))
            good[rows[lane[wrong]]] = False
        return good

    def _on_edge(self, path: Int64Array, points: Float64Array) -> BoolArray:
        """Test whether the point of a diffracted path lies on its edge; true of other paths."""
        within = np.ones(len(path), bool)
        over = np.flatnonzero(self.paths.bend[path] == Bend.EDGE)
        if len(over):
            edge = self.paths.surfaces.edge[path[over]]
            axis = edge[:, 1] - edge[:, 0]
            point = points[over, self.paths.first[path[over]]]
            along = ((point - edge[:, 0]) * axis).sum(-1)
            # Beyond the end of an edge, the path that is shortest over its line does not exist.
            within[over] = (along > 0) & (along < (axis**2).sum(-1))
        return within


def _sides(
    start: Float64Array,
    points: Float64Array,
    end: Float64Array,
    types: UInt8Array,
    origin: Float64Array,
    normal: Float64Array,
) -> BoolArray:
    """Test whether paths stay on one side of what reflects them, and cross what they are transmitted
    through."""
    depth = types.shape[1]
    good = np.ones(len(types), bool)
    before = start
    for d in range(depth):
        ends_here = types[:, d + 1] == 0 if d + 1 < depth else np.ones(len(types), bool)
        behind = end if d + 1 == depth else np.where(ends_here[:, None], end, points[:, d + 1])
        sides = [((x - origin[:, d]) * normal[:, d]).sum(-1) for x in (before, behind)]
        same = sides[0] * sides[1] > 0
        kind = types[:, d]
        good &= np.where(kind == Interaction.REFLECTION, same, (kind != Interaction.TRANSMISSION) | ~same)
        before = points[:, d]
    return good


def _segments(
    start: Float64Array,
    points: Float64Array,
    end: Float64Array,
    types: UInt8Array,
    normal: Float64Array,
    outward: Float64Array,
    planes: Int64Array,
) -> tuple[Float64Array, Float64Array, Int64Array, Int64Array]:
    """All segments of Q paths: start and end of a ray along each, the plane it ends on or −1, whose it is."""
    depth = types.shape[1]
    count = (types != 0).sum(1)
    length = np.sqrt((normal**2).sum(-1, keepdims=True))
    unit = normal / np.where(length > 0, length, 1.0)
    rows = np.arange(len(types))
    before = start
    parts = []
    for d in range(depth + 1):
        ends = count == d
        arriving = np.where(ends[:, None], end, points[:, d] if d < depth else end)
        at_edge = types[:, d] == Interaction.DIFFRACTION if d < depth else np.zeros(len(rows), bool)
        target = np.where(at_edge[:, None], arriving + _OFF_EDGE * outward, arriving)
        wanted = np.where(ends | at_edge, -1, planes[:, d] if d < depth else -1)
        start_of = before
        if d:
            edge = types[:, d - 1] == Interaction.DIFFRACTION
            side = np.sign(((arriving - before) * unit[:, d - 1]).sum(-1))[:, None]
            lifted = before + _OFF_SURFACE * side * unit[:, d - 1]
            start_of = np.where(edge[:, None], before + _OFF_EDGE * outward, lifted)
            # The last ray goes from the receiver, whose position is exact; points on faces are rounded.
            back = np.where(edge[:, None], start_of, before)
            start_of, target = np.where(ends[:, None], end, start_of), np.where(ends[:, None], back, target)
            wanted = np.where(ends & ~edge, planes[:, d - 1], wanted)
        lane = rows[count >= d]
        parts.append((start_of[lane], target[lane], wanted[lane], lane))
        before = arriving
    first, last, wanted, lanes = (np.concatenate(column) for column in zip(*parts, strict=True))
    return first, last, wanted, lanes
