"""Detail of the traced scenery: small and far pieces are left out, the rest is made of fewer triangles.

Reflections come from planes, and few of a city's planes matter to a street: what detail costs in accuracy
depends on the scene, so measure it (``tests/bench/bench_detail.py``), notes list what is left out.

Decimation moves a corner onto a neighbour, which takes two triangles with it. The error of a move is the
largest distance from the neighbour to any plane that the corner has stood for (R. Ronfard, J. Rossignac,
"Full-range approximation of triangulated polyhedra", Computer Graphics Forum 15, 1996); planes are handed
on, so errors do not add up. Corners that stay do not move: a wall of which none was taken away keeps its
plane to the bit, which matters more for reflections than an even error.
"""

from __future__ import annotations

import heapq
import math
from collections import Counter, defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, TypeAlias

import msgspec
import numpy as np

from caviar_protocol.arrays import Float64Array, Int64Array, quantity
from caviar_protocol.space.coordinates import Vector, dot
from caviar_space.meshes import Mesh

# Unit normal and offset: a point p is n·p + d off.
_Plane: TypeAlias = tuple[float, float, float, float]
_Corners: TypeAlias = tuple[int, int, int]

LARGEST_TOLERANCE = 1 / 16
"""Of `with_few_faces`, in sides of the box."""

# Cosine of the largest turn of a triangle's normal by one move: it is not turned inside out.
_TURN = 0.2


def welded(mesh: Mesh) -> Mesh:
    """Weld the vertices that are at exactly one place.

    Args:
        mesh: Any.

    Returns:
        The mesh with one vertex for each place, faces in their order; faces that lose a side by it, and
        vertices of no face, are gone.

    Example:
        >>> corners = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
        >>> len(welded(Mesh(corners, np.array([[0, 1, 2], [3, 4, 5]], np.int32))).vertices)
        4
    """
    vertices, inverse = np.unique(mesh.vertices, axis=0, return_inverse=True)
    return _used(Mesh(vertices, inverse.reshape(-1)[mesh.faces].astype(np.int32)))


def decimated(mesh: Mesh, tolerance_m: float) -> Mesh:
    """Leave out vertices that lie nearly in the planes of their neighbours.

    Each vertex taken away lies in planes no farther than the tolerance from the one that stands for it.
    Rims keep their course within the same tolerance. The result depends on nothing but the mesh.

    Args:
        mesh: Any.
        tolerance_m: [m].

    Returns:
        A mesh of fewer triangles, a subset of the vertices, welded.

    Example:
        >>> from caviar_space.meshes import unit_box
        >>> len(decimated(unit_box(), 0.1).faces)
        12
    """
    mesh = welded(mesh)
    return _used(_Decimation(mesh, tolerance_m).run())


def with_few_faces(mesh: Mesh, most: int) -> tuple[Mesh, float]:
    """Decimate a unit mesh by the least tolerance that leaves few enough faces: 1/2048, 1/1024, … of its box.

    Args:
        mesh: Within −½ … ½ on every axis.
        most: Faces.

    Returns:
        The mesh, and the tolerance in sides of its box: 0 where it has as few already, at most
        `LARGEST_TOLERANCE`, which may leave more faces.

    Example:
        >>> from caviar_space.meshes import unit_box
        >>> with_few_faces(unit_box(), 12)[1]
        0.0
    """
    if len(mesh.faces) <= most:
        return mesh, 0.0
    tolerance = 1 / 2048
    while len((found := decimated(mesh, tolerance)).faces) > most and tolerance < LARGEST_TOLERANCE:
        tolerance *= 2
    return found, tolerance


def _used(mesh: Mesh) -> Mesh:
    """Without faces of fewer than three corners and without vertices of no face."""
    a, b, c = mesh.faces.T
    faces = mesh.faces[(a != b) & (b != c) & (c != a)]
    used: Int64Array = np.unique(faces)
    number = np.zeros(len(mesh.vertices), np.int32)
    number[used] = np.arange(len(used), dtype=np.int32)
    return Mesh(mesh.vertices[used], number[faces])


class _Decimation:
    """The moves of one mesh, cheapest first."""

    def __init__(self, mesh: Mesh, tolerance: float) -> None:
        self._mesh = mesh
        self._tolerance = tolerance
        self._points: list[Vector] = [(x, y, z) for x, y, z in mesh.vertices.tolist()]
        self._faces: dict[int, _Corners] = {i: (a, b, c) for i, (a, b, c) in enumerate(mesh.faces.tolist())}
        self._of_vertex: dict[int, set[int]] = defaultdict(set)
        for number, corners in self._faces.items():
            for corner in corners:
                self._of_vertex[corner].add(number)
        self._planes = self._all_planes()

    def run(self) -> Mesh:
        """Move until every further move would be off by more than the tolerance."""
        heap: list[tuple[float, int, int]] = []
        for vertex in self._of_vertex:
            self._push(heap, vertex)
        while heap:
            error, vertex, onto = heapq.heappop(heap)
            # Entries of vertices that are gone stay in the heap: they are recognised when their turn comes.
            if vertex not in self._of_vertex or onto not in self._neighbours(vertex):
                continue
            now = self._error(vertex, onto)
            if now > error:  # planes were handed on since
                self._offer(heap, vertex, onto)
                continue
            if self._may_move(vertex, onto):
                self._move(vertex, onto)
                self._push(heap, onto)
                for neighbour in self._neighbours(onto):
                    self._offer(heap, neighbour, onto)
        # In the order of before: numbers of planes go by the order of triangles.
        faces = np.array([self._faces[i] for i in sorted(self._faces)], np.int32).reshape(-1, 3)
        return Mesh(self._mesh.vertices, faces)

    def _push(self, heap: list[tuple[float, int, int]], vertex: int) -> None:
        """Offer all moves of a vertex that are near enough."""
        for onto in self._neighbours(vertex):
            self._offer(heap, vertex, onto)

    def _offer(self, heap: list[tuple[float, int, int]], vertex: int, onto: int) -> None:
        error = self._error(vertex, onto)
        if error <= self._tolerance:
            heapq.heappush(heap, (error, vertex, onto))

    def _neighbours(self, vertex: int) -> set[int]:
        found = {corner for face in self._of_vertex[vertex] for corner in self._faces[face]}
        found.discard(vertex)
        return found

    def _error(self, vertex: int, onto: int) -> float:
        x, y, z = self._points[onto]
        return max((abs(a * x + b * y + c * z + d) for a, b, c, d in self._planes[vertex]), default=0.0)

    def _may_move(self, vertex: int, onto: int) -> bool:
        """Test whether the surface stays one: no triangle turns over, and no third surface is joined on."""
        shared = self._of_vertex[vertex] & self._of_vertex[onto]
        tips = {corner for face in shared for corner in self._faces[face]} - {vertex, onto}
        # The link condition (H. Edelsbrunner, "Geometry and Topology for Mesh Generation", 2001, 4.3).
        if self._neighbours(vertex) & self._neighbours(onto) != tips or len(shared) > 2:
            return False
        standing = set()
        for face in self._of_vertex[vertex] - shared:
            before = self._faces[face]
            a, b, c = (onto if corner == vertex else corner for corner in before)
            old, new = self._normal(before), self._normal((a, b, c))
            if old is not None and (new is None or dot(old, new) < _TURN):
                return False
            standing.add(frozenset((a, b, c)))
        others = {frozenset(self._faces[face]) for face in self._of_vertex[onto] - shared}
        return not standing & others

    def _move(self, vertex: int, onto: int) -> None:
        for face in self._of_vertex.pop(vertex):
            a, b, c = (onto if corner == vertex else corner for corner in self._faces[face])
            if a == b or b == c or c == a:
                for corner in {a, b, c}:
                    self._of_vertex[corner].discard(face)
                del self._faces[face]
            else:
                self._faces[face] = (a, b, c)
                self._of_vertex[onto].add(face)
        self._planes[onto] |= self._planes.pop(vertex)

    def _all_planes(self) -> dict[int, set[_Plane]]:
        """Planes of each vertex: those of its faces, and across them along rims."""
        planes: dict[int, set[_Plane]] = {vertex: set() for vertex in self._of_vertex}
        sides: dict[tuple[int, int], list[int]] = defaultdict(list)
        for number, (a, b, c) in self._faces.items():
            normal = self._normal((a, b, c))
            if normal is not None:
                plane = self._through(normal, a)
                for corner in (a, b, c):
                    planes[corner].add(plane)
            for start, end in ((a, b), (b, c), (c, a)):
                sides[min(start, end), max(start, end)].append(number)
        for (start, end), faces in sides.items():
            normal = self._normal(self._faces[faces[0]])
            if len(faces) == 2 or normal is None:
                continue
            # At a rim, the plane across the face keeps the rim in its course.
            across = _unit(_cross(normal, _minus(self._points[end], self._points[start])))
            if across is not None:
                for corner in (start, end):
                    planes[corner].add(self._through(across, start))
        return planes

    def _through(self, normal: Vector, vertex: int) -> _Plane:
        # Rounded: triangles of one wall share one plane, of which a vertex has to be held to but one.
        a, b, c = (round(part, 9) for part in normal)
        return a, b, c, -round(dot(normal, self._points[vertex]), 6)

    def _normal(self, corners: _Corners) -> Vector | None:
        a, b, c = (self._points[corner] for corner in corners)
        return _unit(_cross(_minus(b, a), _minus(c, a)))


def _minus(a: Vector, b: Vector) -> Vector:
    return a[0] - b[0], a[1] - b[1], a[2] - b[2]


def _cross(a: Vector, b: Vector) -> Vector:
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


def _unit(vector: Vector) -> Vector | None:
    length = math.sqrt(dot(vector, vector))
    return (vector[0] / length, vector[1] / length, vector[2] / length) if length > 1e-12 else None


class DetailSettings(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Parts of the scenery that the channel leaves out; a key that is not given leaves nothing out.

    A piece is what hangs together by common corners within one named shape.
    """

    smallest_m: Annotated[float, quantity("m", "diagonal of the box around a piece at least", ge=0)] = 0.0
    centre_m: Annotated[tuple[float, float] | None, quantity("m", "x and y that radius_m is around")] = None
    radius_m: Annotated[
        float | None, quantity("m", "horizontal distance of the box around a piece at most")
    ] = None
    tolerance_m: Annotated[
        float, quantity("m", "distance between the surface and that of fewer triangles at most", ge=0)
    ] = 0.0

    def __post_init__(self) -> None:
        if (self.centre_m is None) != (self.radius_m is None):
            raise ValueError(
                "centre_m and radius_m go together; write both, for example centre_m = [0.0, 0.0] and "
                "radius_m = 300.0, or neither"
            )
        if self.radius_m is not None and self.radius_m < 0:
            raise ValueError(f"radius_m is {self.radius_m}; it must be at least 0")

    @property
    def is_full(self) -> bool:
        """True if nothing is left out."""
        return self.smallest_m == 0 and self.radius_m is None and self.tolerance_m == 0


@dataclass(frozen=True, kw_only=True)
class DetailEffect:
    """Effect of detail on the scenery."""

    triangles: tuple[int, int]
    """Before and after."""
    pieces: int
    """Before."""
    small: int
    """Pieces left out because they are smaller than ``smallest_m``."""
    far: int
    """Pieces left out because they are farther than ``radius_m``."""
    area_share: float
    """Part of the surface's area [m²] that is left."""

    @property
    def brief(self) -> str:
        """For products: what is left, empty for all of it."""
        before, after = self.triangles
        return f"{after} of {before} triangles, {self.area_share:.1%} of the area" if after < before else ""

    @property
    def note(self) -> str:
        """For the user, in one line."""
        if not self.brief:
            return "detail is switched off: no piece of the scenery is small or far, and no triangle is spare"
        return (
            f"mesh detail: {self.brief}; of {self.pieces} pieces {self.small} are left out as small and "
            f"{self.far} as far"
        )


def detailed(
    shapes: Sequence[tuple[str, Mesh]], settings: DetailSettings
) -> tuple[list[tuple[str, Mesh]], DetailEffect]:
    """Leave out what is small or far, and decimate the rest.

    Args:
        shapes: Names and meshes.
        settings: What is left out.

    Returns:
        The meshes with this detail, in their order, and what that did to them. Shapes of which no piece is
        left are gone; a mesh that is left whole and not decimated is passed through.
    """
    kept: list[tuple[str, Mesh]] = []
    lost: Counter[str] = Counter()
    pieces = 0
    for name, mesh in shapes:
        label = piece_numbers(mesh)
        # Pieces of a shape are judged one by one: a mesh of all trees of a park is many pieces.
        reasons = _reasons(mesh, label, settings)
        pieces += len(reasons)
        lost.update(reasons)
        staying = np.array([not reason for reason in reasons], np.bool_)
        if not staying.any():
            continue
        # Passed through as it is, so that its planes stay the same to the bit.
        left = mesh if staying.all() else Mesh(mesh.vertices, mesh.faces[staying[label]])
        if settings.tolerance_m > 0:
            left = decimated(left, settings.tolerance_m)
        elif left is not mesh:
            left = welded(left)
        if len(left.faces):
            kept.append((name, left))
    whole = sum(_area(mesh) for _, mesh in shapes)
    return kept, DetailEffect(
        triangles=(sum(len(mesh.faces) for _, mesh in shapes), sum(len(mesh.faces) for _, mesh in kept)),
        pieces=pieces,
        small=lost["small"],
        far=lost["far"],
        area_share=sum(_area(mesh) for _, mesh in kept) / whole if whole > 0 else 1.0,
    )


def piece_numbers(mesh: Mesh) -> Int64Array:
    """Number the pieces of a mesh, from 0 in the order of their first triangles.

    Args:
        mesh: Any; triangles that touch at a corner are of one piece.

    Returns:
        Number of the piece that each triangle belongs to, Shape ``[F]``.
    """
    _, place = np.unique(mesh.vertices, axis=0, return_inverse=True)
    corners: Int64Array = place.reshape(-1)[mesh.faces].astype(np.int64)
    label = np.arange(len(mesh.vertices), dtype=np.int64)
    while True:
        # Labels are handed on, and each round follows twice as many links as the last.
        lowest = label[corners].min(1)
        following = label.copy()
        np.minimum.at(following, corners, lowest[:, None])
        following = following[following]
        if (following == label).all():
            break
        label = following
    _, first, inverse = np.unique(label[corners[:, 0]], return_index=True, return_inverse=True)
    rank = np.empty(len(first), np.int64)
    rank[np.argsort(first)] = np.arange(len(first))
    numbers: Int64Array = rank[inverse.reshape(-1)]
    return numbers


def _reasons(mesh: Mesh, label: Int64Array, settings: DetailSettings) -> list[str]:
    """Reasons for which pieces are left out; empty for those that stay."""
    reasons = []
    for piece in range(int(label.max(initial=-1)) + 1):
        corners = mesh.vertices[mesh.faces[label == piece]].reshape(-1, 3)
        low, high = corners.min(0), corners.max(0)
        if np.linalg.norm(high - low) < settings.smallest_m:
            reasons.append("small")
        elif settings.centre_m is not None and settings.radius_m is not None:
            beside = _distance(np.array(settings.centre_m), low[:2], high[:2])
            reasons.append("far" if beside > settings.radius_m else "")
        else:
            reasons.append("")
    return reasons


def _distance(point: Float64Array, low: Float64Array, high: Float64Array) -> float:
    """From a point to the nearest of a box."""
    return float(np.linalg.norm(point - np.clip(point, low, high)))


def _area(mesh: Mesh) -> float:
    a, b, c = np.moveaxis(mesh.vertices[mesh.faces], 1, 0)
    return float(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2)
