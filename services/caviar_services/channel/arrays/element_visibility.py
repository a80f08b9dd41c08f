"""Which pairs of antenna elements a path exists for.

A path exists for a pair of elements where every segment between its points is free and every point lies
on a face, those of one plane taken together. Both are asked of the ray tracer at once: a ray along each
segment must first meet something at the segment's end, or nothing if an antenna or an edge is there.

The points where a path's lines between two arrays cross a plane lie in the convex hull of those between
the outermost elements. So where all pairs of outermost elements have a path, all have it, unless a
hole or an obstacle is smaller than the array is. Of the other paths some elements are looked at, evenly
spaced, and between them, by the same reason, all pairs where these do not agree.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from caviar_protocol.arrays import BoolArray, Float64Array, Int64Array, UInt8Array
from caviar_protocol.space.antenna_arrays import element_positions
from caviar_protocol.topics import AntennaArray, Interaction
from caviar_services.channel.arrays.element_paths import Bend, ElementPaths
from caviar_services.channel.paths import Antenna


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

    def of(self, antenna: int) -> Float64Array:
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
        """Of the receiver and of the transmitter of a path."""
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
        """Whether paths exist for pairs by path, column and row at RX, and column and row at TX."""
        path = paths[index[0]]
        taken = self.receive.first[self.receiver[path]] + index[1] * sizes[1] + index[2]
        sent = self.transmit.first[self.transmitter[path]] + index[3] * sizes[3] + index[4]
        return self.exists(path, self.transmit.positions[sent], self.receive.positions[taken])

    def exists(self, path: Int64Array, start: Float64Array, end: Float64Array) -> BoolArray:
        """Whether the paths between single positions exist, Shape ``[Q]``."""
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
        """Whether the point of a diffracted path lies on its edge; true of other paths."""
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
    """Whether paths stay on one side of what reflects them, and cross what they are transmitted through."""
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
