"""The world ``sumo`` against SUMO itself: poses, determinism, traffic that comes and goes, errors."""

from __future__ import annotations

import hashlib
import importlib.util
import logging
import math
import signal
import subprocess
import sys
from collections import Counter
from collections.abc import Callable, Iterator
from itertools import pairwise
from pathlib import Path
from xml.etree import ElementTree

import msgspec
import numpy as np
import pytest
from world_builders import T_SAM_NS, scene_at, wire_bytes

from caviar_protocol.errors import CaviarError, RunError, ScenarioError, SetupError
from caviar_protocol.scenario import DeviceSpec
from caviar_protocol.space.coordinates import euler_from_quaternion, rotation_matrix
from caviar_protocol.topics import Scene
from caviar_services.service import Frame, Preparation, RunInfo
from caviar_services.world.carriages import carriages
from caviar_services.world.sumo import SumoSettings, SumoWorld
from caviar_services.world.sumo_conventions import PLACED, step_length_ms
from caviar_services.world.sumo_process import load_libsumo

pytestmark = [
    pytest.mark.slow,
    pytest.mark.sumo,
    pytest.mark.skipif(importlib.util.find_spec("libsumo") is None, reason="needs the world extra"),
]

Make = Callable[..., SumoWorld]
_LOG = logging.getLogger(__name__)

FRESH_PROCESS = """
import hashlib, sys
from caviar_protocol.codec import encode_payload
from caviar_services.service import Frame, Preparation, RunInfo
from caviar_services.world.sumo_conventions import PLACED
from caviar_services.world.sumo import SumoSettings, SumoWorld

folder, seed = sys.argv[1], int(sys.argv[2])
world = SumoWorld(
    SumoSettings(net=folder + "/canyon.net.xml", routes=folder + "/canyon.rou.xml", begin_s=20.0),
    RunInfo(name="traffic"),
)
world.prepare(Preparation(demand={}))
world.reset(0, seed, 0)
digest = hashlib.sha256()
for number in range(60):
    frame = Frame(episode=0, number=number, t_ns=number * 100_000_000)
    for part in encode_payload(world.step(frame).products["scene"]):
        digest.update(part)
world.close()
print(digest.hexdigest())
"""


INTERRUPTED = """
import os, signal, sys
from pathlib import Path
from xml.etree import ElementTree
from caviar_protocol.codec import encode_payload
from caviar_services.service import Frame, Preparation, RunInfo
from caviar_services.world.sumo_conventions import PLACED
from caviar_services.world.sumo import SumoSettings, SumoWorld

folder, scratch, first, last, kill = sys.argv[1], Path(sys.argv[2]), *map(int, sys.argv[3:])
world = SumoWorld(
    SumoSettings(net=folder + "/canyon.net.xml", routes=folder + "/canyon.rou.xml", begin_s=20.0),
    RunInfo(name="traffic", devices=()),
)
world.prepare(Preparation(demand={}))
world.reset(0, 7, 0)
if first:
    world.restore((scratch / "state").read_bytes())
with (scratch / "products").open("ab") as file:
    for number in range(first, last):
        frame = Frame(episode=0, number=number, t_ns=number * 100_000_000, previous=number - 1)
        for part in encode_payload(world.step(frame).products["scene"]):
            file.write(part)
if kill:
    (scratch / "state").write_bytes(world.checkpoint())
    os.kill(os.getpid(), signal.SIGKILL)
world.close()
"""


@pytest.fixture
def make(repository: Path) -> Iterator[Make]:
    """Worlds in the street of the canyon. Making one closes the one before, and the test's end the
    last: libsumo holds one simulation."""
    folder = repository / "deploy" / "caviar_scenarios" / "street-canyon"
    worlds: list[SumoWorld] = []

    def create(
        name: str = "traffic",
        sampling_period_ns: int = T_SAM_NS,
        devices: tuple[DeviceSpec, ...] = (),
        **changes: object,
    ) -> SumoWorld:
        files = {
            "net": str(folder / "canyon.net.xml"),
            "routes": str(folder / "canyon.rou.xml"),
            "begin_s": 20.0,
        }
        settings = SumoSettings(**{**files, **changes})
        for world in worlds:
            world.close()
        run = RunInfo(name=name, sampling_period_ns=sampling_period_ns, devices=devices)
        worlds.append(SumoWorld(settings, run))
        worlds[-1].prepare(Preparation(demand={}))
        return worlds[-1]

    yield create
    for world in worlds:
        world.close()


def scenes(world: SumoWorld, seed: int, frames: int, episode: int = 0) -> list[Scene]:
    world.reset(episode, seed, 0)
    return [scene_at(world, k) for k in range(frames)]


# --- poses -----------------------------------------------------------------------------------

NODES = '<nodes><node id="a" x="{x0}" y="{y0}" z="{z0}"/><node id="b" x="{x1}" y="{y1}" z="{z1}"/></nodes>'
EDGES = '<edges><edge id="ab" from="a" to="b" numLanes="1" speed="20" spreadType="center"/></edges>'
LORRY = """<routes>
  <vType id="lorry" vClass="truck" length="9.0" width="2.4" height="3.6" maxSpeed="12" sigma="0"
         speedDev="0"/>
  <vehicle id="one" type="lorry" depart="0" departPos="9" departSpeed="12"><route edges="ab"/></vehicle>
</routes>"""


def converted(folder: Path) -> None:
    """Make a network of the nodes and edges there."""
    import sumo

    subprocess.run(
        [
            Path(sumo.SUMO_HOME) / "bin" / "netconvert",
            *("--node-files", "r.nod.xml", "--edge-files", "r.edg.xml", "-o", "r.net.xml"),
            *("--offset.disable-normalization", "true", "--junctions.endpoint-shape", "true"),
        ],
        cwd=folder,
        check=True,
        capture_output=True,
    )


@pytest.fixture
def ramp(tmp_path: Path) -> tuple[Path, np.ndarray, np.ndarray]:
    """A straight road at no special angle, uphill, and its two ends."""
    begin, end = np.array([30.0, -20.0, 5.0]), np.array([-130.0, 220.0, 22.0])
    names = dict(zip(("x0", "y0", "z0", "x1", "y1", "z1"), (*begin, *end), strict=True))
    (tmp_path / "r.nod.xml").write_text(NODES.format(**names))
    (tmp_path / "r.edg.xml").write_text(EDGES)
    (tmp_path / "r.rou.xml").write_text(LORRY)
    converted(tmp_path)
    return tmp_path, begin, end


def test_pose_and_velocity_on_a_slope_by_hand(make: Make, ramp: tuple[Path, np.ndarray, np.ndarray]) -> None:
    """A lorry at 12 m/s up a ramp: its body lies on the line, nose along it, and moves along it."""
    folder, begin, end = ramp
    world = make(net=str(folder / "r.net.xml"), routes=str(folder / "r.rou.xml"), begin_s=1.0)
    forward = (end - begin) / np.linalg.norm(end - begin)
    left = np.array([-forward[1], forward[0], 0.0]) / math.hypot(forward[0], forward[1])
    up = np.cross(forward, left)
    places = []
    for scene in scenes(world, 1, 80):
        assert scene.names == ("traffic.one",)
        assert scene.classes == ("truck",)
        assert scene.dimensions[0].tolist() == [9.0, 2.4, 3.6]
        axes = rotation_matrix(scene.orientation[0].tolist())
        assert axes == pytest.approx(np.stack([forward, left, up], axis=1), abs=1e-4)
        bumper = scene.position[0] + 4.5 * forward - 1.8 * up
        places.append(float((bumper - begin) @ forward))
        assert np.linalg.norm(bumper - begin - places[-1] * forward) < 0.01
        assert scene.velocity[0] == pytest.approx(12.0 * forward, abs=1e-3)
    assert np.diff(places) == pytest.approx(1.2, abs=1e-3)


TRACK_NODES = """<nodes><node id="a" x="-300" y="0" z="0"/><node id="b" x="0" y="0" z="3" radius="{radius}"/>
  <node id="c" x="0" y="300" z="9" radius="{radius}"/><node id="d" x="300" y="300" z="9"/></nodes>"""
TRACK_EDGES = """<edges><edge id="ab" from="a" to="b" {lane}/><edge id="bc" from="b" to="c" {lane}/>
  <edge id="cd" from="c" to="d" {lane}/></edges>"""
TRAIN = """<routes><vType id="ice" vClass="{vclass}" length="{length}"/>
  <vehicle id="T" type="ice" depart="0" departPos="{length}" departSpeed="15">
    <route edges="ab bc cd"/></vehicle>
</routes>"""


def track_distance(folder: Path, points: np.ndarray) -> float:
    """Largest distance of points from the lanes of SUMO's network [m]."""
    root = ElementTree.parse(folder / "r.net.xml").getroot()  # noqa: S314
    shapes = [lane.get("shape", "").split() for lane in root.iter("lane")]
    lanes = [np.array([[*map(float, p.split(",")), 0.0][:3] for p in shape]) for shape in shapes]
    a = np.concatenate([lane[:-1] for lane in lanes])
    along = np.concatenate([lane[1:] - lane[:-1] for lane in lanes])
    off = points[:, None] - a
    share = np.clip((off * along).sum(-1) / np.maximum((along**2).sum(-1), 1e-12), 0, 1)
    return float(np.linalg.norm(off - share[..., None] * along, axis=-1).min(axis=1).max())


@pytest.mark.parametrize(
    ("vclass", "length", "radius", "count", "chosen"),
    [("rail", 200.0, 1.5, 8, {}), ("tram", 32.0, 12.0, 4, {}), ("trailer", 16.5, 6.0, 2, {}),
     ("truck", 20.0, 6.0, 4, {"ice": 5.0})],
)  # fmt: skip
def test_carriages_stay_on_the_track_through_right_angles(
    make: Make,
    tmp_path: Path,
    vclass: str,
    length: float,
    radius: float,
    count: int,
    chosen: dict[str, float],
) -> None:
    (tmp_path / "r.nod.xml").write_text(TRACK_NODES.format(radius=radius))
    lane = f'numLanes="1" speed="15" spreadType="center" allow="{vclass}"'
    (tmp_path / "r.edg.xml").write_text(TRACK_EDGES.format(lane=lane))
    (tmp_path / "r.rou.xml").write_text(TRAIN.format(vclass=vclass, length=length))
    converted(tmp_path)
    files = {"net": str(tmp_path / "r.net.xml"), "routes": str(tmp_path / "r.rou.xml")}
    world = make(**files, carriages=chosen, begin_s=1.0)
    heads: list[np.ndarray] = []
    for scene in scenes(world, 1, 700):
        if not scene.names:
            break
        assert scene.names == ("traffic.T", *(f"traffic.T/{k}" for k in range(1, count)))
        axes = np.array([rotation_matrix(q) for q in scene.orientation.tolist()])
        half = scene.dimensions[:, :1] / 2
        assert scene.dimensions[:, 0] == pytest.approx(length / count)
        floor = scene.position - scene.dimensions[:, 2:] / 2 * axes[:, :, 2]
        front, rear = floor + half * axes[:, :, 0], floor - half * axes[:, :, 0]
        assert np.linalg.norm(front[1:] - rear[:-1], axis=1).max(initial=0) < 1e-6  # coupled
        assert track_distance(tmp_path, np.concatenate([front, rear])) < 0.01
        heads.append(front[0])
    assert len(heads) > 200
    assert min(head[0] for head in heads) < -80
    assert max(head[1] for head in heads) > 100


def test_a_parked_train_stands_on_its_track(make: Make, tmp_path: Path) -> None:
    (tmp_path / "r.nod.xml").write_text(NODES.format(x0=0, y0=0, z0=0, x1=300, y1=0, z1=0))
    (tmp_path / "r.edg.xml").write_text(EDGES)
    (tmp_path / "r.rou.xml").write_text(
        '<routes><vType id="t" vClass="truck" length="60"/>'
        '<vehicle id="T" type="t" depart="0" departPos="70">'
        '<route edges="ab"/><stop lane="ab_0" endPos="90" duration="20" parking="true"/></vehicle>'
        "</routes>"
    )
    converted(tmp_path)
    files = {"net": str(tmp_path / "r.net.xml"), "routes": str(tmp_path / "r.rou.xml")}
    found = scenes(make(**files, carriages={"t": 20.0}, begin_s=0.0), 1, 300)
    parked = [scene for scene in found if scene.names and np.allclose(scene.position[0, 0], 80.0, atol=1e-3)]
    assert len(parked) > 100
    assert parked[0].position[:, :2].ravel() == pytest.approx([80.0, 0, 60, 0, 40, 0], abs=1e-3)


@pytest.mark.parametrize("length", [-1.0, 1e-9, math.nan, math.inf])
def test_lengths_that_no_carriage_has_are_refused(length: float) -> None:
    with pytest.raises(msgspec.ValidationError, match=r"carriages\.ice is .* m; write 1 to 1000 m"):
        msgspec.convert({"carriages": {"ice": length}}, SumoSettings)


def test_carriages_move_as_rigid_bodies() -> None:
    """Velocities and yaw rates are those by which ends move when the front goes on along the way."""
    angles = np.linspace(0, np.pi, 400)
    bend = [(40 * math.sin(a), 40 - 40 * math.cos(a), 0.02 * a) for a in angles]
    way = [*reversed(bend), (-300.0, 0.0, 0.0)]
    speed, step = 14.0, 1e-5
    start, end = np.array(way[1]), np.array(way[0])
    forward = (end - start) / np.linalg.norm(end - start)
    later = [tuple(end + speed * step * forward), *way[1:]]
    before, after = (carriages(points, 150.0, 6, speed) for points in (way, later))
    for one, two in zip(before, after, strict=True):
        middles = [(np.array(c.front) + c.rear) / 2 for c in (one, two)]
        assert (middles[1] - middles[0]) / step == pytest.approx(one.velocity, abs=1e-3)
        yaws = [math.atan2(c.front[1] - c.rear[1], c.front[0] - c.rear[0]) for c in (one, two)]
        assert (yaws[1] - yaws[0]) / step == pytest.approx(one.yaw_rate, abs=1e-4)


def test_a_placed_network_moves_everything_with_it(make: Make) -> None:
    """Turned by 30° and shifted: positions, headings and velocities follow as one rigid body."""
    plain = scenes(make(), 5, 30)[-1]
    placed = scenes(make(offset_m=(100.0, -50.0, 7.0), yaw_deg=30.0), 5, 30)[-1]
    c, s = math.cos(math.pi / 6), math.sin(math.pi / 6)
    turn = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    assert placed.names == plain.names
    assert placed.position == pytest.approx(plain.position @ turn.T + [100.0, -50.0, 7.0], abs=1e-9)
    assert placed.velocity == pytest.approx(plain.velocity @ turn.T, abs=1e-9)
    for p, q in zip(plain.orientation.tolist(), placed.orientation.tolist(), strict=True):
        assert rotation_matrix(q) == pytest.approx(turn @ rotation_matrix(p), abs=1e-12)


def test_velocity_agrees_with_how_positions_change(make: Make) -> None:
    """On straight road the way of a step is its speed times the step (SUMO moves, then reports)."""
    before, after = scenes(make(), 3, 41)[-2:]
    common = [name for name in before.names if name in after.names]
    checked = 0
    for name in common:
        i, j = before.names.index(name), after.names.index(name)
        way = after.position[j] - before.position[i]
        straight = np.allclose(before.orientation[i], after.orientation[j], atol=1e-9)
        if straight and abs(way[1]) < 1e-9:
            assert way / 0.1 == pytest.approx(after.velocity[j], abs=1e-6)
            checked += 1
    assert checked >= 5


def test_the_yaw_rate_is_how_the_heading_changed_in_the_last_step(make: Make) -> None:
    """On the way along the street nothing turns, and where vehicles change lanes or turn they say so."""
    turned = 0
    for before, after in pairwise(scenes(make(), 3, 60)):
        for j, name in enumerate(after.names):
            if name in before.names:
                i = before.names.index(name)
                yaws = [euler_from_quaternion(q)[0] for q in (before.orientation[i], after.orientation[j])]
                rate = math.remainder(yaws[1] - yaws[0], 2 * math.pi) / 0.1
                turning = after.angular_velocity
                told = (0.0, 0.0, 0.0) if turning is None else turning[j].tolist()
                assert told == pytest.approx((0.0, 0.0, rate), abs=1e-8)
                turned += rate != 0
    assert turned < 60


def test_a_lorry_in_a_bend_turns_with_its_speed_over_the_radius(make: Make, tmp_path: Path) -> None:
    """A quarter of a circle of 60 m to the left, at 12 m/s: 0.2 rad/s counter-clockwise. Its bend is a
    polygon of 2° a side."""
    angle = np.radians(np.arange(0.0, 91.0, 2.0))
    arc = " ".join(f"{60 * math.sin(a):.6f},{60 - 60 * math.cos(a):.6f},0" for a in angle)
    ends = dict(zip(("x0", "y0", "z0", "x1", "y1", "z1"), (0, 0, 0, 60, 60, 0), strict=True))
    (tmp_path / "r.nod.xml").write_text(NODES.format(**ends))
    (tmp_path / "r.edg.xml").write_text(EDGES.replace("<edge ", f'<edge shape="{arc}" '))
    (tmp_path / "r.rou.xml").write_text(LORRY)
    converted(tmp_path)
    world = make(net=str(tmp_path / "r.net.xml"), routes=str(tmp_path / "r.rou.xml"), begin_s=1.0)
    turning = [s.angular_velocity[0] for s in scenes(world, 1, 60) if s.angular_velocity is not None]
    assert len(turning) > 50
    assert np.mean(turning, axis=0) == pytest.approx((0.0, 0.0, 0.2), rel=0.05)


def test_all_vehicles_stand_on_the_ground_on_their_side_of_the_road(make: Make) -> None:
    """Right-hand traffic in the street: eastbound south of its middle, westbound north of it."""
    for scene in scenes(make(offset_m=(0.0, 0.0, -0.03)), 2, 50)[::10]:
        assert scene.position[:, 2] - scene.dimensions[:, 2] / 2 == pytest.approx(-0.03, abs=1e-9)
        for name, (x, y, _), (vx, *_) in zip(scene.names, scene.position, scene.velocity, strict=True):
            if name.startswith(("traffic.bus-east", "traffic.east")) and abs(x) < 14:
                assert vx > 0
                assert y < 0.45
            if name.startswith(("traffic.bus-west", "traffic.west")) and abs(x) < 14:
                assert vx < 0
                assert y > 0.45


# --- traffic ---------------------------------------------------------------------------------


def test_vehicles_come_and_go_and_keep_what_they_are(make: Make) -> None:
    seen: dict[str, tuple[str, tuple[float, ...]]] = {}
    present: list[set[str]] = []
    for scene in scenes(make(), 1, 150):
        present.append(set(scene.names))
        for name, kind, size in zip(scene.names, scene.classes, scene.dimensions.tolist(), strict=True):
            assert seen.setdefault(name, (kind, tuple(size))) == (kind, tuple(size))
    assert present[-1] - present[0]
    assert present[0] - present[-1]
    assert {kind for kind, _ in seen.values()} == {"car", "truck", "bus"}
    for name in seen:  # no object flickers: each is there from its first to its last frame
        frames = [k for k, names in enumerate(present) if name in names]
        assert frames == list(range(frames[0], frames[-1] + 1))


def test_the_road_is_filled_before_frame_0(make: Make) -> None:
    assert scenes(make(begin_s=0.0), 1, 1)[0].names == ()
    assert len(scenes(make(begin_s=40.0), 1, 1)[0].names) >= 12


def test_the_same_episode_twice_is_equal_bit_by_bit(make: Make) -> None:
    world = make()
    first = [wire_bytes(scene) for scene in scenes(world, 4, 40, episode=2)]
    assert [wire_bytes(scene) for scene in scenes(world, 4, 40, episode=2)] == first


def test_seed_episode_and_name_each_change_the_traffic(make: Make) -> None:
    digests = {
        hashlib.sha256(b"".join(map(wire_bytes, found))).hexdigest()
        for found in (
            scenes(make(prefix="v."), 4, 40),
            scenes(make(prefix="v."), 5, 40),
            scenes(make(prefix="v."), 4, 40, episode=1),
            scenes(make(name="other", prefix="v."), 4, 40),
        )
    }
    assert len(digests) == 4


def test_fresh_processes_agree_and_another_seed_differs(repository: Path) -> None:
    folder = str(repository / "deploy" / "caviar_scenarios" / "street-canyon")

    def digest(seed: int) -> str:
        done = subprocess.run(
            [sys.executable, "-c", FRESH_PROCESS, folder, str(seed)],
            check=True,
            capture_output=True,
            text=True,
        )
        assert done.stderr == ""
        return done.stdout  # the digest and nothing else: SUMO is silent

    first = digest(1)
    assert len(first) == 65
    assert digest(1) == first
    assert digest(2) != first


def test_a_gap_is_stepped_whole(make: Make) -> None:
    world = make()
    steady = scenes(world, 6, 31)[-1]
    world.reset(0, 6, 0)
    scene_at(world, 0)
    assert wire_bytes(scene_at(world, 30, previous=0)) == wire_bytes(steady)


def test_steps_shorter_than_the_sampling_period(make: Make) -> None:
    """SUMO in steps of 50 ms under frames of 100 ms: two steps a frame."""
    world = make(step_ms=50, begin_s=20.0)
    before, after = scenes(world, 3, 41)[-2:]
    way = {
        name: after.position[after.names.index(name)] - before.position[before.names.index(name)]
        for name in set(before.names) & set(after.names)
    }
    speeds = [np.linalg.norm(step) / 0.1 for step in way.values()]
    assert 2.0 < np.median(speeds) < 14.0


def test_going_back_in_time_and_between_steps_is_refused(make: Make) -> None:
    world = make()
    scenes(world, 1, 5)
    with pytest.raises(RunError, match="after a later instant"):
        scene_at(world, 3)
    with pytest.raises(RunError, match="multiple of its step of 100 ms"):
        world.step(Frame(episode=0, number=6, t_ns=6 * T_SAM_NS + 1))


# --- settings and errors ---------------------------------------------------------------------


@pytest.mark.parametrize(
    ("period_ns", "step_ms", "expected"),
    [(100_000_000, None, 100), (100_000_000, 20, 20), (1_000_000, None, 1), (5_000_000_000, 500, 500)],
)
def test_step_lengths_that_fit(period_ns: int, step_ms: int | None, expected: int) -> None:
    assert step_length_ms(period_ns, step_ms) == expected


@pytest.mark.parametrize(
    ("period_ns", "step_ms", "message"),
    [
        (33_333_333, None, r"whole milliseconds.*write 33000000 or 34000000"),
        (100_000_000, 30, r"step of 30 ms does not fit .* 100 ms; write step_ms = 25"),
        (100_000_000, 200, r"write step_ms = 100"),
        (100_000_000, 0, r"write step_ms = 1"),
        (2_500_000_000, None, r"write step_ms = 625"),
        (500, None, r"500 ns is none; write 1000000$"),
    ],
)
def test_step_lengths_that_do_not_fit_are_answered_with_one_that_does(
    period_ns: int, step_ms: int | None, message: str
) -> None:
    with pytest.raises(ScenarioError, match=message):
        step_length_ms(period_ns, step_ms)


def test_names_have_the_prefix_that_is_declared(make: Make) -> None:
    for changes, prefix in (({"name": "cars"}, "cars."), ({"prefix": "v-"}, "v-")):
        world = make(**changes)
        assert world.prefixes() == (prefix,)
        assert all(name.startswith(prefix) for name in scenes(world, 1, 1)[0].names)


def test_what_is_wrong_with_files_is_named(make: Make, tmp_path: Path) -> None:
    missing = tmp_path / "none.net.xml"
    with pytest.raises(ScenarioError, match=r"settings\.net.*none\.net\.xml"):
        make(net=str(missing))
    broken = tmp_path / "broken.net.xml"
    broken.write_text("<net>\n<edge></net>")  # SUMO itself would end the process
    with pytest.raises(ScenarioError, match=r"broken\.net\.xml:2.*settings\.net.*XML"):
        make(net=str(broken))
    swapped = tmp_path / "swapped.rou.xml"
    swapped.write_text("<routes/>")
    with pytest.raises(ScenarioError, match=r"<routes>.*<net>"):
        make(net=str(swapped))
    with pytest.raises(ScenarioError, match=r"needs net"):
        make(net="")
    with pytest.raises(ScenarioError, match=r"'cart'.*car"):
        make(meshes=("cart",))


def test_what_sumo_refuses_is_said_in_its_words(make: Make) -> None:
    with pytest.raises(SetupError, match=r"SUMO does not start: .*--no-such-option"):
        make(options=("--no-such-option",))


def test_a_route_over_unknown_roads_ends_the_run_with_sumos_words(make: Make, tmp_path: Path) -> None:
    routes = tmp_path / "lost.rou.xml"
    routes.write_text('<routes><vehicle id="lost" depart="0"><route edges="nowhere"/></vehicle></routes>')
    with pytest.raises(CaviarError, match=r"SUMO .*'nowhere'.*'lost'"):
        scenes(make(routes=str(routes)), 1, 2)


CORNER = '<nodes><node id="a" x="0" y="0"/><node id="b" x="99" y="0"/><node id="c" x="99" y="99"/></nodes>'
TWO_ROADS = """<edges><edge id="ab" from="a" to="b"/><edge id="bc" from="b" to="c"/></edges>"""
TRAIN_AND_GAP = """<routes><vType id="long" vClass="bus" length="{length}"/><vType id="c"/>
<vehicle id="turns" type="long" depart="0" departPos="60"><route edges="ab bc"/></vehicle>
<vehicle id="gap" type="c" depart="{gap}"><route edges="bc ab"/></vehicle></routes>"""


def bent(folder: Path, length: float, gap: float) -> dict[str, str]:
    """A right angle of road, a vehicle that takes it, and one whose route leads nowhere."""
    (folder / "r.nod.xml").write_text(CORNER)
    (folder / "r.edg.xml").write_text(TWO_ROADS)
    (folder / "r.rou.xml").write_text(TRAIN_AND_GAP.format(length=length, gap=gap))
    converted(folder)
    return {"net": str(folder / "r.net.xml"), "routes": str(folder / "r.rou.xml")}


@pytest.mark.parametrize(("length", "named"), [(40.0, True), (11.0, False)])
def test_a_vehicle_too_long_for_its_bend_is_named(
    make: Make, tmp_path: Path, length: float, named: bool
) -> None:
    world = make(**bent(tmp_path, length, gap=500.0), begin_s=0.0)
    world.reset(0, 1, 0)
    frames = [Frame(episode=0, number=k, t_ns=k * T_SAM_NS) for k in range(100)]
    found = [world.step(frame).counts.get("beside-road/traffic.turns", 0) for frame in frames]
    assert bool(sum(found)) is named
    assert not any(found[:5])


def test_a_route_with_a_gap_is_said_in_words_and_its_jump_is_counted(make: Make, tmp_path: Path) -> None:
    files = bent(tmp_path, 11.0, gap=0.0)
    with pytest.raises(CaviarError, match=r"SUMO .*'gap' has no valid route"):
        scenes(make(**files, begin_s=0.0), 1, 2)
    world = make(**files, begin_s=0.0, options=("--ignore-route-errors", "--time-to-teleport", "1"))
    world.reset(0, 1, 0)
    counts = Counter[str]()
    for k in range(200):
        counts.update(world.step(Frame(episode=0, number=k, t_ns=k * T_SAM_NS)).counts)
    jumps = [name for name in counts if name.startswith("simulator-says/Teleporting vehicle …")]
    assert sum(counts[name] for name in jumps) == 1


def test_two_simulations_in_one_process_are_refused(make: Make) -> None:
    first, second = make(), make(name="second")
    first.reset(0, 1, 0)
    with pytest.raises(SetupError, match="process of its own"):
        second.reset(0, 1, 0)
    first.close()
    second.reset(0, 1, 0)
    assert scene_at(second, 0).names


def test_libsumo_not_installed_is_answered_with_the_command(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "libsumo", None)
    with pytest.raises(SetupError, match=r"pip install 'caviar-sim\[world\]'"):
        load_libsumo()


# --- real networks ---------------------------------------------------------------------------


def test_rosslyn_with_its_vehicle_types(make: Make, shared_data: Path) -> None:
    """The network of the paper's data sets, whose lorries and buses are known by type id only."""
    folder = shared_data / "rosslyn" / "sumo"
    world = make(
        net=str(folder / "quickstart.net.xml"),
        routes=str(folder / "quickstart.rou.xml"),
        classes={"Truck": "truck", "Bus": "bus"},
        offset_m=(658.82, 358.76, 0.0),
        begin_s=100.0,
    )
    sizes = {"car": [4.645, 1.775, 1.59], "truck": [12.5, 2.5, 4.3], "bus": [9.0, 2.4, 3.2]}
    found = scenes(world, 1, 100)[-1]
    assert len(found.names) > 10
    assert set(found.classes) == {"car", "truck", "bus"}
    for kind, size in zip(found.classes, found.dimensions.tolist(), strict=True):
        assert size == pytest.approx(sizes[kind])


def test_beijing_with_people_and_drones(make: Make, shared_data: Path) -> None:
    folder = shared_data / "beijing"
    world = make(
        net=str(folder / "longtan.net.xml"),
        routes=(str(folder / "longtan_pedestrian.rou.xml"), str(folder / "longtan_drone.rou.xml")),
        classes={"Maverick": "uav"},
        begin_s=60.0,
    )
    found = scenes(world, 1, 30)
    people = [i for i, kind in enumerate(found[-1].classes) if kind == "pedestrian"]
    assert len(people) > 5
    assert found[-1].assets[people[0]] == "objects/pedestrian.ply"
    assert 0.5 < np.median(np.linalg.norm(found[-1].velocity[people], axis=1)) < 2.0
    assert "uav" in found[-1].classes


def test_a_configuration_file_is_run_and_settings_go_before_it(
    make: Make, shared_data: Path, tmp_path: Path
) -> None:
    config = str(shared_data / "rosslyn" / "sumo" / "quickstart.sumocfg")
    mine = tmp_path / "mine.rou.xml"
    mine.write_text(
        '<routes><vehicle id="mine" depart="0" departPos="30"><route edges="H1 H2"/></vehicle></routes>'
    )

    def names(routes: str | tuple[str, ...], begin_s: float) -> tuple[str, ...]:
        return scenes(make(config=config, net="", routes=routes, begin_s=begin_s), 1, 1)[0].names

    assert len(names((), 60.0)) > 5
    assert names(str(mine), 1.0) == ("traffic.mine",)


# --- people ----------------------------------------------------------------------------------

CROSSING = {"net": "crossing.net.xml", "routes": "crossing.rou.xml", "additional": "crossing.add.xml"}


def moved(scene: Scene, before: Scene) -> Iterator[tuple[float, float]]:
    """How far each person of two scenes was moved [m], and by what it was turned [rad]."""
    for i, name in enumerate(scene.names):
        if scene.classes[i] == "pedestrian" and name in before.names:
            j = before.names.index(name)
            yaws = [euler_from_quaternion(q)[0] for q in (before.orientation[j], scene.orientation[i])]
            way = scene.position[i] - before.position[j]
            far = float(np.linalg.norm(way))
            if far <= 3.0:  # who is put elsewhere is no walk; the report counts it
                assert np.abs(scene.velocity[i] - way / 0.1).max() < 1e-6
            yield far, abs(math.remainder(yaws[1] - yaws[0], 2 * math.pi))


@pytest.mark.parametrize(
    ("model", "person_steps"),
    [
        ("striping", 600),
        pytest.param("striping", 3_000, marks=pytest.mark.exhaustive),
        pytest.param("striping", 41_000, marks=pytest.mark.exhaustive),
        pytest.param("jupedsim", 41_000, marks=pytest.mark.exhaustive),
        pytest.param("nonInteracting", 41_000, marks=pytest.mark.exhaustive),
    ],
)
def test_no_person_exceeds_3_m_s_or_turns_about_in_a_step_unless_the_report_says_so(
    make: Make, repository: Path, model: str, person_steps: int
) -> None:
    """Beside it what SUMO itself would have shown: its jumps and turns are counted."""
    folder = repository / "deploy" / "caviar_scenarios" / "crossing"
    files = {key: str(folder / name) for key, name in CROSSING.items()}
    world = make(**files, begin_s=60.0, options=("--pedestrian.model", model))
    world.reset(0, 3, 0)
    steps = frame = fast = turned = 0
    counts: Counter[str] = Counter()
    before: Scene | None = None
    while steps < person_steps:
        made = world.step(Frame(episode=0, number=frame, t_ns=frame * T_SAM_NS, previous=frame - 1))
        scene = made.products["scene"]
        assert isinstance(scene, Scene)
        counts.update({key: count for key, count in made.counts.items() if key.startswith("person")})
        for far, turn in moved(scene, before) if before is not None else ():
            steps += 1
            fast += far > 0.3
            turned += turn > math.pi / 2
        before, frame = scene, frame + 1
    assert fast <= counts[PLACED]
    assert turned <= counts[PLACED]
    # Shown with --log-cli-level=INFO; the page people-and-traffic has these figures.
    _LOG.info(f"{model}: {steps} person-steps in {frame} frames, {dict(counts)}")


def test_people_walk_on_in_another_process_as_they_would_have(make: Make, repository: Path) -> None:
    """Where bodies are behind their persons is part of the state."""
    folder = repository / "deploy" / "caviar_scenarios" / "crossing"
    files = {key: str(folder / name) for key, name in CROSSING.items()}
    world = make(**files, begin_s=30.0)
    scenes(world, 7, 60)
    state = world.checkpoint()
    expected = [wire_bytes(scene_at(world, k)) for k in range(60, 80)]
    again = make(**files, begin_s=30.0)
    again.reset(0, 7, 0)
    again.restore(state)
    assert again.checkpoint() == state
    assert [wire_bytes(scene_at(again, k)) for k in range(60, 80)] == expected


# --- states ------------------------------------------------------------------------------------


def test_a_process_that_is_killed_is_gone_on_for_by_another(repository: Path, tmp_path: Path) -> None:
    """60 frames in one process, and with a kill after frame 16: the same bytes."""
    folder = repository / "deploy" / "caviar_scenarios" / "street-canyon"

    def run(scratch: Path, first: int, last: int, *, kill: bool) -> int:
        scratch.mkdir(exist_ok=True)
        numbers = map(str, (first, last, int(kill)))
        command = [sys.executable, "-c", INTERRUPTED, str(folder), str(scratch), *numbers]
        return subprocess.run(command, check=False, timeout=60).returncode

    assert run(tmp_path / "whole", 0, 60, kill=False) == 0
    assert run(tmp_path / "broken", 0, 17, kill=True) == -signal.SIGKILL
    assert run(tmp_path / "broken", 17, 60, kill=False) == 0
    whole, broken = ((tmp_path / name / "products").read_bytes() for name in ("whole", "broken"))
    assert hashlib.sha256(whole).hexdigest() == hashlib.sha256(broken).hexdigest()
    assert len(whole) > 60 * 100


def test_who_came_first_keeps_a_device_in_another_process(make: Make) -> None:
    """A pattern's devices are with those that came first, also of objects that came long ago."""
    devices = (DeviceSpec(name="rx", kind="antenna", role="rx", on="*", count=2),)
    world = make(devices=devices)
    before = scenes(world, 7, 40)
    state = world.checkpoint()
    expected = [wire_bytes(scene_at(world, k)) for k in range(40, 60)]
    assert len(before[-1].names) > 2
    again = make(devices=devices)
    again.reset(0, 7, 0)
    again.restore(state)
    assert again.checkpoint() == state
    assert [wire_bytes(scene_at(again, k)) for k in range(40, 60)] == expected


def test_other_traffic_than_that_which_was_saved_is_an_error(make: Make) -> None:
    """What SUMO then does is not what the run has seen."""
    world = make()
    scenes(world, 7, 30)
    state = world.checkpoint()
    world.reset(0, 8, 0)
    with pytest.raises(RunError, match="29 steps after frame 0"):
        world.restore(state)


# --- one traffic for all episodes ----------------------------------------------------------------------


def test_episodes_of_one_traffic_begin_in_saved_states_and_are_the_same_in_any_order(
    make: Make, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def scenes(cache: Path, episodes: list[int]) -> dict[int, list[tuple[bytes, ...]]]:
        monkeypatch.setenv("XDG_CACHE_HOME", str(cache))
        world = make(begin_s=20.0, between_episodes_s=7.0)
        found = {}
        for episode in episodes:
            world.reset(episode, 3, 0)
            found[episode] = [wire_bytes(scene_at(world, number)) for number in range(15)]
        world.close()
        return found

    forwards = scenes(tmp_path / "one", [0, 1, 2])
    backwards = scenes(tmp_path / "two", [2, 1, 0])  # the first one passes through the traffic up to it
    assert forwards == backwards
    assert len({episode[0] for episode in forwards.values()}) == 3
    saved = sorted((tmp_path / "one" / "caviar" / "traffic").glob("*/*"))
    assert [file.name for file in saved] == [f"00000{number}.xml.gz" for number in range(3)]


def test_an_episode_of_one_traffic_begins_where_a_run_comes_that_long_after_the_first(
    make: Make, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    spec = DeviceSpec(name="rx", kind="antenna", on="traffic.*", count=4, mount="roof", role="rx")
    shared = make(begin_s=20.0, between_episodes_s=30.0, devices=(spec,))
    shared.reset(1, 3, 0)
    first = scene_at(shared, 0)
    passed = make(begin_s=50.0, devices=(spec,))
    passed.reset(0, 3, 0)
    then = scene_at(passed, 0)
    assert len(first.devices) == 4
    assert (first.names, first.position.tolist()) == (then.names, then.position.tolist())
    # Who came first carries the receivers: the order of departure is that of the run.
    assert [device.name for device in first.devices] == [device.name for device in then.devices]


def test_people_walk_on_in_an_episode_of_one_traffic(
    make: Make, repository: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    folder = repository / "deploy" / "caviar_scenarios" / "crossing"
    files = {key: str(folder / name) for key, name in CROSSING.items()}
    found = []
    for settings, episode in (({"begin_s": 30.0, "between_episodes_s": 30.0}, 1), ({"begin_s": 60.0}, 0)):
        world = make(**files, **settings)
        world.reset(episode, 3, 0)
        scene = scene_at(world, 0)
        found.append(dict(zip(scene.names, scene.position.tolist(), strict=True)))
        assert list(scene.classes).count("pedestrian") > 10
    shared, passed = found
    assert shared.keys() == passed.keys()
    for name, place in shared.items():
        assert place == pytest.approx(passed[name], abs=1e-3), name


@pytest.mark.parametrize("spacing", [0.0, -1.0, 0.25, math.inf])
def test_a_spacing_that_is_no_number_of_steps_is_refused(make: Make, spacing: float) -> None:
    with pytest.raises(ScenarioError, match=r"between_episodes_s.*100 ms"):
        make(between_episodes_s=spacing)
