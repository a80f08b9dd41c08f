"""Scenes that are imported: what they hold, the folder they become, and where they lie on the Earth.

A reader of a format makes an `ImportedScene`, `write_scene` the folder: ``scene.xml`` with meshes, which is
what ``scenery = "file:…/scene.xml"`` names, and ``scene.json``, which says what came from where.
"""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import msgspec
import numpy as np

from caviar_protocol.arrays import Float64Array
from caviar_protocol.digest import file_digest
from caviar_protocol.errors import AssetError, SetupError
from caviar_protocol.host import install_command
from caviar_space.meshes import Mesh
from caviar_space.mitsuba_xml import RadioMaterial, scenery_files
from caviar_space.volumes import outward

Place = tuple[float, float, float]


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
    notes: list[str] = field(default_factory=list)
    """Differences between the source and what the scene holds."""


def source_of(file: Path) -> dict[str, str | int]:
    """Name, size and SHA-256 of a file, for the provenance.

    Args:
        file: A file that was read.
    """
    return {"file": file.name, "bytes": file.stat().st_size, "sha256": file_digest(file)}


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
    files["scene.json"] = msgspec.json.format(msgspec.json.encode(description), indent=2)
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(prefix=f".{out.name}-", dir=out.parent) as temporary:
            made = Path(temporary) / "scene"
            for path, content in {**files, **(more or {})}.items():
                (made / path).parent.mkdir(parents=True, exist_ok=True)
                (made / path).write_bytes(content)
            shutil.move(made, out)
    except OSError as error:
        raise AssetError(f"cannot write {out}: {error.strerror}; choose another folder") from error
