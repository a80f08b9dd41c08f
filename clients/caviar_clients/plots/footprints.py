"""Scenery from above: what of its meshes a map shows."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from caviar_protocol.arrays import Float64Array, Int64Array
from caviar_protocol.space.ply import read_ply

Box = tuple[Sequence[float], Sequence[float]]
"""Lowest and highest corner [m]."""

_STEEP = 0.1
"""A face is a wall where the vertical part of its unit normal is smaller."""

_GROUND_WALLS = 0.02
"""A mesh with a smaller share of walls that reaches down to the lowest point is ground."""


@dataclass(frozen=True, eq=False)
class Footprints:
    """Scenery as a map draws it, in world x and y [m]."""

    faces: Float64Array
    """Triangles to fill, Shape ``[F, 3, 2]``."""
    edges: Float64Array
    """Outlines, Shape ``[E, 2, 2]``."""


@dataclass(frozen=True, eq=False)
class _Shape:
    corners: Float64Array
    """Shape ``[F, 3, 3]``."""
    faces: Int64Array
    """Vertex numbers, equal where two vertices coincide, Shape ``[F, 3]``."""
    steepness: Float64Array
    """Vertical part of the unit normals, Shape ``[F]``; 1: level."""
    area: Float64Array


def footprints(meshes: Iterable[tuple[Path, Float64Array]]) -> Footprints:
    """Footprints of PLY meshes, each with its 4×4 transform into the world; ground is left out."""
    _, buildings = _ground_and_buildings(meshes)
    return Footprints(
        faces=np.concatenate([_level(shape) for shape in buildings] or [np.zeros((0, 3, 2))]),
        edges=np.concatenate([_outline(shape) for shape in buildings] or [np.zeros((0, 2, 2))]),
    )


def ground(meshes: Iterable[tuple[Path, Float64Array]]) -> Float64Array:
    """Triangles [m] of the PLY meshes that are ground, Shape ``[F, 3, 3]``; each with its 4×4 transform."""
    found, _ = _ground_and_buildings(meshes)
    return np.concatenate([shape.corners for shape in found] or [np.zeros((0, 3, 3))])


def with_boxes(drawn: Footprints | None, boxes: Sequence[Box]) -> Footprints:
    """Footprints, and those of boxes along the world's axes, each its lowest and its highest corner [m]."""
    corners = np.array([[[x0, y0], [x1, y0], [x1, y1], [x0, y1]] for (x0, y0, *_), (x1, y1, *_) in boxes])
    faces = corners[:, [[0, 1, 2], [0, 2, 3]]].reshape(-1, 3, 2)
    edges = np.stack([corners, np.roll(corners, -1, axis=1)], axis=2).reshape(-1, 2, 2)
    if drawn is not None:
        faces, edges = np.concatenate([drawn.faces, faces]), np.concatenate([drawn.edges, edges])
    return Footprints(faces=faces, edges=edges)


def _ground_and_buildings(
    meshes: Iterable[tuple[Path, Float64Array]],
) -> tuple[list[_Shape], list[_Shape]]:
    shapes = [_shape(file, to_world) for file, to_world in meshes]
    shapes = [shape for shape in shapes if len(shape.faces)]
    lowest = min((shape.corners[..., 2].min() for shape in shapes), default=0.0)
    walls = [_extent(shape) for shape in shapes if not _is_level(shape)]
    level = [_is_ground(shape, lowest, walls) for shape in shapes]
    return (
        [shape for shape, is_ground in zip(shapes, level, strict=True) if is_ground],
        [shape for shape, is_ground in zip(shapes, level, strict=True) if not is_ground],
    )


def _shape(file: Path, to_world: Float64Array) -> _Shape:
    vertices, faces = read_ply(file)
    vertices = vertices @ to_world[:3, :3].T + to_world[:3, 3]
    # Exporters repeat a vertex for each face; a grid of 1 cm makes them one again.
    _, same = np.unique(np.round(vertices * 100), axis=0, return_inverse=True)
    corners = vertices[faces]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = np.linalg.norm(normal, axis=1) / 2
    solid = area > 1e-9
    return _Shape(
        corners=corners[solid],
        faces=same.reshape(-1)[faces[solid]],
        steepness=np.abs(normal[solid, 2]) / (2 * area[solid]),
        area=area[solid],
    )


def _is_ground(shape: _Shape, lowest: float, walls: Sequence[Float64Array]) -> bool:
    """Whether a mesh is ground, given the extents of the meshes with walls.

    A roof may reach the ground too, as a mesh apart from its walls; it has their extent.
    """
    if not _is_level(shape) or shape.corners[..., 2].min() >= lowest + 1.0:
        return False
    return not any(np.allclose(_extent(shape), other, rtol=0, atol=0.05) for other in walls)


def _is_level(shape: _Shape) -> bool:
    walls = shape.area[shape.steepness < _STEEP].sum() / shape.area.sum()
    return bool(walls < _GROUND_WALLS)


def _extent(shape: _Shape) -> Float64Array:
    """Lowest and highest x and y [m], Shape ``[2, 2]``."""
    places = shape.corners[..., :2].reshape(-1, 2)
    return np.array([places.min(axis=0), places.max(axis=0)])


def _level(shape: _Shape) -> Float64Array:
    faces: Float64Array = shape.corners[shape.steepness >= _STEEP][..., :2]
    return faces


def _outline(shape: _Shape) -> Float64Array:
    """Edges where the roof ends, and level edges of walls for buildings without a roof."""
    pairs = np.stack([shape.faces, np.roll(shape.faces, -1, axis=1)], axis=-1)
    ends = np.stack([shape.corners, np.roll(shape.corners, -1, axis=1)], axis=2)
    level = shape.steepness >= _STEEP
    keys = np.sort(pairs[level].reshape(-1, 2), axis=1)
    _, first, times = np.unique(keys, axis=0, return_index=True, return_counts=True)
    border = ends[level].reshape(-1, 2, 3)[first[times == 1]]
    walls = ends[~level].reshape(-1, 2, 3)
    walls = walls[np.abs(walls[:, 0, 2] - walls[:, 1, 2]) < 0.05]
    outline: Float64Array = np.concatenate([border, walls])[..., :2]
    return outline
