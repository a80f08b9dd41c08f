"""PLY meshes as arrays, in the precision of the file; a renderer keeps single precision only.

Text and binary files of either byte order are read, with any elements beside vertices and faces.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from caviar_protocol.arrays import MAX_COORDINATE_M, Float64Array, Int64Array
from caviar_protocol.errors import AssetError

# Names of PLY 1.0, and those with sizes that later tools write.
_TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2",
    "ushort": "u2", "uint16": "u2", "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4",
    "float": "f4", "float32": "f4", "double": "f8", "float64": "f8",
}  # fmt: skip
_BYTE_ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}


def read_ply(file: Path, called: str = "") -> tuple[Float64Array, Int64Array]:
    r"""Read the vertices and triangles of a PLY mesh.

    Args:
        file: A PLY file with elements ``vertex`` and ``face``; flat polygons, convex or not, are cut into
            triangles.
        called: What errors call the file, where its path would mean nothing to the user: a copy.

    Returns:
        Vertices [m], Shape ``[V, 3]``, and indices of the corners of each triangle, Shape ``[F, 3]``.

    Raises:
        AssetError: The file cannot be read, is no mesh, breaks off, has a vertex that is not finite or beyond
            `MAX_COORDINATE_M`, or a face that refers to a vertex that is not there.

    Example:
        >>> lines = ["ply", "format ascii 1.0", "element vertex 4"]
        >>> lines += [f"property float {axis}" for axis in "xyz"]
        >>> lines += ["element face 1", "property list uchar int vertex_indices", "end_header"]
        >>> lines += ["0 0 0", "1 0 0", "1 1 0", "0 1 0", "4 0 1 2 3"]
        >>> Path("square.ply").write_text("\n".join(lines))
        187
        >>> vertices, triangles = read_ply(Path("square.ply"))
        >>> vertices.shape, triangles.tolist()
        ((4, 3), [[0, 1, 2], [0, 2, 3]])
    """
    called = called or str(file)
    try:
        vertices, triangles = _parse(file.read_bytes())
    except OSError as error:
        raise AssetError(f"{called} cannot be read: {error.strerror}") from error
    except (ValueError, KeyError, IndexError) as error:
        raise AssetError(f"{called}: not a PLY file that can be read ({error}); export it again") from error
    bad = np.flatnonzero(~(abs(vertices) <= MAX_COORDINATE_M).all(1))
    if len(bad):
        where = vertices[bad[0]].tolist()
        remedy = f"give every vertex finite coordinates of at most {MAX_COORDINATE_M:g}"
        raise AssetError(f"{called}: vertex {bad[0]} is at {where}; {remedy}")
    return vertices, triangles


_MOST_HEADER = 1 << 16


def ply_comments(file: Path) -> tuple[str, ...]:
    """Comments in the header of a PLY file.

    Args:
        file: The file; one that cannot be read, or has no header, has none.
    """
    return tuple(line[len("comment ") :] for line in _header_lines(file) if line.startswith("comment "))


def ply_faces(file: Path) -> int:
    """Faces that the header of a PLY file announces; 0 where it announces none or cannot be read.

    Args:
        file: The file, of which only the header is read.
    """
    for line in _header_lines(file):
        match line.split():
            case ["element", "face", count] if count.isdigit():
                return int(count)
    return 0


def _header_lines(file: Path) -> list[str]:
    try:
        with file.open("rb") as opened:
            head = opened.read(_MOST_HEADER)
    except OSError:
        return []
    return head.partition(b"end_header")[0].decode("latin-1").splitlines()


@dataclass
class _Element:
    """An element of the header: so many rows of numbers, lists, or both."""

    name: str
    count: int
    properties: list[tuple[str, str, str]] = field(default_factory=list)
    """Name, type of the length (empty: a number, no list), type of the items."""

    @property
    def has_lists(self) -> bool:
        return any(length for _, length, _ in self.properties)

    @property
    def numbers(self) -> list[tuple[str, str]]:
        """Name and type of each property that is one number."""
        return [(name, kind) for name, length, kind in self.properties if not length]

    @property
    def axes(self) -> list[str]:
        return list("xyz") if self.name == "vertex" else []


def _parse(data: bytes) -> tuple[Float64Array, Int64Array]:
    order, elements, begin = _header(data)
    body = _Binary(data, begin, order) if order else _Text(data[begin:])
    found: dict[str, Any] = {}
    for element in elements:
        found[element.name] = body.polygons(element) if element.has_lists else body.columns(element)
        # What stands after the faces, such as lines and materials of some tools, need not be readable.
        if element.name == "face":
            break
    if missing := {"vertex", "face"} - set(found):
        raise ValueError(f"no element {missing.pop()}")
    vertices, polygons = found["vertex"], found["face"]
    if isinstance(polygons, np.ndarray):  # triangles alone
        sizes, corners = np.full(len(polygons), 3), polygons.ravel()
    else:
        sizes, corners = (
            np.array([len(p) for p in polygons], np.int64),
            np.concatenate([np.zeros(0, np.int64), *polygons]),
        )
    if len(corners) and not 0 <= corners.min() <= corners.max() < len(vertices):
        raise ValueError(f"faces refer to vertices {corners.min()} to {corners.max()} of {len(vertices)}")
    return vertices, cut_polygons(corners, sizes, vertices)


def _header(data: bytes) -> tuple[str, list[_Element], int]:
    """Byte order, elements, and where the data begin."""
    # Before the lines are split: binary data after the header may hold line feeds.
    end = data.find(b"end_header")
    if end < 0:
        raise ValueError(
            "it is empty" if not data else f"no line end_header; the file begins with {data[:8]!r}"
        )
    order, elements = None, list[_Element]()
    for words in (line.split() for line in data[:end].decode("latin-1").splitlines()):
        match words:
            case ["format", name, _]:
                order = _BYTE_ORDERS[name]
            case ["element", name, count]:
                if int(count) < 0:
                    raise ValueError(f"{count} of element {name}")
                elements.append(_Element(name, int(count)))
            case ["property", "list", length, item, name]:
                elements[-1].properties.append((name, _TYPES[length], _TYPES[item]))
            case ["property", kind, name]:
                elements[-1].properties.append((name, "", _TYPES[kind]))
    if order is None:
        raise ValueError(f"no format; the file begins with {data[:8]!r}")
    return order, elements, data.index(b"\n", end) + 1


class _Text:
    """The data of a text file, of which elements are taken one after the other."""

    def __init__(self, data: bytes) -> None:
        self._words = data.split()
        self._at = 0

    def columns(self, element: _Element) -> Float64Array:
        width = len(element.numbers)
        rows = self._next(element.count * width)
        names = [name for name, _ in element.numbers]
        # Rows in double precision, whatever the header says: what is written is what is meant.
        table = np.array(rows, dtype=np.float64).reshape(element.count, width)
        return table[:, [names.index(axis) for axis in element.axes]]

    def polygons(self, element: _Element) -> list[Int64Array]:
        polygons, first = [], _first_list(element)
        for _ in range(element.count):
            row = [self._next(int(self._next(1)[0]) if length else 1) for _, length, _ in element.properties]
            polygons.append(np.array([int(word) for word in row[first]], np.int64))
        return polygons

    def _next(self, count: int) -> list[bytes]:
        words = self._words[self._at : self._at + count]
        if len(words) < count:
            raise ValueError("it breaks off")
        self._at += count
        return words


class _Binary:
    """The data of a binary file, of which elements are taken one after the other."""

    def __init__(self, data: bytes, begin: int, order: str) -> None:
        self._data, self._at, self._order = data, begin, order

    def columns(self, element: _Element) -> Float64Array:
        row = np.dtype([(name, self._order + kind) for name, kind in element.numbers])
        table = self._next(row, element.count)
        if not element.axes:
            return np.empty((element.count, 0))
        return np.stack([table[axis].astype(np.float64) for axis in element.axes], axis=-1)

    def polygons(self, element: _Element) -> list[Int64Array] | Int64Array:
        """Corners of each face; as one array, Shape ``[F, 3]``, where all are triangles."""
        properties = [
            (name, np.dtype(self._order + length) if length else None, np.dtype(self._order + item))
            for name, length, item in element.properties
        ]
        triangle = _triangle_row(properties)
        # Most meshes have triangles only: one look at all of them instead of a step for each.
        if triangle and len(self._data) >= self._at + element.count * triangle.itemsize:
            table = np.frombuffer(self._data, triangle, element.count, self._at)
            if (table["length"] == 3).all():
                self._at += table.nbytes
                corners: Int64Array = table["corners"].astype(np.int64)
                return corners
        polygons, first = [], _first_list(element)
        for _ in range(element.count):
            row = [
                self._next(item, 1 if length is None else int(self._next(length, 1)[0]))
                for _, length, item in properties
            ]
            polygons.append(row[first].astype(np.int64))
        return polygons

    def _next(self, kind: np.dtype[Any], count: int) -> NDArray[Any]:
        values = (
            np.frombuffer(self._data, kind, count, self._at)
            if count * kind.itemsize
            else np.empty(count, kind)
        )
        self._at += values.nbytes
        return values


def _first_list(element: _Element) -> int:
    """Place of the first list among the properties of an element: the corners of faces."""
    return next(i for i, (_, length, _) in enumerate(element.properties) if length)


def _triangle_row(
    properties: Sequence[tuple[str, np.dtype[Any] | None, np.dtype[Any]]],
) -> np.dtype[Any] | None:
    """A row with one list, if that has three items; None where there are several lists."""
    if sum(length is not None for _, length, _ in properties) != 1:
        return None
    # As one structured row the whole element is read by one call of NumPy.
    row: list[Any] = []
    for name, length, item in properties:
        row += [(f"number {name}", item)] if length is None else [("length", length), ("corners", item, 3)]
    return np.dtype(row)


def cut_polygons(corners: Int64Array, sizes: Int64Array, vertices: Float64Array) -> Int64Array:
    """Cut polygons into triangles, in their sense and order, Shape ``[F, 3]``: around the first corner of
    each, unless that would reach out of one that is not convex, as roofs often are.

    Args:
        corners: Vertices of all polygons, one polygon after the other.
        sizes: Corners of each polygon.
        vertices: [m], Shape ``[V, 3]``.
    """
    counts = np.maximum(sizes - 2, 0)
    of = np.repeat(np.arange(len(sizes)), counts)
    begin = (np.cumsum(sizes) - sizes)[of]
    second = begin + 1 + np.arange(len(of)) - (np.cumsum(counts) - counts)[of]
    fans = np.stack([corners[begin], corners[second], corners[second + 1]], axis=-1).reshape(-1, 3)
    if (counts <= 1).all():
        return fans
    a, b, c = np.moveaxis(vertices[fans], 1, 0)
    areas = np.cross(b - a, c - a)
    # Newell's normal, right for flat polygons of any form.
    normals = np.stack([np.bincount(of, axis, len(sizes)) for axis in areas.T], axis=-1)
    for number in np.unique(of[np.einsum("fx,fx->f", areas, normals[of]) < 0]).tolist():
        polygon = corners[sizes[:number].sum() :][: sizes[number]].tolist()
        fans[of == number] = _ears(polygon, vertices, normals[number])
    return fans


def _ears(polygon: list[int], vertices: Float64Array, normal: Float64Array) -> list[tuple[int, int, int]]:
    """Triangles of a polygon, cut off one after the other where no other corner is inside (G. H. Meisters,
    "Polygons have ears", Am. Math. Mon. 82, 1975)."""

    def turn(a: int, b: int, c: int) -> float:
        return float(np.cross(vertices[b] - vertices[a], vertices[c] - vertices[a]) @ normal)

    left, ears = list(polygon), []
    while len(left) > 3:
        for i, tip in enumerate(left):
            a, b = left[i - 1], left[(i + 1) % len(left)]
            others = (p for p in left if p not in (a, tip, b))
            if turn(a, tip, b) > 0 and not any(
                min(turn(a, tip, p), turn(tip, b, p), turn(b, a, p)) >= 0 for p in others
            ):
                break
        else:  # a polygon that crosses itself, or has come down to a line
            i, a, tip, b = 0, left[-1], left[0], left[1]
        ears.append((a, tip, b))
        del left[i]
    return [*ears, (left[0], left[1], left[2])]
