"""Which pairs of antenna elements a path exists for.

A path exists for a pair of elements where every segment between its points is free and every point lies
on a face, those of one plane taken together. Both are asked of the ray tracer at once: a ray along each
segment must first meet something at the segment's end, or nothing if an antenna or an edge is there.

The points where a path's lines between two arrays cross a plane lie in the convex hull of those between
the outermost elements. So where all pairs of outermost elements have a path, all have it, unless a
hole or an obstacle is smaller than the array is; and where none of a part of the pairs' outermost
ones has it, none in that part. Only what is mixed is divided further, down to single elements.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from caviar_protocol.arrays import BoolArray, Float64Array, Int64Array, UInt8Array
from caviar_protocol.topics import AntennaArray, Interaction
from caviar_services.channel.element_paths import Bend, ElementPaths

Nearest = Callable[[Float64Array, Float64Array], Float64Array]
"""Distances [m] to the first surface along rays of origins ``[Q, 3]`` and unit directions ``[Q, 3]``;
infinite where there is none."""

_OFF_SURFACE = 1e-3
"""[m]; rays start and end this far from faces and edges, which are known to some 1e-5 m."""

_AT_END = 1e-2
"""[m]; a surface this near a segment's end is what stands there."""

_SHORTEST = 1e-6
"""[m]; shorter segments are not tested."""


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


@dataclass(frozen=True, eq=False)
class Visibility:
    """Pairs of elements that P paths exist for."""

    every: BoolArray
    """Paths that all pairs have, Shape ``[P]``."""
    some: dict[int, BoolArray]
    """Of paths that some pairs have: which, Shape ``[M, N]``, M receiving and N transmitting elements.
    A path in neither exists for no pair."""


def visibility(
    paths: ElementPaths,
    transmitter: Int64Array,
    receiver: Int64Array,
    transmit: Elements,
    receive: Elements,
    nearest: Nearest,
) -> Visibility:
    """Of all paths, which run between antennas ``transmitter`` and ``receiver``, Shape ``[P]`` each."""
    test = _Test(paths, transmitter, receiver, transmit, receive, nearest)
    count = len(transmitter)
    whole = np.zeros((count, 4, 2), np.int64)
    for side, (which, elements) in enumerate(((transmitter, transmit), (receiver, receive))):
        ends = np.array([(array.rows - 1, array.columns - 1) for array in elements.arrays]).reshape(-1, 2)
        whole[:, 2 * side : 2 * side + 2, 1] = ends[which]
    cells, owner = whole, np.arange(count)
    every: BoolArray = np.zeros(count, bool)
    some: dict[int, BoolArray] = {}
    while len(cells):
        seen = test.corners(cells, owner)
        full: BoolArray = seen.all(1)
        mixed: BoolArray = seen.any(1) & ~full
        if cells is whole:
            every = full
            some = {p: test.empty(p) for p in np.flatnonzero(mixed).tolist()}
        else:
            for cell, path in zip(cells[full].tolist(), owner[full].tolist(), strict=True):
                _fill(some[path], cell, transmit.arrays[transmitter[path]], receive.arrays[receiver[path]])
        cells, owner = _halves(cells[mixed], owner[mixed])
    return Visibility(every, some)


def _halves(cells: Int64Array, owner: Int64Array) -> tuple[Int64Array, Int64Array]:
    """Each cell cut in two across its longest side."""
    longest = np.argmax(cells[:, :, 1] - cells[:, :, 0], axis=1)
    rows = np.arange(len(cells))
    middle = cells[rows, longest].sum(1) // 2
    low, high = cells.copy(), cells.copy()
    low[rows, longest, 1] = middle
    high[rows, longest, 0] = middle + 1
    return np.concatenate([low, high]), np.concatenate([owner, owner])


def _fill(pairs: BoolArray, cell: list[list[int]], transmit: AntennaArray, receive: AntennaArray) -> None:
    """Set the pairs of a cell; element ``i`` is row ``i % rows`` of column ``i // rows``."""
    grid = pairs.reshape(receive.columns, receive.rows, transmit.columns, transmit.rows)
    tx_row, tx_column, rx_row, rx_column = (slice(low, high + 1) for low, high in cell)
    grid[rx_column, rx_row, tx_column, tx_row] = True


@dataclass(frozen=True, eq=False)
class _Test:
    paths: ElementPaths
    transmitter: Int64Array
    receiver: Int64Array
    transmit: Elements
    receive: Elements
    nearest: Nearest

    def empty(self, path: int) -> BoolArray:
        sizes = (
            self.receive.arrays[self.receiver[path]].size,
            self.transmit.arrays[self.transmitter[path]].size,
        )
        return np.zeros(sizes, bool)

    def corners(self, cells: Int64Array, owner: Int64Array) -> BoolArray:
        """Whether the pairs of outermost elements of cells have their path, Shape ``[cells, 16]``."""
        corner = np.array(list(np.ndindex(2, 2, 2, 2)))
        index = np.where(corner == 0, cells[:, None, :, 0], cells[:, None, :, 1])
        tx, rx = self.transmitter[owner, None], self.receiver[owner, None]
        sent = self.transmit.first[tx] + index[..., 1] * _rows(self.transmit)[tx] + index[..., 0]
        taken = self.receive.first[rx] + index[..., 3] * _rows(self.receive)[rx] + index[..., 2]
        # Lines and points have fewer than four corners at an end: the same pair is asked once.
        sizes = len(self.transmit.positions), len(self.receive.positions)
        key = (owner[:, None] * sizes[0] + sent) * sizes[1] + taken
        keys, place = np.unique(key, return_inverse=True)
        lane, element = np.divmod(keys, sizes[1])
        path, source = np.divmod(lane, sizes[0])
        exists = self.exists(path, self.transmit.positions[source], self.receive.positions[element])
        return exists[place].reshape(key.shape)

    def exists(self, path: Int64Array, start: Float64Array, end: Float64Array) -> BoolArray:
        """Whether the paths between single positions exist, Shape ``[Q]``."""
        surfaces = self.paths.surfaces
        types, normal = surfaces.types[path], surfaces.normal[path]
        points = self.paths.corners(path, start, end)
        good: BoolArray = np.isfinite(points).all((1, 2)) & _sides(
            start, points, end, types, surfaces.origin[path], normal
        )
        good &= self._on_edge(path, points)
        rows = np.flatnonzero(good)
        outward = surfaces.outward[path[rows]]
        first, last, solid, lane = _segments(
            start[rows], points[rows], end[rows], types[rows], normal[rows], outward
        )
        along = last - first
        length = np.sqrt((along**2).sum(-1))
        real = length > _SHORTEST
        first, along, length, solid, lane = (x[real] for x in (first, along, length, solid, lane))
        if len(lane):
            met = self.nearest(first, along / length[:, None])
            wrong = (met < length - _AT_END) | (solid & (met > length + _AT_END))
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
            within[over] = (along > 0) & (along < (axis**2).sum(-1))
        return within


def _rows(elements: Elements) -> Int64Array:
    return np.array([array.rows for array in elements.arrays], np.int64)


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
) -> tuple[Float64Array, Float64Array, BoolArray, Int64Array]:
    """All segments of Q paths: start and end of a ray along each, whether it ends on a face, whose it is."""
    depth = types.shape[1]
    count = (types != 0).sum(1)
    length = np.sqrt((normal**2).sum(-1, keepdims=True))
    unit = normal / np.where(length > 0, length, 1.0)
    rows = np.arange(len(types))
    before, lifted = start, start
    parts = []
    for d in range(depth + 1):
        lane = rows[count >= d]
        arriving = np.where((count == d)[:, None], end, points[:, d] if d < depth else end)
        at_edge = types[:, d] == Interaction.DIFFRACTION if d < depth else np.zeros(len(rows), bool)
        inner = (count > d) & ~at_edge
        target = np.where(at_edge[:, None], arriving + _OFF_SURFACE * outward, arriving)
        if d:  # leave a face on the side that the segment runs to
            side = np.sign(((arriving - before) * unit[:, d - 1]).sum(-1))
            edge = types[:, d - 1] == Interaction.DIFFRACTION
            lift = np.where(edge[:, None], outward, side[:, None] * unit[:, d - 1])
            lifted = before + _OFF_SURFACE * lift
        parts.append((lifted[lane], target[lane], inner[lane], lane))
        before = arriving
    first, last, solid, lanes = (np.concatenate(column) for column in zip(*parts, strict=True))
    return first, last, solid, lanes
