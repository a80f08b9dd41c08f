"""Faces that waves meet otherwise than their author may expect: several in one plane, and two of one wall.

A face is a slab of its material's thickness, whatever stands behind it (docs/topics/channel). A wall that is
modelled as a closed body has two faces, so that waves cross two slabs; as a sheet in its middle
(`solid_wall`) it is one slab of the distance between both.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from caviar_protocol.arrays import BoolArray, Float64Array, Int64Array
from caviar_space.mesh_detail import piece_numbers
from caviar_space.meshes import Mesh, joined
from caviar_space.planes import PlaneTable, is_closed, plane_numbers, plane_numbers_of, shared_planes
from caviar_space.vectors import cross

# [m]; what overlaps, or stands out, by less does not.
_NEAR = 1e-3

LYING = 0.5
"""Vertical part of the normal of grounds and roofs, at least."""

# Relative difference of areas and volumes of a plate and of what counts as one.
_PLATE = 1e-3


def planes_of(meshes: Sequence[Mesh], material: Int64Array) -> Int64Array:
    """Number of the infinite plane of each triangle of all meshes, Shape ``[F]`` (`shared_planes`).

    Args:
        meshes: In world coordinates.
        material: Number of the material of each, Shape ``[M]``.
    """
    numbers = plane_numbers_of(meshes)
    counts = np.array([int(number.max(initial=-1)) + 1 for number in numbers], np.int64)
    before = np.cumsum(counts) - counts
    parts = np.concatenate([number + first for number, first in zip(numbers, before, strict=True)])
    corners = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes)])
    faces = np.concatenate([mesh.faces + first for mesh, first in zip(meshes, corners, strict=False)])
    table = PlaneTable(parts.astype(np.int64), faces.astype(np.int64))
    vertices = np.concatenate([mesh.vertices for mesh in meshes])
    table.update(vertices - (vertices.min(0) + vertices.max(0)) / 2)
    found: Int64Array = shared_planes(table, np.repeat(material, counts))[parts]
    return found


def overlapping_pieces(
    meshes: Sequence[Mesh], material: Int64Array, plane: Int64Array
) -> set[tuple[int, int]]:
    """Find pairs of pieces of different materials that overlap in one plane, where waves can meet them.

    A floor of a house on the ground, and the common wall of two houses, are inside: no wave comes there.

    Args:
        meshes: In world coordinates.
        material: Number of the material of each, Shape ``[M]``.
        plane: Number of the plane of each triangle, Shape ``[F]`` (`planes_of`).
    """
    triangles = np.concatenate([mesh.vertices[mesh.faces] for mesh in meshes])
    piece = np.repeat(np.arange(len(meshes)), [len(mesh.faces) for mesh in meshes])
    material = material[piece]
    begin = np.flatnonzero(np.diff(piece, prepend=-1))
    order = np.lexsort((material, plane))
    starts = np.flatnonzero(np.diff(plane[order], prepend=-1))
    found: set[tuple[int, int]] = set()
    for rows in np.split(order, starts[1:]):
        if material[rows[0]] == material[rows[-1]]:
            continue
        a, b, c = np.moveaxis(triangles[rows], 1, 0)
        normals = cross(b - a, c - a)
        largest = int(np.einsum("fx,fx->f", normals, normals).argmax())
        length = float(np.linalg.norm(normals[largest]))
        if not length:
            continue
        normal = normals[largest] / length
        height = (triangles - a[largest]) @ normal
        sides: tuple[float, ...] = (1.0, -1.0)
        if abs(normal[2]) > LYING:  # grounds and roofs are met from above
            sides = (1.0,) if normal[2] > 0 else (-1.0,)
        for side in sides:
            # What stands out of the plane on a side covers it there.
            covered = np.maximum.reduceat((side * height).max(1), begin) > _NEAR
            free = rows[~covered[piece[rows]]]
            flat = np.delete(triangles[free], int(np.abs(normal).argmax()), axis=2)
            for row, corners in zip(free.tolist(), flat, strict=True):
                others = free[material[free] > material[row]]
                over = others[_overlaps(corners, flat[material[free] > material[row]])]
                found.update((int(piece[row]), int(other)) for other in np.unique(piece[over]))
    return found


def _overlaps(triangle: Float64Array, others: Float64Array) -> BoolArray:
    """Test whether triangles overlap one by more than `_NEAR`: none of their edges parts them (the separating
    axis theorem). Shapes ``[3, 2]`` and ``[N, 3, 2]`` [m]."""
    both = np.concatenate([np.broadcast_to(triangle, others.shape), others], axis=1)
    edges = np.concatenate([np.roll(part, -1, axis=1) - part for part in np.split(both, 2, axis=1)], axis=1)
    axes = np.stack([-edges[..., 1], edges[..., 0]], axis=-1)
    axes /= np.maximum(np.linalg.norm(axes, axis=-1, keepdims=True), 1e-300)
    at = np.einsum("nax,ncx->nac", axes, both)
    depth = np.minimum(at[..., :3].max(-1), at[..., 3:].max(-1)) - np.maximum(
        at[..., :3].min(-1), at[..., 3:].min(-1)
    )
    overlap: BoolArray = (depth > _NEAR).all(1)
    return overlap


def wall_thickness(mesh: Mesh, number: Int64Array, most: float) -> float:
    """Distance [m] of the nearest two faces of a closed mesh between which it is solid; 0: there are none.

    Args:
        mesh: Any.
        number: Of the flat face of each triangle, from 0, Shape ``[F]``.
        most: Distance at most [m].
    """
    a, b, c = np.moveaxis(mesh.vertices[mesh.faces] - mesh.vertices.mean(0), 1, 0)
    areas = cross(b - a, c - a)
    count = int(number.max(initial=-1)) + 1
    normal = np.stack([np.bincount(number, axis, count) for axis in areas.T], axis=-1)
    size = np.linalg.norm(normal, axis=1)
    low, high = np.full((count, 3), np.inf), np.full((count, 3), -np.inf)
    for corner in (a, b, c):
        np.minimum.at(low, number, corner)
        np.maximum.at(high, number, corner)
    first = np.zeros(count, np.int64)
    first[number[::-1]] = np.arange(len(number))[::-1]
    # A closed mesh whose normals lead inwards has a volume below 0.
    outwards = np.sign(np.einsum("fx,fx->", a, areas))
    flat = np.flatnonzero(size > 0)
    normal = outwards * normal[flat] / size[flat, None]
    leading = np.take_along_axis(normal, np.abs(normal).argmax(1)[:, None], 1)[:, 0]
    line = np.round(normal * np.sign(leading)[:, None], 3) + 0.0
    offset = np.einsum("nx,nx->n", a[first[flat]], normal * np.sign(leading)[:, None])
    order = np.lexsort((offset, *line.T))
    here, there = order[:-1], order[1:]
    distance = offset[there] - offset[here]
    wall = (line[here] == line[there]).all(1) & (leading[here] < 0) & (leading[there] > 0)
    wall &= (distance > 0) & (distance <= most)
    reach = distance[:, None] + _NEAR
    low, high = low[flat], high[flat]
    wall &= ((low[here] < high[there] + reach) & (low[there] < high[here] + reach)).all(1)
    return float(distance[wall].min()) if wall.any() and is_closed(mesh) else 0.0


def solid_wall(mesh: Mesh, most: float) -> tuple[Mesh, float] | None:
    """Sheet in the middle of a plate: of a closed body that is one flat face moved by a thickness.

    A wall with openings is one, too. What is not of one thickness, as a box that is no wall or two walls that
    meet at a corner, is none; nor is a post, whose narrow sides have more area than a face.

    Args:
        mesh: One connected body.
        most: Thickness at most [m].

    Returns:
        The sheet, and the thickness [m]; None: it is no plate.

    Example:
        >>> from caviar_space.meshes import box
        >>> sheet, thickness = solid_wall(box((0, 9), (5, 5.2), (0, 3)), 0.5)
        >>> round(thickness, 6), np.unique(sheet.vertices[:, 1]).tolist(), len(sheet.faces)
        (0.2, [5.1], 2)
    """
    if not len(mesh.faces) or not is_closed(mesh):
        return None
    middle = mesh.vertices.mean(0)
    a, b, c = np.moveaxis(mesh.vertices[mesh.faces] - middle, 1, 0)
    areas = cross(b - a, c - a) / 2
    number = plane_numbers(mesh).astype(np.int64)
    size = np.linalg.norm(areas, axis=1)
    largest = int(np.bincount(number, size).argmax())
    normal = areas[number == largest].sum(0)
    area = float(np.linalg.norm(normal))
    volume = abs(float(np.einsum("fx,fx->", a, areas))) / 3
    if not area:
        return None
    normal /= area
    height = (a @ normal)[number == largest].mean() - (np.stack([a, b, c]) @ normal)
    thickness = float(np.abs(height).max())
    other = (size > 0) & (areas @ normal < -(1 - _PLATE) * size) & (number != largest)
    opposite = float(size[other].sum())
    if thickness > most or max(abs(opposite - area), abs(volume / thickness - area)) > _PLATE * area:
        return None
    if size.sum() - area - opposite > area:  # a post or a cube: a sheet would be missed from a side
        return None
    inwards = -np.sign(np.einsum("fx,fx->", a, areas)) * normal * thickness / 2
    used, faces = np.unique(mesh.faces[number == largest], return_inverse=True)
    return Mesh(mesh.vertices[used] + inwards, faces.reshape(-1, 3).astype(np.int32)), thickness


def solid_walls(mesh: Mesh, most: float) -> list[tuple[Mesh, float | None]]:
    """Replace the plates of a mesh by their middle sheets (`solid_wall`).

    Args:
        mesh: Any; its parts hang together by common corners.
        most: Thickness of a plate at most [m].

    Returns:
        Meshes with the thickness of their walls [m], to 0.1 mm; None: of what is no plate, which comes first.
    """
    part = piece_numbers(mesh)
    order = np.argsort(part, kind="stable")
    sheets: dict[float, list[Mesh]] = {}
    rest = np.ones(len(part), np.bool_)
    for rows in np.split(order, np.flatnonzero(np.diff(part[order])) + 1):
        used, faces = np.unique(mesh.faces[rows], return_inverse=True)
        found = solid_wall(Mesh(mesh.vertices[used], faces.reshape(-1, 3).astype(np.int32)), most)
        if found is not None:
            sheets.setdefault(round(found[1], 4), []).append(found[0])
            rest[rows] = False
    made: list[tuple[Mesh, float | None]] = [(joined(of), thickness) for thickness, of in sheets.items()]
    if not sheets:
        return [(mesh, None)]
    return [(Mesh(mesh.vertices, mesh.faces[rest]), None), *made] if rest.any() else made
