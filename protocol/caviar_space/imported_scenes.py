"""Scenes that are imported: what they hold, the folder they become, and where they lie on the Earth.

A reader of a format makes an `ImportedScene`, `write_scene` the folder: ``scene.xml`` with meshes, which is
what ``scenery = "file:…/scene.xml"`` names, and ``scene.json``, which says what came from where.
"""

from __future__ import annotations

import tempfile
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import msgspec
import numpy as np

from caviar_protocol.arrays import Float64Array, Int64Array
from caviar_protocol.digest import file_digest
from caviar_protocol.errors import AssetError, SetupError
from caviar_protocol.host import install_command
from caviar_space.ground import are_ground
from caviar_space.meshes import Mesh
from caviar_space.mitsuba_xml import RadioMaterial, scenery_files
from caviar_space.textures import Texture
from caviar_space.volumes import outward

Place = tuple[float, float, float]

# Of walls and roofs whose source says none, where it is not 0.2 m.
_THICKNESS_M = {"glass": 0.01, "metal": 0.01, "wood": 0.05}


class Georeference(msgspec.Struct, frozen=True, kw_only=True):
    """Origin of a scene on the ellipsoid of WGS84; x is east, y north, z up [m]."""

    latitude_deg: float
    longitude_deg: float
    altitude_m: float = 0.0
    projection: Literal["enu", "tmerc"] = "enu"
    """``enu``: axes of the plane that touches the ellipsoid at the origin; ``tmerc``: transverse Mercator of
    scale 1 about the origin, in which maps are drawn, and z the height above the ellipsoid at each place."""

    def to_scene(self, latitude_deg: float, longitude_deg: float, altitude_m: float = 0.0) -> Place:
        """Convert a place on WGS84 to x, y, z in the scene [m].

        Raises:
            SetupError: pyproj, of the extra ``geo``, is not installed.
        """
        x, y, z = self._transformer().transform(longitude_deg, latitude_deg, altitude_m)
        return x, y, z

    def to_wgs84(self, x: float, y: float, z: float = 0.0) -> Place:
        """Convert a place in the scene [m] to latitude [°], longitude [°] and altitude [m].

        Raises:
            SetupError: See `to_scene`.
        """
        longitude, latitude, altitude = self._transformer().transform(x, y, z, direction="INVERSE")
        return latitude, longitude, altitude

    def places(self, degrees: Float64Array) -> Float64Array:
        """Convert places on WGS84 to x, y, z in the scene [m], Shape ``[N, 3]``.

        Args:
            degrees: Longitude [°], latitude [°] and altitude [m], Shape ``[N, 3]``.

        Raises:
            SetupError: See `to_scene`.
        """
        return np.stack(self._transformer().transform(*degrees.T), axis=-1)

    def _transformer(self) -> Any:
        try:
            from pyproj import Transformer
        except ImportError as error:
            raise SetupError(
                f"places on the Earth need pyproj, of the extra `geo`; run: {install_command('geo')}"
            ) from error
        origin = f"+lat_0={self.latitude_deg!r} +lon_0={self.longitude_deg!r}"
        if self.projection == "tmerc":
            return Transformer.from_pipeline(
                "+proj=pipeline +step +proj=unitconvert +xy_in=deg +xy_out=rad +step +proj=tmerc +k=1 "
                f"+ellps=WGS84 {origin} +step +proj=affine +zoff={-self.altitude_m!r}"
            )
        origin += f" +h_0={self.altitude_m!r}"
        return Transformer.from_pipeline(
            "+proj=pipeline +step +proj=unitconvert +xy_in=deg +xy_out=rad +step +proj=cart +ellps=WGS84 "
            f"+step +proj=topocentric +ellps=WGS84 {origin}"
        )


@dataclass(frozen=True, eq=False)
class Piece:
    """A piece of scenery."""

    mesh: Mesh
    """In world coordinates [m]."""
    material: str
    kind: str
    """``foliage``: a volume; anything else: faces."""
    file: str
    line: int
    """Of the source, where it begins."""
    texture: Texture | None = None


@dataclass(eq=False, kw_only=True)
class ImportedScene:
    """Content of a scene, as a reader of its format finds it."""

    name: str
    origin: Georeference | None = None
    """None: the source has none."""
    pieces: dict[str, Piece] = field(default_factory=dict)
    materials: dict[str, RadioMaterial] = field(default_factory=dict)
    transmitters_m: list[Place] = field(default_factory=list)
    receivers_m: list[Place] = field(default_factory=list)
    frequencies_hz: list[float] = field(default_factory=list)
    without_foliage_loss: bool = False
    """Whether the source says that foliage takes nothing from waves."""
    sources: list[dict[str, str | int]] = field(default_factory=list)
    """File, bytes and SHA-256 of each file that was read."""
    files: dict[str, bytes] = field(default_factory=dict)
    """Content of other files of its folder, by path: the network of its roads, ``sumo/net.net.xml``."""
    notes: list[str] = field(default_factory=list)
    """Differences between the source and what the scene holds."""


def wall_material(itu_material: str, colour: tuple[float, float, float] | None = None) -> RadioMaterial:
    """Material of walls and roofs of which a source says no thickness.

    Args:
        itu_material: Its name in ITU-R P.2040.
        colour: Linear sRGB, 0…1; None: as the material looks.
    """
    return RadioMaterial(itu_material, _THICKNESS_M.get(itu_material, 0.2), colour)


def source_of(file: Path) -> dict[str, str | int]:
    """Name, size and SHA-256 of a file, for the provenance.

    Args:
        file: A file that was read.
    """
    return {"file": file.name, "bytes": file.stat().st_size, "sha256": file_digest(file)}


Box = tuple[float, float, float, float]


def box_in_metres(box_deg: Box, origin: Georeference) -> Box:
    """Lowest x and y, highest x and y [m] of a box on the Earth.

    Args:
        box_deg: West, south, east, north on WGS84 [°].
        origin: Of the scene.

    Raises:
        SetupError: See `Georeference.to_scene`.
    """
    west, south, east, north = box_deg
    corners = [origin.to_scene(lat, lon, origin.altitude_m) for lat in (south, north) for lon in (west, east)]
    (x0, y0, _), (x1, y1, _) = np.min(corners, axis=0).tolist(), np.max(corners, axis=0).tolist()
    return x0, y0, x1, y1


def cut_to_box(scene: ImportedScene, box: Box) -> None:
    """Cut a scene to a box.

    What is connected and no larger than the box stays whole where its middle is within, and goes otherwise:
    a building, a tree. What is larger ends at the border: the ground, or a town that is one surface.

    Args:
        scene: The scene, which is changed.
        box: Lowest x and y, highest x and y [m].

    Raises:
        AssetError: Nothing of the scene is within.
    """
    low, high = np.array(box[:2]), np.array(box[2:])
    names = list(scene.pieces)
    level = dict(zip(names, are_ground([scene.pieces[name].mesh for name in names]), strict=True))
    count = len(names)
    for name in names:
        piece = scene.pieces.pop(name)
        triangles = piece.mesh.vertices[piece.mesh.faces]
        part = np.zeros(len(triangles), np.int64) if level[name] else _connected(piece.mesh)
        parts = int(part.max(initial=-1)) + 1
        if piece.texture is not None:
            triangles = np.concatenate([triangles, piece.texture.uv], axis=2)
        ends = np.full((2, parts, 2), np.inf)
        np.minimum.at(ends[0], part, triangles[..., :2].min(axis=1))
        np.minimum.at(ends[1], part, -triangles[..., :2].max(axis=1))
        first, last = ends[0], -ends[1]
        middle = ((first + last) / 2 >= low) & ((first + last) / 2 <= high)
        large = ((last - first) > high - low).any(axis=1) | level[name]
        # A volume that is cut is open: it stays whole.
        cut = large & (piece.kind != "foliage")
        kept = [triangles[(middle.all(axis=1) & ~cut)[part]], _clipped(triangles[cut[part]], low, high)]
        triangles = np.concatenate(kept)
        if len(triangles):
            corners = triangles[..., :3].reshape(-1, 3)
            vertices, places = np.unique(corners, axis=0, return_inverse=True)
            mesh = Mesh(vertices, places.reshape(-1, 3).astype(np.int32))
            texture = piece.texture and replace(piece.texture, uv=triangles[..., 3:])
            scene.pieces[name] = replace(piece, mesh=mesh, texture=texture)
    if not scene.pieces:
        raise AssetError(f"nothing of the {count} pieces of {scene.name} is within the box; name another one")
    if len(scene.pieces) < count:
        scene.notes.append(f"{count - len(scene.pieces)} of {count} pieces outside of the box: left out")
    for antennas in (scene.transmitters_m, scene.receivers_m):
        inside = [place for place in antennas if (low <= place[:2]).all() and (high >= place[:2]).all()]
        if len(inside) < len(antennas):
            scene.notes.append(f"{len(antennas) - len(inside)} antennas outside of the box: left out")
        antennas[:] = inside


def _connected(mesh: Mesh) -> Int64Array:
    """Number of the connected part of each triangle, by corners at one place, Shape ``[F]``."""
    from scipy.sparse import coo_array  # type: ignore[import-untyped]
    from scipy.sparse.csgraph import connected_components  # type: ignore[import-untyped]

    _, place = np.unique(mesh.vertices, axis=0, return_inverse=True)
    a, b, c = place.reshape(-1)[mesh.faces].T
    ends = np.concatenate([a, b]), np.concatenate([b, c])
    graph = coo_array((np.ones(2 * len(a)), ends), shape=(len(mesh.vertices),) * 2)
    _, found = np.unique(connected_components(graph, directed=False)[1][a], return_inverse=True)
    return found.reshape(-1)


def _clipped(triangles: Float64Array, low: Float64Array, high: Float64Array) -> Float64Array:
    """Parts of triangles within a box, as triangles, Shape ``[F, 3, N]`` to ``[G, 3, N]``; what corners have
    beside x and y is interpolated."""
    for axis, sign, limit in ((0, 1, low[0]), (1, 1, low[1]), (0, -1, -high[0]), (1, -1, -high[1])):
        distance = sign * triangles[..., axis] - limit
        inside = distance >= 0
        made = [triangles[inside.all(axis=1)]]
        for alone in (True, False):  # whether the corner that differs from both others is within
            chosen = inside.sum(axis=1) == (1 if alone else 2)
            turn = (inside[chosen] == alone).argmax(axis=1)[:, None] + np.arange(3)
            rows = np.arange(len(turn))[:, None]
            corner, d = triangles[chosen][rows, turn % 3], distance[chosen][rows, turn % 3]
            share = d[:, :1] / (d[:, :1] - d[:, 1:])
            first, second = np.moveaxis(
                corner[:, :1] + share[..., None] * (corner[:, 1:] - corner[:, :1]), 1, 0
            )
            if alone:
                made.append(np.stack([corner[:, 0], first, second], axis=1))
            else:
                made.append(np.stack([first, corner[:, 1], corner[:, 2]], axis=1))
                made.append(np.stack([first, corner[:, 2], second], axis=1))
        triangles = np.concatenate(made)
    return triangles


def write_scene(scene: ImportedScene, out: Path, more: Mapping[str, bytes] | None = None) -> None:
    """Write the folder of a scene, whole or not at all.

    Args:
        scene: The scene.
        out: Folder that is made.
        more: Content of other files of it, by path.

    Raises:
        AssetError: The folder is there or cannot be written, or foliage is not closed; names it.
    """
    if out.exists():
        raise AssetError(f"{out} is there already; name another folder, or remove it")
    for name, piece in scene.pieces.items():
        try:
            if piece.kind == "foliage":
                outward(piece.mesh)
        except ValueError as error:
            raise AssetError(
                f"{piece.file}:{piece.line}: foliage {name!r} encloses no volume: {error}; close it"
            ) from error
    shapes = {name: (piece.mesh, piece.material) for name, piece in scene.pieces.items()}
    used = {material: scene.materials[material] for _, material in shapes.values()}
    files = {
        name.removeprefix("scenery/"): content
        for name, content in scenery_files("scene", shapes, used).items()
    }
    description = {
        "name": scene.name,
        "axes": "x east, y north, z up [m]",
        "origin": scene.origin,
        "pieces": {
            name: {
                "kind": piece.kind,
                "material": piece.material,
                "source": f"{piece.file}:{piece.line}",
                "triangles": len(piece.mesh.faces),
                **({"texture": piece.texture.described(name)} if piece.texture else {}),
            }
            for name, piece in scene.pieces.items()
        },
        "materials": {name: material._asdict() for name, material in used.items()},
        "transmitters_m": scene.transmitters_m,
        "receivers_m": scene.receivers_m,
        "frequencies_hz": scene.frequencies_hz,
        "notes": scene.notes,
        "sources": scene.sources,
    }
    for name, piece in scene.pieces.items():
        if piece.texture:
            files[piece.texture.path] = piece.texture.image
            files[f"meshes/{name}.uv"] = piece.texture.uv.astype("<f4").tobytes()
    files["scene.json"] = msgspec.json.format(msgspec.json.encode(description), indent=2)
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(prefix=f".{out.name}-", dir=out.parent) as temporary:
            made = Path(temporary) / "scene"
            for path, content in {**files, **scene.files, **(more or {})}.items():
                (made / path).parent.mkdir(parents=True, exist_ok=True)
                (made / path).write_bytes(content)
            made.rename(out)  # not into a folder that came to be meanwhile
    except OSError as error:
        raise AssetError(f"cannot write {out}: {error.strerror}; choose another folder") from error
