"""The C++ client: its codec against the vectors, its axes, its refusals, and its reference world in whole runs."""

from __future__ import annotations

import fnmatch
import hashlib
import importlib.util
import json
import re
import shlex
import shutil
import signal
import subprocess
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import Any

import msgpack
import numpy as np
import pytest
import zmq
from scenarios_support import ROOT, environment, eventually, recorded_below, running
from vector_files import Vector, all_vectors, array_of, is_array, load, named

from caviar_broker.control.socket import ask
from caviar_clients.conform import conform
from caviar_clients.conform.client import Received, Rules, Started, Wire
from caviar_clients.conform.session import Seen, Session
from caviar_clients.conform.street import Inputs
from caviar_protocol.codec import decode_payload, encode_payload
from caviar_protocol.errors import RunError
from caviar_protocol.keys import Pair, write_pair
from caviar_protocol.recording import Recording
from caviar_protocol.topics import Action, Channel, Link

pytestmark = pytest.mark.slow

CPP = ROOT / "clients" / "cpp"
PROBE = Path(__file__).with_name("cpp_probe.cpp")
STRICT = ("-std=c++17", "-fno-exceptions", "-fno-rtti", "-Wall", "-Wextra", "-Werror", "-Wpedantic")
ANY = "tcp://127.0.0.1:0"
WITHIN_S = 60.0
VECTORS = all_vectors()
EMPTY = Inputs(without_optional=True)


# --- compiling ------------------------------------------------------------------------------------------


def compiled(compiler: str, source: Path, folder: Path, *flags: str) -> Path:
    """A program of a source; skips by name where the compiler or ZeroMQ's header is missing."""
    if shutil.which(compiler) is None:
        pytest.skip(f"{compiler} is not installed")
    has_header = subprocess.run(
        [compiler, "-E", "-x", "c++", "-"], input="#include <zmq.h>", capture_output=True, text=True, check=False
    )
    if has_header.returncode != 0:
        pytest.skip("zmq.h is not installed (Debian: libzmq3-dev)")
    program = folder / f"{source.stem}-{compiler}"
    command = [compiler, *flags, f"-I{CPP}", str(source), "-o", str(program), "-lzmq", "-pthread"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stderr == ""
    return program


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("cpp")


@pytest.fixture(scope="module")
def world(folder: Path) -> Path:
    """The reference world, compiled as an engine compiles: without exceptions, RTTI, or a warning."""
    return compiled("g++", CPP / "world.cpp", folder, *STRICT)


class Probe:
    """The program that answers questions about the header."""

    def __init__(self, program: Path) -> None:
        self.program = program
        self._process = subprocess.Popen([program], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)

    def __call__(self, *words: object) -> Any:
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        shown = [f"x{word.hex()}" if isinstance(word, bytes) else str(word) for word in words]
        self._process.stdin.write(" ".join(shown) + "\n")
        self._process.stdin.flush()
        return json.loads(self._process.stdout.readline())

    def close(self) -> None:
        self._process.communicate()


@pytest.fixture(scope="module")
def probe(folder: Path) -> Iterator[Probe]:
    found = Probe(compiled("g++", PROBE, folder, "-std=c++17", "-Wall", "-Wextra", "-Werror"))
    yield found
    found.close()


def test_clang_compiles_the_world_without_exceptions_rtti_or_a_warning(folder: Path) -> None:
    compiled("clang++", CPP / "world.cpp", folder, *STRICT)


def test_the_reference_world_has_at_most_80_lines_of_code() -> None:
    lines = [line.strip() for line in (CPP / "world.cpp").read_text("utf-8").splitlines()]
    assert sum(bool(line) and not line.startswith("//") for line in lines) <= 80


# --- encoding -------------------------------------------------------------------------------------------


def asked(probe: Probe, vector: Vector) -> Any:
    """What the header makes of a vector."""
    kind = vector.stated["kind"]
    if kind == "message":
        lengths = vector.stated.get("lengths", [])
        parts: Sequence[bytes | str] = vector.parts[: len(vector.parts) - len(lengths)]
        return probe("message", *parts, *[f"zeros:{length}" for length in lengths])
    if kind == "payload":
        return probe("payload", vector.stated["topic"], vector.header, vector.body)
    return probe("arrays", vector.header, vector.body)


@pytest.mark.parametrize("vector", [v for v in VECTORS if v.refused is not None], ids=named)
def test_a_wrong_vector_is_refused_with_its_code(probe: Probe, vector: Vector) -> None:
    assert asked(probe, vector).get("code") == vector.refused


@pytest.mark.parametrize("vector", [v for v in VECTORS if v.refused is None], ids=named)
def test_a_vector_is_read_and_written_again_in_canonical_form(probe: Probe, vector: Vector) -> None:
    got = asked(probe, vector)
    assert "header" in got, got
    assert (got["header"], got.get("body", "")) == tuple(part.hex() for part in canonical(vector))
    if vector.canonical and "value" in vector.stated:
        assert_means(got["value"], vector.means, vector.name)


def canonical(vector: Vector) -> tuple[bytes, bytes]:
    """Header and body as a writer writes them."""
    if vector.canonical:
        return vector.header, vector.body
    if vector.stated["kind"] == "message":
        return msgpack.packb(vector.means), b""
    return encode_payload(decode_payload(vector.stated["topic"], vector.header, vector.body))


def assert_means(got: Any, stated: Any, path: str) -> None:
    """Compare what was decoded with the JSON of a vector, which has no field that is not there."""
    if is_array(stated):
        expected = array_of(stated)
        assert (got["dtype"], got["shape"]) == (stated["dtype"], list(expected.shape)), path
        assert bytes.fromhex(got["data"]) == expected.tobytes(), path
    elif isinstance(stated, dict):
        assert set(got) == set(stated), path
        for key, value in stated.items():
            assert_means(got[key], value, f"{path}.{key}")
    elif isinstance(stated, list):
        assert len(got) == len(stated), path
        for index, (item, value) in enumerate(zip(got, stated, strict=True)):
            assert_means(item, value, f"{path}[{index}]")
    else:
        assert (got, type(got)) == (stated, type(stated)), path


SIMPLE = {"≥ ": ">=", "≤ ": "<=", "> ": ">", ", ": "", "plain value": "plain"}


def written_type(cell: str) -> str:
    """A type of a table of SPEC.md as the header writes it."""
    cell = re.sub(r" \(.*since .*\)$", "", cell).replace("\\|", "|")
    if found := re.fullmatch(r"array `(.*?)` \[(.*)\]", cell):
        return f"{found[1]}[{found[2].replace(' ', '')}]"
    if found := re.fullmatch(r"list of (.*), 0 to (\d+) of them", cell):
        return f"[{written_type(found[1])}]<={found[2]}"
    if found := re.fullmatch(r"list of (\d) (\w+)", cell):
        return f"{found[2]}*{found[1]}"
    if found := re.fullmatch(r"list of (.*)", cell):
        return f"[{written_type(found[1])}]"
    if found := re.fullmatch(r"map, str to (.*)", cell):
        return f"{{{written_type(found[1])}}}"
    if links := re.findall(r"\[(\w+)\]\(#[\w-]+\)", cell):
        return "/".join(links)
    if "`" in cell:
        return "|".join(re.findall("`(.*?)`", cell))
    for words, sign in SIMPLE.items():
        cell = cell.replace(words, sign)
    return cell


def tables_of_the_specification() -> str:
    """All tables of fields, as the header writes them."""
    text, found = (ROOT / "protocol" / "SPEC.md").read_text("utf-8"), []
    for name, table in re.findall(r"<!-- fields: (\w+) -->(.*?)<!-- end -->", text, re.DOTALL):
        words = [name]
        for line in table.splitlines():
            if not line.startswith("| ") or line.startswith(("| field |", "| ---")):
                continue
            field, kind, _, default = [cell.strip() for cell in re.split(r"(?<!\\)\|", line)[1:5]]
            if field == "type":
                words[0] += "#" + kind.strip('`"')
                continue
            shown = {"required": "!", "left out": "?", "all defaults": "=@"}
            words.append(f"{field}:{written_type(kind)}{shown.get(default, '=' + default.replace(', ', ','))}")
        found.append(" ".join(words))
    return " ".join(found)


def test_the_types_of_the_header_are_those_of_the_specification(probe: Probe) -> None:
    assert probe("schema").split() == tables_of_the_specification().split()


def test_digests_are_those_of_the_specification(probe: Probe) -> None:
    scene = load("scene_one_object")
    text = (ROOT / "protocol" / "SPEC.md").read_text("utf-8")
    assert f"`{probe('digest', scene.header, scene.body)}`" in text
    assert f"`{probe('geometry', 'objects/car.ply', b'abc')}`" in text
    # A length at which the padding of SHA-256 takes a block of its own.
    long = bytes(range(256)) * 3
    for size in (47, 55, 56, 63, 64, 700):
        right = hashlib.sha256((size).to_bytes(8, "little") + long[:size]).hexdigest()
        assert probe("digest", long[:size], b"") == right


# --- what a world publishes, and what it gets -----------------------------------------------------------

ARRIVALS = (("car.2", "uav"), ("car.1",), ("car.0",), (), ("car.2",))
"""Objects that come in each frame of the vectors `mounts_0` to `mounts_4`."""


def test_devices_are_mounted_as_in_the_vectors(probe: Probe) -> None:
    assert probe("mounts", load("welcome_mounts").header)["code"] == ""
    order: list[str] = []
    for frame, new in enumerate(ARRIVALS):
        vector = load(f"mounts_{frame}")
        there = vector.stated["value"]["names"]
        order = [name for name in (*order, *new) if name in there]
        # Those that are there already may stand anywhere in the list: only who came counts.
        shuffled = [*new, *[name for name in order if name not in new]]
        got = probe("scene", vector.header, vector.body, ",".join(shuffled))
        assert (got["header"], got["body"]) == (vector.header.hex(), vector.body.hex()), f"frame {frame}"


def test_a_device_that_keeps_its_heading_turns_against_its_object(probe: Probe) -> None:
    welcome = msgpack.unpackb(load("welcome_mounts").header)
    spec = next(device for device in welcome["scenario"]["devices"] if device["name"] == "top")
    scenario = {"devices": [spec | {"keeps_heading": True, "yaw_deg": 90.0}]}
    assert probe("mounts", msgpack.packb(welcome | {"scenario": scenario}))["code"] == ""
    stated = json.loads(json.dumps(load("scene_one_object").stated["value"]))
    scene = decode_payload("scene", load("scene_one_object").header, load("scene_one_object").body)
    got = probe("scene", load("scene_one_object").header, load("scene_one_object").body, stated["names"][0])
    mounted = decode_payload("scene", bytes.fromhex(got["header"]), bytes.fromhex(got["body"])).devices[0]
    # The object of the vector is turned by 90° about z, so that the device is not turned against it.
    np.testing.assert_allclose(scene.orientation[0], [0.5**0.5, 0.0, 0.0, 0.5**0.5], atol=1e-9)
    np.testing.assert_allclose(mounted.orientation, [1.0, 0.0, 0.0, 0.0], atol=1e-9)


@pytest.mark.parametrize(
    "pattern",
    ["car.*", "*", "c?r.[0-9]", "car.[!2-4]", "[[]x]", "*.*.*", "a[]b]c", "[", "a[b", "µ?", "ca[r-].*", "", "**b"],
)
def test_patterns_match_as_in_other_services(probe: Probe, pattern: str) -> None:
    for text in ("car.1", "car.3", "uav", "[x]", "a.b.c", "a]c", "abc", "[", "a[b", "µ", "µé", "ca-.x", "", "aab"):
        right = pattern == text or fnmatch.fnmatchcase(text, pattern)
        assert probe("match", pattern.encode(), text.encode()) is right, f"{pattern!r} on {text!r}"


AXES = json.loads((ROOT / "clients" / "axes.json").read_text("utf-8"))
PARTS = ("position", "orientation", "velocity", "angular_velocity")


@pytest.mark.parametrize("engine", AXES["engines"])
def test_poses_convert_to_and_from_an_engine(probe: Probe, engine: str) -> None:
    for pose in AXES["poses"]:
        for direction, source, target in (("from", "enu", engine), ("to", engine, "enu")):
            got = probe("axes", engine, direction, *[number for part in PARTS for number in pose[source][part]])
            for part in PARTS:
                right = np.array(pose[target][part])
                found = np.array(got[part])
                if part == "orientation" and found @ right < 0:
                    found = -found  # q and −q are one rotation
                np.testing.assert_allclose(found, right, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize(
    ("engine", "right"),
    [("unreal", [0.01, 0.02, 0.03]), ("unity", [3, 1, 2]), ("godot", [3, 1, 2]), ("ned", [1, 2, 3])],
)
def test_sides_of_a_box_have_no_sign(probe: Probe, engine: str, right: list[float]) -> None:
    assert probe("axes", engine, "to", 1.0, 2.0, 3.0, 1.0, *[0.0] * 9)["sides"] == pytest.approx(right)


def test_commands_of_an_action_are_read(probe: Probe) -> None:
    vector = load("action_every_command")
    action = decode_payload("action", vector.header, vector.body)
    assert isinstance(action, Action)
    got = asked(probe, vector)["typed"]
    kinds = [("beam", "waypoint", "velocity", "schedule")[command["kind"]] for command in got]
    assert kinds == [command.__struct_config__.tag for command in action.commands]
    for mine, theirs in zip(got, action.commands, strict=True):
        for field in theirs.__struct_fields__:
            value = getattr(theirs, field)
            assert mine[field] == (list(value) if isinstance(value, tuple) else value), field


def test_users_of_a_link_are_read(probe: Probe) -> None:
    vector = load("link_full")
    link = decode_payload("link", vector.header, vector.body)
    assert isinstance(link, Link)
    got = asked(probe, vector)["typed"]
    assert len(got) == len(link.tx) > 1
    for i, user in enumerate(got):
        for field in set(user) - {"best_tx_beam", "best_rx_beam"}:
            assert user[field] == getattr(link, field)[i], field
        assert [user["best_tx_beam"], user["best_rx_beam"]] == [link.top_tx_beam[i, 0], link.top_rx_beam[i, 0]]


def test_paths_of_a_channel_are_read_as_rays(probe: Probe) -> None:
    vector = load("channel_paths")
    channel = decode_payload("channel", vector.header, vector.body)
    assert isinstance(channel, Channel)
    got = asked(probe, vector)["typed"]
    assert len(got) == len(channel.tau) > 1
    pair_of = np.repeat(np.arange(len(channel.offsets) - 1), np.diff(channel.offsets))
    for p, ray in enumerate(got):
        depth = int(np.count_nonzero(channel.interactions[p]))
        assert ray["tx"] == channel.tx[pair_of[p] // len(channel.rx)]
        assert ray["rx"] == channel.rx[pair_of[p] % len(channel.rx)]
        assert [complex(*gain) for gain in ray["a"]] == channel.a[:, p].tolist()
        assert (ray["tau"], ray["aod"], ray["aoa"]) == (
            channel.tau[p],
            channel.aod[p].tolist(),
            channel.aoa[p].tolist(),
        )
        assert ray["interactions"] == channel.interactions[p, :depth].tolist()
        assert ray["points"] == channel.points[p, :depth].tolist()
        names = [channel.object_names[i] if i >= 0 else "" for i in channel.objects[p, :depth]]
        assert ray["objects"] == names


# --- the protocol ---------------------------------------------------------------------------------------


def failures(program: Path, **settings: Any) -> dict[str, str]:
    """What the conformance kit finds wrong with a world."""
    command = shlex.join([str(program), "{endpoint}", "{name}"])
    verdicts = conform(ANY, command=command, rules=Rules(name="mine", role="world", settings=settings))
    passed = {v.case for v in verdicts if v.outcome == "pass"}
    assert passed >= {"frames", "restore", "queued-grants", "undecodable-input", "scene-mounts", "sigterm"}
    return {v.case: f"expected {v.expected}; got {v.got}" for v in verdicts if v.outcome == "fail"}


def test_the_reference_world_fails_no_case_of_the_kit(world: Path) -> None:
    assert failures(world) == {}


def test_a_world_that_answers_later_and_looks_at_channels_fails_no_case(probe: Probe) -> None:
    assert failures(probe.program, deferred=True) == {}


@contextmanager
def joined(program: Path, folder: Path, **welcome: Any) -> Iterator[Session]:
    """A life of a client up to WELCOME."""
    wire = Wire(ANY)
    session = Session(wire, Started(f"{program} {{endpoint}} {{name}}", wire.endpoint, "mine", folder), Rules(), Seen())
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
        ("orientation", "object 'car': its orientation has norm 2.0"),
        ("dimensions", "object 'car': sides of its box are above 0"),
        ("position", "object 'car': its position is farther than 1e9 m, or no number"),
        ("velocity", "object 'car': its velocity is not below that of light"),
        ("asset", "asset 'objects/none.ply' was not offered; offer_mesh() in prepare() returns its name"),
        ("prefix", "object 'tram': its name begins with no prefix; call claim() for it in prepare()"),
        ("kind", "object 'car': its kind is missing"),
        ("twice", "object 'car': its name occurs twice"),
        ("device", "object 'bs' has a device's name"),
    ],
)
def test_a_wrong_object_is_named_in_fault_before_it_leaves(
    probe: Probe, tmp_path: Path, wrong: str, line: str
) -> None:
    with joined(probe.program, tmp_path, settings={"wrong": wrong}) as session:
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
def test_wrong_scenery_is_named_in_fault(probe: Probe, tmp_path: Path, wrong: str, line: str) -> None:
    with joined(probe.program, tmp_path, settings={"wrong": wrong}) as session:
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
        car, house = (read_mesh(session.offered[name]) for name in ("objects/car.ply", "scenery/meshes/house.ply"))
    # Meshes of objects fill the unit box; those of scenery stand where they are.
    np.testing.assert_allclose([car.min(axis=(0, 1)), car.max(axis=(0, 1))], [[-0.5] * 3, [0.5] * 3])
    np.testing.assert_allclose([house.min(axis=(0, 1)), house.max(axis=(0, 1))], [[-30, 16, 0], [30, 28, 12]])
    # Corners are counter-clockwise seen from outside: the signed volume of a closed body is its volume.
    assert np.linalg.det(house).sum() / 6 == pytest.approx(60 * 12 * 12)


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
        back._route, back.hello = hello.route, hello.fields  # noqa: SLF001 - the kit begins each life itself
        back._seen.allow(WITHIN_S)  # noqa: SLF001
        back.welcome()
        back.begin_episode()
        assert back.step().parts[1:] == before
        session.stage = back.stage
        back.send("SHUTDOWN", {"reason": "enough"})
        back.expect("BYE")


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
