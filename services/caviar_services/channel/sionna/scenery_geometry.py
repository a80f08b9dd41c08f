"""Geometry of scenery that gives other fields than its author may expect: warned of once, before the run.

Faces of two materials in one plane: waves meet one of them. Closed thin walls: the ray tracer takes each face
as a slab of its material's thickness, so a wave crosses such a wall twice.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence

import numpy as np

from caviar_protocol.arrays import BoolArray, Float64Array, Int64Array
from caviar_protocol.messages import WARNING
from caviar_services.channel.sionna.scene_loading import Shape
from caviar_space.meshes import Mesh
from caviar_space.planes import is_closed
from caviar_space.vectors import cross

# [m]; what overlaps, or stands out, by less does not.
_NEAR = 1e-3

# Vertical part of the normal of grounds and roofs, at least.
_LYING = 0.5

# Faces of a closed wall are no farther apart than this many thicknesses of its material.
_THICKNESSES = 2.0


def coinciding_materials(shapes: Sequence[Shape], plane: Int64Array) -> tuple[str, ...]:
    """Warn of pieces of different materials that overlap in one plane, where waves can meet them.

    A floor of a house on the ground, and the common wall of two houses, are inside: no wave comes there.

    Args:
        shapes: The scenery, one shape a material.
        plane: Number of the plane of each triangle, Shape ``[F]``.
    """
    pieces = [(name, shape) for shape in shapes for name in shape.names]
    meshes = [mesh for shape in shapes for mesh in shape.meshes]
    if len(shapes) < 2:
        return ()
    triangles = np.concatenate([mesh.vertices[mesh.faces] for mesh in meshes])
    piece = np.repeat(np.arange(len(meshes)), [len(mesh.faces) for mesh in meshes])
    material = np.repeat(np.arange(len(shapes)), [len(shape.meshes) for shape in shapes])[piece]
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
        if abs(normal[2]) > _LYING:  # grounds and roofs are met from above
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
    if not found:
        return ()
    (one, of_one), (other, of_other) = (pieces[number] for number in min(found))
    more = f", as do {len(found) - 1} more pairs" if len(found) > 1 else ""
    note = (
        f"{WARNING}{one!r} of material {of_one.material.name!r} and {other!r} of {of_other.material.name!r} "
        f"overlap in one plane{more}: waves meet {one!r} alone there; leave one out, or move it a millimetre "
        "to the side that it is to be met from"
    )
    return (note,)


def _overlaps(triangle: Float64Array, others: Float64Array) -> BoolArray:
    """Whether triangles overlap one by more than `_NEAR`: none of their edges parts them (the separating axis
    theorem). Shapes ``[3, 2]`` and ``[N, 3, 2]`` [m]."""
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


def closed_walls(shapes: Sequence[Shape], face: Int64Array, transparent: Collection[str]) -> tuple[str, ...]:
    """Warn of closed meshes two faces of which are the two sides of one wall.

    Args:
        shapes: The scenery, one shape a material.
        face: Number of the flat face of each triangle, counted through all pieces, Shape ``[F]``.
        transparent: Ids of the shapes that waves go through.
    """
    found, begin = [], 0
    for shape in shapes:
        thickness = float(shape.material.thickness[0])
        for name, mesh in zip(shape.names, shape.meshes, strict=True):
            own = face[begin : begin + len(mesh.faces)]
            begin += len(mesh.faces)
            apart = 0.0
            if shape.id in transparent:
                apart = _wall(mesh, own - own.min(), _THICKNESSES * thickness)
            if apart:
                found.append((name, shape.material.name, apart, thickness))
    if not found:
        return ()
    name, material, apart, thickness = found[0]
    more = f" (and {len(found) - 1} more)" if len(found) > 1 else ""
    note = (
        f"{WARNING}{name!r}{more} is a closed wall, {apart:.3g} m between its faces: each face is a slab of "
        f"{thickness:g} m of {material!r}, so that waves cross two slabs; make it one open sheet"
    )
    return (note,)


def _wall(mesh: Mesh, number: Int64Array, most: float) -> float:
    """Distance [m] of the nearest two faces of a closed mesh, at most ``most``, between which it is solid; 0
    where there are none."""
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
