"""PLY meshes as arrays, without a renderer."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from caviar_protocol.arrays import Float64Array, Int64Array
from caviar_protocol.errors import AssetError

_PLY_TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2",
    "ushort": "u2", "uint16": "u2", "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4",
    "float": "f4", "float32": "f4", "double": "f8", "float64": "f8",
}  # fmt: skip


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
