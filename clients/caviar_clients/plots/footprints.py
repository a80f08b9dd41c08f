"""Scenery from above: what of its meshes a map shows."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from caviar_protocol.arrays import Float64Array, Int64Array
from caviar_protocol.errors import AssetError

_STEEP = 0.1
"""A face is a wall where the vertical part of its unit normal is smaller."""

_GROUND_WALLS = 0.02
"""A mesh with a smaller share of walls that reaches down to the lowest point is ground."""

_PLY_TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2",
    "ushort": "u2", "uint16": "u2", "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4",
    "float": "f4", "float32": "f4", "double": "f8", "float64": "f8",
}  # fmt: skip


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
    shapes = [_shape(file, to_world) for file, to_world in meshes]
    shapes = [shape for shape in shapes if len(shape.faces)]
    lowest = min((shape.corners[..., 2].min() for shape in shapes), default=0.0)
    buildings = [shape for shape in shapes if not _is_ground(shape, lowest)]
    return Footprints(
        faces=np.concatenate([_level(shape) for shape in buildings] or [np.zeros((0, 3, 2))]),
        edges=np.concatenate([_outline(shape) for shape in buildings] or [np.zeros((0, 2, 2))]),
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


def _is_ground(shape: _Shape, lowest: float) -> bool:
    walls = shape.area[shape.steepness < _STEEP].sum() / shape.area.sum()
    return bool(walls < _GROUND_WALLS and shape.corners[..., 2].min() < lowest + 1.0)


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


def read_ply(file: Path) -> tuple[Float64Array, Int64Array]:
    """Vertices [m], Shape ``[V, 3]``, and triangles, Shape ``[F, 3]``, of a PLY mesh, text or binary.

    Polygons are cut into triangles. Raises `AssetError` naming the file where it is not a mesh.
    """
    try:
        data = file.read_bytes()
        head, mark, rest = data.partition(b"end_header")
        if not head.startswith(b"ply") or not mark:
            raise AssetError(f"{file} is not a PLY mesh; its first bytes are {data[:8]!r}")
        return _checked(*_parse(_header(head.decode("ascii")), rest[rest.index(b"\n") + 1 :]))
    except OSError as error:
        raise AssetError(f"{file} cannot be read: {error.strerror}") from error
    except (ValueError, KeyError, IndexError, StopIteration) as error:
        raise AssetError(f"{file} is a PLY mesh that cannot be read: {error!r}") from error


@dataclass(frozen=True)
class _Header:
    order: str
    """``<`` or ``>`` of a binary file, empty for text."""
    counts: dict[str, int]
    properties: dict[str, list[tuple[str, ...]]]


def _header(text: str) -> _Header:
    order, counts = "", {}
    properties: dict[str, list[tuple[str, ...]]] = {}
    for words in (line.split() for line in text.splitlines()):
        match words:
            case ["format", "binary_little_endian", _]:
                order = "<"
            case ["format", "binary_big_endian", _]:
                order = ">"
            case ["element", name, count]:
                counts[name], properties[name] = int(count), []
            case ["property", *rest]:
                properties[next(reversed(properties))].append(tuple(rest))
    if list(counts)[:2] != ["vertex", "face"]:
        raise ValueError(f"elements {list(counts)}, expected vertex, then face")
    return _Header(order, counts, properties)


def _parse(header: _Header, data: bytes) -> tuple[Float64Array, Int64Array]:
    fields = [words[-1] for words in header.properties["vertex"]]
    columns = [fields.index(axis) for axis in "xyz"]
    count, faces = header.counts["vertex"], header.counts["face"]
    if not header.order:
        words = data.split()
        numbers = np.array(words[: count * len(fields)], dtype=np.float64).reshape(count, len(fields))
        return numbers[:, columns], _fan(iter(map(int, words[count * len(fields) :])), faces)
    record = np.dtype([(w[-1], header.order + _PLY_TYPES[w[0]]) for w in header.properties["vertex"]])
    table = np.frombuffer(data, record, count)
    vertices = np.stack([table[axis].astype(np.float64) for axis in "xyz"], axis=-1)
    return vertices, _binary_faces(header, data[count * record.itemsize :], faces)


def _checked(vertices: Float64Array, faces: Int64Array) -> tuple[Float64Array, Int64Array]:
    if len(faces) and not 0 <= faces.min() <= faces.max() < len(vertices):
        raise ValueError(f"faces refer to vertices {faces.min()} to {faces.max()} of {len(vertices)}")
    return vertices, faces


def _binary_faces(header: _Header, data: bytes, count: int) -> Int64Array:
    (words,) = header.properties["face"]  # one list, as every exporter writes it
    sizes, indices = (np.dtype(header.order + _PLY_TYPES[word]) for word in words[1:3])
    triangle: Any = np.dtype([("size", sizes), ("index", indices, 3)])
    if len(data) >= count * triangle.itemsize:
        table = np.frombuffer(data, triangle, count)
        if (table["size"] == 3).all():
            found: Int64Array = table["index"].astype(np.int64)
            return found
    numbers: list[int] = []
    position = 0
    for _ in range(count):
        size = int(np.frombuffer(data, sizes, 1, position)[0])
        position += sizes.itemsize
        numbers += [size, *np.frombuffer(data, indices, size, position).tolist()]
        position += size * indices.itemsize
    return _fan(iter(numbers), count)


def _fan(numbers: Any, count: int) -> Int64Array:
    """Triangles of polygons that are given as size, index, index, …"""
    triangles = []
    for _ in range(count):
        polygon = [next(numbers) for _ in range(next(numbers))]
        triangles += [(polygon[0], *polygon[i : i + 2]) for i in range(1, len(polygon) - 1)]
    return np.array(triangles, dtype=np.int64).reshape(-1, 3)
