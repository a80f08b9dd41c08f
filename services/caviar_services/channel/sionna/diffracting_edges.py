"""Edges that diffract: where faces of meshes meet, welded by position, and how rays of a launch meet them.

Sionna RT looks for edges within the mesh that a ray has hit, by vertices that faces of this mesh share. Here
they are those of `mesh_edges`: of scenery as one surface, whose meshes may share none, and of each body.

With a range (`EdgeRange`), edges out of it cost nothing: where none is in range, rays are launched without
diffraction.

Buildings come as several meshes, walls apart from roofs, whose common borders share no vertex. So corners
are distinguished by their place, and a border that another mesh divides is divided likewise. Around an edge,
half-planes of faces divide space into sectors. Where one of these is wider than π, its two half-planes are
the faces of a wedge: that is a convex edge, whatever else ends there. A sector of 2π is that of a single
half-plane: a free edge, the rim of an open surface.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from operator import itemgetter
from typing import Any

import numpy as np

from caviar_protocol.arrays import BoolArray, Float64Array, Int32Array, Int64Array
from caviar_protocol.topics import Interaction
from caviar_services.channel.paths import PathTable
from caviar_services.channel.propagation.utd import Wedges, wedges_of
from caviar_services.channel.sionna import dr, mi
from caviar_services.channel.sionna.triangle_numbering import NumberedTriangles
from caviar_services.drjit_setup import aligned_columns, aligned_indices
from caviar_space.meshes import Mesh
from caviar_space.vectors import Rows, ranges

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
        """Mask of edges of one face, Shape ``[E]``."""
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
        """Edges of all parts, part by part.

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
    pieces: _Pieces, run: Int64Array, sides: _Sides, at: Int64Array, vertices: Float64Array, faces: Int64Array
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


# [m]; corners of scenery that are nearer to each other are one.
_SAME_PLACE = 1e-3

# The same for bodies, as a part of their extent.
_SAME_IN_BODY = 1e-6

# Part of the rays that are diffracted where they could be; Sionna RT's is 0.2, so that most are left for
# reflections, for which there are other rays here.
_DIFFRACTED = 0.5

# [m] by which edges are longer for the ray tracer: what runs over their very ends is decided in float64.
_BEYOND = 2e-3


class SceneEdges:
    """All edges of a scene: first those of scenery, then those of each body.

    Args:
        scene: Whose edges.
        bodies: Unit meshes of the bodies, by asset.
        free: Whether the rims of open surfaces are edges.
    """

    def __init__(self, scene: NumberedTriangles, bodies: Mapping[str, Mesh], free: bool) -> None:
        self._scene = scene
        self._edges = _of_all_pieces(scene, bodies, free)
        owner = scene.piece_of(self._edges.triangles[:, 0])
        self.number: Int32Array = (np.arange(len(self)) - np.searchsorted(owner, owner)).astype(np.int32)
        """Of each edge within the object that its first face is of, the same in every frame."""
        self._moving = int(np.searchsorted(owner, scene.first_body_piece))
        self._piece = owner[self._moving :]
        self._on_device: tuple[int, DeviceEdges] | None = None

    def __len__(self) -> int:
        return len(self._edges)

    @property
    def triangles(self) -> Int64Array:
        """A triangle of each face of each edge, Shape ``[E, 2]``."""
        return self._edges.triangles

    @property
    def all_ends(self) -> Float64Array:
        """`ends` of all edges, Shape ``[E, 2, 3]``; those of bodies that stand for nothing have no length."""
        return self._scene.vertices[self._edges.ends]

    @property
    def of_bodies(self) -> tuple[Int64Array, Int64Array]:
        """Numbers of the edges of bodies, in ascending order, and of the piece that each is of."""
        edges = np.arange(self._moving, len(self))
        return edges, self._piece

    def ends(self, edges: Int64Array) -> Float64Array:
        """Both ends of edges as they stand [m], Shape ``[N, 2, 3]``; 0 for −1.

        Args:
            edges: Numbers, Shape ``[N]``.
        """
        return self._corners(self._edges.ends, edges)

    def faces(self, edges: Int64Array) -> tuple[Wedges, BoolArray]:
        """Faces of edges as they stand, and which edges have any: those of bodies that stand for nothing
        have none.

        Args:
            edges: Numbers, Shape ``[N]``.
        """
        return wedges_of(self.ends(edges), self._corners(self._edges.apexes, edges))

    def outward(self, edges: Int64Array) -> Float64Array:
        """Unit vectors between the normals of both faces, Shape ``[N, 3]``; 0 at free edges and for −1.

        Args:
            edges: Numbers, Shape ``[N]``.
        """
        outward, some = np.zeros((len(edges), 3)), np.flatnonzero(edges >= 0)
        between = self.faces(edges[some])[0].normals.sum(1)
        length = np.sqrt((between**2).sum(-1, keepdims=True))
        free = self._edges.is_free[edges[some], None]
        outward[some] = np.where(free, 0.0, between / np.where(length > 0, length, 1.0))
        return outward

    def _corners(self, vertices: Int64Array, edges: Int64Array) -> Float64Array:
        found, some = np.zeros((len(edges), 2, 3)), edges >= 0
        found[some] = self._scene.vertices[vertices[edges[some]]]
        return found

    @property
    def on_device(self) -> DeviceEdges:
        """The edges as they stand, in the ray tracer's arrays."""
        version = self._scene.version
        if self._on_device is None:
            made = DeviceEdges(self._edges, self._rows(0), self._scene)
        elif self._on_device[0] != version:
            made = self._on_device[1]
            # Edges of scenery stand, and stay as they were uploaded.
            made.move(self._moving, self._rows(self._moving))
        else:
            return self._on_device[1]
        self._on_device = version, made
        return made

    def _rows(self, first: int) -> Float64Array:
        """Origin, direction, length and both normals of edges from this one on, Shape ``[13, N]``; 0 where
        an edge has no faces."""
        edges = np.arange(first, len(self))
        faces, is_edge = self.faces(edges)
        ends = self.ends(edges) - self._scene.centre
        along = ((ends[:, 1] - ends[:, 0]) * faces.edge).sum(1, keepdims=True)
        origin = np.where(along < 0, ends[:, 1], ends[:, 0]) - _BEYOND * faces.edge
        normals = np.moveaxis(faces.normals, 1, 0)
        columns = np.concatenate([origin, faces.edge, np.abs(along) + 2 * _BEYOND, *normals], axis=1)
        return np.where(is_edge, columns.T, 0.0)


def _of_all_pieces(scene: NumberedTriangles, bodies: Mapping[str, Mesh], free: bool) -> MeshEdges:
    piece = scene.piece_of(np.arange(len(scene.triangle_vertices)))
    still = np.flatnonzero(piece < scene.first_body_piece)
    of_scenery = mesh_edges(
        scene.vertices,
        scene.triangle_vertices[still].astype(np.int64),
        scene.part_of[still],
        _SAME_PLACE,
        free,
    )
    of_bodies: list[tuple[int, MeshEdges]] = []
    for asset, mesh in bodies.items():
        tolerance = _SAME_IN_BODY * float(np.ptp(mesh.vertices, axis=0).max(initial=0.0))
        numbers = scene.face_numbers(asset).astype(np.int64)
        of_body = mesh_edges(mesh.vertices, mesh.faces.astype(np.int64), numbers, tolerance, free)
        of_bodies += [
            (body, of_body.shifted(*scene.begin_of(scene.first_body_piece + body)))
            for body in scene.bodies_of(asset).tolist()
        ]
    of_bodies.sort(key=itemgetter(0))
    parts = [of_scenery.renumbered(still), *(edges for _, edges in of_bodies)]
    return MeshEdges.joined(parts)


class DeviceEdges:
    """Edges in the ray tracer's arrays; `number` of them is in `WedgeGeometry.local_edge`.

    Args:
        edges: Whose triangles are numbered through all shapes.
        rows: See `SceneEdges`.
        scene: Of the triangles.
    """

    def __init__(self, edges: MeshEdges, rows: Float64Array, scene: NumberedTriangles) -> None:
        triangle, edge = edges.sides
        bounds = np.searchsorted(triangle, np.arange(len(scene.triangle_vertices) + 1))
        self._shape = mi.UInt(aligned_indices(scene.offset_by_shape))
        self._first, self._count = (mi.UInt(aligned_indices(c)) for c in (bounds[:-1], np.diff(bounds)))
        self._edge = mi.UInt(aligned_indices(edge))
        self._triangles = [mi.UInt(aligned_indices(column)) for column in edges.triangles.T]
        shapes, _ = scene.shapes_of(edges.triangles)
        self._one_shape = mi.UInt(aligned_indices(shapes[:, 0] == shapes[:, 1]))
        self._rows = rows
        self._take_rows()

    def move(self, first: int, rows: Float64Array) -> None:
        """Put the edges from one on elsewhere.

        Args:
            first: Number of that edge.
            rows: As for the class, of these edges.
        """
        self._rows[:, first:] = rows
        self._take_rows()

    def _take_rows(self) -> None:
        columns = [mi.Float(column) for column in aligned_columns(self._rows)]
        self._origin, self._along = mi.Point3f(*columns[:3]), mi.Vector3f(*columns[3:6])
        self._length = columns[6]
        self._normals = mi.Normal3f(*columns[7:10]), mi.Normal3f(*columns[10:])

    def drawn(self, hit: Any, came_from: Any, sample: Any, active: Any) -> tuple[Any, Any, Any]:
        """Edge drawn among those of the triangles that rays hit, where rays came from outside of its wedge.

        Args:
            hit: `mitsuba.SurfaceInteraction3f`.
            came_from: `mitsuba.Point3f` [m].
            sample: `mitsuba.Float` from 0 to 1, to draw by.
            active: `mitsuba.Bool`.

        Returns:

        Whether there is one; the ray tracer's `WedgeGeometry`, its first face that which is lit more
        steeply; and its point nearest to where the ray hit.
        """
        from sionna.rt.constants import EPSILON_FLOAT
        from sionna.rt.utils import WedgeGeometry

        shape = dr.gather(mi.UInt, self._shape, mi.UInt(dr.reinterpret_array(mi.UInt, hit.shape)), active)
        count = dr.gather(mi.UInt, self._count, shape + hit.prim_index, active)
        active &= count > 0
        place = dr.minimum(mi.UInt(sample * mi.Float(count)), dr.maximum(count, 1) - 1)
        place += dr.gather(mi.UInt, self._first, shape + hit.prim_index, active)
        number = dr.gather(mi.UInt, self._edge, place, active)
        origin = dr.gather(mi.Point3f, self._origin, number, active)
        along = dr.gather(mi.Vector3f, self._along, number, active)
        length = dr.gather(mi.Float, self._length, number, active)
        one, other = (dr.gather(mi.Normal3f, normal, number, active) for normal in self._normals)
        point = origin + dr.clip(dr.dot(hit.p - origin, along), 0.0, length) * along
        back = came_from - point
        active &= length > 0.0
        active &= (dr.dot(back, one) > EPSILON_FLOAT) | (dr.dot(back, other) > EPSILON_FLOAT)
        offset = [dr.gather(mi.UInt, face, number, active) - shape for face in self._triangles]
        wedge = WedgeGeometry(mi.MeshPtr(hit.shape), *offset, number, origin, along, length, one, other)
        wedge.swap_faces(dr.dot(back, other) > dr.dot(back, one))
        # Where the shape that was hit has but one of both faces: the triangle that was hit, and another. The
        # ray tracer takes two triangles that are one for a free edge.
        apart = dr.gather(mi.UInt, self._one_shape, number, active) == 0
        wedge.prim0 = dr.select(apart, hit.prim_index, wedge.prim0)
        wedge.primn = dr.select(apart, hit.prim_index + 1, wedge.primn)
        return active, wedge, point


def edge_generator(edges: SceneEdges) -> Any:
    """Make a `SBCandidateGenerator` of Sionna RT whose rays are diffracted at these edges.

    Args:
        edges: Of the scene.
    """
    from sionna.rt.constants import InteractionType
    from sionna.rt.path_solvers.sb_candidate_generator import SBCandidateGenerator

    class EdgeGenerator(SBCandidateGenerator):  # type: ignore[misc]
        def _sample_diffraction_point(
            self,
            si: Any,
            loc_en_inter: Any,
            ray_origin: Any,
            ki_world: Any,
            sample2: Any,
            edge_diffraction: bool,
            active: Any,
        ) -> tuple[Any, Any, Any, Any]:
            found, wedge, point = edges.on_device.drawn(si, ray_origin, sample2.x, active)
            only = loc_en_inter == InteractionType.DIFFRACTION
            part = dr.select(only, 1.0, _DIFFRACTED)
            diffracted = found & (sample2.y < part)
            probability = dr.select(found, dr.select(diffracted, part, 1.0 - part), 1.0)
            return diffracted, probability, point, wedge

    return EdgeGenerator()


@dataclass(frozen=True, eq=False)
class EdgeRange:
    """Edges of a scene, as it stands, that are within a distance of one end of a path at least."""

    edges: SceneEdges | None
    """Of the scene; None: it has none."""
    within_m: float
    """How far they may be."""

    def reaches(self, places: Float64Array) -> bool:
        """Test whether any edge is in range of any of these places.

        Args:
            places: [m], Shape ``[N, 3]``.
        """
        if self.edges is None:
            return False
        edges = self.edges.all_ends
        begin, along = edges[:, 0], edges[:, 1] - edges[:, 0]
        square = (along**2).sum(-1)
        begin, along, square = begin[square > 0], along[square > 0], square[square > 0]
        for place in places:
            share = np.clip(((place - begin) * along).sum(-1) / square, 0.0, 1.0)
            nearest = begin + share[:, None] * along - place
            if ((nearest**2).sum(-1) <= self.within_m**2).any():
                return True
        return False

    def within(self, table: PathTable, start: Float64Array, end: Float64Array) -> BoolArray:
        """Mask of paths with no edge out of range of both ends, Shape ``[P]``.

        Args:
            table: The paths.
            start, end: Their ends [m], Shape ``[P, 3]``.
        """
        bent = table.types == Interaction.DIFFRACTION
        near = np.zeros(bent.shape, np.bool_)
        for place in (start, end):
            near |= ((table.points - place[:, None]) ** 2).sum(-1) <= self.within_m**2
        kept: BoolArray = (near | ~bent).all(1)
        return kept
