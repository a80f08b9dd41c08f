"""Vertices of PLY files as they stand in the file: a renderer keeps them in single precision only."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from caviar_protocol.arrays import Float64Array
from caviar_protocol.errors import AssetError

_TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1",
    "short": "i2", "int16": "i2", "ushort": "u2", "uint16": "u2",
    "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4",
    "float": "f4", "float32": "f4", "double": "f8", "float64": "f8",
}  # fmt: skip

_ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">"}


@dataclass
class _Element:
    """An element of the header: so many rows of these properties, those of lists as (count, item)."""

    name: str
    count: int
    properties: list[tuple[str, str]] = field(default_factory=list)
    lists: list[tuple[str, str]] = field(default_factory=list)


def ply_vertices(file: Path) -> Float64Array:
    """Vertices [m] of a PLY file, Shape ``[V, 3]``, in the file's order and its own precision.

    Numbers of an ASCII file that calls them ``float`` are read as they are written.

    Raises `AssetError` naming the file where it is no PLY file, breaks off, or a vertex is not finite.
    """
    data = file.read_bytes()
    try:
        form, elements, begin = _header(data)
        if form == "ascii":
            vertices = _ascii(elements, data[begin:])
        else:
            vertices = _binary(elements, data, begin, _ORDERS[form])
    except (ValueError, KeyError, IndexError, StopIteration) as error:
        raise AssetError(f"{file}: not a PLY file that can be read ({error!r}); export it again") from error
    bad = np.flatnonzero(~np.isfinite(vertices).all(1))
    if len(bad):
        where = vertices[bad[0]].tolist()
        raise AssetError(f"{file}: vertex {bad[0]} is at {where}; give every vertex finite coordinates")
    return vertices


def _header(data: bytes) -> tuple[str, Sequence[_Element], int]:
    end = data.index(b"end_header")
    form, elements = "", list[_Element]()
    for line in data[:end].decode("latin-1").splitlines():
        words = line.split()
        match words:
            case ["format", name, _]:
                form = name
            case ["element", name, count]:
                elements.append(_Element(name, int(count)))
            case ["property", "list", count, item, _]:
                elements[-1].lists.append((_TYPES[count], _TYPES[item]))
            case ["property", kind, name]:
                elements[-1].properties.append((name, _TYPES[kind]))
    return form, elements, data.index(b"\n", end) + 1


def _ascii(elements: Sequence[_Element], body: bytes) -> Float64Array:
    lines: Iterator[bytes] = (line for line in body.splitlines() if line.strip())
    for element in elements:
        rows = [next(lines) for _ in range(element.count)]
        if element.name == "vertex":
            names = [name for name, _ in element.properties]
            columns = [names.index(axis) for axis in "xyz"]
            words = [row.split() for row in rows]
            return np.array([[float(row[c]) for c in columns] for row in words], np.float64).reshape(-1, 3)
    raise ValueError("no element vertex")


def _binary(elements: Sequence[_Element], data: bytes, begin: int, order: str) -> Float64Array:
    for element in elements:
        row = np.dtype([(name, order + kind) for name, kind in element.properties])
        if element.name == "vertex" and not element.lists:
            table = np.frombuffer(data, row, element.count, begin)
            return np.stack([table[axis].astype(np.float64) for axis in "xyz"], axis=-1)
        if element.properties and element.lists:
            raise ValueError(f"element {element.name} mixes lists and numbers")
        if element.lists:
            begin = _behind_lists(element, data, begin, order)
        else:
            begin += row.itemsize * element.count
    raise ValueError("no element vertex")


def _behind_lists(element: _Element, data: bytes, begin: int, order: str) -> int:
    """Where the rows of an element of lists end."""
    for _ in range(element.count):
        for count, item in element.lists:
            kind = np.dtype(order + count)
            length = int(np.frombuffer(data, kind, 1, begin)[0])
            begin += kind.itemsize + length * np.dtype(item).itemsize
    return begin
