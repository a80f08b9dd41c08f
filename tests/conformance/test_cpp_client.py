"""Worlds made with the C++ header: compiled as in an engine, judged by the kit, killed, and in whole runs."""

from __future__ import annotations

import importlib.util
import json
import re
import shlex
import signal
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import engine_worlds as worlds
import msgpack
import numpy as np
import pytest
import zmq
from cpp_programs import CPP, PROBE, STRICT, WORLD, compiled, program_folder
from scenarios_support import ROOT, environment, eventually, recorded_below, running

from caviar_broker.control.socket import ask
from caviar_labs.conform import conform
from caviar_labs.conform.canonical import Answer
from caviar_labs.conform.client import Received, Rules, Started, Wire
from caviar_labs.conform.session import Seen, Session
from caviar_labs.conform.street import Inputs
from caviar_protocol.assets import is_mesh_name
from caviar_protocol.codec import decode_payload
from caviar_protocol.errors import RunError
from caviar_protocol.keys import Pair, write_pair
from caviar_protocol.recording import Recording
from caviar_protocol.topics import Scene

pytestmark = pytest.mark.slow

ANY = "tcp://127.0.0.1:0"
WITHIN_S = 60.0
EMPTY = Inputs(without_optional=True)


@pytest.fixture(scope="module")
def folder(pytestconfig: pytest.Config, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return program_folder(pytestconfig, tmp_path_factory)


@pytest.fixture(scope="module")
def world(folder: Path) -> Path:
    """The reference world."""
    return compiled("g++", WORLD, folder, *STRICT)


@pytest.fixture(scope="module")
def odd(folder: Path) -> Path:
    """A world that its settings set: to be wrong, or to answer later, as an engine does."""
    return compiled("g++", PROBE, folder, "-std=c++17", "-Wall", "-Wextra", "-Werror")


def test_clang_compiles_the_world_amid_the_macros_of_engines_and_platforms(folder: Path) -> None:
    macros = ("-DPI=3.1f", "-Dcheck(e)=0", "-Dverify(e)=0", "-Dnil=0", "-Dsmall=char", "-DTEXT(t)=t")
    compiled("clang++", WORLD, folder, *STRICT, *macros)


def test_the_reference_world_has_at_most_80_lines_of_code() -> None:
    lines = [line.strip() for line in WORLD.read_text("utf-8").splitlines()]
    assert sum(bool(line) and not line.startswith("//") for line in lines) <= 80


# --- the protocol ---------------------------------------------------------------------------------------


def failures(program: Path, *more: str, **settings: Any) -> dict[str, str]:
    """What the conformance kit finds wrong with a world; ``more``: cases that it has to pass, too."""
    command = shlex.join([str(program), "{endpoint}", "{name}"])
    verdicts = conform(ANY, command=command, rules=Rules(name="mine", role="world", settings=settings))
    passed = {v.case for v in verdicts if v.outcome == "pass"}
    always = {"frames", "restore", "queued-grants", "undecodable-input", "scene-mounts", "sigterm"}
    assert passed >= {*always, *more}
    return {v.case: f"expected {v.expected}; got {v.got}" for v in verdicts if v.outcome == "fail"}


def test_the_reference_world_fails_no_case_of_the_kit(world: Path) -> None:
    assert failures(world, "run-time-meshes") == {}


def test_a_world_that_answers_later_and_looks_at_channels_fails_no_case(odd: Path) -> None:
    assert failures(odd, deferred=True) == {}


@contextmanager
def joined(program: Path, folder: Path, **welcome: Any) -> Iterator[Session]:
    """A life of a client up to WELCOME."""
    wire = Wire(ANY)
    client = Started(f"{program} {{endpoint}} {{name}}", wire.endpoint, "mine", folder)
    session = Session(wire, client, Rules(), Seen())
    try:
        session.begin()
        session.welcome(**welcome)
        yield session
    finally:
        session.close()
        wire.close()


@pytest.mark.parametrize(
    ("wrong", "line"),
    [
        ("orientation", "object 'car': orientation is (2, 0, 0, 0); give it a unit quaternion"),
        ("dimensions", "object 'car': dimensions are (1, 0, 1); give it sides above 0"),
        ("position", "object 'car': position is (0, 0, nan); give it finite numbers of at most 1e9 m"),
        ("velocity", "object 'car': velocity is (300000000, 0, 0); give it finite numbers, slower than"),
        ("turning", "object 'car': angular_velocity is (0, 0, 400000000); give it finite numbers"),
        ("unknown mesh", "object 'car': mesh is 'objects/none.ply', which was not offered"),
        ("prefix", "object 'tram': name begins with no prefix ('bs', 'car', 'sector'); call claim()"),
        ("no name", "object '': name is ''; give it 1 to 128 printable characters"),
        ("class", "object 'car': class_ is ''; give it 1 to 128 printable characters"),
        ("twice", "object 'car': name is in the frame twice"),
        ("device", "object 'bs': name is that of a device"),
    ],
)
def test_a_wrong_object_is_named_in_fault_before_it_leaves(
    odd: Path, tmp_path: Path, wrong: str, line: str
) -> None:
    with joined(odd, tmp_path, settings={"wrong": wrong}) as session:
        session.begin_episode()
        frame = session.grant()
        fault = session.expect("FAULT")
        assert fault.fields["frame"] == frame
        assert line in fault.fields["message"]
        session.send("GRANT", *session.granting(frame, EMPTY)[:1])
        assert session.expect("FAULT").parts == fault.parts


@pytest.mark.parametrize(
    ("wrong", "line"),
    [
        ("mesh", "mesh 'car': corner 1 is none of its vertices"),
        ("material", "material 'gold': 'gold' is none of asphalt_concrete brick"),
        ("name", "asset '../car.ply': a relative path is expected"),
    ],
)
def test_wrong_scenery_is_named_in_fault(odd: Path, tmp_path: Path, wrong: str, line: str) -> None:
    with joined(odd, tmp_path, settings={"wrong": wrong}) as session:
        session.send("PREPARE", session.who)
        fault = session.expect("FAULT")
        assert "frame" not in fault.fields
        assert line in fault.fields["message"]


def test_scenery_is_readable_for_a_ray_tracer(world: Path, tmp_path: Path) -> None:
    with joined(world, tmp_path) as session:
        session.prepare()
        assert set(session.offered) == {
            "objects/car.ply",
            "scenery/meshes/ground.ply",
            "scenery/meshes/house.ply",
            "scenery/scene.xml",
        }
        car, house = (
            read_mesh(session.offered[name]) for name in ("objects/car.ply", "scenery/meshes/house.ply")
        )
    # Meshes of objects fill the unit box; those of scenery stand where they are.
    np.testing.assert_allclose([car.min(axis=(0, 1)), car.max(axis=(0, 1))], [[-0.5] * 3, [0.5] * 3])
    np.testing.assert_allclose([house.min(axis=(0, 1)), house.max(axis=(0, 1))], [[-30, 16, 0], [30, 28, 12]])
    # Corners are counter-clockwise seen from outside: the signed volume of a closed body is its volume.
    assert np.linalg.det(house).sum() / 6 == pytest.approx(60 * 12 * 12)


def test_a_mesh_that_comes_while_the_run_goes_on_is_announced_and_goes_after_its_objects(
    odd: Path, tmp_path: Path
) -> None:
    with joined(odd, tmp_path, settings={"spawn": "right"}) as session:
        begun(session, max_faces=12)
        # The kit's world was here before: what it announced then, if anything, is gone.
        assert session.step(EMPTY).fields["geometry"] == {"frame": 0}
        done = session.step(EMPTY)
        assert done.fields["geometry"]["frame"] == 1
        (asset,) = done.fields["geometry"]["assets"]
        assert assets_of(done) == [asset["name"]] == [f"objects/{asset['digest']}.ply"]
        data = session.fetch(asset)
        assert b"\ncomment material wood\n" in data
        mesh = read_mesh(data)
        np.testing.assert_allclose([mesh.min(axis=(0, 1)), mesh.max(axis=(0, 1))], [[-0.5] * 3, [0.5] * 3])
        # No object has it after frame 3; it stays for 20 frames.
        changes = {frame: session.step(EMPTY).fields.get("geometry") for frame in range(2, 26)}
        assert {frame: change for frame, change in changes.items() if change} == {24: {"frame": 24}}


def test_a_mesh_that_the_broker_refuses_is_not_announced_again(odd: Path, tmp_path: Path) -> None:
    with joined(odd, tmp_path, settings={"spawn": "right"}) as session:
        begun(session, max_faces=100)
        session.step(EMPTY)
        (asset,) = session.step(EMPTY).fields["geometry"]["assets"]
        error = {"code": "refused-mesh", "message": "it is none", "of": "DONE", "subject": asset["digest"]}
        session.send("ERROR", error)
        assert session.step(EMPTY).fields["geometry"] == {"frame": 2}
        assert "geometry" not in session.step(EMPTY).fields


@pytest.mark.parametrize(
    ("spawn", "max_faces"),
    [("nan", 100), ("none", 100), ("flat", 100), ("gold", 100), ("right", 11), ("right", 0)],
)
def test_a_mesh_that_is_none_or_that_the_run_does_not_take_leaves_a_box(
    odd: Path, tmp_path: Path, spawn: str, max_faces: int
) -> None:
    with joined(odd, tmp_path, settings={"spawn": spawn}) as session:
        begun(session, max_faces)
        frames = [session.step(EMPTY) for _ in range(4)]
        assert [assets_of(done) for done in frames] == [[""]] * 4
        # What offer_mesh returned of the box is right all the same; a flat one is 1 cm high.
        scene = decode_payload("scene", *frames[1].parts[1:3])
        assert isinstance(scene, Scene)
        height, middle = (0.01, 0.5) if spawn == "flat" else (1.0, 0.5)
        assert [*scene.dimensions[0], *scene.position[0]] == [4.0, 2.0, height, 0.0, 0.0, middle]
        announced = [done.fields.get("geometry", {}).get("assets", []) for done in frames]
        assert announced == [[]] * 4


def begun(session: Session, max_faces: int) -> None:
    """Take a world into an episode of a run that takes meshes while it goes on."""
    session.prepare(inputs=EMPTY, max_faces=max_faces)
    session.reset(0)


def assets_of(done: Answer) -> list[str]:
    """Meshes of the objects of a scene."""
    scene = decode_payload("scene", *done.parts[1:3])
    assert isinstance(scene, Scene)
    return list(scene.assets)


def read_mesh(data: bytes) -> np.ndarray[Any, Any]:
    """Corners of the triangles of a binary PLY file, Shape ``[T, 3, 3]``."""
    head, _, rest = data.partition(b"end_header\n")
    vertices, triangles = map(int, re.findall(rb"element \w+ (\d+)", head))
    points = np.frombuffer(rest, "<f4", 3 * vertices).reshape(-1, 3)
    faces = np.frombuffer(rest, [("n", "|u1"), ("corners", "<i4", 3)], triangles, 12 * vertices)
    assert len(rest) == 12 * vertices + 13 * triangles
    assert set(faces["n"]) == {3}
    return points[faces["corners"]].astype(float)


def test_a_world_that_lost_the_broker_comes_back_under_its_name(world: Path, tmp_path: Path) -> None:
    with joined(world, tmp_path, heartbeat_s=0.05, liveness_s=0.3, rejoin_ns=10**10) as session:
        session.begin_episode()
        before = session.step().parts[1:]
        hello = wait_for_hello(session.wire)
        assert {key: hello.fields[key] for key in session.hello} == session.hello
        back = Session(session.wire, session.client, Rules(), Seen())
        back._route, back.hello = hello.route, hello.fields
        back._seen.allow(WITHIN_S)
        back.welcome()
        back.begin_episode()
        assert back.step().parts[1:] == before
        session.stage = back.stage
        back.send("SHUTDOWN", {"reason": "enough"})
        back.expect("BYE")


@pytest.mark.parametrize("how", worlds.ENDS)
def test_the_end_of_a_run_is_told_with_its_reason_and_status(odd: Path, tmp_path: Path, how: str) -> None:
    with waiting_run(worlds.ending(tmp_path, how), tmp_path) as run:
        worlds.check_end(how, [odd, run.endpoint, "world"], run.mark, run.out)


def test_times_of_steps_count_from_the_begin_of_their_episode(odd: Path, tmp_path: Path) -> None:
    with joined(odd, tmp_path, settings={"how": "right"}) as session:
        session.prepare(inputs=EMPTY)
        session.reset(0, t0_ns=-(10**9))
        scene = decode_payload("scene", *session.step(EMPTY).parts[1:3])
        assert isinstance(scene, Scene)
        assert scene.position[0, :2].tolist() == [1, 1]


def wait_for_hello(wire: Wire) -> Received:
    """The next HELLO, where heartbeats remain without an answer."""
    for _ in range(round(WITHIN_S / 0.05)):
        received = wire.poll(0.05)
        if received is not None and received.kind == "HELLO":
            return received
    raise AssertionError("no HELLO")


def test_keys_of_the_environment_are_those_of_its_connections(
    world: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    broker, own = Pair.new(), Pair.new()
    write_pair(tmp_path, "broker", broker)
    write_pair(tmp_path, "mine", own)
    with zmq.Context() as context, context.socket(zmq.ROUTER) as router:
        router.linger = 0
        router.curve_server, router.curve_secretkey = True, broker.secret.encode()
        port = router.bind_to_random_port("tcp://127.0.0.1")
        keys = {"CAVIAR_KEY": str(tmp_path / "mine.key"), "CAVIAR_BROKER_KEY": str(tmp_path / "broker.pub")}
        for name, value in keys.items():
            monkeypatch.setenv(name, value)
        with subprocess.Popen([world, f"tcp://127.0.0.1:{port}", "mine"], stderr=subprocess.PIPE) as process:
            try:
                assert router.poll(round(WITHIN_S * 1000))
                assert msgpack.unpackb(router.recv_multipart()[1])["type"] == "HELLO"
            finally:
                process.kill()
    monkeypatch.setenv("CAVIAR_KEY", str(tmp_path / "mine.pub"))
    ended = subprocess.run([world, "tcp://127.0.0.1:1", "mine"], capture_output=True, text=True, check=False)
    assert ended.returncode == 1
    assert "CAVIAR_KEY: " in ended.stderr


# --- whole runs -----------------------------------------------------------------------------------------

SCENARIO = CPP / "world.toml"
KILLED_AFTER = 30
"""Frames: more than between two checkpoints, so that the world takes its state over."""


def free_space(folder: Path, *without: str) -> Path:
    """The scenario without a ray tracer, and without some services."""
    text = SCENARIO.read_text("utf-8")
    for service in ("channel.settings", *without):
        table = rf"^\[services\.{re.escape(service)}\].*?(?=^\[)"
        text = re.sub(table, "", text, flags=re.DOTALL | re.MULTILINE)
    text = re.sub(r'^use = "sionna-rt".*$', 'use = "free-space"', text, flags=re.MULTILINE)
    left = [topic for topic in ("scene", "channel", "lidar", "link") if topic not in without]
    text = re.sub(r"^record = .*$", f"record = {json.dumps(left)}", text, flags=re.MULTILINE)
    path = folder / "free-space.toml"
    path.write_text(text, "utf-8")
    return path


class Run:
    """A run that waits for the world."""

    def __init__(self, process: subprocess.Popen[str], mark: str, out: Path) -> None:
        self._process, self.mark, self.out = process, mark, out
        self.output = ""
        eventually(lambda: bool(self._status()), WITHIN_S, "the run listens")
        self.endpoint = str(self._status()["endpoint"])

    def _status(self) -> dict[str, Any]:
        for directory in self.out.glob("*/"):
            try:
                return dict(ask(directory, do="status")["status"])
            except RunError:
                return {}
        return {}

    @property
    def directory(self) -> Path:
        return next(self.out.glob("*/"))

    @contextmanager
    def world(self, program: Path) -> Iterator[subprocess.Popen[bytes]]:
        with subprocess.Popen([program, self.endpoint, "world"], env=environment(self.mark)) as process:
            try:
                yield process
            finally:
                process.kill()

    def digest(self) -> str:
        """Of the run, once it is over."""
        self.output, _ = self._process.communicate(timeout=4 * WITHIN_S)
        assert self._process.returncode == 0, self.output
        return str(json.loads((self.directory / "summary.json").read_text())["digest"])


@contextmanager
def waiting_run(scenario: Path, folder: Path, *options: str) -> Iterator[Run]:
    with running(scenario, folder / "out", *options) as (process, mark):
        yield Run(process, mark, folder / "out")


def has(module: str) -> bool:
    return importlib.util.find_spec(module) is not None


@pytest.mark.skipif(not has("mcap"), reason="mcap is not installed")
def test_a_run_of_300_frames_with_rays_a_lidar_a_link_and_a_recorder(world: Path, tmp_path: Path) -> None:
    scenario = SCENARIO if has("sionna") and has("mitsuba") else free_space(tmp_path, "lidar")
    with waiting_run(scenario, tmp_path) as run, run.world(world) as process:
        run.digest()
        assert process.wait(WITHIN_S) == 0
    recording = Recording(run.directory)
    topics = ("scene", "channel", "link", *(["lidar"] if scenario == SCENARIO else []))
    found: dict[str, list[Any]] = {
        topic: [product.payload for _, product in recording.products(topic)] for topic in topics
    }
    assert {topic: len(products) for topic, products in found.items()} == dict.fromkeys(topics, 300)
    assert {name for scene in found["scene"] for name in scene.names} == {"car", "pedestrian", "ramp", "uav"}
    # The mesh of the ramp came while the run went on.
    spawned = {asset for scene in found["scene"] for asset in scene.assets if is_mesh_name(asset)}
    assert spawned == set(recording.meshes)
    assert len(spawned) == 1
    rung = "siso-rt" if scenario == SCENARIO else "free-space"
    assert {channel.rung for channel in found["channel"]} == {rung}
    # The pedestrian's phone is there as long as its owner.
    assert {len(channel.rx) for channel in found["channel"]} == {2, 3}
    assert all(link.bit_rate.min() >= 0 for link in found["link"])
    assert all(len(scan.ray) > 100 for lidar in found.get("lidar", []) for scan in lidar.scans)
    if scenario == SCENARIO:
        # Rays meet what the world brought: its ground, its house.
        assert {"ground", "house"} <= {name for channel in found["channel"] for name in channel.object_names}


def test_killed_and_started_again_it_goes_on_with_the_same_digest(world: Path, tmp_path: Path) -> None:
    # Each service is a process that starts: the world, whose UAV has state, needs none of the others.
    scenario, digests = free_space(tmp_path, "lidar", "link", "agent"), []
    for folder in ("undisturbed", "killed"):
        # As fast as it goes, 80 frames are over before the kill.
        with waiting_run(scenario, tmp_path / folder, "--frames", "80", "--pace", "4") as run:
            if folder == "killed":
                with run.world(world) as first:
                    wait_for_frames(run)
                    first.send_signal(signal.SIGKILL)
            with run.world(world):
                digests.append(run.digest())
    assert digests[0] == digests[1]
    assert "back: world" in run.output


def wait_for_frames(run: Run) -> None:
    """Wait until as many frames are recorded as the world has to have done when it is killed."""
    eventually(lambda: recorded_below(run.out) >= KILLED_AFTER, WITHIN_S, "frames are recorded")


@pytest.mark.exhaustive
def test_the_first_world_of_the_guide_plays_the_scenario_of_the_guide(folder: Path, tmp_path: Path) -> None:
    page = (ROOT / "docs" / "howto" / "cpp-client.md").read_text("utf-8")
    files = dict(re.findall(r"^```\w+\n(?://|#) (street\.\w+)\n(.*?)^```$", page, re.DOTALL | re.MULTILINE))
    for name, content in files.items():
        (tmp_path / name).write_text(content, "utf-8")
    program = compiled("g++", tmp_path / "street.cpp", folder, "-std=c++17", "-O2")
    with waiting_run(tmp_path / "street.toml", tmp_path) as run, run.world(program) as process:
        assert len(run.digest()) == 64
        assert process.wait(WITHIN_S) == 0
