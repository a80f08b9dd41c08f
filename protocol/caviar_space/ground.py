"""Ground and buildings of scenery, told apart by the share of walls of each mesh and by its height."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from caviar_protocol.arrays import Float64Array, Int64Array
from caviar_space.meshes import Mesh
from caviar_space.mitsuba_xml import transformed_mesh

# A face is a wall where the vertical part of its unit normal is smaller.
STEEP = 0.1

# A mesh with a smaller share of walls that reaches down to the lowest point is ground.
_GROUND_WALLS = 0.02


@dataclass(frozen=True, eq=False)
class Piece:
    corners: Float64Array
    """Shape ``[F, 3, 3]``."""
    faces: Int64Array
    """Vertex numbers, equal where two vertices coincide, Shape ``[F, 3]``."""
    steepness: Float64Array
    """Vertical part of the unit normals, Shape ``[F]``; 1: level."""
    area: Float64Array


def ground(meshes: Iterable[tuple[Path, Float64Array]]) -> list[Float64Array]:
    """Read the triangles of the PLY meshes that are ground.

    Args:
        meshes: File of each mesh, and its 4×4 transform into the world.

    Returns:
        Corners [m] of the triangles of each mesh, Shape ``[F, 3, 3]``.
    """
    return [shape.corners for shape in ground_and_buildings(meshes)[0]]


def ground_and_buildings(
    meshes: Iterable[tuple[Path, Float64Array]],
) -> tuple[list[Piece], list[Piece]]:
    shapes = [_piece(transformed_mesh(file, to_world)) for file, to_world in meshes]
    shapes = [shape for shape in shapes if len(shape.faces)]
    level = _ground_of(shapes)
    return (
        [shape for shape, is_ground in zip(shapes, level, strict=True) if is_ground],
        [shape for shape, is_ground in zip(shapes, level, strict=True) if not is_ground],
    )


def are_ground(meshes: Sequence[Mesh]) -> list[bool]:
    """Tell which meshes in the world are ground; one without area is not."""
    shapes = [_piece(mesh) for mesh in meshes]
    level = iter(_ground_of([shape for shape in shapes if len(shape.faces)]))
    return [bool(len(shape.faces)) and next(level) for shape in shapes]


def _ground_of(shapes: Sequence[Piece]) -> list[bool]:
    lowest = min((shape.corners[..., 2].min() for shape in shapes), default=0.0)
    walls = np.array([_extent(shape) for shape in shapes if not _is_level(shape)]).reshape(-1, 2, 2)
    return [_is_ground(shape, lowest, walls) for shape in shapes]


def _piece(mesh: Mesh) -> Piece:
    vertices, faces = mesh.vertices, mesh.faces
    # Exporters repeat a vertex for each face; a grid of 1 cm makes them one again.
    _, same = np.unique(np.round(vertices * 100), axis=0, return_inverse=True)
    corners = vertices[faces]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = np.linalg.norm(normal, axis=1) / 2
    solid = area > 1e-9
    return Piece(
        corners=corners[solid],
        faces=same.reshape(-1)[faces[solid]],
        steepness=np.abs(normal[solid, 2]) / (2 * area[solid]),
        area=area[solid],
    )


def _is_ground(shape: Piece, lowest: float, walls: Float64Array) -> bool:
    """Test whether a mesh is ground, given the extents of the meshes with walls, Shape ``[W, 2, 2]``.

    A roof may reach the ground too, as a mesh apart from its walls; it has their extent.
    """
    if not _is_level(shape) or shape.corners[..., 2].min() >= lowest + 1.0:
        return False
    return not bool((np.abs(_extent(shape) - walls) <= 0.05).all(axis=(1, 2)).any())


def _is_level(shape: Piece) -> bool:
    walls = shape.area[shape.steepness < STEEP].sum() / shape.area.sum()
    return bool(walls < _GROUND_WALLS)


def _extent(shape: Piece) -> Float64Array:
    """Lowest and highest x and y of a mesh [m], Shape ``[2, 2]``."""
    places = shape.corners[..., :2].reshape(-1, 2)
    return np.array([places.min(axis=0), places.max(axis=0)])
