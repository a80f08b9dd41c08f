"""Triangles that lie in one plane: what a specular path meets is a plane of an object, not a triangle."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from caviar_protocol.arrays import BoolArray, Float64Array, Int32Array, Int64Array
from caviar_services.channel.propagation.geometry import cross
from caviar_services.channel.sionna.plane_clustering import coplanar
from caviar_services.mesh.shapes import Mesh

_OFF_PLANE = 2e-5
"""Farthest corner from the plane, as a part of the mesh's extent; float32 corners are within 1e-7."""

_ANGLE = 2e-4
"""[rad] Largest angle between the normals of a plane's triangles."""

_SAME_CORNER = 1e-6
"""Corners this near, as a part of a mesh's extent, are one."""

_RIM = 1e-3
"""[m]; a point this near a triangle is one of it."""


def plane_numbers(mesh: Mesh) -> Int32Array:
    """Number of the plane that each triangle of a mesh lies in, Shape ``[F]``.

    Planes are numbered in the order of their first triangles, so a number stays what it is while the
    mesh moves, turns and is stretched: what lies in one plane does so afterwards. Triangles need not touch:
    a path has one point in a plane at most. A triangle without area is a plane of its own.
    """
    return plane_numbers_of([mesh])[0]


def plane_numbers_of(meshes: Sequence[Mesh]) -> list[Int32Array]:
    """`plane_numbers` of each of many meshes, all at once."""
    if not meshes:
        return []
    counts = [len(mesh.faces) for mesh in meshes]
    of = np.repeat(np.arange(len(meshes)), counts)
    corners = np.concatenate([mesh.vertices[mesh.faces] for mesh in meshes])
    normal = cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = np.linalg.norm(normal, axis=1)
    flat = area > 0
    normal[flat] /= area[flat, None]
    extents = [float(np.ptp(mesh.vertices, axis=0).max()) if len(mesh.vertices) else 0.0 for mesh in meshes]
    # The largest triangle's normal is the most exact one: it defines the plane.
    order = np.argsort(-area, kind="stable")
    order = order[flat[order]]
    distance = _OFF_PLANE * np.array(extents)
    first = np.arange(len(of))
    first[order] = order[coplanar(corners[order], normal[order], of[order], distance, _ANGLE)]
    ends = np.cumsum(counts)
    return [_in_order(label) for label in np.split(first, ends[:-1])]


def _in_order(label: Int64Array) -> Int32Array:
    """Labels renumbered in the order in which they first occur."""
    _, first, inverse = np.unique(label, return_index=True, return_inverse=True)
    rank = np.empty(len(first), np.int32)
    rank[np.argsort(first)] = np.arange(len(first), dtype=np.int32)
    return rank[inverse.reshape(-1)]


def shared_planes(table: PlaneTable, count: int) -> Int64Array:
    """For each plane of a table, the number of the infinite plane that it is a part of, Shape ``[P]``.

    The first ``count`` planes, which stand still, share one where they agree to a grid of 1e-4 in the
    normal and 1 mm in the offset: the walls of a row of houses reflect as one. The others are on their own.
    """
    normal, middle = table.normal[:count], (table.low[:count].min(0) + table.high[:count].max(0)) / 2
    # One of both directions of a normal: that whose first component of some size is positive.
    leading = np.argmax(np.abs(normal) > 1e-3, axis=1)
    normal = normal * np.where(np.take_along_axis(normal, leading[:, None], 1) < 0, -1.0, 1.0)
    offset = ((table.origin[:count] - middle) * normal).sum(1)
    cells = np.round(np.column_stack([normal * 1e4, offset * 1e3])).astype(np.int64)
    flat = np.flatnonzero((normal != 0).any(1))
    label = np.arange(len(table.normal))
    _, first, inverse = np.unique(cells[flat], axis=0, return_index=True, return_inverse=True)
    label[flat] = flat[first][inverse.reshape(-1)]
    return _in_order(label).astype(np.int64)


class PlaneTable:
    """Where the planes of many meshes are: a triangle of each, and the box around all of its triangles.

    Parameters
    ----------
    numbers
        Plane of each triangle, counted through all meshes from 0, Shape ``[F]``.
    faces
        Corners of each triangle, Shape ``[F, 3]``.
    """

    def __init__(self, numbers: Int64Array, faces: Int64Array) -> None:
        self._faces = faces
        self._numbers = numbers
        self._corners = np.zeros((0, 3))
        self._order = np.argsort(numbers, kind="stable")
        count = int(numbers.max(initial=-1)) + 1
        self._begin = np.searchsorted(numbers[self._order], np.arange(count))
        self.triangle = np.zeros(count, np.int64)
        """The triangle that stands for each plane."""
        self.origin = np.zeros((count, 3))
        """A point of each plane [m]."""
        self.normal = np.zeros((count, 3))
        """Unit normal; 0 where a plane has no area."""
        self.low = np.zeros((count, 3))
        """Box around the triangles of each plane [m]."""
        self.high = np.zeros((count, 3))
        self._joined: Sequence[Int64Array] = ()

    def update(self, corners: Float64Array, planes: Int64Array | None = None) -> None:
        """Take planes, all of them where none are named, from these corners of all meshes [m], Shape
        ``[V, 3]``; the table keeps them."""
        self._corners = corners
        if planes is None:
            planes = np.arange(len(self._begin))
        if not len(planes):
            return
        order, sizes = self.triangles_of(planes)
        begin = np.cumsum(sizes) - sizes
        triangles = corners[self._faces[order]]
        a, b, c = triangles[:, 0], triangles[:, 1], triangles[:, 2]
        normal = cross(b - a, c - a)
        square = np.einsum("fc,fc->f", normal, normal)
        largest = np.maximum.reduceat(square, begin)
        hits = np.flatnonzero(square == np.repeat(largest, sizes))
        chosen = hits[np.searchsorted(hits, begin)]
        self.triangle[planes] = order[chosen]
        self.origin[planes] = a[chosen]
        length = np.sqrt(largest)[:, None]
        self.normal[planes] = normal[chosen] / np.where(length > 0, length, 1.0)
        self.low[planes] = np.minimum.reduceat(np.minimum(np.minimum(a, b), c), begin)
        self.high[planes] = np.maximum.reduceat(np.maximum(np.maximum(a, b), c), begin)

    def join(self, groups: Sequence[Int64Array]) -> None:
        """Take planes, group by group in ascending order, for one surface, until `update` is called for the
        first of each: the box of the first is around all of them."""
        self._joined = groups
        for group in groups:
            self.low[group[0]] = self.low[group].min(0)
            self.high[group[0]] = self.high[group].max(0)

    def corners_of(self, triangles: Int64Array) -> Float64Array:
        """Corners of triangles by number [m], Shape ``[N, 3, 3]``."""
        corners: Float64Array = self._corners[self._faces[triangles]]
        return corners

    def triangles_of(self, planes: Int64Array) -> tuple[Int64Array, Int64Array]:
        """Numbers of the triangles of these planes, plane after plane, and how many each has."""
        sizes = np.append(self._begin[1:], len(self._order))[planes] - self._begin[planes]
        place = np.arange(int(sizes.sum())) - np.repeat(np.cumsum(sizes) - sizes, sizes)
        return self._order[place + np.repeat(self._begin[planes], sizes)], sizes

    def first_holding(self, triangles: Int64Array, points: Float64Array) -> Int64Array:
        """For each point [m], Shape ``[N, 3]``, in one of these triangles, the first triangle of the same
        surface that holds it too.

        Where faces coincide, the floor of a house and the ground below it, or two houses' common wall, a ray
        hits whichever was looked at first, which depends on the rays beside it.
        """
        if not len(triangles):
            return triangles
        plane = self._numbers[triangles]
        begin = self._begin[plane]
        sizes = np.append(self._begin[1:], len(self._order))[plane] - begin
        hit = np.repeat(np.arange(len(triangles)), sizes)
        place = np.arange(len(hit)) - np.repeat(np.cumsum(sizes) - sizes, sizes) + begin[hit]
        candidate = self._order[place]
        held = _holds(self._corners[self._faces[candidate]], points[hit])
        first = triangles.copy()
        # Within a plane triangles are in ascending order.
        hits, where = np.unique(hit[held], return_index=True)
        first[hits] = candidate[held][where]
        for group in self._joined:
            for row in np.flatnonzero(np.isin(plane, group[1:])).tolist():
                others = np.sort(self.triangles_of(group)[0])
                others = others[others < first[row]]
                holding = others[_holds(self.corners_of(others), points[np.full(len(others), row)])]
                first[row] = holding[0] if len(holding) else first[row]
        return first


def _holds(triangles: Float64Array, points: Float64Array) -> BoolArray:
    """Whether points lie in triangles of their plane or at most `_RIM` outside, Shape ``[N]``."""
    normal = cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    length = np.linalg.norm(normal, axis=1)
    inside: BoolArray = length > 0
    normal /= np.where(inside, length, 1.0)[:, None]
    for corner in range(3):
        edge = triangles[:, (corner + 1) % 3] - triangles[:, corner]
        across = (cross(edge, points - triangles[:, corner]) * normal).sum(1)
        inside &= across >= -_RIM * np.linalg.norm(edge, axis=1)
    return inside


def two_sided_planes(mesh: Mesh, numbers: Int32Array) -> BoolArray:
    """Whether the planes of a mesh can be met from both sides, by number, Shape ``[N]``.

    From outside of a closed surface whose normals lead outwards, only front faces are met. Every side of a
    triangle then belongs to as many triangles that go along it one way as the other.
    """
    count = int(numbers.max(initial=-1)) + 1
    corners = mesh.vertices[mesh.faces]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    if float(np.einsum("fc,fc->", corners[:, 0] - corners.mean((0, 1)), normal)) <= 0 or not _is_closed(mesh):
        return np.ones(count, np.bool_)
    # Two parts of one plane may face each other's back.
    order = np.argsort(-np.einsum("fc,fc->f", normal, normal), kind="stable")
    largest = np.zeros((count, 3))
    largest[numbers[order[::-1]]] = normal[order[::-1]]
    against: Float64Array = np.einsum("fc,fc->f", normal, largest[numbers])
    two_sided = np.zeros(count, np.bool_)
    two_sided[numbers[against < 0]] = True
    return two_sided


def _is_closed(mesh: Mesh) -> bool:
    extent = float(np.ptp(mesh.vertices, axis=0).max()) if len(mesh.vertices) else 0.0
    if extent == 0:
        return False
    cells = np.round(mesh.vertices / (_SAME_CORNER * extent)).astype(np.int64)
    corner = np.unique(cells, axis=0, return_inverse=True)[1].reshape(-1)[mesh.faces]
    some = (corner != np.roll(corner, -1, axis=1)).all(1)
    sides = np.stack([corner[some], np.roll(corner[some], -1, axis=1)], axis=-1).reshape(-1, 2)
    return _counted(sides) == _counted(sides[:, ::-1])


def _counted(sides: Int64Array) -> Sequence[list[int]]:
    found, counts = np.unique(sides, axis=0, return_counts=True)
    rows: list[list[int]] = np.column_stack([found, counts]).tolist()
    return rows
