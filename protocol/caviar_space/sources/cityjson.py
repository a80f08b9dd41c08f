"""CityJSON 1.0 to 2.0: surfaces of buildings, roads and land in a frame of metres about their middle.

G. Ledoux et al., "CityJSON: a compact and easy-to-use encoding of the CityGML data model", Open Geospatial
Data, Software and Standards 4(4), 2019; https://www.cityjson.org/specs/2.0.1/.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Annotated, Any

import msgspec
import numpy as np

from caviar_protocol.arrays import Float64Array
from caviar_protocol.errors import AssetError
from caviar_space.imported_scenes import Georeference, ImportedScene
from caviar_space.meshes import Mesh
from caviar_space.mitsuba_xml import RadioMaterial
from caviar_space.sources import Request
from caviar_space.sources.pieces import SceneBuilder, at, itu_name, joined_triangles, reading, slug
from caviar_space.volumes import outward

# Levels of lists around the surfaces of a geometry.
_DEPTHS = {"MultiSurface": 0, "CompositeSurface": 0, "Solid": 1, "MultiSolid": 2, "CompositeSolid": 2}
_FOLIAGE = RadioMaterial(colour=(0.0, 0.25, 0.0))
_LEAVES = {"SolitaryVegetationObject", "PlantCover"}
_Place = tuple[float, float, float]
_Index = Annotated[int, msgspec.Meta(ge=0)]
_Rings = list[list[list[_Index]]]


class _Semantics(msgspec.Struct, frozen=True):
    surfaces: list[dict[str, Any]] = []
    values: list[Any] | None = None


class _Geometry(msgspec.Struct, frozen=True):
    type: str
    lod: str | float = ""
    boundaries: list[Any] = []
    semantics: _Semantics | None = None
    template: int = 0
    matrix: list[float] = msgspec.field(default=[], name="transformationMatrix")


class _Object(msgspec.Struct, frozen=True):
    type: str
    geometry: list[_Geometry] = []
    children: list[str] = []


class _Transform(msgspec.Struct, frozen=True):
    scale: _Place
    translate: _Place


class _Metadata(msgspec.Struct, frozen=True):
    system: str | None = msgspec.field(default=None, name="referenceSystem")


class _Templates(msgspec.Struct, frozen=True):
    templates: list[_Geometry] = []
    vertices: list[_Place] = msgspec.field(default=[], name="vertices-templates")


class _City(msgspec.Struct, frozen=True):
    """A whole file, or a line of a file of features."""

    type: str
    objects: dict[str, _Object] = msgspec.field(name="CityObjects")
    version: str = ""
    vertices: list[_Place] = []
    transform: _Transform | None = None
    metadata: _Metadata = _Metadata()
    templates: _Templates = msgspec.field(default=_Templates(), name="geometry-templates")


def read_cityjson(path: Path, request: Request) -> ImportedScene:
    """Read a CityJSON file as a scene; see `caviar_space.sources.Reader`.

    Each object of the city is a piece, or one for each of its materials. Heights stay those of the file.
    """
    builder = SceneBuilder(path, request)
    data = builder.read(path)
    with reading(path, "CityJSON"):
        # A file of lines has a feature in each, after one of what they have in common.
        lines = data.splitlines() if path.suffix.lower() == ".jsonl" else [data]
        city, *features = (msgspec.json.decode(line, type=_City) for line in lines if line.strip())
        if city.type != "CityJSON" or not city.version.startswith(("1.", "2.")):
            raise ValueError(f"it is {city.type} of version {city.version}: CityJSON 1.0 to 2.0 is read")
        objects: dict[str, _Object] = {}
        vertices: dict[str, Float64Array] = {}
        every: list[Float64Array] = []
        for each in (city, *features):
            points = np.array(each.vertices, np.float64).reshape(-1, 3)
            if city.transform is not None:
                points = points * city.transform.scale + city.transform.translate
            every.append(points)
            objects |= each.objects
            vertices |= dict.fromkeys(each.objects, points)
        to_scene = _projection(builder, np.concatenate(every), city.metadata.system)
        levels = {_lod(geometry) for thing in objects.values() for geometry in thing.geometry}
        if request.lod and request.lod not in levels:
            raise AssetError(
                f"{path} has no level of detail {request.lod!r}; it has: {', '.join(sorted(levels))}"
            )
    left_out: dict[str, int] = {}
    for number, (name, thing) in enumerate(objects.items(), 1):
        if number % 100 == 1:
            request.progress(name, number / len(objects))
        level = request.lod or _finest(thing)
        parts = [_finest(objects[child]) for child in thing.children if child in objects]
        if not request.lod and level < max(parts, default=""):
            continue  # its parts have it in more detail
        with reading(f"{path}: object {name!r}", "CityJSON"):
            surfaces: dict[str, list[list[Float64Array]]] = {}
            for geometry in (g for g in thing.geometry if _lod(g) == level):
                if geometry.type not in (*_DEPTHS, "GeometryInstance"):
                    left_out[geometry.type] = left_out.get(geometry.type, 0) + 1
                    continue
                for rings, surface in _surfaces(city, vertices[name], geometry):
                    if surface == "ClosureSurface":  # closes a volume where there is no wall
                        left_out[surface] = left_out.get(surface, 0) + 1
                        continue
                    said = surface in request.materials or itu_name(surface)
                    surfaces.setdefault(builder.itu(surface if said else thing.type), []).append(rings)
            for itu, outlines in surfaces.items():
                corners, faces = joined_triangles(outlines)
                corners, kind = to_scene(corners), slug(thing.type)
                if thing.type in _LEAVES and _is_closed(corners, faces):
                    kind = "foliage"
                elif thing.type == "SolitaryVegetationObject":
                    left_out["open trees"] = left_out.get("open trees", 0) + 1
                    continue
                material = builder.keep(kind, _FOLIAGE) if kind == "foliage" else builder.material(itu)
                called = f"{kind}-{name}" if len(surfaces) == 1 else f"{kind}-{name}-{itu}"
                builder.add(called, corners, faces, material, kind, path, number)
    builder.note_left_out(left_out)
    return builder.finish(about_corner=builder.scene.origin is None)


def _lod(geometry: _Geometry) -> str:
    return f"{geometry.lod:g}" if isinstance(geometry.lod, float) else geometry.lod


def _finest(thing: _Object) -> str:
    kinds = (*_DEPTHS, "GeometryInstance")
    return max((_lod(each) for each in thing.geometry if each.type in kinds), default="")


def _surfaces(
    city: _City, vertices: Float64Array, geometry: _Geometry
) -> Iterator[tuple[list[Float64Array], str]]:
    """Rings of each surface in the file's coordinates, and the type of its semantics."""
    if geometry.type == "GeometryInstance":
        anchor = vertices[msgspec.convert(geometry.boundaries, list[_Index])[0]]
        template = at(city.templates.templates, geometry.template, "template")
        if template.type not in _DEPTHS:
            return
        matrix = np.reshape(np.array(geometry.matrix, np.float64), (4, 4))
        points = np.array(city.templates.vertices, np.float64).reshape(-1, 3)
        vertices, geometry = points @ matrix[:3, :3].T + matrix[:3, 3] + anchor, template
    boundaries, values = geometry.boundaries, None
    if geometry.semantics is not None:
        values = geometry.semantics.values
    for _ in range(_DEPTHS[geometry.type]):
        if values is not None:
            values = [
                value
                for part, inner in zip(values, boundaries, strict=True)
                for value in (part if part is not None else [None] * len(inner))
            ]
        boundaries = [inner for part in boundaries for inner in part]
    surfaces = msgspec.convert(boundaries, _Rings)
    types = [str(each.get("type", "")) for each in geometry.semantics.surfaces] if geometry.semantics else []
    for rings, value in zip(surfaces, values or [None] * len(surfaces), strict=True):
        yield (
            [vertices[ring] for ring in rings],
            at(types, value, "semantic surface") if value is not None else "",
        )


def _is_closed(corners: Float64Array, faces: Any) -> bool:
    try:
        outward(Mesh(corners, faces))
    except ValueError:
        return False
    return True


def _projection(
    builder: SceneBuilder, vertices: Float64Array, system: str | None
) -> Callable[[Float64Array], Float64Array]:
    """Conversion of the file's coordinates into those of the scene, whose origin it sets."""
    if system is None:
        builder.scene.notes.append(
            "the file has no referenceSystem: where the scene lies on the Earth is open"
        )
        return lambda points: points
    from pyproj import CRS, Transformer

    code = re.search(r"EPSG\W+(?:\d[\d.]*\W+)?(\d+)$", system, re.IGNORECASE)
    if code is None:
        raise ValueError(f"referenceSystem {system!r} names no EPSG code")
    whole = CRS.from_epsg(int(code[1]))
    flat = whole.sub_crs_list[0] if whole.sub_crs_list else whole
    up = whole.axis_info[2].unit_conversion_factor if len(whole.axis_info) > 2 else 1.0
    to_wgs84 = Transformer.from_crs(flat, CRS.from_epsg(4326), always_xy=True)
    x, y = (vertices[:, :2].min(0) + vertices[:, :2].max(0)) / 2
    longitude, latitude = to_wgs84.transform(x, y, errcheck=True)
    if builder.request.origin is not None:
        origin = msgspec.structs.replace(builder.request.origin, projection="tmerc")
    else:
        origin = Georeference(
            latitude_deg=round(latitude, 7), longitude_deg=round(longitude, 7), projection="tmerc"
        )
    builder.scene.origin = origin
    way = to_wgs84.get_last_used_operation()
    known = f"accurate to {way.accuracy:g} m" if way.accuracy >= 0 else "of unknown accuracy"
    builder.scene.notes.append(f"{way.description}: {known}")

    def to_scene(points: Float64Array) -> Float64Array:
        longitude, latitude = to_wgs84.transform(points[:, 0], points[:, 1])
        return origin.places(np.stack([longitude, latitude, points[:, 2] * up], axis=-1))

    return to_scene
