"""Pieces and materials of a scene that a reader puts together, and safe reading of its files.

Third parties' parsers fail in many ways; `reading` makes an `AssetError` of each. What a file claims about
itself is compared with its size before anything is made of that size.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from functools import cache
from pathlib import Path, PurePosixPath
from typing import Any, TypeVar

import numpy as np

from caviar_protocol.arrays import MAX_COORDINATE_M, Float64Array, Int64Array
from caviar_protocol.assets import ITU_MATERIALS
from caviar_protocol.errors import AssetError, CaviarError, SetupError
from caviar_protocol.host import install_command
from caviar_space.imported_scenes import ImportedScene, Piece, source_of, wall_material
from caviar_space.meshes import Mesh
from caviar_space.mitsuba_xml import RadioMaterial
from caviar_space.sources import Request
from caviar_space.textures import Texture

Colour = tuple[float, float, float]
Item = TypeVar("Item")

_MOST_BYTES = 1 << 29
_MOST_TRIANGLES = 20_000_000
# [m] from the origin: beyond, float32, which meshes have, steps by more than 1 mm.
_NEAR_M = 1e4
_WORDS = {
    "aluminium": "metal", "aluminum": "metal", "asphalt": "asphalt_concrete", "bricks": "brick",
    "cement": "concrete", "copper": "metal", "door": "wood", "drywall": "plasterboard", "glazing": "glass",
    "gypsum": "plasterboard", "iron": "metal", "masonry": "brick", "plaster": "plasterboard",
    "road": "asphalt_concrete", "roads": "asphalt_concrete", "steel": "metal", "timber": "wood",
    "tin": "metal", "water": "wet_ground", "window": "glass", "windows": "glass", "wooden": "wood",
    "zinc": "metal",
}  # fmt: skip
"""Material in ITU-R P.2040 by a word of a name."""


def slug(text: str) -> str:
    """Lower case, digits and hyphens of a text.

    Example:
        >>> slug("WallSurface Nr. 3")
        'wall-surface-nr-3'
    """
    return re.sub(r"[^a-z0-9]+", "-", re.sub(r"(?<=[a-z])(?=[A-Z])", "-", text).lower()).strip("-")


@cache
def itu_name(text: str) -> str:
    """Material in ITU-R P.2040 by the words of a name; empty where none is of one.

    Args:
        text: A name: ``mat-itu_wet_ground.001``, ``RoofSteel``.

    Example:
        >>> itu_name("mat-itu_wet_ground.001"), itu_name("RoofSteel"), itu_name("Facade")
        ('wet_ground', 'metal', '')
    """
    words = f"-{slug(text)}-"
    # Longest first: asphalt_concrete is no concrete.
    for name in sorted(ITU_MATERIALS, key=lambda name: (-len(name), name)):
        if f"-{name.replace('_', '-')}-" in words:
            return name
    return next((_WORDS[word] for word in words.split("-") if word in _WORDS), "")


@contextmanager
def reading(where: object, form: str) -> Iterator[None]:
    """Make an `AssetError` of whatever goes wrong within.

    Args:
        where: File, and place in it, for messages.
        form: What the file is to be: ``CityJSON``.

    Raises:
        AssetError: Anything went wrong.
        SetupError: A library is not installed.
    """
    try:
        with np.errstate(all="ignore"):  # damaged numbers are refused where pieces are added
            yield
    except CaviarError:
        raise
    except ImportError as error:
        raise SetupError(
            f"{form} needs {error.name}, of the extra `scenes`; run: {install_command('scenes')}"
        ) from error
    except MemoryError as error:
        raise AssetError(f"{where}: needs more memory than there is; export it in parts") from error
    # Parsers of third parties let a damaged file show as any exception.
    except Exception as error:
        said = " ".join(str(error).split())[:200] or type(error).__name__
        raise AssetError(f"{where}: not {form} that can be read ({said}); export it again") from error


def contents(file: Path) -> bytes:
    """Read a file whole.

    Raises:
        AssetError: It is not there, is too large or cannot be read.
    """
    try:
        if not file.is_file():
            raise AssetError(f"{file} is no file that is there; name one")
        if file.stat().st_size > _MOST_BYTES:
            raise AssetError(f"{file} has more than {_MOST_BYTES >> 20} MiB; export it in parts")
        return file.read_bytes()
    except OSError as error:
        raise AssetError(f"cannot read {file}: {error.strerror}") from error


def beside(folder: Path, name: str, where: object, top: Path | None = None) -> Path:
    """Find a file that another one names: in a folder or below.

    Args:
        folder: To which its name is relative.
        name: A relative URI, or a path.
        where: File that names it, for messages.
        top: Folder that it is to lie in; by default the same.

    Raises:
        AssetError: The name is absolute, of the network, or leads out of the folder.
    """
    from urllib.parse import unquote

    path = PurePosixPath(unquote(name.partition("?")[0]).replace("\\", "/"))
    found = folder / path
    outside = "\0" in name or ":" in str(path) or path.is_absolute() or not path.parts
    if outside or not found.resolve().is_relative_to((top or folder).resolve()):
        raise AssetError(
            f"{where} names {name[:100]!r}; what it names lies in its folder or below: put the file there, "
            "and write its relative path"
        )
    return found


def at(items: Sequence[Item], index: int, what: str) -> Item:
    """Item of a list in a file.

    Raises:
        ValueError: There is none; says what of.
    """
    if not 0 <= index < len(items):
        raise ValueError(f"there is no {what} {index}: of {len(items)}, from 0")
    return items[index]


Y_UP = np.array([[1.0, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]])
"""Turns axes of which y is up and z south into x east, y north, z up."""


def moved(matrix: Float64Array, vertices: Float64Array, faces: Int64Array) -> tuple[Float64Array, Int64Array]:
    """Vertices and triangles after a homogeneous transform, their outside still in front if it mirrors.

    Args:
        matrix: Shape ``[4, 4]``.
        vertices: Shape ``[V, 3]``.
        faces: Shape ``[F, 3]``.
    """
    placed = vertices @ matrix[:3, :3].T + matrix[:3, 3]
    return placed, faces[:, ::-1] if np.linalg.det(matrix[:3, :3]) < 0 else faces


def surface_triangles(rings: Sequence[Float64Array]) -> tuple[Float64Array, Int64Array]:
    """Cut a flat surface into triangles that have all of its corners, as those of its neighbours do.

    Args:
        rings: Outline, counter-clockwise as seen from its front, and holes [m], Shape ``[N, 3]`` each.

    Returns:
        Corners, Shape ``[V, 3]``, and triangles, Shape ``[F, 3]``; none of an outline without area.
    """
    rings = [ring[(ring != np.roll(ring, 1, axis=0)).any(1)] for ring in rings]
    rings = [ring for ring in rings[:1] if len(ring) > 2] + [ring for ring in rings[1:] if len(ring) > 2]
    none = np.zeros((0, 3)), np.zeros((0, 3), np.int64)
    if not rings:
        return none
    points, outline = np.concatenate(rings), rings[0]
    if len(points) == 3:
        return points, np.array([[0, 1, 2]])
    sides = np.roll(outline, -1, axis=0) - outline
    arms = outline - outline[0]
    normal = np.cross(arms, np.roll(arms, -1, axis=0)).sum(0)  # Newell's
    if not np.linalg.norm(normal) > 0:
        return none
    normal /= np.linalg.norm(normal)
    turns = np.cross(np.roll(sides, 1, axis=0), sides) @ normal
    if len(rings) == 1 and len(outline) < 5 and (turns > 0).all():
        return points, np.array([[0, 1, 2], [0, 2, 3]], np.int64)[: len(outline) - 2]
    import shapely

    across = np.cross(normal, np.eye(3)[np.argmin(np.abs(normal))])
    across /= np.linalg.norm(across)
    plane = (points - points[0]) @ np.stack([across, np.cross(normal, across)], axis=1)
    ends = np.cumsum([len(ring) for ring in rings])
    shells = np.split(plane, ends[:-1])
    polygon = shapely.Polygon(shells[0], shells[1:])
    if polygon.is_valid:
        # Not by ear clipping, which leaves out corners on a straight line: there would be gaps.
        cells = shapely.get_parts(shapely.constrained_delaunay_triangles(polygon))
        corners = shapely.get_coordinates(cells).reshape(-1, 4, 2)[:, :3]
        number = {place: index for index, place in enumerate(map(tuple, plane.tolist()))}
        faces = np.array([number[x, y] for x, y in corners.reshape(-1, 2).tolist()]).reshape(-1, 3)
    else:
        from mapbox_earcut import triangulate_float64

        faces = triangulate_float64(plane, ends.astype(np.uint32)).astype(np.int64).reshape(-1, 3)
    (ax, ay), (bx, by), (cx, cy) = np.moveaxis(plane[faces], (1, 2), (0, 1))
    clockwise = (bx - ax) * (cy - ay) < (by - ay) * (cx - ax)
    faces[clockwise] = faces[clockwise, ::-1]
    return points, faces


def joined_triangles(surfaces: Sequence[Sequence[Float64Array]]) -> tuple[Float64Array, Int64Array]:
    """Corners and triangles of several surfaces; see `surface_triangles`."""
    cut = [surface_triangles(rings) for rings in surfaces]
    starts = np.cumsum([0, *(len(points) for points, _ in cut)])
    faces = [triangles + start for (_, triangles), start in zip(cut, starts, strict=False)]
    return np.concatenate([points for points, _ in cut]), np.concatenate(faces)


class SceneBuilder:
    """A scene in the making.

    Args:
        path: The source.
        request: Materials, and progress.
    """

    def __init__(self, path: Path, request: Request) -> None:
        self.scene = ImportedScene(name=slug(path.resolve().name.split(".")[0]) or "scene")
        self.request = request
        self._path = path
        self._assumed: dict[str, str] = {}
        self._dropped = self._triangles = 0
        self._empty: list[str] = []

    def itu(self, name: str) -> str:
        """Material in ITU-R P.2040 by the name that the source gives; what that does not say is noted."""
        asked = self.request.materials
        copied = re.sub(r"\.\d{3,}$", "", name)  # Blender numbers copies
        given = asked.get(name) or asked.get(copied)
        itu = given or itu_name(name) or self.request.material
        if not given and slug(itu) not in slug(name):
            self._assumed.setdefault(copied, itu)
        return itu

    def material(self, name: str, colour: Colour | None = None) -> str:
        """Key of a material.

        Args:
            name: As the source gives it; empty: it gives none.
            colour: Linear sRGB, 0…1.
        """
        return self.keep(name, wall_material(self.itu(name or "unnamed"), colour))

    def keep(self, name: str, made: RadioMaterial) -> str:
        """Key of a material with its properties.

        Args:
            name: As the source gives it.
            made: Its properties.
        """
        base = slug(re.sub(r"\.\d{3,}$", "", name)) or "unnamed"
        number, key = 1, base
        while self.scene.materials.setdefault(key, made) != made:
            number, key = number + 1, f"{base}-{number + 1}"
        return key

    def upright(self, vertices: Float64Array) -> Float64Array:
        """Vertices of a source without axes, turned as the request says which of them is up."""
        note = f"the format has no axes: {self.request.up} is taken as up"
        self.scene.notes += [note] if note not in self.scene.notes else []
        return vertices @ Y_UP[:3, :3].T if self.request.up == "y" else vertices

    def add(
        self,
        name: str,
        vertices: Float64Array,
        faces: Any,
        material: str,
        kind: str,
        file: Path,
        number: int,
        texture: Texture | None = None,
    ) -> None:
        """Add triangles, without those that have no area; corners at one place become one.

        Args:
            name: Of the piece, which gets a number where another has it.
            vertices: [m], Shape ``[V, 3]``.
            faces: Indices of vertices, Shape ``[F, 3]``.
            material: Key.
            kind: Of the piece.
            file, number: Of the source, and of the piece in it.
            texture: With the places of all ``vertices`` in its picture, Shape ``[V, 2]``.

        Raises:
            AssetError: A coordinate is not finite or too large, or a corner is no vertex.
        """
        said = f"{file}: {name!r}"
        self._triangles += max(len(faces), 1)
        if self._triangles > _MOST_TRIANGLES:
            raise AssetError(f"{self._path} has more than {_MOST_TRIANGLES} triangles; import it in parts")
        corners = np.asarray(faces, np.int64).reshape(-1, 3)
        if not len(corners):
            self._empty.append(f"{name!r} of {file.name}")
            return
        if not 0 <= corners.min() <= corners.max() < len(vertices):
            wrong = corners.max() if corners.max() >= len(vertices) else corners.min()
            raise AssetError(f"{said} has a corner at vertex {wrong} of {len(vertices)}; export it again")
        of_vertices, used, corners = corners, *np.unique(corners, return_inverse=True)
        points = np.asarray(vertices, np.float64)[used]
        bad = np.flatnonzero(~(np.abs(points) <= MAX_COORDINATE_M).all(1))
        if len(bad):
            raise AssetError(
                f"{said}: a vertex is at {points[bad[0]].tolist()}; give every vertex finite coordinates of "
                f"at most {MAX_COORDINATE_M:g} m"
            )
        points, place = np.unique(points, axis=0, return_inverse=True)
        corners = place.reshape(-1)[corners.reshape(-1, 3)]
        a, b, c = np.moveaxis(points[corners], 1, 0)
        area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
        flat = area <= 1e-9 * np.maximum(((b - a) ** 2).sum(1), ((c - a) ** 2).sum(1))
        self._dropped += int(flat.sum())
        if flat.all():
            return
        base = key = slug(name)[:100] or "piece"  # of which a file has its name
        count = 1
        while key in self.scene.pieces:
            count, key = count + 1, f"{base}-{number}" if count == 1 else f"{base}-{number}-{count}"
        mesh = Mesh(points, corners[~flat].astype(np.int32))
        texture = texture and texture.part(of_vertices[~flat])
        self.scene.pieces[key] = Piece(mesh, material, kind, file.name, number, texture)

    def note_left_out(self, counts: Mapping[str, int]) -> None:
        """Note what is left out.

        Args:
            counts: By what it is.
        """
        self.scene.notes += [f"{count} {what}: left out" for what, count in sorted(counts.items())]

    def finish(self, about_corner: bool = False) -> ImportedScene:
        """The scene, with notes of what was assumed.

        Args:
            about_corner: Whether its lowest corner becomes its origin; else that alone of one far away does.

        Raises:
            AssetError: It holds no piece.
        """
        scene, pieces = self.scene, self.scene.pieces
        if self._empty:
            scene.notes.append(f"without faces: {_shortened(self._empty)}: left out")
        if not pieces:
            said = "".join(f"; {note}" for note in scene.notes if note.endswith("left out"))[:200]
            raise AssetError(f"{self._path} holds no surface{said}; export it with faces")
        if self._dropped:
            scene.notes.append(f"{self._dropped} triangles have no area: left out")
        if self._assumed:
            assumed = [f"{name} {itu}" for name, itu in sorted(self._assumed.items())]
            scene.notes.append(f"materials by names of the source: {_shortened(assumed)}")
        low = np.floor(np.min([piece.mesh.vertices.min(0) for piece in pieces.values()], axis=0))
        high = np.max([piece.mesh.vertices.max(0) for piece in pieces.values()], axis=0)
        if scene.origin is None and (about_corner or max(-low.min(), high.max()) > _NEAR_M):
            for name, piece in pieces.items():
                mesh = Mesh(piece.mesh.vertices - low, piece.mesh.faces)
                pieces[name] = replace(piece, mesh=mesh)
            x, y, z = low.tolist()
            scene.notes.append(f"the origin of the scene is at {x:.0f}, {y:.0f}, {z:.0f} m of the source")
        scene.origin = scene.origin or self.request.origin
        used = {piece.material for piece in pieces.values()}
        scene.materials = {key: made for key, made in scene.materials.items() if key in used}
        self.request.progress("", 1.0)
        return scene

    def read(self, file: Path) -> bytes:
        """Content of a file, which becomes a source of the scene."""
        data = contents(file)
        self.scene.sources.append(source_of(file))
        return data


def _shortened(names: list[str]) -> str:
    return ", ".join(names[:12]) + (f" and {len(names) - 12} more" if len(names) > 12 else "")
