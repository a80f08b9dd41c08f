"""Files of OpenStreetMap: areas, trees, coasts and roads of XML, PBF and GeoJSON, with their tags.

``.osm`` and ``.osm.pbf`` are read by osmium, which puts multipolygons together; GeoJSON has the same tags as
properties.
"""

from __future__ import annotations

import re
import tempfile
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
import numpy as np

from caviar_protocol.arrays import Float64Array
from caviar_protocol.errors import AssetError, one_line

_KEYS = ("building", "building:part", "highway", "natural", "landuse", "waterway", "type")
# Nodes of a road that netconvert makes use of.
_SIGNS = ("traffic_signals", "crossing", "stop", "give_way", "mini_roundabout")


class Element(NamedTuple):
    """Element of a map."""

    name: str
    """``w``, ``r`` or ``n``, and the number of the way, relation or node."""
    tags: Mapping[str, str]
    shape: Any
    """Shapely's geometry."""


class Way(NamedTuple):
    """Road of a map."""

    number: int
    tags: Mapping[str, str]
    nodes: tuple[int, ...]
    places: Float64Array
    """Of its nodes: first longitude and latitude [°], then x and y [m], Shape ``[N, 2]``."""


@dataclass(eq=False)
class Map:
    """Content of a map, in longitude and latitude [°]."""

    areas: list[Element] = field(default_factory=list)
    trees: list[Element] = field(default_factory=list)
    coast: list[Element] = field(default_factory=list)
    """Lines with the land to their left."""
    roads: list[Way] = field(default_factory=list)
    signs: dict[int, Mapping[str, str]] = field(default_factory=dict)
    """Tags of nodes of roads that stand for traffic signals and the like."""
    bounds: tuple[float, float, float, float] | None = None
    """West, south, east, north."""
    left_out: Counter[str] = field(default_factory=Counter)
    """What of the map the scene does not hold, and how often."""


def read_map_file(path: Path) -> Map:
    """Read a map.

    Args:
        path: ``.osm``, ``.osm.pbf``, ``.geojson``.

    Raises:
        AssetError: The file is no map, or damaged.
    """
    try:
        if path.suffix.lower() in (".geojson", ".json"):
            return _read_geojson(path)
        found = _read_osm(path)
        if not found.areas and not found.roads and found.left_out.total():
            # Overpass gives nodes after ways, and JOSM negative numbers: osmium finds no node then.
            with tempfile.TemporaryDirectory(prefix="caviar-map-") as folder:
                found = _read_osm(_in_order(path, Path(folder)))
    except OSError as error:
        raise AssetError(f"cannot read {path}: {error.strerror or error}") from error
    except RuntimeError as error:
        raise AssetError(
            f"{path} cannot be put in order: {one_line(str(error))}; sort it by osmium"
        ) from error
    return found


def metres(text: str) -> float | None:
    """Length of a tag [m]: ``12``, ``10,5``, ``10 m``, ``33 ft``, ``33'6"``; None where it is none.

    Example:
        >>> metres("10,5"), metres("12.13 m"), metres("100 ft"), metres("NaN")
        (10.5, 12.13, 30.48, None)
    """
    found = re.fullmatch(
        r"""\s*(?P<number>[+-]?\d{1,9}([.,]\d+)?)\s*(?P<unit>m|metres?|meters?|ft|feet|')?"""
        r"""\s*((?P<inches>\d{1,2})\s*(in|"|''))?\s*""",
        text.lower(),
    )
    if found is None:
        return None
    value = float(found["number"].replace(",", "."))
    if found["unit"] in ("ft", "feet", "'"):
        return (value + float(found["inches"] or 0) / 12) * 0.3048
    return None if found["inches"] else value


def _read_osm(path: Path) -> Map:
    import osmium
    import shapely

    found, seen = Map(), set[str]()
    wkb = osmium.geom.WKBFactory()
    rings: dict[str, Mapping[str, str]] = {}
    try:
        with osmium.io.Reader(str(path)) as reader:
            box = reader.header().box()
            if box.valid():
                low, high = box.bottom_left, box.top_right
                found.bounds = (low.lon, low.lat, high.lon, high.lat)
        keys = osmium.filter.KeyFilter(*_KEYS)
        for thing in osmium.FileProcessor(str(path)).with_areas(keys).with_filter(keys):
            tags = dict(thing.tags)
            if thing.is_area():
                name = f"{'w' if thing.from_way() else 'r'}{thing.orig_id()}"
                # An outline that crosses itself is an area without rings.
                if _is_area(tags) and thing.num_rings()[0]:
                    seen.add(name)
                    found.areas.append(Element(name, tags, shapely.from_wkb(wkb.create_multipolygon(thing))))
            elif thing.is_way():
                if _is_area(tags) and "highway" not in tags:
                    rings[f"w{thing.id}"] = tags
                elif "highway" in tags or tags.get("natural") in ("tree_row", "coastline"):
                    _add_line(found, thing.id, tags, thing.nodes)
            elif thing.is_relation():
                if _is_area(tags) and tags.get("type") == "multipolygon":
                    rings[f"r{thing.id}"] = tags
            elif tags.get("natural") == "tree":
                place = shapely.Point(thing.location.lon, thing.location.lat)
                found.trees.append(Element(f"n{thing.id}", tags, place))
            elif tags.get("highway") in _SIGNS:
                found.signs[thing.id] = tags
    except (RuntimeError, ValueError, osmium.InvalidLocationError) as error:
        raise AssetError(f"{path} cannot be read: {one_line(str(error))}; get the extract again") from error
    for name in rings.keys() - seen:
        what = "building" if building_kind(rings[name]) else "area"
        found.left_out[f"{what} without a closed outline: cut at the border, or crossing itself"] += 1
    return found


def _in_order(path: Path, folder: Path) -> Path:
    """A copy of a map with positive numbers, nodes before ways before relations."""
    import osmium

    with osmium.SimpleWriter(str(folder / "positive.osm.pbf")) as writer:
        for thing in osmium.FileProcessor(str(path)):
            if thing.is_node():
                writer.add(thing.replace(id=abs(thing.id)))
            elif thing.is_way():
                writer.add(thing.replace(id=abs(thing.id), nodes=[abs(node.ref) for node in thing.nodes]))
            else:
                members = [(member.type, abs(member.ref), member.role) for member in thing.members]
                writer.add(thing.replace(id=abs(thing.id), members=members))
    merged = osmium.MergeInputReader()
    merged.add_file(str(folder / "positive.osm.pbf"))
    with osmium.SimpleWriter(str(folder / "ordered.osm.pbf")) as writer:
        merged.apply(writer)
    return folder / "ordered.osm.pbf"


def _add_line(found: Map, number: int, tags: Mapping[str, str], nodes: Any) -> None:
    """Add a road or a row of trees, without nodes that the file has not."""
    import shapely

    there = [node for node in nodes if node.location.valid()]
    found.left_out["node of a road that is not in the file"] += len(nodes) - len(there)
    places = np.array([(node.location.lon, node.location.lat) for node in there]).reshape(-1, 2)
    if len(there) < 2:
        return
    if "highway" in tags:
        found.roads.append(Way(number, tags, tuple(node.ref for node in there), places))
    else:
        lines = found.coast if tags["natural"] == "coastline" else found.trees
        lines.append(Element(f"w{number}", tags, shapely.LineString(places)))


class _Feature(msgspec.Struct):
    properties: dict[str, Any] | None = None
    geometry: dict[str, Any] | None = None
    id: Any = None


class _Collection(msgspec.Struct):
    type: str
    features: list[_Feature]


def _read_geojson(path: Path) -> Map:
    import shapely

    try:
        collection = msgspec.json.decode(path.read_bytes(), type=_Collection)
    except (msgspec.MsgspecError, RecursionError, UnicodeError) as error:
        raise AssetError(
            f"{path} is no GeoJSON: {one_line(str(error))}; write a FeatureCollection"
        ) from error
    found, numbers = Map(), dict[tuple[float, float], int]()
    for index, feature in enumerate(collection.features):
        where = f"{path}: feature {index}"
        given = feature.properties or {}
        given = given | given["tags"] if isinstance(given.get("tags"), dict) else given
        tags = {key: str(value) for key, value in given.items() if value is not None}
        name = re.sub(r"\W+", "-", str(feature.id or given.get("@id") or index))[:60].strip("-")
        if not feature.geometry:
            found.left_out["feature without a geometry"] += 1
            continue
        try:
            shape = shapely.geometry.shape(feature.geometry)
        except Exception as error:  # of whatever kind the values are wrong
            raise AssetError(f"{where}: its geometry is none: {one_line(str(error))}; mend it") from error
        places = shapely.get_coordinates(shape)
        if not (np.isfinite(places).all() and (np.abs(places) <= (180, 90)).all()):
            raise AssetError(
                f"{where}: coordinates beyond 180 and 90; GeoJSON has longitude and latitude [°]"
            )
        for part in shapely.get_parts(shape):
            if part.geom_type == "Polygon" and _is_area(tags):
                found.areas.append(Element(f"f{name}", tags, part))
            elif part.geom_type == "LineString" and "highway" in tags:
                at = shapely.get_coordinates(part)
                refs = tuple(numbers.setdefault(tuple(p), len(numbers) + 1) for p in np.round(at, 7).tolist())
                found.roads.append(Way(index + 1, tags, refs, at))
            elif part.geom_type in ("Point", "LineString") and tags.get("natural") in ("tree", "tree_row"):
                found.trees.append(Element(f"f{name}", tags, part))
            elif part.geom_type == "Point" and tags.get("highway") in _SIGNS:
                at = tuple(np.round(shapely.get_coordinates(part)[0], 7).tolist())
                found.signs[numbers.setdefault(at, len(numbers) + 1)] = tags
    return found


def building_kind(tags: Mapping[str, str]) -> str:
    """Kind of building, ``part``, or empty."""
    if tags.get("building:part", "no") != "no":
        return "part"
    kind = tags.get("building", "no")
    underground = tags.get("location") == "underground" or (metres(tags.get("layer", "0")) or 0) < 0
    return "" if kind == "no" or underground else kind


def is_water(tags: Mapping[str, str]) -> bool:
    return tags.get("natural") == "water" or tags.get("waterway") == "riverbank"


def is_wood(tags: Mapping[str, str]) -> bool:
    return tags.get("natural") == "wood" or tags.get("landuse") == "forest"


def _is_area(tags: Mapping[str, str]) -> bool:
    return bool(building_kind(tags)) or is_water(tags) or is_wood(tags)
