"""Edges that diffract: where faces of meshes meet, welded by position, whichever meshes they are of.

Buildings come as several meshes, walls apart from roofs, whose common borders share no vertex. So corners
are distinguished by their place, and a border that another mesh divides is divided likewise.

Around an edge, half-planes of faces divide space into sectors. Where one of these is wider than π, its two
half-planes are the faces of a wedge: that is a convex edge, whatever else ends there. A sector of 2π is that
of a single half-plane: a free edge, the rim of an open surface.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from caviar_protocol.arrays import BoolArray, Float64Array, Int64Array
from caviar_services.channel.paths import Rows
from caviar_space.vectors import ranges

# [rad]; faces that deviate less from one plane are one, as in `planes`.
_FLAT_ANGLE = 2e-4

# Sine of the angle between two pieces of an edge below which they are one edge.
_STRAIGHT = 1e-4

# Pairs of a border and a corner that are looked at together.
_AT_ONCE = 1_000_000


@dataclass(frozen=True, eq=False)
class MeshEdges:
    """E straight edges between two faces each, or of one face."""

    ends: Int64Array
    """Vertices at both ends, Shape ``[E, 2]``."""
    apexes: Int64Array
    """A vertex of each face that is not on the edge, Shape ``[E, 2]``."""
    triangles: Int64Array
    """A triangle of each face, the lower number first, twice the same at a free edge; Shape ``[E, 2]``."""
    sides: tuple[Int64Array, Int64Array]
    """Triangles that have a side on an edge, and the edges: one pair for each side, by triangle."""

    def __len__(self) -> int:
        return len(self.ends)

    @property
    def is_free(self) -> BoolArray:
        """Which edges are of one face, Shape ``[E]``."""
        free: BoolArray = self.triangles[:, 0] == self.triangles[:, 1]
        return free

    def renumbered(self, triangles: Int64Array) -> MeshEdges:
        """The same, with other numbers of the triangles.

        Args:
            triangles: The number of each, which ascend, Shape ``[F]``.
        """
        sides = triangles[self.sides[0]], self.sides[1]
        return replace(self, triangles=triangles[self.triangles], sides=sides)

    def shifted(self, vertices: int, triangles: int) -> MeshEdges:
        """The same, with higher numbers.

        Args:
            vertices, triangles: By how much the numbers of vertices and triangles are higher.
        """
        return MeshEdges(
            self.ends + vertices,
            self.apexes + vertices,
            self.triangles + triangles,
            (self.sides[0] + triangles, self.sides[1]),
        )

    @classmethod
    def joined(cls, parts: Sequence[MeshEdges]) -> MeshEdges:
        """All of these, part by part.

        Args:
            parts: One at least; each has higher numbers of triangles than the one before.
        """
        before = np.cumsum([0, *(len(part) for part in parts[:-1])])
        return cls(
            np.concatenate([part.ends for part in parts]),
            np.concatenate([part.apexes for part in parts]),
            np.concatenate([part.triangles for part in parts]),
            (
                np.concatenate([part.sides[0] for part in parts]),
                np.concatenate([part.sides[1] + n for part, n in zip(parts, before, strict=True)]),
            ),
        )


def mesh_edges(
    vertices: Float64Array, faces: Int64Array, face_of: Int64Array, tolerance: float, free: bool
) -> MeshEdges:
    """Find the straight edges of triangles.

    Args:
        vertices: [m], Shape ``[V, 3]``.
        faces: Vertices of each triangle, Shape ``[F, 3]``.
        face_of: Number of the plane face that each triangle is a part of, Shape ``[F]``.
        tolerance: [m]; vertices that are nearer to each other are at one place.
        free: Whether free edges are wanted too.

    Example:
        >>> from caviar_space.planes import plane_numbers
        >>> from caviar_space.meshes import unit_box
        >>> mesh = unit_box()
        >>> faces, planes = mesh.faces.astype(int), plane_numbers(mesh).astype(int)
        >>> edges = mesh_edges(mesh.vertices, faces, planes, 1e-6, free=False)
        >>> len(edges)
        12
    """
    wide = np.flatnonzero(_widths(vertices[faces]) > tolerance)
    if not len(wide):
        none = np.zeros((0, 2), np.int64)
        return MeshEdges(none, none, none, (none[:, 0], none[:, 0]))
    place, at = _welded(vertices, tolerance)
    sides = _divided(_sides(place[faces], wide), vertices[at], tolerance)
    pieces = _pieces(sides, vertices[at], vertices[faces], face_of, tolerance)
    if not free:
        pieces = pieces.take(pieces.faces[:, 0] != pieces.faces[:, 1])
    run = _runs(pieces, vertices[at], face_of[sides.triangle])
    return _joined(pieces, run, sides, at, vertices, faces)


@dataclass(frozen=True, eq=False)
class _Sides(Rows):
    """Sides of triangles, or parts of them, between two places; the lower number comes first."""

    ends: Int64Array
    """Shape ``[S, 2]``."""
    triangle: Int64Array
    """Shape ``[S]``."""
    apex: Int64Array
    """Corner of the triangle that is not on the side, 0 to 2, Shape ``[S]``."""


@dataclass(frozen=True, eq=False)
class _Pieces:
    """Pieces of edges, each between two places."""

    ends: Int64Array
    """Shape ``[W, 2]``."""
    faces: Int64Array
    """A side on each of both faces, twice the same where there is one face, Shape ``[W, 2]``."""
    of_side: Int64Array
    """Piece that each side is on, −1 for none, Shape ``[S]``."""

    def take(self, which: BoolArray) -> _Pieces:
        number = np.append(np.where(which, np.cumsum(which) - 1, -1), -1)
        return _Pieces(self.ends[which], self.faces[which], number[self.of_side])


def _welded(vertices: Float64Array, tolerance: float) -> tuple[Int64Array, Int64Array]:
    """Number of the place of each vertex, Shape ``[V]``, and a vertex at each place."""
    from scipy.spatial import cKDTree  # type: ignore[import-untyped]

    exact, place = np.unique(vertices, axis=0, return_inverse=True)
    pairs = cKDTree(exact).query_pairs(tolerance, output_type="ndarray")
    cluster = _connected(pairs, len(exact))
    _, at, place = np.unique(cluster[place.reshape(-1)], return_index=True, return_inverse=True)
    return place.reshape(-1), at


def _connected(pairs: Int64Array, count: int) -> Int64Array:
    """Number of the component that each of ``count`` nodes is in, with links between pairs ``[N, 2]``."""
    from scipy.sparse import coo_array  # type: ignore[import-untyped]
    from scipy.sparse.csgraph import connected_components  # type: ignore[import-untyped]

    links = coo_array((np.ones(len(pairs)), tuple(pairs.T)), shape=(count, count))
    number: Int64Array = connected_components(links, directed=False)[1].astype(np.int64)
    return number


def _widths(corners: Float64Array) -> Float64Array:
    """Least height of triangles [m]; of what is narrower than places are, neighbours are each other's."""
    sides = np.roll(corners, -1, axis=1) - corners
    double = np.sqrt((np.cross(sides[:, 0], sides[:, 1]) ** 2).sum(1))
    longest = np.sqrt((sides**2).sum(2).max(1))
    width: Float64Array = double / np.where(longest > 0, longest, 1.0)
    return width


def _sides(corners: Int64Array, triangles: Int64Array) -> _Sides:
    """All sides of these triangles; ``corners`` are the places of all, Shape ``[F, 3]``."""
    of_all = np.stack([corners, np.roll(corners, -1, axis=1)], axis=-1)
    ends = np.sort(of_all[triangles], axis=-1).reshape(-1, 2)
    return _Sides(ends, np.repeat(triangles, 3), np.tile([2, 0, 1], len(triangles)))


def _divided(sides: _Sides, at: Float64Array, tolerance: float) -> _Sides:
    """Sides at which only one triangle is, divided where such a side of another ends on them."""
    _, which, counts = np.unique(sides.ends, axis=0, return_inverse=True, return_counts=True)
    alone = np.flatnonzero(counts[which.reshape(-1)] == 1)
    corners = np.unique(sides.ends[alone])
    side, corner, along = _on(at[sides.ends[alone]], at[corners], tolerance)
    if not len(side):
        return sides
    cut = np.unique(alone[side])
    # From end to end of each side by way of the corners on it.
    owner = np.concatenate([cut, alone[side], cut])
    stop = np.concatenate([sides.ends[cut, 0], corners[corner], sides.ends[cut, 1]])
    reached = np.concatenate([np.full(len(cut), -1.0), along, np.full(len(cut), np.inf)])
    order = np.lexsort((reached, owner))
    owner, stop = owner[order], stop[order]
    within = owner[1:] == owner[:-1]
    ends = np.sort(np.stack([stop[:-1], stop[1:]], axis=-1)[within], axis=-1)
    whole, parts = sides.take(np.delete(np.arange(len(sides.triangle)), cut)), sides.take(owner[:-1][within])
    return _Sides.joined([whole, replace(parts, ends=ends)])


def _on(
    sides: Float64Array, corners: Float64Array, tolerance: float
) -> tuple[Int64Array, Int64Array, Float64Array]:
    """Side and corner of each pair of which the corner is on the side, and how far along [m].

    Args:
        sides, corners: [m], Shapes ``[S, 2, 3]`` and ``[C, 3]``.
    """
    low, high = sides.min(1) - tolerance, sides.max(1) + tolerance
    order = np.argsort(corners, axis=0, kind="stable")
    first, behind = (
        np.stack(
            [np.searchsorted(corners[order[:, axis], axis], ends[:, axis]) for axis in range(3)], axis=-1
        )
        for ends in (low, high)
    )
    fewest = np.argmin(behind - first, axis=1)  # the axis along which fewest corners are beside a side
    found = [(np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros(0))]
    for axis in range(3):
        rows = np.flatnonzero(fewest == axis)
        begin, sizes = first[rows, axis], (behind - first)[rows, axis]
        batch = np.cumsum(sizes) // _AT_ONCE
        for some in np.split(np.arange(len(rows)), np.flatnonzero(np.diff(batch)) + 1):
            own, place = ranges(begin[some], sizes[some])
            side, corner = rows[some][own], order[place, axis]
            near = ((corners[corner] >= low[side]) & (corners[corner] <= high[side])).all(1)
            side, corner = side[near], corner[near]
            line, offset = sides[side, 1] - sides[side, 0], corners[corner] - sides[side, 0]
            length = np.sqrt((line**2).sum(1))
            along = (offset * line).sum(1) / length
            off = np.sqrt(((offset - (along / length)[:, None] * line) ** 2).sum(1))
            on = (off <= tolerance) & (along > tolerance) & (along < length - tolerance)
            found.append((side[on], corner[on], along[on]))
    side, corner, along = (np.concatenate(column) for column in zip(*found, strict=True))
    return side, corner, along


def _pieces(
    sides: _Sides, at: Float64Array, corners: Float64Array, face_of: Int64Array, tolerance: float
) -> _Pieces:
    """Pieces of edges, around which a sector is wider than π; ``corners`` are those of triangles."""
    ends, piece = np.unique(sides.ends, axis=0, return_inverse=True)
    piece = piece.reshape(-1)
    line = at[ends[:, 1]] - at[ends[:, 0]]
    line /= np.sqrt((line**2).sum(1, keepdims=True))
    apex = corners[sides.triangle, sides.apex] - at[sides.ends[:, 0]]
    inward = apex - (apex * line[piece]).sum(1, keepdims=True) * line[piece]
    height = np.sqrt((inward**2).sum(1))
    order = np.argsort(piece, kind="stable")
    first = order[np.searchsorted(piece[order], np.arange(len(ends)))]
    x, y = inward[first], np.cross(line, inward[first])
    angle = np.arctan2((inward * y[piece]).sum(1), (inward * x[piece]).sum(1)) % (2 * np.pi)
    # Half-planes in their order around the edge, and the sector from each to the next.
    order = np.lexsort((sides.triangle, angle, piece))
    begins = np.searchsorted(piece[order], np.arange(len(ends)))
    last = np.append(begins[1:], len(order)) - 1
    following = np.arange(1, len(order) + 1)
    following[last] = begins
    sector = angle[order[following]] - angle[order]
    sector[last] += 2 * np.pi
    widest = _first_largest(sector, begins)
    wide = sector[widest]
    faces = np.stack([order[widest], order[following[widest]]], axis=-1)
    least = height[faces].min(1)
    slack = np.maximum(_FLAT_ANGLE, tolerance / least)
    same = face_of[sides.triangle[faces[:, 0]]] == face_of[sides.triangle[faces[:, 1]]]
    is_single = wide > 2 * np.pi - slack
    faces[is_single, 1] = faces[is_single, 0]
    kept = is_single | (~same & (wide > np.pi + slack))
    faces = np.take_along_axis(faces, np.argsort(sides.triangle[faces], axis=1, kind="stable"), axis=1)
    return _Pieces(ends, faces, piece).take(kept)


def _first_largest(values: Float64Array, begins: Int64Array) -> Int64Array:
    """Index of the first largest value of each run that begins at one of these indices."""
    largest = np.maximum.reduceat(values, begins) if len(begins) else values
    hits = np.flatnonzero(values == np.repeat(largest, np.diff(np.append(begins, len(values)))))
    return hits[np.searchsorted(hits, begins)]


def _runs(pieces: _Pieces, at: Float64Array, face_of_side: Int64Array) -> Int64Array:
    """Number of the edge that each piece is a part of: pieces of the same faces, one after the other."""
    count = len(pieces.ends)
    _, pair = np.unique(np.sort(face_of_side[pieces.faces], axis=1), axis=0, return_inverse=True)
    piece, place = np.tile(np.arange(count), 2), pieces.ends.T.reshape(-1)
    onward = at[pieces.ends[:, ::-1].T.reshape(-1)] - at[place]
    onward /= np.sqrt((onward**2).sum(1, keepdims=True))
    pair = np.tile(pair.reshape(-1), 2)
    order = np.lexsort((piece, place, pair))
    one, other = order[:-1], order[1:]
    straight = (pair[one] == pair[other]) & (place[one] == place[other])
    straight &= ((onward[one] + onward[other]) ** 2).sum(1) < _STRAIGHT**2
    return _connected(np.column_stack([piece[one[straight]], piece[other[straight]]]), count)


def _joined(
    pieces: _Pieces,
    run: Int64Array,
    sides: _Sides,
    at: Int64Array,
    vertices: Float64Array,
    faces: Int64Array,
) -> MeshEdges:
    """Edges of pieces, in the order of their triangles."""
    count = int(run.max(initial=-1)) + 1
    order = np.lexsort((*sides.triangle[pieces.faces].T[::-1], run))
    first = order[np.searchsorted(run[order], np.arange(count))]
    # The ends of an edge are those of its pieces that are farthest apart.
    line = vertices[at[pieces.ends[first, 1]]] - vertices[at[pieces.ends[first, 0]]]
    place, of = pieces.ends.T.reshape(-1), np.tile(run, 2)
    along = (vertices[at[place]] * line[of]).sum(1)
    order = np.lexsort((along, of))
    bounds = np.searchsorted(of[order], np.arange(count + 1))
    ends = np.stack([place[order[bounds[:-1]]], place[order[bounds[1:] - 1]]], axis=-1)
    face = pieces.faces[first]
    triangles = sides.triangle[face]
    rank = np.lexsort((*ends.T, *triangles.T[::-1]))
    number = np.empty(count, np.int64)
    number[rank] = np.arange(count)
    on = np.flatnonzero(pieces.of_side >= 0)
    pairs = np.unique(np.stack([sides.triangle[on], number[run[pieces.of_side[on]]]], axis=-1), axis=0)
    return MeshEdges(
        ends=at[ends[rank]],
        apexes=faces[triangles, sides.apex[face]][rank],
        triangles=triangles[rank],
        sides=(pairs[:, 0], pairs[:, 1]),
    )
