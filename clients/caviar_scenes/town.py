"""``caviar new NAME --scene FOLDER``: a scenario on the streets of an imported scene.

Traffic and people are random trips on the scene's network, made by SUMO's own tools; base stations stand on
roofs from which much of the streets is seen, or on masts at junctions where no roof does; a UAV flies above
the streets. Without a network there are base stations and the UAV alone.
"""

from __future__ import annotations

import math
import os
import re
import subprocess
import sys
import tempfile
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from string import Template
from typing import NamedTuple
from xml.etree import ElementTree

import numpy as np

from caviar_protocol.arrays import BoolArray, Float64Array
from caviar_protocol.errors import AssetError, RunError, SetupError
from caviar_protocol.host import install_command
from caviar_space.ground import are_ground
from caviar_space.meshes import Mesh
from caviar_space.mitsuba_xml import read_scenery, world_mesh
from caviar_space.sources.road_network import NET

TEMPLATE = "new/town.toml"
"""The scenario, in the package of scenarios."""
BEGIN_S = 300.0
"""SUMO's time at frame 0 [s]: the streets are busy by then."""
END_S = 1800.0
"""SUMO's time at which the last trip begins [s]."""
DENSITY = (2.5, 4.0)
"""Vehicles on a kilometre of lanes, and people on one of sidewalks, about, between `LEAST` and `MOST`."""
LEAST, MOST = 10, 120
"""Vehicles, and people, of a scenario, about."""
STATIONS = 3
"""Base stations of a scenario."""
_CELL_M = 2.0
_REACH_M = 250.0
_ON_ROOF_M = 2.0
_MAST_M = 8.0


@dataclass(frozen=True, eq=False)
class Skyline:
    """Heights of a scene's buildings in square cells."""

    low: Float64Array
    """Corner with the lowest x and y [m], Shape ``[2]``."""
    heights: Float64Array
    """Of buildings [m], over x and y, Shape ``[X, Y]``; −∞: open ground."""
    ground: Float64Array
    """Of the ground [m], Shape ``[X, Y]``."""

    def at(self, places: Float64Array, ground: bool = False) -> Float64Array:
        """Heights of buildings, or of the ground, at x and y [m], Shape ``[…, 2]`` to ``[…]``."""
        cells = ((places - self.low) / _CELL_M).astype(np.int64)
        x, y = np.moveaxis(np.clip(cells, 0, np.array(self.heights.shape) - 1), -1, 0)
        found: Float64Array = (self.ground if ground else self.heights)[x, y]
        return found

    def sees(self, eye: Float64Array, places: Float64Array) -> BoolArray:
        """Test which places are in sight of an eye.

        Args:
            eye: x, y, z [m].
            places: x, y, z [m], Shape ``[N, 3]``.
        """
        steps = np.linspace(0.0, 1.0, 80)[1:-1, None, None]
        line = eye + steps * (places - eye)
        # What is next to the eye is below it: the eye stands on it.
        far = np.linalg.norm(line - eye, axis=-1) > 1.5 * _CELL_M
        clear: BoolArray = ~((self.at(line[..., :2]) > line[..., 2]) & far).any(axis=0)
        return clear


class Station(NamedTuple):
    """Place of a base station."""

    position: Float64Array
    yaw_deg: float
    pitch_deg: float
    on: str
    """Where it stands, for a comment."""


@dataclass(frozen=True, eq=False)
class Streets:
    """Network of a scene."""

    file: Path
    offset: tuple[float, float]
    """Place of its origin in the scene [m]."""
    lanes: dict[str, Float64Array]
    """Centre line of one lane to drive on [m], Shape ``[P, 2]``, by road."""
    corners: Float64Array
    """Corners of junctions [m], Shape ``[N, 2]``."""
    length_km: tuple[float, float]
    """Of lanes to drive on, and of sidewalks."""


def new_town(path: Path, scene: Path, seed: int = 1, say: Callable[[str], None] = lambda text: None) -> None:
    """Write a scenario, and its traffic beside it.

    Args:
        path: The scenario, ``NAME.toml``, which must not be there.
        scene: Folder of an imported scene.
        seed: Of trips.
        say: Called with what is there and what is done.

    Raises:
        AssetError: The folder is no scene, or the network is damaged.
        RunError: The file is there, or SUMO's tools fail.
        SetupError: SUMO is not installed.
    """
    if path.exists():
        raise RunError(f"{path} is there already: choose another name, or remove it")
    description = scene / "scene.xml"
    if not description.is_file():
        raise AssetError(f"{scene} has no scene.xml; name the folder that `caviar scene import … --out` made")
    shapes = read_scenery(description).shapes
    foliage = [shape.name.startswith("foliage") for shape in shapes]
    meshes = [world_mesh(shape) for shape, leaves in zip(shapes, foliage, strict=True) if not leaves]
    level = are_ground(meshes)
    solids = [mesh for mesh, flat in zip(meshes, level, strict=True) if not flat]
    skyline = skyline_of(solids, [mesh for mesh, flat in zip(meshes, level, strict=True) if flat])
    streets = _streets(scene / NET) if (scene / NET).is_file() else None
    files: dict[Path, bytes] = {}
    values = {"traffic": "", "bodies": "", "receivers": ""}
    # A scenario names its files relative to itself, with `/` on every system.
    here = path.parent.resolve()

    def named(file: Path) -> str:
        return f'"file:{Path(os.path.relpath(file.resolve(), here)).as_posix()}"'

    trips = ElementTree.Element("routes")
    if streets is None:
        say(f"{scene} has no network of roads: base stations and a UAV alone")
        scenery = f"scenery = {named(description)}\n"
    else:
        trips, counts = _traffic(streets, seed)
        say(f"{counts[0]} vehicles and {counts[1]} people at {BEGIN_S:g} s")
        scenery = ""
        values.update(_traffic_tables(streets, counts, named(description), named(streets.file),
                                      f'"file:{path.stem}.rou.xml"'))  # fmt: skip
    what = "traffic, people, " if streets else ""
    ways = [(trip, trip.find("route").get("edges").split()) for trip in trips.iter("vehicle")]  # type: ignore[union-attr]
    targets = _targets(skyline, streets, [way for _, way in ways])
    stations, seen = _stations(skyline, solids, targets, streets)
    lit = Counter(road for road, one in zip(targets.roads, seen.tolist(), strict=True) if one)
    every = Counter(targets.roads)
    # The UAV takes the way with most places in sight, and users are those with the largest share of them.
    longest = max((way for _, way in ways), key=lambda way: sum(lit[road] for road in set(way)), default=[])
    ways.sort(key=lambda pair: -sum(lit[road] for road in pair[1]) / sum(every[road] for road in pair[1]))
    for number, (trip, _) in enumerate(ways[: len(ways) // 4 + 1]):
        trip.set("id", f"user-{number}")
    if streets is not None:
        files[path.with_suffix(".rou.xml")] = ElementTree.tostring(
            trips, encoding="utf-8", xml_declaration=True
        )
    waypoints, how = _flight(skyline, streets, longest)
    values |= {
        "title": f"Scene {scene.resolve().name} with {what}base stations and a UAV",
        "command": " ".join(["caviar", *sys.argv[1:]]),
        "name": path.stem,
        "sky_scenery": scenery,
        "uav_path": how,
        "waypoints": "\n".join(f"  [{t:.1f}, {x:.1f}, {y:.1f}, {z:.1f}]," for t, x, y, z in waypoints),
        "foliage": _FOLIAGE if any(foliage) else "",
        "stations": "".join(_device(number, station) for number, station in enumerate(stations, 1)),
    }
    text = (resources.files("caviar_scenarios") / TEMPLATE).read_text()
    files[path] = re.sub(r"\n{3,}", "\n\n", Template(text).substitute(values)).encode()
    for file, content in files.items():
        try:
            file.parent.mkdir(parents=True, exist_ok=True)
            file.write_bytes(content)
        except OSError as error:
            raise RunError(f"cannot write {file}: {error.strerror}; choose another folder") from error


def skyline_of(solids: Sequence[Mesh], grounds: Sequence[Mesh]) -> Skyline:
    """Heights of buildings and ground.

    Args:
        solids: Buildings.
        grounds: Ground, and what else is level.
    """
    if not solids and not grounds:
        raise AssetError("the scene has no meshes; import it again")
    places = np.concatenate([mesh.vertices[:, :2] for mesh in (*solids, *grounds)])
    low = places.min(axis=0)
    shape = np.ceil((places.max(axis=0) - low) / _CELL_M).astype(int) + 1
    found = np.full((2, *shape), -np.inf)
    for heights, meshes in zip(found, (solids, grounds), strict=True):
        for mesh in meshes:
            for corners in mesh.vertices[mesh.faces]:
                _raise_to(heights, np.column_stack([(corners[:, :2] - low) / _CELL_M, corners[:, 2]]))
    return Skyline(low, found[0], np.where(np.isneginf(found[1]), 0.0, found[1]))


def _raise_to(heights: Float64Array, triangle: Float64Array) -> None:
    """Raise cells whose middle is in a triangle to it; its corners have x and y in cells, and z [m]."""
    a, b, c = triangle
    area = (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])
    if abs(area) < 1e-3:
        return
    first, last = triangle[:, :2].min(axis=0).astype(int), triangle[:, :2].max(axis=0).astype(int) + 1
    x, y = np.meshgrid(np.arange(first[0], last[0]), np.arange(first[1], last[1]), indexing="ij")
    u = ((x + 0.5 - a[0]) * (c[1] - a[1]) - (y + 0.5 - a[1]) * (c[0] - a[0])) / area
    v = ((b[0] - a[0]) * (y + 0.5 - a[1]) - (b[1] - a[1]) * (x + 0.5 - a[0])) / area
    inside = (u >= -1e-9) & (v >= -1e-9) & (u + v <= 1 + 1e-9)
    z = a[2] + u * (b[2] - a[2]) + v * (c[2] - a[2])
    np.maximum.at(heights, (x[inside], y[inside]), z[inside])


def _streets(file: Path) -> Streets:
    """Read a network of SUMO.

    Raises:
        AssetError: The file is no network.
    """

    def points(element: ElementTree.Element) -> Float64Array:
        return np.array([p.split(",")[:2] for p in element.get("shape", "").split()], float).reshape(-1, 2)

    try:
        root = ElementTree.parse(file).getroot()  # noqa: S314 - expat bounds what entities expand to
        x, y = (-float(word) + 0.0 for word in root.find("location").get("netOffset").split(","))  # type: ignore[union-attr]
        lanes, driven, on_foot = dict[str, Float64Array](), 0.0, 0.0
        for edge in root.iter("edge"):
            for lane in edge.iter("lane") if edge.get("function", "normal") == "normal" else ():
                if lane.get("allow") == "pedestrian":
                    on_foot += float(lane.get("length", 0))
                else:
                    driven += float(lane.get("length", 0))
                    lanes[edge.get("id", "")] = points(lane) + np.array((x, y))
        corners = [
            points(junction)[:1] for junction in root.iter("junction") if junction.get("type") != "internal"
        ]
        places = np.concatenate([np.zeros((0, 2)), *corners]) + np.array((x, y))
    except (OSError, ValueError, AttributeError, ElementTree.ParseError) as error:
        raise AssetError(f"{file} is no network of SUMO: {error}; import the scene again") from error
    return Streets(file, (x, y), lanes, places, (driven / 1e3, on_foot / 1e3))


def _along(line: Float64Array, step_m: float) -> Float64Array:
    """Places on a line, a step apart [m], Shape ``[N, 2]``."""
    way = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=1))])
    at = np.linspace(0.0, way[-1], max(int(way[-1] / step_m), 1) + 1)
    return np.stack([np.interp(at, way, line[:, axis]) for axis in (0, 1)], axis=1)


class _Targets(NamedTuple):
    """Places that base stations are to see."""

    places: Float64Array
    """[m], Shape ``[N, 3]``."""
    weights: Float64Array
    """Vehicles that pass by, Shape ``[N]``."""
    roads: list[str]
    """Of each, in the network."""


def _targets(skyline: Skyline, streets: Streets | None, routes: Sequence[Sequence[str]]) -> _Targets:
    """Places on lanes, or on open ground."""
    if streets is not None and streets.lanes:
        lines = [_along(lane, 15.0) for lane in streets.lanes.values()]
        places, sizes = np.concatenate(lines), [len(line) for line in lines]
        passing = Counter(road for route in routes for road in route)
        weights = np.repeat([1.0 + passing[road] for road in streets.lanes], sizes)
        roads = [road for road, size in zip(streets.lanes, sizes, strict=True) for _ in range(size)]
    else:
        x, y = (np.arange(0.5, size, 25.0 / _CELL_M) for size in skyline.heights.shape)
        grid = np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1).reshape(-1, 2) * _CELL_M + skyline.low
        places = grid[np.isneginf(skyline.at(grid))]
        weights, roads = np.ones(len(places)), [""] * len(places)
    return _Targets(np.column_stack([places, skyline.at(places, ground=True) + 1.5]), weights, roads)


def _stations(
    skyline: Skyline, solids: Sequence[Mesh], targets: _Targets, streets: Streets | None
) -> tuple[list[Station], BoolArray]:
    """Base stations, each where most is seen that the others do not see; and which targets they see."""
    roofs = np.concatenate([np.zeros((0, 3)), *(mesh.vertices for mesh in solids)])
    # Corners of roofs that nothing is on, one in a square of 10 m.
    above = roofs[:, 2] - skyline.at(roofs[:, :2], ground=True)
    exposed = (above >= 6.0) & (above <= 60.0) & (skyline.at(roofs[:, :2]) < roofs[:, 2] + 0.5)
    roofs = roofs[exposed]
    if len(roofs):
        order = np.lexsort((roofs[:, 1], roofs[:, 0], -roofs[:, 2]))
        _, first = np.unique((roofs[order, :2] // 10).astype(int), axis=0, return_index=True)
        roofs = roofs[order][np.sort(first)]
    eyes = list[tuple[Float64Array, str]]((roof + np.array((0, 0, _ON_ROOF_M)), "a roof") for roof in roofs)
    if streets is not None:
        corners = streets.corners
        masts = np.column_stack([corners, skyline.at(corners, ground=True) + _MAST_M])
        eyes += [(mast, "a mast at a junction") for mast in masts if np.isneginf(skyline.at(mast[:2]))]
    if not eyes:
        middle = skyline.low + np.array(skyline.heights.shape) * _CELL_M / 2
        eyes = [(np.array([*middle, _MAST_M]), "a mast")]
    places, weights = targets.places, targets.weights
    near = [np.linalg.norm(places - eye, axis=1) < _REACH_M for eye, _ in eyes]
    # Only the eyes with most targets around them are looked through.
    promising = sorted(range(len(eyes)), key=lambda i: (eyes[i][1] != "a roof", -weights[near[i]].sum()))[
        :600
    ]
    seen = np.zeros((len(promising), len(places)), bool)
    for row, i in enumerate(promising):
        seen[row, near[i]] = skyline.sees(eyes[i][0], places[near[i]])
    found, covered = list[Station](), np.zeros(len(places), bool)
    for _ in range(STATIONS):
        new = seen & ~covered
        best = int((new @ weights).argmax())
        if found and new[best].sum() < 10:
            break
        eye, on = eyes[promising[best]]
        towards = places[new[best]] - eye if new[best].any() else np.array([[1.0, 0.0, 0.0]])
        level = np.linalg.norm(towards[:, :2], axis=1)
        x, y = (towards[:, :2] / np.maximum(level, 1.0)[:, None]).sum(axis=0)
        pitch = math.degrees(math.atan2(-float(np.median(towards[:, 2])), float(np.median(level))))
        found.append(Station(eye, math.degrees(math.atan2(y, x)), min(max(pitch, 0.0), 45.0), on))
        covered |= seen[best]
    return found, covered


def _device(number: int, station: Station) -> str:
    x, y, z = (round(float(value), 2) for value in station.position)
    return f"""
# On {station.on}, towards the streets that it sees.
[[devices]]
name = "bs{number}"
kind = "antenna"
role = "tx"
world = "sky"
position_m = [{x}, {y}, {z}]
yaw_deg = {station.yaw_deg:.1f}
pitch_deg = {station.pitch_deg:.1f}
array = {{ rows = 4, columns = 8, pattern = "tr38901" }}
power_dbm = 30.0
"""


def _flight(
    skyline: Skyline, streets: Streets | None, route: Sequence[str]
) -> tuple[list[tuple[float, float, float, float]], str]:
    """Waypoints of the UAV, t [s], x, y, z [m], at 8 m/s, 10 m above all within 20 m; and their kind."""
    ways = [streets.lanes[name] for name in route if name in streets.lanes] if streets else []
    if ways:
        line, how = np.concatenate(ways), "Along the streets of one of the trips."
    else:
        size = np.array(skyline.heights.shape) * _CELL_M
        angles = np.linspace(0.0, 2.0 * math.pi, 25)
        circle = np.stack([np.cos(angles), np.sin(angles)], axis=1)
        line, how = skyline.low + size / 2 + size.min() / 4 * circle, "A circle about the middle."
    places = _along(line, 40.0)
    around = np.stack(np.meshgrid([-20.0, 0.0, 20.0], [-20.0, 0.0, 20.0]), axis=-1).reshape(-1, 2)
    below = _along(line, 5.0)[:, None] + around
    high = max(float(skyline.at(below).max()), float(skyline.at(below, ground=True).max()) + 15.0) + 10.0
    times = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(places, axis=0), axis=1) / 8.0)])
    keep = np.concatenate([[True], np.diff(times) > 0.1])
    rows = zip(times[keep].tolist(), places[keep].tolist(), strict=True)
    return [(t, x, y, high) for t, (x, y) in rows], how


def _traffic(streets: Streets, seed: int) -> tuple[ElementTree.Element, tuple[int, int]]:
    """Trips of vehicles and people, and how many of both are there at the beginning of a run."""
    try:
        from sumo import SUMO_HOME
    except ImportError as error:
        raise SetupError(f"traffic needs SUMO ({error}); run: {install_command('world')}") from error
    home = Path(SUMO_HOME)
    extent = np.ptp(np.concatenate([*streets.lanes.values(), streets.corners]), axis=0)
    extent_m = float(extent.max(initial=0.0))
    apart_m = min(300.0, 0.4 * extent_m)
    # Little's law, with trips of some 150 s and walks of 400 s in a town of 1.5 km.
    stays_s = min(0.1 * extent_m, 150.0), min(0.3 * extent_m, 400.0)
    rates = [
        min(max(density * km, LEAST), MOST) / stay_s if km else 0.0
        for density, km, stay_s in zip(DENSITY, streets.length_km, stays_s, strict=True)
    ]
    root = ElementTree.fromstring(_TYPES)  # noqa: S314 - our own
    trips = list[ElementTree.Element]()
    with tempfile.TemporaryDirectory(prefix="caviar-trips-") as folder:
        for rate, kind, more in (
            (
                rates[0],
                "car",
                ["--vehicle-class", "passenger", "--fringe-factor", "3", "--min-distance", f"{apart_m:g}"],
            ),
            (rates[1], "walk", ["--pedestrians", "--max-distance", "700"]),
        ):
            if not rate:
                continue
            _run([sys.executable, str(home / "tools" / "randomTrips.py"), "-n", str(streets.file.resolve()),
                  "-o", "trips.xml", "-r", f"{kind}.xml", "--seed", str(seed), "--end", f"{END_S:g}",
                  "--period", f"{1 / rate:.4f}", "--prefix", f"{kind}-", *more], folder)  # fmt: skip
            trips += list(ElementTree.parse(Path(folder, f"{kind}.xml")).getroot())  # noqa: S314 - SUMO wrote it
        for trip in sorted(trips, key=lambda trip: float(trip.get("depart", 0))):
            if trip.tag == "vehicle":
                trip.attrib |= {"type": "traffic", "departLane": "best", "departSpeed": "max"}
            elif trip.tag == "person":
                trip.set("type", "person")
            else:
                continue
            root.append(trip)
        ElementTree.indent(root)
        ElementTree.ElementTree(root).write(Path(folder, "all.rou.xml"))
        _run([str(home / "bin" / "sumo"), "-n", str(streets.file.resolve()), "-r", "all.rou.xml",
              "--step-length", "0.5", "--begin", "0", "--end", f"{BEGIN_S:g}", "--seed", str(seed),
              "--no-step-log", "--no-warnings", "--summary-output", "cars.xml",
              "--person-summary-output", "people.xml"], folder)  # fmt: skip
        counts = []
        for name, key in (("cars.xml", "running"), ("people.xml", "walking")):
            steps = ElementTree.parse(Path(folder, name)).getroot().findall("step")  # noqa: S314 - SUMO wrote it
            counts.append(int(steps[-1].get(key, 0)) if steps else 0)
    return root, (counts[0], counts[1])


def _run(command: Sequence[str], folder: str) -> None:
    ran = subprocess.run(command, cwd=folder, capture_output=True, check=False, text=True)  # noqa: S603 - SUMO's
    if ran.returncode:
        said = " ".join((ran.stderr or ran.stdout).strip().splitlines()[-2:])
        raise RunError(
            f"{Path(command[0]).name} of SUMO fails: {said}; import the scene again with a larger box"
        )


def _traffic_tables(
    streets: Streets, counts: tuple[int, int], scenery: str, net: str, routes: str
) -> dict[str, str]:
    """Text of the services and devices of traffic."""
    x, y = streets.offset
    pool = {"car": counts[0], "truck": counts[0] // 5, "pedestrian": counts[1]}
    held = ", ".join(f"{kind} = {16 * (count * 5 // 4 // 16 + 1)}" for kind, count in pool.items())
    return {
        "traffic": f"""
[services.traffic]
role = "world"
use = "sumo"
budget_ms = 50

[services.traffic.settings]
scenery = {scenery}
net = {net}
routes = {routes}
prefix = "traffic."
begin_s = {BEGIN_S:g}                     # SUMO runs so long first: the streets are busy by then
between_episodes_s = 30.0         # all episodes are of one traffic
offset_m = [{x:g}, {y:g}, 0.0]        # the network's origin in the scene: -netOffset
meshes = ["car", "pedestrian", "truck"]
""",
        "bodies": f"""object_materials = {{ pedestrian = "skin" }}
pool = {{ {held} }}  # bodies held ready for those who come
""",
        "receivers": """
# On the roofs of eight vehicles whose ways are more in sight of the base stations than those of others.
# Each keeps its receiver until it leaves. "traffic.*" are all vehicles and people.
[[devices]]
name = "rx"
kind = "antenna"
role = "rx"
world = "traffic"
on = "traffic.user-*"
count = 8
mount = "roof"
position_m = [0.0, 0.0, 0.1]
array = { columns = 4 }
""",
    }


_TYPES = """<routes>
    <vTypeDistribution id="traffic">
        <vType id="car"
            vClass="passenger" length="4.5" width="1.8" height="1.5" sigma="0.5" probability="0.85"/>
        <vType id="van"
            vClass="delivery" length="5.9" width="2.0" height="2.6" sigma="0.5" probability="0.15"/>
    </vTypeDistribution>
    <vType id="person" vClass="pedestrian" length="0.30" width="0.50" height="1.72"/>
</routes>"""

# 0.45·f^0.284 dB/m with f in GHz, up to 14 m of leaves.
_FOLIAGE = """[services.channel.settings.foliage."foliage-*"]
attenuation_db_per_m = { mmwave = 1.16 }
source = "Weissberger's modified exponential decay, ESD-TR-81-101, 1982: 0.45 f^0.284, up to 14 m"
"""
