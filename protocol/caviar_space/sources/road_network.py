"""Networks of SUMO of the roads of a map, in the axes of the scene, with sidewalks and beside buildings.

The roads are written as a small map of their own, in which no road leaves the box, runs through a building,
or is in a tunnel, and SUMO's netconvert makes lanes, junctions, sidewalks and crossings of it. Lanes have
widths that maps do not say: where one reaches into a building, the road loses its sidewalk there, and where
that is not enough itself, and the network is made again.
"""

from __future__ import annotations

import math
import subprocess
import tempfile
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import count, pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any
from xml.etree import ElementTree

import numpy as np

from caviar_protocol.arrays import BoolArray, Float64Array, Int64Array
from caviar_protocol.errors import AssetError, SetupError
from caviar_protocol.host import install_command

if TYPE_CHECKING:
    from caviar_space.imported_scenes import Georeference
    from caviar_space.sources.map_files import Way

NET = "sumo/net.net.xml"
"""Path of the network in the folder of a scene."""
_FAST = ("motorway", "trunk", "motorway_link", "trunk_link")
_STREETS = tuple(f"{kind}{link}" for kind in ("primary", "secondary", "tertiary") for link in ("", "_link"))
STREETS = (*_STREETS, "unclassified", "residential", "living_street")
"""Kinds of roads that have sidewalks, of which ``sidewalk=no`` has none."""
ROADS = (*_FAST, *STREETS, "pedestrian", "busway")
"""Kinds of roads that are in the network."""
_TAGS = (
    "highway", "oneway", "lanes", "lanes:forward", "lanes:backward", "maxspeed", "junction", "name",
    "access", "vehicle", "motor_vehicle", "foot", "bus", "psv",
)  # fmt: skip
SIDEWALK_M = 2.0
"""Width of a sidewalk [m]."""
# Half of what a vehicle needs of its lane [m], on the road and where it turns.
_HALF_M, _TURNING_HALF_M = 1.05, 1.3
# Of a road on ground that is not level [m].
_STEP_M = 20.0
# Networks that are made at most, each with fewer roads and sidewalks.
_ATTEMPTS = 6
_FULL, _BARE, _NONE = 2, 1, 0


@dataclass(eq=False)
class Network:
    """Network of roads, as a file of SUMO."""

    files: dict[str, bytes] = field(default_factory=dict)
    """Content by path in the folder of the scene; empty: the map has no roads."""
    left_out: Counter[str] = field(default_factory=Counter)
    notes: list[str] = field(default_factory=list)


@dataclass(eq=False)
class _Roads:
    """Straight segments of roads within the box."""

    ways: list[Way] = field(default_factory=list)
    way: list[int] = field(default_factory=list)
    """Index in `ways` of each segment, Shape ``[N]``."""
    ends: list[tuple[int, int]] = field(default_factory=list)
    """Nodes of each segment, Shape ``[N, 2]``."""
    places: dict[int, tuple[float, float]] = field(default_factory=dict)
    """Of nodes [m]."""


def network_of(
    ways: Sequence[Way],
    signs: Mapping[int, Mapping[str, str]],
    footprints: Sequence[Any],
    box: tuple[float, float, float, float],
    origin: Georeference,
    ground: Callable[[Float64Array], Float64Array] | None,
    progress: Callable[[str, float], None],
) -> Network:
    """Make the network of roads.

    Args:
        ways: Roads, in the scene [m].
        signs: Tags of nodes that are traffic signals and the like.
        footprints: Polygons of buildings [m], which no lane may reach.
        box: Lowest and highest x and y [m]; roads end at its border.
        origin: Of the scene.
        ground: Heights at x and y [m], Shape ``[N, 2]`` to ``[N]``; None: 0.
        progress: Called with the share that is done.

    Raises:
        AssetError: netconvert fails; has its last words.
        SetupError: SUMO is not installed.
    """
    import shapely

    made = Network()
    roads = _cut(ways, box, ground is None, made.left_out)
    if not roads.ends:
        made.notes.append("no network of roads: the map has none within the box")
        return made
    try:
        from sumo import SUMO_HOME
    except ImportError as error:
        raise SetupError(
            f"roads need SUMO's netconvert ({error}); run: {install_command('world')}"
        ) from error
    segments = shapely.linestrings([[roads.places[a], roads.places[b]] for a, b in roads.ends])
    solid = np.array([polygon.buffer(-0.05) for polygon in footprints], object)
    buildings = shapely.STRtree(solid)
    lit = [roads.ways[way].tags for way in roads.way]
    state = np.array(
        [_FULL if t["highway"] in STREETS and t.get("sidewalk") not in ("no", "none") else _BARE for t in lit]
    )
    through = np.unique(buildings.query(segments, "intersects")[0])
    state[through] = _NONE
    made.left_out["segment of a road through a building: no road"] += len(through)
    with tempfile.TemporaryDirectory(prefix="caviar-roads-") as folder:
        for attempt in range(_ATTEMPTS):
            progress("roads: netconvert", attempt / _ATTEMPTS)
            if not state.any():
                made.notes.append("no network of roads: all of them run through buildings")
                return made
            net = _converted(Path(folder), roads, state, signs, origin, ground, Path(SUMO_HOME))
            hits = list(_hits(ElementTree.fromstring(net), buildings, solid))  # noqa: S314 - SUMO wrote it
            if not hits or attempt == _ATTEMPTS - 1:
                break
            bare, none = _less(segments, state, hits)
            made.left_out["segment of a road whose sidewalk reaches into a building: no sidewalk"] += bare
            made.left_out["segment of a road whose lanes reach into a building: no road"] += none
    for walked, what in ((False, "lane"), (True, "sidewalk")):
        made.left_out[f"{what} that reaches into a building still"] += sum(hit[0] is walked for hit in hits)
    made.files[NET] = net
    return made


def _cut(
    ways: Sequence[Way], box: tuple[float, float, float, float], level: bool, left_out: Counter[str]
) -> _Roads:
    """Segments of roads above the ground within the box, the last one of which ends at its border."""
    import shapely

    frame = shapely.box(*box)
    found, new = _Roads(), count(1 << 40)  # nodes of maps have lower numbers
    for way in ways:
        tags = way.tags
        if tags["highway"] not in ROADS or tags.get("area") == "yes":
            continue
        hidden = tags.get("tunnel", "no") != "no" or tags.get("covered", "no") != "no"
        inside = shapely.contains_xy(frame, way.places)
        pieces = list(
            zip(way.nodes, way.nodes[1:], way.places, way.places[1:], inside, inside[1:], strict=False)
        )
        pieces = [
            piece for piece in pieces
            if piece[4] or piece[5] or frame.intersects(shapely.LineString(piece[2:4]))
        ]  # fmt: skip
        if hidden or tags.get("layer", "0").startswith("-"):
            left_out["road in a tunnel or covered: no road"] += bool(pieces)
            continue
        found.ways.append(way)
        for a, b, at_a, at_b, a_in, b_in in pieces:
            line = shapely.LineString([at_a, at_b])
            clipped = shapely.get_coordinates(line if a_in and b_in else line & frame)
            if a == b or len(clipped) != 2 or np.linalg.norm(clipped[1] - clipped[0]) < 0.1:
                continue
            # Between its ends a road follows the ground.
            parts = 1 if level else math.ceil(float(np.linalg.norm(clipped[1] - clipped[0])) / _STEP_M)
            nodes = [
                a if a_in else next(new),
                *(next(new) for _ in range(parts - 1)),
                b if b_in else next(new),
            ]
            for node, at in zip(nodes, np.linspace(clipped[0], clipped[1], parts + 1).tolist(), strict=True):
                found.places.setdefault(node, tuple(at))
            found.way += [len(found.ways) - 1] * parts
            found.ends += pairwise(nodes)
    return found


def _converted(
    folder: Path,
    roads: _Roads,
    state: Int64Array,
    signs: Mapping[int, Mapping[str, str]],
    origin: Georeference,
    ground: Callable[[Float64Array], Float64Array] | None,
    home: Path,
) -> bytes:
    """The network that netconvert makes of the segments that are left."""
    _write_types(home, folder / "roads.typ.xml")
    _write_roads(folder / "roads.osm", roads, state, signs, origin, ground)
    projection = (
        f"+proj=tmerc +lat_0={origin.latitude_deg!r} +lon_0={origin.longitude_deg!r} +k=1 +ellps=WGS84"
    )
    command = [
        str(home / "bin" / "netconvert"), "--osm-files", "roads.osm", "--type-files", "roads.typ.xml",
        "--proj", projection, "--offset.disable-normalization", "--precision", "3",
        "--output-file", "out.net.xml", "--output.street-names",
        "--crossings.guess", "--walkingareas", "--geometry.remove", "--junctions.join", "--roundabouts.guess",
        "--tls.guess-signals", "--tls.discard-simple", "--tls.join", "--keep-edges.components", "1",
        "--no-turnarounds.except-deadend", "--aggregate-warnings", "3",
        *(["--osm.elevation"] if ground else []),
    ]  # fmt: skip
    ran = subprocess.run(command, cwd=folder, capture_output=True, check=False, text=True)  # noqa: S603 - SUMO's
    if ran.returncode or not (folder / "out.net.xml").is_file():
        said = " ".join((ran.stderr or ran.stdout).strip().splitlines()[-3:])
        raise AssetError(f"netconvert makes no network of the roads: {said}; name another box")
    # Without netconvert's comment, which has the time: equal maps give equal files.
    head, sign, net = (folder / "out.net.xml").read_bytes().partition(b"<net ")
    return head.partition(b"\n")[0] + b"\n" + sign + net


def _write_types(home: Path, file: Path) -> None:
    """SUMO's types of roads with sidewalks, and again, as ``…_bare``, without."""
    tree = ElementTree.parse(home / "data" / "typemap" / "osmNetconvert.typ.xml")  # noqa: S314 - SUMO's own
    for kind in tree.getroot().findall("type"):
        if kind.get("id", "").removeprefix("highway.") in STREETS:
            kind.set("disallow", f"pedestrian {kind.get('disallow', '')}")
            bare = ElementTree.SubElement(tree.getroot(), "type", kind.attrib)
            bare.set("id", f"{kind.get('id')}_bare")
            kind.set("sidewalkWidth", f"{SIDEWALK_M}")
    tree.write(file)


def _write_roads(
    file: Path,
    roads: _Roads,
    state: Int64Array,
    signs: Mapping[int, Mapping[str, str]],
    origin: Georeference,
    ground: Callable[[Float64Array], Float64Array] | None,
) -> None:
    """The map of the segments that are left; those of one way that are alike and connected are one way."""
    root = ElementTree.Element("osm", version="0.6")
    names, places = list(roads.places), np.array(list(roads.places.values()))
    heights = dict(zip(names, ground(places).tolist(), strict=True)) if ground else {}
    latitude, longitude, *_ = origin.to_wgs84(places[:, 0], places[:, 1], np.zeros(len(places)))  # type: ignore[arg-type]
    for name, north, east in zip(names, latitude.tolist(), longitude.tolist(), strict=True):  # type: ignore[attr-defined]
        node = ElementTree.SubElement(root, "node", id=str(name), lat=f"{north:.10f}", lon=f"{east:.10f}")
        if ground is not None:
            ElementTree.SubElement(node, "tag", k="ele", v=f"{heights[name]:.3f}")
        for key, value in signs.get(name, {}).items():
            if key in ("highway", "crossing", "traffic_signals:direction", "direction"):
                ElementTree.SubElement(node, "tag", k=key, v=value)
    before: tuple[int, int, int] | None = None
    for number, (way, (a, b)) in enumerate(zip(roads.way, roads.ends, strict=True)):
        if state[number] == _NONE:
            continue
        if before != (way, state[number], a):
            tags = roads.ways[way].tags
            element = ElementTree.SubElement(root, "way", id=str(number + 1))
            ElementTree.SubElement(element, "nd", ref=str(a))
            kind = tags["highway"]
            if kind in STREETS and state[number] == _BARE:
                kind += "_bare"
            for key in _TAGS:
                if key in tags:
                    ElementTree.SubElement(element, "tag", k=key, v=kind if key == "highway" else tags[key])
        # Before the tags: netconvert reads elements in any order.
        ElementTree.SubElement(element, "nd", ref=str(b))
        before = (way, state[number], b)
    ElementTree.ElementTree(root).write(file, encoding="utf-8", xml_declaration=True)


def _hits(net: ElementTree.Element, buildings: Any, solid: Any) -> Iterator[tuple[bool, Any]]:
    """Find lanes that reach into buildings: whether each is one to walk on, and where it does [m]."""
    import shapely

    walked, lines, halves = list[bool](), list[Any](), list[float]()
    for edge in net.iter("edge"):
        if edge.get("function") in ("crossing", "walkingarea"):
            continue
        for lane in edge.iter("lane"):
            points = [point.split(",")[:2] for point in lane.get("shape", "").split()]
            if len(points) < 2:
                continue
            on_foot = lane.get("allow") == "pedestrian"
            walked.append(on_foot)
            lines.append(shapely.LineString(np.array(points, float)))
            half = _TURNING_HALF_M if edge.get("function") == "internal" else _HALF_M
            halves.append(float(lane.get("width", SIDEWALK_M)) / 2 if on_foot else half)
    wide = shapely.buffer(lines, halves, cap_style="flat")
    for lane_number, building in buildings.query(wide, "intersects").T:
        yield walked[lane_number], shapely.intersection(wide[lane_number], solid[building]).centroid


def _less(segments: Any, state: Int64Array, hits: Sequence[tuple[bool, Any]]) -> tuple[int, int]:
    """Take from segments near hits their sidewalks, or the segments; count of either."""
    import shapely

    before = state.copy()
    for on_foot, place in hits:
        distance = shapely.distance(segments, place)
        distance[before == _NONE] = np.inf
        if on_foot:
            distance[before != _FULL] = np.inf
        if not distance.min() < 20.0:
            continue
        near: BoolArray = distance <= distance.min() + 0.5
        # A one-way road moves over to make room for its sidewalk: without one its lanes may fit.
        full = near & (before == _FULL)
        if full.any():
            state[full] = np.minimum(state[full], _BARE)
        else:
            state[near] = _NONE
    return int(np.sum((before == _FULL) & (state == _BARE))), int(
        np.sum((before != _NONE) & (state == _NONE))
    )
