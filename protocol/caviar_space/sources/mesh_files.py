"""OBJ with MTL, PLY and STL as scenes: formats of meshes that know neither units nor axes.

Lengths are metres, and z is up unless the request says y. Polygons are cut into triangles as they are, convex
or not.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from caviar_protocol.arrays import Float64Array, Int64Array
from caviar_protocol.errors import AssetError
from caviar_protocol.space.ply import cut_polygons, ply_comments, read_ply
from caviar_space.imported_scenes import ImportedScene
from caviar_space.sources import Request
from caviar_space.sources.pieces import Colour, SceneBuilder, beside, contents, reading


@dataclass
class Wavefront:
    """Content of an OBJ file."""

    vertices: Float64Array
    """[m], Shape ``[V, 3]``."""
    faces: dict[tuple[str, str], Int64Array]
    """Triangles, Shape ``[F, 3]``, by the names of object and material."""
    libraries: list[str] = field(default_factory=list)
    """Files of materials that it names."""
    left_out: dict[str, int] = field(default_factory=dict)
    """Count of parts that are no polygons, by what they are."""


def wavefront(file: Path) -> Wavefront:
    """Read an OBJ file.

    Args:
        file: The file.

    Raises:
        AssetError: It cannot be read, or a line is wrong; names it.
    """
    vertices: list[list[float]] = []
    polygons: dict[tuple[str, str], tuple[list[int], list[int]]] = {}
    found = Wavefront(np.zeros((0, 3)), {})
    name, material = file.stem, ""
    for line, words in _lines(contents(file)):
        with reading(f"{file}:{line}", "OBJ"):
            match words:
                case ["v", *numbers]:
                    x, y, z = (float(number) for number in numbers[:3])
                    vertices.append([x, y, z])
                case ["f", _, _, _, *_]:
                    indices = [_index(corner, len(vertices)) for corner in words[1:]]
                    of, sizes = polygons.setdefault((name, material), ([], []))
                    of += indices
                    sizes.append(len(indices))
                case ["o" | "g", *given]:
                    name = " ".join(given) or file.stem
                case ["usemtl", *given]:
                    material = " ".join(given)
                case ["mtllib", *given]:
                    found.libraries.append(" ".join(given))
                case ["p" | "l" | "f" | "curv" | "surf" as what, *_]:
                    called = {"p": "points", "l": "lines", "f": "faces of fewer than three corners"}.get(
                        what, "curved surfaces"
                    )
                    found.left_out[called] = found.left_out.get(called, 0) + 1
    with reading(file, "OBJ"):
        found.vertices = np.array(vertices, np.float64).reshape(-1, 3)
        for key, (of, sizes) in polygons.items():
            found.faces[key] = cut_polygons(np.array(of), np.array(sizes), found.vertices)
    return found


def _lines(data: bytes) -> Iterator[tuple[int, list[str]]]:
    """Number and words of each line; one that ends in a backslash goes on."""
    begun: list[str] = []
    for number, line in enumerate(data.decode("utf-8", "replace").split("\n"), 1):
        text = line.partition("#")[0].rstrip()
        begun += text.removesuffix("\\").split()
        if begun and not text.endswith("\\"):
            yield number, begun
            begun = []


def _index(corner: str, count: int) -> int:
    """Vertex of a corner such as 3/1/2, from 0; negative ones count from the end."""
    number = int(corner.partition("/")[0])
    index = number - 1 if number > 0 else count + number
    if not (number and 0 <= index < count):
        raise ValueError(f"there is no vertex {number}: {count} stand above")
    return index


def read_obj(path: Path, request: Request) -> ImportedScene:
    """Read an OBJ file and its MTL as a scene; see `caviar_space.sources.Reader`."""
    builder = SceneBuilder(path, request)
    builder.read(path)
    found = wavefront(path)
    colours: dict[str, Colour] = {}
    for name in found.libraries:
        library = beside(path.parent, name, path)
        if not library.is_file():
            builder.scene.notes.append(f"{path.name} names {name}, which is not there: no colours")
            continue
        material = ""
        for line, words in _lines(builder.read(library)):
            with reading(f"{library}:{line}", "MTL"):
                match words:
                    case ["newmtl", *given]:
                        material = " ".join(given)
                    case ["Kd", red, green, blue]:
                        r, g, b = (min(max(float(part), 0.0), 1.0) for part in (red, green, blue))
                        colours[material] = r, g, b
    vertices = builder.upright(found.vertices)
    for number, ((name, material), faces) in enumerate(found.faces.items(), 1):
        key = builder.material(material, colours.get(material))
        builder.add(name, vertices, faces, key, "object", path, number)
    builder.note_left_out(found.left_out)
    return builder.finish()


def read_ply_scene(path: Path, request: Request) -> ImportedScene:
    """Read a PLY mesh as a scene; see `caviar_space.sources.Reader`.

    Its material is that of a comment ``material NAME``, else that of the file's name.
    """
    builder = SceneBuilder(path, request)
    builder.read(path)
    with reading(path, "PLY"):
        vertices, faces = read_ply(path)
    words = (comment.split(maxsplit=1) for comment in ply_comments(path))
    said = next((each[1] for each in words if each[:1] == ["material"] and each[1:]), path.stem)
    builder.add(path.stem, builder.upright(vertices), faces, builder.material(said), "object", path, 1)
    return builder.finish()


def read_stl(path: Path, request: Request) -> ImportedScene:
    """Read an STL mesh, text or binary, as a scene; see `caviar_space.sources.Reader`.

    Its material is that of the file's name.
    """
    builder = SceneBuilder(path, request)
    data = builder.read(path)
    with reading(path, "STL"):
        if len(data) >= 84 and len(data) == 84 + 50 * (count := int.from_bytes(data[80:84], "little")):
            row = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("more", "<u2")])
            corners = np.frombuffer(data, row, count, 84)["corners"].astype(np.float64)
        elif re.match(rb"\s*solid\b", data) and b"\0" not in data:
            found = re.findall(rb"\bvertex\s+(\S+)\s+(\S+)\s+(\S+)", data)
            corners = np.array(found, dtype=bytes).astype(np.float64).reshape(-1, 3, 3)
            if len(corners) != len(re.findall(rb"\bendfacet\b", data)) or b"endsolid" not in data:
                raise ValueError(f"it is cut off after {len(corners)} triangles")
        else:
            told = int.from_bytes(data[80:84], "little")
            raise AssetError(
                f"{path}: an STL of {told} triangles has {84 + 50 * told} bytes, this one {len(data)}; "
                "export it again"
            )
    faces = np.arange(corners.size // 3).reshape(-1, 3)
    vertices = builder.upright(corners.reshape(-1, 3))
    builder.add(path.stem, vertices, faces, builder.material(path.stem), "object", path, 1)
    return builder.finish()
