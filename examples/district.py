"""A district of three by three blocks for data sets: scenery, road network, traffic, and scenarios of them.

    python examples/district.py --out FOLDER --seed 1 [--name district]

Writes ``NAME.toml``, ten vehicles with receivers and LIDARs, ``NAME-fixed.toml``, ten receivers that stand,
and the folder ``NAME``; equal seeds give equal files. Needs the extra ``world``, whose ``netconvert`` makes
the network. The shipped scenarios `district` and `district-b` are seeds 1 and 2.
"""

import argparse
import re
import subprocess
import tempfile
from importlib.resources import files
from itertools import pairwise
from pathlib import Path
from string import Template

import numpy as np

from caviar_space.imported_scenes import ImportedScene, Piece, wall_material, write_scene
from caviar_space.meshes import SHAPES, Mesh

LANE_M, AVENUE_LANES, SIDEWALK_M, KERB_M = 3.2, 2, 3.0, 2.6
"""Widths; the kerb is where vehicles stand, between lanes and sidewalk."""
AVENUE_M = LANE_M * AVENUE_LANES + KERB_M + SIDEWALK_M
"""From the middle of the avenue to its façades."""
STREET_M = LANE_M + SIDEWALK_M
"""From the middle of a side street to its façades."""
END_M = 32.0
"""Roads go on so far beyond the blocks."""
MATERIALS = {"brick": 0.4, "concrete": 0.3, "glass": 0.2, "metal": 0.1}
CELLS = (20, 200, 10)
"""Of the LIDAR's grid, as in the paper's s008."""

Point = tuple[float, float]
Solid = tuple[float, float, float]
"""A point, the size of a body, or start, end and front of a part of a façade [m]."""
Mast = tuple[list[float], float]
"""Place [m] and direction [°] of a station on a roof."""


class Shapes:
    """Triangles by name of the piece."""

    def __init__(self) -> None:
        self.kinds: dict[str, tuple[str, str]] = {}
        self._parts: dict[str, list[Mesh]] = {}

    def add(self, name: str, material: str, mesh: Mesh, kind: str = "building") -> None:
        self.kinds[name] = material, kind
        self._parts.setdefault(name, []).append(mesh)

    def pieces(self, file: str) -> dict[str, Piece]:
        made = {}
        for name, parts in sorted(self._parts.items()):
            begins = np.cumsum([0, *(len(part.vertices) for part in parts)])
            faces = np.concatenate([p.faces + b for p, b in zip(parts, begins, strict=False)])
            mesh = Mesh(np.concatenate([part.vertices for part in parts]), faces.astype(np.int32))
            made[name] = Piece(mesh, self.kinds[name][0], self.kinds[name][1], file, 1)
        return made


def soup(triangles: list[tuple[Solid, Solid, Solid]]) -> Mesh:
    """A mesh of triangles whose common corners are one vertex."""
    corners = np.round(np.array(triangles, float).reshape(-1, 3), 3)
    vertices, faces = np.unique(corners, axis=0, return_inverse=True)
    return Mesh(vertices, faces.reshape(-1, 3).astype(np.int32))


def building(origin: Point, along: Point, bays: list[Solid], depth: float, height: float) -> Mesh:
    """Walls and roof of a building.

    Args:
        origin: Left end of the façade line, seen from the street [m].
        along: Unit vector to its right end.
        bays: Start, end and depth in front of the façade line of each part of the façade [m].
        depth: Behind the façade line [m].
        height: [m]
    """
    ax, ay = along
    ox, oy = ay, -ax  # out of the façade

    def at(s: float, t: float, z: float) -> tuple[float, float, float]:
        return origin[0] + s * ax + t * ox, origin[1] + s * ay + t * oy, z

    triangles = []

    def wall(a: Point, b: Point) -> None:
        if a != b:
            low, high, top, other = at(*a, 0.0), at(*b, 0.0), at(*b, height), at(*a, height)
            triangles.extend([(low, high, top), (low, top, other)])

    for k, (start, end, front) in enumerate(bays):
        wall((start, front), (end, front))
        wall((end, -depth), (start, -depth))
        before = bays[k - 1][2] if k else -depth
        after = bays[k + 1][2] if k + 1 < len(bays) else -depth
        # A step of the façade belongs to the part before it.
        if not k:
            wall((start, -depth), (start, front))
        wall((end, front), (end, after))
        # The roof: a fan from a corner that no edge leads through, so that it ends where its neighbours do.
        outline = [(start, -depth), (start, front), (end, front), (end, -depth)]
        if -depth < after < front:
            outline.insert(3, (end, after))
        if -depth < before < front:
            outline = [(start, before), *outline[1:], outline[0]]
        corners = [at(*corner, height) for corner in outline]
        triangles += [(corners[0], b, c) for b, c in pairwise(corners[1:])]
    return soup(triangles)


def facade(rng: np.random.Generator, length: float, deepest: float) -> list[Solid]:
    """Parts of a façade of 3 to 9 m, each so far before its line or behind that they differ."""
    count = max(1, round(length / rng.uniform(4.5, 8.0)))
    cuts = np.round(np.linspace(0, length, count + 1), 2)
    fronts = np.round(rng.uniform(-deepest, 0.0, count), 2)
    return [(float(a), float(b), float(f)) for a, b, f in zip(cuts, cuts[1:], fronts, strict=False)]


def block(
    shapes: Shapes, rng: np.random.Generator, name: str, low: Point, high: Point, tall: Point
) -> list[Mast]:
    """Buildings around a courtyard.

    Args:
        shapes: To which they are added.
        rng: Of sizes, heights and materials.
        name: Of the block.
        low, high: Its corners [m].
        tall: Least and greatest height [m].

    Returns:
        A place at the edge of each roof, 3 m above it [m], and the direction out of the façade [°].
    """
    masts = []
    (x0, y0), (x1, y1) = low, high
    deep = rng.uniform(11.0, 14.0)
    sides = [
        ((x0, y1), (0.0, -1.0), y1 - y0), ((x1, y0), (0.0, 1.0), y1 - y0),
        ((x0 + deep + 1, y0), (1.0, 0.0), x1 - x0 - 2 * deep - 2),
        ((x1 - deep - 1, y1), (-1.0, 0.0), x1 - x0 - 2 * deep - 2),
    ]  # fmt: skip
    for origin, along, length in sides:
        ends = np.linspace(0, length, max(1, round(length / rng.uniform(18.0, 28.0))) + 1)
        for start, end in pairwise(ends):
            gap = float(rng.choice([0.3, 0.6, 4.0], p=[0.5, 0.3, 0.2]))  # the widest leads to the courtyard
            material = str(rng.choice(list(MATERIALS), p=list(MATERIALS.values())))
            corner = origin[0] + along[0] * start, origin[1] + along[1] * start
            bays = facade(rng, round(float(end - start) - gap, 2), 1.6)
            height = round(float(rng.uniform(*tall)), 1)
            shapes.add(f"{name}-{material}", material, building(corner, along, bays, float(deep), height))
            half, (ax, ay) = float(end - start - gap) / 2, along
            place = corner[0] + half * ax - 2.5 * ay, corner[1] + half * ay + 2.5 * ax, height + 3.0
            masts.append(([round(float(v), 1) for v in place], float(np.degrees(np.arctan2(-ax, ay)) + 0.0)))
    return masts


def tree(rng: np.random.Generator, x: float, y: float) -> Mesh:
    """A crown: a closed body of twelve sides."""
    turns = np.arange(6) * np.pi / 3 + rng.uniform(0, np.pi / 3)
    radius, bottom, top = rng.uniform(1.3, 2.0), rng.uniform(2.4, 3.0), rng.uniform(6.0, 8.5)
    ring = [(x + radius * np.cos(t), y + radius * np.sin(t), (bottom + top) / 2) for t in turns]
    triangles = []
    for a, b in zip(ring, [*ring[1:], ring[0]], strict=True):
        triangles += [(a, b, (x, y, top)), (b, a, (x, y, bottom))]
    return soup(triangles)


def box(low: Solid, high: Solid) -> Mesh:
    (x0, y0, _), (x1, y1, z1) = low, high
    return building((x0, y0), (1.0, 0.0), [(0.0, x1 - x0, 0.0)], y1 - y0, z1)


def standing(kind: str, size: Solid, x: float, y: float, yaw_deg: float) -> Mesh:
    """A vehicle that stands."""
    mesh, c, s = SHAPES[kind](), np.cos(np.radians(yaw_deg)), np.sin(np.radians(yaw_deg))
    local = mesh.vertices * size
    turned = np.stack([c * local[:, 0] - s * local[:, 1] + x, s * local[:, 0] + c * local[:, 1] + y], -1)
    return Mesh(np.column_stack([turned, local[:, 2] + size[2] / 2 + 0.01]), mesh.faces)


class Plan:
    """Where blocks, streets and the station are, from a generator of random numbers."""

    def __init__(self, rng: np.random.Generator) -> None:
        west, middle, east = rng.uniform(48, 60), rng.uniform(52, 66), rng.uniform(44, 56)
        south, centre, north = rng.uniform(58, 70), rng.uniform(72, 84), rng.uniform(58, 70)
        self.side_x = round(AVENUE_M + middle + STREET_M, 1)
        self.street_y = round(-centre / 2 - STREET_M, 1), round(centre / 2 + STREET_M, 1)
        low, high = self.street_y
        self.columns = (
            (-AVENUE_M - west, -AVENUE_M), (AVENUE_M, self.side_x - STREET_M),
            (self.side_x + STREET_M, self.side_x + STREET_M + east),
        )  # fmt: skip
        self.rows = (
            (low - STREET_M - south, low - STREET_M), (low + STREET_M, high - STREET_M),
            (high + STREET_M, high + STREET_M + north),
        )  # fmt: skip
        self.box = self.columns[0][0], self.rows[0][0], self.columns[2][1], self.rows[2][1]
        x0, y0, x1, y1 = (round(v, 1) for v in self.box)
        self.nodes = {
            "as": (0.0, y0 - END_M), "a1": (0.0, low), "a2": (0.0, high), "an": (0.0, y1 + END_M),
            "bs": (self.side_x, y0 - END_M), "b1": (self.side_x, low),
            "b2": (self.side_x, high), "bn": (self.side_x, y1 + END_M),
            "w1": (x0 - END_M, low), "e1": (x1 + END_M, low),
            "w2": (x0 - END_M, high), "e2": (x1 + END_M, high),
        }  # fmt: skip
        self.station = (
            round(-LANE_M * AVENUE_LANES - KERB_M - 0.6, 2),
            round(float(rng.uniform(-6, 6)), 1),
            4.0,
        )


LINES = (
    ("as", "a1", "a2", "an"),
    ("bs", "b1", "b2", "bn"),
    ("w1", "a1", "b1", "e1"),
    ("w2", "a2", "b2", "e2"),
)
"""The avenue, the side street along it, and the streets across, by their nodes."""


PARKED = {0.4: (7.5, 2.3, 3.4), 0.5: (5.9, 2.0, 2.6), 0.65: (4.5, 1.8, 1.5)}
"""Sizes of lorries, vans and cars that stand [m], below which draw."""


def scenery(plan: Plan, rng: np.random.Generator, name: str) -> tuple[ImportedScene, list[Mast]]:
    """The scene, and the masts of two roofs beside the avenue."""
    shapes, masts = Shapes(), {}
    for i, (x0, x1) in enumerate(plan.columns):
        for j, (y0, y1) in enumerate(plan.rows):
            tall = (12.0, 32.0) if i < 2 else (8.0, 20.0)
            masts[i, j] = block(shapes, rng, f"block-{i + 1}{j + 1}", (x0, y0), (x1, y1), tall)
    x0, y0, x1, y1 = plan.box
    ground = [(x, y, 0.0) for x in (x0 - 60, x1 + 60) for y in (y0 - 60, y1 + 60)]
    a, b, c, d = ground
    shapes.add("ground", "asphalt", soup([(a, c, d), (a, d, b)]), "ground")
    kerb = LANE_M * AVENUE_LANES + KERB_M / 2
    for side in (-1, 1):
        for low, high in plan.rows:
            for y in np.arange(low + 8, high - 6, 9.0):
                draw = rng.random()
                if side < 0 and abs(y - plan.station[1]) < 6:
                    continue  # nothing stands around the station
                if draw < 0.3:
                    x = side * (kerb + 2.3)
                    shapes.add("foliage-trees", "wood", tree(rng, x, y), "foliage")
                    shapes.add("trunks", "wood", box((x - 0.15, y - 0.15, 0), (x + 0.15, y + 0.15, 2.3)))
                elif low < 0 < high:
                    continue  # the kerb of the middle block is for deliveries
                elif draw < 0.65:
                    kind = "truck" if draw < 0.5 else "car"
                    size = next(size for below, size in PARKED.items() if draw < below)
                    parked = standing(kind, size, side * kerb, y, side * 90.0)
                    shapes.add("parked", "metal", parked, "vehicle")
    colours = {"brick": (0.45, 0.2, 0.13), "concrete": None, "glass": None, "metal": None, "wood": None}
    materials = {material: wall_material(material, colour) for material, colour in colours.items()}
    materials["asphalt"] = wall_material("concrete", (0.08, 0.08, 0.09))
    pieces = shapes.pieces("examples/district.py")
    used = {piece.material for piece in pieces.values()}
    scene = ImportedScene(
        name=name, pieces=pieces, materials={k: v for k, v in materials.items() if k in used},
        transmitters_m=[plan.station], frequencies_hz=[60e9],
    )  # fmt: skip
    east = [mast for mast in masts[0, 0] if mast[1] == 0.0]
    west = [mast for mast in masts[1, 2] if abs(mast[1]) == 180.0]
    return scene, [east[0], west[0]]


def network(plan: Plan) -> bytes:
    """The road network of SUMO, in the coordinates of the scene."""
    signals = {"a1", "a2", "b1", "b2"}
    nodes = []
    for name, (x, y) in plan.nodes.items():
        kind = "traffic_light" if name in signals else "dead_end"
        nodes.append(f'<node id="{name}" x="{x:.1f}" y="{y:.1f}" type="{kind}"/>')
    edges = []
    for line in LINES:
        avenue = line[0] == "as"
        for a, b in [*pairwise(line), *((b, a) for a, b in pairwise(line))]:
            lanes = [f'<lane index="0" allow="pedestrian" width="{SIDEWALK_M}"/>']
            if avenue:
                lanes.append(f'<lane index="1" disallow="all" width="{KERB_M}"/>')
            drive = AVENUE_LANES if avenue else 1
            lanes += [
                f'<lane index="{len(lanes) + k}" width="{LANE_M}" disallow="pedestrian"/>'
                for k in range(drive)
            ]
            edges.append(
                f'<edge id="{a}-{b}" from="{a}" to="{b}" numLanes="{len(lanes)}" '
                f'priority="{2 if avenue else 1}" speed="{13.9 if avenue else 8.3}">{"".join(lanes)}</edge>'
            )
    with tempfile.TemporaryDirectory() as folder:
        at = Path(folder)
        (at / "nod.xml").write_text(f"<nodes>{''.join(nodes)}</nodes>")
        (at / "edg.xml").write_text(f"<edges>{''.join(edges)}</edges>")
        import sumo  # of the extra `world`

        program = Path(sumo.SUMO_HOME) / "bin" / "netconvert"
        options = (
            "--node-files nod.xml --edge-files edg.xml --crossings.guess --walkingareas "
            "--offset.disable-normalization --no-turnarounds.except-deadend --output.street-names false "
            "--tls.cycle.time 77 --tls.left-green.time 7 --output-file net.xml"
        )
        subprocess.run([str(program), *options.split()], cwd=at, check=True, capture_output=True)  # noqa: S603
        text = (at / "net.xml").read_text()
    text = re.sub(r"<!-- generated on.*?-->\s*", "", text, count=1, flags=re.DOTALL)
    return re.sub(r"\n\s+", "\n", text).encode()


def kerbs(plan: Plan) -> bytes:
    """Where deliveries stop, two places behind each other on each side."""
    lines = ["<additional>"]
    (low, high), middle = plan.street_y, plan.station[1]
    for edge in DELIVERIES.values():
        # Places along an edge count from where its lanes begin, behind the junction.
        sign = 1 if edge == "a1-a2" else -1
        begin = (low if sign > 0 else -high) + STREET_M + 3.0
        for number, off in enumerate((-24.0, 2.0)):
            start = sign * middle + off - begin
            lines.append(
                f'    <parkingArea id="{edge}-{number}" lane="{edge}_2" startPos="{start:.1f}" '
                f'endPos="{start + 22.0:.1f}" roadsideCapacity="2" width="{KERB_M}"/>'
            )
    return "\n".join([*lines, "</additional>", ""]).encode()


def edges_of(nodes: str) -> str:
    way = nodes.split()
    return " ".join(f"{a}-{b}" for a, b in pairwise(way))


TOURS = (
    ("as a1 a2 an a2 a1 as", 8, 1300),
    ("as a1 a2 b2 e2 b2 bn b2 b1 e1 b1 a1 as", 4, 1530),
    ("w1 a1 a2 an a2 w2 a2 a1 w1", 5, 1250),
    ("bs b1 a1 a2 b2 b1 e1 b1 bs", 5, 1430),
)
"""Ways of the vehicles with receivers, how often each goes round, and seconds until the next one."""
THROUGH = {
    "as a1 a2 an": 0.115, "an a2 a1 as": 0.115, "w1 a1 b1 e1": 0.03, "e2 b2 a2 w2": 0.03,
    "bs b1 b2 bn": 0.03, "bn b2 b1 bs": 0.03, "w2 a2 an": 0.02, "e1 b1 a1 as": 0.02,
}  # fmt: skip
"""Ways of other vehicles, and how many a second."""
DELIVERIES = {"as a1 a2 an": "a1-a2", "an a2 a1 as": "a2-a1"}
"""Ways of lorries and vans that stand at the kerb beside the station for a while, and where."""
STAYS_S = {60: 0.006, 150: 0.0035, 300: 0.001}
"""How long they stand, and how many of them come a second."""
WALKS = ("as-a1 a2-an", "an-a2 a1-w1", "e2-b2 a1-as")
TYPES = {
    "car": 'vClass="passenger" length="4.5" width="1.8" height="1.6" minGap="2.0" '
    'speedFactor="normc(0.75,0.1,0.5,1.0)"',
    "van": 'vClass="delivery" length="5.9" width="2.0" height="2.6" minGap="2.0" accel="2.0" '
    'speedFactor="normc(0.70,0.1,0.5,1.0)"',
    "lorry": 'vClass="truck" length="9.0" width="2.5" height="3.6" minGap="2.5" accel="1.3" decel="4.0" '
    'speedFactor="normc(0.65,0.1,0.5,0.9)"',
    "bus": 'vClass="bus" length="12.0" width="2.5" height="3.2" minGap="2.5" accel="1.2" decel="4.0" '
    'speedFactor="0.65"',
}
MIXES = {
    "traffic": ("car van lorry bus", "0.57 0.18 0.16 0.09"),
    "delivery": ("van lorry", "0.35 0.65"),
    "users": ("car van lorry", "0.8 0.12 0.08"),
}
PERSON = (
    '    <vType id="person" vClass="pedestrian" length="0.30" width="0.50" height="1.72" '
    'speedFactor="normc(1.0,0.1,0.7,1.3)"/>'
)


def flow(name: str, kind: str, begin: float, period: object, body: str) -> tuple[float, str]:
    """Vehicles that come again and again, and when the first does [s]."""
    return begin, (
        f'    <flow id="{name}" type="{kind}" begin="{begin}" end="1000000" period="{period}" '
        f'departLane="best" departSpeed="max">{body}</flow>'
    )


def traffic() -> bytes:
    """Types, tours, flows and people of SUMO, in the order of their departure."""
    flows = []
    for k, of in enumerate((0, 1, 2, 3, 0, 1, 2, 3, 1, 2)):
        tour, rounds, period = TOURS[of]
        route = f'<route edges="{edges_of(tour)}" repeat="{rounds}"/>'
        flows.append(flow(f"user-{k}", "users", 13.0 * k, period, route))
    for k, (way, rate) in enumerate(THROUGH.items()):
        route = f'<route edges="{edges_of(way)}"/>'
        flows.append(flow(f"flow-{k}", "traffic", k * 0.5, f"exp({rate})", route))
    for k, (way, kerb) in enumerate(DELIVERIES.items()):
        for stay, rate in STAYS_S.items():
            for area in "01":
                stop = f'<stop parkingArea="{kerb}-{area}" duration="{stay}"/>'
                name, body = f"delivery-{k}{area}-{stay}", f'<route edges="{edges_of(way)}"/>{stop}'
                flows.append(flow(name, "delivery", k * 0.5, f"exp({rate / 2})", body))
    for k, way in enumerate(WALKS):
        first, last = way.split()
        # SUMO makes all people of a flow when it reads it, so a flow is short.
        for begin in range(0, 66_000, 2000):
            people = f'id="walk-{k}-{begin}" type="person" begin="{begin}" end="{begin + 2000}"'
            walk = f'<walk from="{first}" to="{last}"/>'
            flows.append((begin, f'    <personFlow {people} period="exp(0.025)">{walk}</personFlow>'))
    lines = ['<?xml version="1.0" encoding="UTF-8"?>', "<routes>"]
    lines += [f'    <vType id="{name}" {of}/>' for name, of in TYPES.items()]
    lines += [
        f'    <vTypeDistribution id="{name}" vTypes="{of}" probabilities="{shares}"/>'
        for name, (of, shares) in MIXES.items()
    ]
    lines += [PERSON, *(text for _, text in sorted(flows))]
    return "\n".join([*lines, "</routes>", ""]).encode()


ROOF = """
[[devices]]
name = "roof-$k"
kind = "antenna"
role = "tx"
position_m = $place
yaw_deg = $yaw
pitch_deg = 25.0
array = { columns = 64, pattern = "tr38901" }
power_dbm = 30.0
"""
LIDAR = """[services.lidar]
role = "sensors"
use = "lidar"
budget_ms = 150

[services.lidar.settings]
points_every = 0  # the grid alone
grid = { minimum_m = [$x0, $y0, 0.0], maximum_m = [$x1, $y1, 10.0], cells = $cells }

"""
MOBILE = """
# 0.1 m above the roof of each vehicle on a tour.
[[devices]]
name = "rx"
kind = "antenna"
role = "rx"
on = "vehicle.user-*"
count = 10
mount = "roof"
position_m = [0.0, 0.0, 0.1]
keeps_heading = true  # rows of elements lie north–south, as in the ITU challenge
array = { columns = 8 }

# Above each of these receivers, and so above everything that the vehicle is made of.
[[devices]]
name = "lidar"
kind = "lidar"
on = "vehicle.user-*"
count = 10
mount = "roof"
position_m = [0.0, 0.0, 0.5]
beams = 32
azimuth_steps = 900
elevation_deg = [-25.0, 3.0]
range_m = [0.5, 100.0]
"""
FIXED = """
[[devices]]
name = "rx$k"
kind = "antenna"
role = "rx"
position_m = $place
yaw_deg = $yaw
array = { columns = 8 }
"""


def filled(text: str, **values: object) -> str:
    return Template(text).substitute(values)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--out", type=Path, required=True, help="folder in which files and a folder are made")
    parser.add_argument("--seed", type=int, required=True, help="of the city")
    parser.add_argument("--name", default="district", help="of the scenario; default: district")
    args = parser.parse_args()
    rng = np.random.default_rng(args.seed)
    plan = Plan(rng)
    scene, masts = scenery(plan, rng, args.name)
    roads = {"net.xml": network(plan), "traffic.rou.xml": traffic(), "kerbs.add.xml": kerbs(plan)}
    write_scene(scene, args.out / args.name, roads)
    y = plan.station[1]
    grid = filled(LIDAR, x0=-11.5, x1=11.5, y0=y - 125.0, y1=y + 125.0, cells=list(CELLS))
    roofs = "\n# On roofs; presets keep the station in the street alone, as the paper's sets have one."
    roofs += "".join(filled(ROOF, k=k, place=place, yaw=yaw) for k, (place, yaw) in enumerate(masts, 1))
    scenario = (files("caviar_scenarios") / "new" / "district.toml").read_text(encoding="utf-8").rstrip()
    common = {"roofs": roofs, "base": args.name, "seed": args.seed, "station": list(plan.station)}
    # Above the heads, at the façades opposite; rows of elements lie along the avenue.
    places = [[AVENUE_M - 0.15, round(y - 36.0 + 8 * k, 1), 3.4] for k in range(10)]
    fixed = "".join(filled(FIXED, k=k, place=place, yaw=180.0) for k, place in enumerate(places))
    on_vehicles = "ten vehicles with receivers and LIDARs of their own", '"lidar.grid", ', grid, MOBILE
    standing_still = "ten receivers at the façades of its avenue", "", "", fixed
    for suffix, parts in (("", on_vehicles), ("-fixed", standing_still)):
        who, topic, lidar, devices = parts
        title, name = f"A district for data sets: {who}.", args.name + suffix
        text = filled(scenario, title=title, name=name, topic=topic, lidar=lidar, devices=devices, **common)
        (args.out / f"{args.name}{suffix}.toml").write_text(text)


if __name__ == "__main__":
    main()
