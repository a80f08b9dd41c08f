"""Sources of scenes: readers of files of other programs, one module a family of formats.

A reader takes a path and a `Request`, and gives an `ImportedScene`. A new format is a function here and a row
of `READERS`; nothing else names it. What a reader needs of third parties is in the extra ``scenes``, and is
imported when the reader runs.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from pkgutil import resolve_name
from typing import Literal, Protocol

from caviar_protocol.errors import AssetError
from caviar_space.imported_scenes import Box, Georeference, ImportedScene, box_in_metres, cut_to_box


@dataclass(frozen=True, kw_only=True)
class Request:
    """What a user asks of a reader."""

    box_deg: Box | None = None
    """West, south, east, north on WGS84 [°]; None: all of the source."""
    box_m: Box | None = None
    """Lowest x and y, highest x and y, in the scene [m]; None: all of the source."""
    origin: Georeference | None = None
    """Origin of the scene on the Earth; None: the source's, or the middle of the box or of the source."""
    heights: Path | None = None
    """Grid of heights of the ground (GeoTIFF, DTED); None: flat, at 0."""
    material: str = "concrete"
    """Material in ITU-R P.2040 of what the source gives none."""
    materials: Mapping[str, str] = field(default_factory=dict)
    """Material in ITU-R P.2040 by the name that the source gives."""
    up: Literal["y", "z"] = "z"
    """Axis that points up in sources of meshes that do not say: OBJ, PLY, STL, Mitsuba."""
    lod: str = ""
    """Level of detail to take, where the source has several; empty: the finest."""
    error_m: float = 0.0
    """Largest geometric error of tiles [m]; 0: the finest tiles."""
    progress: Callable[[str, float], None] = lambda name, share: None
    """Called with what comes next, and the share that is done, 0…1."""


class Reader(Protocol):
    """Function that reads a source.

    Raises:
        AssetError: A file is missing or wrong; names file, place and remedy.
        SetupError: A library of the extra ``scenes`` is not installed.
    """

    def __call__(self, path: Path, request: Request) -> ImportedScene: ...


_SOURCES = "caviar_space.sources"

READERS: Mapping[str, tuple[tuple[str, ...], str]] = {
    "wireless-insite": (
        (".study.xml", ".city", ".ter", ".object", ".veg"), f"{_SOURCES}.wireless_insite:read_project",
    ),
    "openstreetmap": ((".osm", ".osm.pbf", ".osm.bz2", ".osm.gz", ".geojson"),
                      f"{_SOURCES}.openstreetmap:read_map"),
    "3d-tiles": (("tileset.json",), f"{_SOURCES}.tiles3d:read_tileset"),
    "cityjson": ((".city.json", ".json", ".jsonl"), f"{_SOURCES}.cityjson:read_cityjson"),
    "gltf": ((".glb", ".gltf"), f"{_SOURCES}.gltf:read_gltf"),
    "obj": ((".obj",), f"{_SOURCES}.mesh_files:read_obj"),
    "ply": ((".ply",), f"{_SOURCES}.mesh_files:read_ply_scene"),
    "stl": ((".stl",), f"{_SOURCES}.mesh_files:read_stl"),
    "dxf": ((".dxf",), f"{_SOURCES}.dxf:read_dxf"),
    "mitsuba": ((".xml",), f"{_SOURCES}.mitsuba:read_mitsuba"),
}  # fmt: skip
"""Ends of the names of files, and the place of the reader, by the name of the format.

Of several ends that fit, the longest counts. A folder is of the first format of whose files it has some.
"""

# They have more within the box than triangles, roads, and no heights of the ground.
_MAPS = ("openstreetmap",)


def read_source(path: Path, request: Request | None = None, form: str = "") -> ImportedScene:
    """Read a source of a scene.

    Args:
        path: File, or folder of files.
        request: Box, origin, materials, and detail; by default all of the source as it is.
        form: A key of `READERS`; empty: by the name of the file.

    Raises:
        AssetError: There is no such file or format, or the file is wrong.
        SetupError: A library of the extra ``scenes`` is not installed.
    """
    request = request or Request()
    if not path.exists():
        raise AssetError(f"{path} is not there; name a file or folder of: {', '.join(READERS)}")
    name = form or _format_of(path)
    if name not in READERS:
        said = f"no format of scenes {name!r}" if name else "its name is that of no format of scenes"
        raise AssetError(f"{path}: {said}; write --format: {', '.join(READERS)}")
    if request.heights and name not in _MAPS:
        raise AssetError(f"{path} has its own ground; heights are for maps: {', '.join(_MAPS)}")
    ends, reader_place = READERS[name]
    if path.is_dir() and name != "wireless-insite":
        files = sorted(file for file in path.iterdir() if file.name.lower().endswith(ends))
        if len(files) != 1:
            said = ", ".join(file.name for file in files[:5]) or "none"
            raise AssetError(f"{path} has {len(files)} files of {name} ({said}); name one")
        path = files[0]
    reader: Reader = resolve_name(reader_place)
    scene = reader(path, request)
    scene.origin = scene.origin or request.origin
    box = request.box_m
    if request.box_deg:
        if scene.origin is None:
            raise AssetError(f"{path} has no place on the Earth; write --origin LAT,LON, or --box-m")
        box = box_in_metres(request.box_deg, scene.origin)
    if box and name not in _MAPS:
        cut_to_box(scene, box)
    return scene


def _format_of(path: Path) -> str:
    names = sorted(file.name.lower() for file in path.iterdir()) if path.is_dir() else [path.name.lower()]
    fitting = [
        (len(end) if path.is_file() else -number, form)
        for number, (form, (ends, _)) in enumerate(READERS.items())
        for end in ends
        if any(name.endswith(end) for name in names)
    ]
    found = max(fitting, default=(0, ""))[1]
    if found == "cityjson" and path.is_file():  # .json says little
        with path.open("rb") as file:
            head = file.read(1 << 16)
        for word, form in ((b'"geometricError"', "3d-tiles"), (b'"FeatureCollection"', "openstreetmap")):
            if word in head:
                return form
    return found
