"""Fewer triangles within a tolerance: corners are taken away one after another.

A corner is moved onto a neighbour, which takes two triangles with it. The error of a move is the largest
distance from the neighbour to any plane that the corner has stood for (R. Ronfard, J. Rossignac,
"Full-range approximation of triangulated polyhedra", Computer Graphics Forum 15, 1996); planes are handed
on, so errors do not add up. Corners that stay do not move: a wall of which none was taken away keeps its
plane to the bit, which matters more for reflections than an even error.
"""

from __future__ import annotations

import heapq
import math
from collections import defaultdict
from typing import TypeAlias

import numpy as np

from caviar_protocol.arrays import Int64Array
from caviar_services.mesh.shapes import Mesh

_Vector: TypeAlias = tuple[float, float, float]
_Plane: TypeAlias = tuple[float, float, float, float]
"""Unit normal and offset: a point p is n·p + d off."""
_Corners: TypeAlias = tuple[int, int, int]

_TURN = 0.2
"""Cosine of the largest turn of a triangle's normal by one move: it is not turned inside out."""


def welded(mesh: Mesh) -> Mesh:
    """The mesh with one vertex where there were several at exactly one place, faces in their order; faces
    that lose a side by it, and vertices of no face, are gone."""
    vertices, inverse = np.unique(mesh.vertices, axis=0, return_inverse=True)
    return _used(Mesh(vertices, inverse.reshape(-1)[mesh.faces].astype(np.int32)))


def decimated(mesh: Mesh, tolerance_m: float) -> Mesh:
    """A mesh of fewer triangles, a subset of the vertices, welded.

    Each vertex taken away lies in planes no farther than ``tolerance_m`` [m] from the one that stands for it.
    Rims keep their course within the same tolerance. The result depends on nothing but the mesh.
    """
    mesh = welded(mesh)
    return _used(_Decimation(mesh, tolerance_m).run())


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
        self._points: list[_Vector] = [(x, y, z) for x, y, z in mesh.vertices.tolist()]
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
        """Whether the surface stays one: no triangle turns over, and no third surface is joined on."""
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
            if old is not None and (new is None or _dot(old, new) < _TURN):
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
            across = _unit(_cross(normal, _minus(self._points[end], self._points[start])))
            if across is not None:
                for corner in (start, end):
                    planes[corner].add(self._through(across, start))
        return planes

    def _through(self, normal: _Vector, vertex: int) -> _Plane:
        # Rounded: triangles of one wall share one plane, of which a vertex has to be held to but one.
        a, b, c = (round(part, 9) for part in normal)
        return a, b, c, -round(_dot(normal, self._points[vertex]), 6)

    def _normal(self, corners: _Corners) -> _Vector | None:
        a, b, c = (self._points[corner] for corner in corners)
        return _unit(_cross(_minus(b, a), _minus(c, a)))


def _minus(a: _Vector, b: _Vector) -> _Vector:
    return a[0] - b[0], a[1] - b[1], a[2] - b[2]


def _dot(a: _Vector, b: _Vector) -> float:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def _cross(a: _Vector, b: _Vector) -> _Vector:
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


def _unit(vector: _Vector) -> _Vector | None:
    length = math.sqrt(_dot(vector, vector))
    return (vector[0] / length, vector[1] / length, vector[2] / length) if length > 1e-12 else None
