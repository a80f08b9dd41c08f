"""Which triangles lie in one plane, of a million in seconds: a greedy clustering over a hash grid of planes.

The largest triangle defines a plane and claims every smaller one within tolerance of it; of the rest, again
the largest, and so on. Taken one after the other this costs as many comparisons as there are planes times
triangles. Here planes are points in a space of four coordinates, unit normal and offset, which is cut into
cells: only triangles that share a cell are compared, and all triangles that are the largest of each of their
cells define their planes at once. The result is that of the sequence.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable

import numpy as np

from caviar_protocol.arrays import BoolArray, Float64Array, Int64Array
from caviar_services.channel.enumeration.face_rectangles import ranges
from caviar_services.channel.propagation.geometry import cross

_SLACK = 1.001
"""Room for rounding beyond the tolerances, so that no pair within them falls into separate cells."""

_CELL = 2.0
"""Width of a cell in tolerances: narrow ones make many copies of a triangle, wide ones many comparisons."""

_LARGE, _MANY = 20_000, 50
"""Meshes of more triangles than the first are searched for planes that hold one of so many of them."""

_AT_ONCE = 1_000_000
"""Comparisons at once, about."""

LieIn = Callable[[Int64Array, Int64Array], BoolArray]
"""Whether triangles lie in the planes of others, given by their numbers."""

_HEMISPHERE = np.array([0.5377, 0.3071, 0.7852])
"""Normals are turned to this side; along no axis, so that few of a scene are at its border."""


def coplanar(
    triangles: Float64Array, normals: Float64Array, mesh: Int64Array, distance: Float64Array, angle: float
) -> Int64Array:
    """For each triangle, the first of its mesh in whose plane it lies and that defines one, Shape ``[F]``.

    Parameters
    ----------
    triangles
        Corners [m], Shape ``[F, 3, 3]``, each with an area; the earlier one defines the plane of both.
    normals
        Unit normals, of either sense, Shape ``[F, 3]``.
    mesh
        Number of the mesh that each is of, Shape ``[F]``.
    distance
        Of corners from the plane at most [m], by mesh.
    angle
        [rad] between both normals at most.
    """

    def lie_in(these: Int64Array, others: Int64Array) -> BoolArray:
        across = np.sqrt((cross(normals[these], normals[others]) ** 2).sum(1))
        near = np.flatnonzero(across <= angle)
        these, others = these[near], others[near]
        off = np.einsum("fcx,fx->fc", triangles[these] - triangles[others, :1], normals[others])
        lie = np.zeros(len(across), np.bool_)
        lie[near] = (np.abs(off) <= distance[mesh[these], None]).all(1)
        return lie

    plane = np.full(len(triangles), len(triangles))
    defined = np.zeros(len(triangles), np.bool_)
    for number in np.flatnonzero(np.bincount(mesh) > _LARGE).tolist():
        _claim_large_planes(np.flatnonzero(mesh == number), plane, defined, lie_in)
    rest = np.flatnonzero((plane == len(triangles)) & ~defined)
    _claim_by_cells(rest, *_cells(triangles[rest], normals[rest], mesh[rest], distance, angle), plane, lie_in)
    defining: Int64Array = np.minimum(plane, np.arange(len(triangles)))
    return defining


def _claim_large_planes(triangles: Int64Array, plane: Int64Array, defined: BoolArray, lie_in: LieIn) -> None:
    """Let the triangles of a mesh define planes one after the other, as long as each claims many of them."""
    while len(triangles) > _LARGE:
        first, others = triangles[0], triangles[1:]
        defined[first] = True
        lie = lie_in(others, np.full(len(others), first))
        plane[others[lie]] = first
        triangles = others[~lie]
        if lie.sum() * _MANY < len(others):
            return


def _claim_by_cells(
    rows: Int64Array, entry: Int64Array, cell: Int64Array, plane: Int64Array, lie_in: LieIn
) -> None:
    """Let triangles define planes all at once that are the first of each of their cells, until none is left.

    ``entry`` and ``cell`` are what `_cells` returned for the triangles ``rows``.
    """
    entry = rows[entry]
    begin = np.flatnonzero(_begins(cell))
    size = np.diff(np.append(begin, len(cell)))
    copies = np.bincount(entry, minlength=len(plane))
    pending = copies > 0
    waiting = np.arange(len(entry))
    while len(waiting):
        cells = cell[waiting]
        starts = np.flatnonzero(_begins(cells))
        cells, first = cells[starts], np.minimum.reduceat(entry[waiting], starts)
        defining, count = np.unique(first, return_counts=True)
        defining = defining[count == copies[defining]]
        some = np.isin(first, defining)
        cells, first = cells[some], first[some]
        for part in np.split(np.arange(len(cells)), _parts(size[cells])):
            of, held = ranges(begin[cells[part]], size[cells[part]])
            these, by = entry[held], first[part][of]
            # Of several planes that of the earliest triangle, also where a later one has claimed it before.
            later = np.flatnonzero(plane[these] > by)
            these, by = these[later], by[later]
            lie = (these > by) & lie_in(these, by)
            np.minimum.at(plane, these[lie], by[lie])
            pending[these[lie]] = False
        pending[defining] = False
        waiting = waiting[pending[entry[waiting]]]


def _parts(sizes: Int64Array) -> Int64Array:
    """Where to cut these sizes into parts of about `_AT_ONCE` together."""
    number = np.cumsum(sizes) // _AT_ONCE
    return np.flatnonzero(number[1:] != number[:-1]) + 1


def _cells(
    triangles: Float64Array, normals: Float64Array, mesh: Int64Array, distance: Float64Array, angle: float
) -> tuple[Int64Array, Int64Array]:
    """Triangles and the cells, numbered from 0, that each may share with others of its plane, sorted by cell.

    Cells of one triangle alone are left out.
    """
    corner, reach = _about_middles(triangles[:, 0], mesh, len(distance))
    number = np.arange(len(triangles))
    side = normals @ _HEMISPHERE
    normals = np.where(side[:, None] < 0, -normals, normals)
    border = np.flatnonzero(np.abs(side) <= 2 * angle)
    number = np.concatenate([number, border])
    normals = np.concatenate([normals, -normals[border]])
    offset = np.einsum("fx,fx->f", corner[number], normals)
    # Offsets of planes that differ in the normal, too: by the angle times the distance of the corner.
    width = _SLACK * np.maximum(distance + angle * reach, 1e-300)
    place = np.column_stack([normals / (_SLACK * angle), offset / width[mesh[number]]])
    low = np.floor((place - 0.5) / _CELL).astype(np.int64)
    spans = np.floor((place + 0.5) / _CELL).astype(np.int64) > low
    low -= low.min(0, initial=0)
    strides = np.cumprod([1, *(low.max(0, initial=0) + 2)[:-1]])
    parts = []
    for step in itertools.product((0, 1), repeat=4):
        rows = np.flatnonzero((spans | ~np.array(step, np.bool_)).all(1))
        parts.append((number[rows], (low[rows] + step) @ strides))
    triangle, key = (np.concatenate(column) for column in zip(*parts, strict=True))
    order = np.argsort(key) if len(distance) == 1 else np.lexsort((key, mesh[triangle]))
    triangle, key = triangle[order], key[order]
    cell = np.cumsum(_begins(key) | _begins(mesh[triangle])) - 1
    shared = np.bincount(cell, minlength=1)[cell] > 1
    triangle, cell = triangle[shared], cell[shared]
    return triangle, np.cumsum(_begins(cell)) - 1


def _about_middles(points: Float64Array, mesh: Int64Array, meshes: int) -> tuple[Float64Array, Float64Array]:
    """Points [m] relative to the means of those of their meshes, Shape ``[F, 3]``, and the farthest of each
    mesh, by mesh."""
    counts = np.maximum(np.bincount(mesh, minlength=meshes), 1)
    means = np.stack([np.bincount(mesh, axis, meshes) for axis in points.T], axis=-1) / counts[:, None]
    points = points - means[mesh]
    reach = np.zeros(meshes)
    np.maximum.at(reach, mesh, np.sqrt(np.einsum("fx,fx->f", points, points)))
    return points, reach


def _begins(values: Int64Array) -> BoolArray:
    """Where runs of equal values begin."""
    begins = np.ones(len(values), np.bool_)
    begins[1:] = values[1:] != values[:-1]
    return begins
