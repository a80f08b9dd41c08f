"""What the tests of client libraries for game engines share: cases as lines of text, runs with their worlds.

A library is asked through a small program in its language: it reads cases, fields divided by tabs, from a
file, and prints one line for each. Numbers are written as ``x`` and the 16 digits of their 8 bytes, as a
language may read and print decimals inexactly.
"""

from __future__ import annotations

import json
import math
import re
import socket
import struct
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, contextmanager, suppress
from pathlib import Path
from typing import Any

import msgpack  # type: ignore[import-untyped]
import numpy as np
from scenarios_support import ROOT, blocks, caviar, environment, eventually, recorded_below, running
from test_websocket_agent import WITHIN_S, WebRun
from vector_files import FOLDER, Vector, all_vectors, array_of, load

from caviar_protocol.arrays import WIRE_DTYPES
from caviar_protocol.assets import digest_in
from caviar_protocol.codec import decode_payload
from caviar_protocol.digest import payload_digest
from caviar_protocol.recording import Recording
from caviar_protocol.topics import (
    Action,
    BeamChoice,
    Channel,
    Lidar,
    Link,
    Scene,
    UserSchedule,
    VelocityCommand,
    WaypointCommand,
)
from caviar_services.world.assets import RunTimeMeshes

FRAMES = 150
ARRIVALS = (("car.2", "uav"), ("car.1",), ("car.0",), (), ("car.2",))
"""Objects that come in each frame of the vectors ``mounts_0`` to ``mounts_4``."""
Ask = Callable[[str, Sequence[str]], list[str]]
"""Answers of a library to cases of a kind."""


LONGEST = 80
"""Lines of code that a reference world may have."""


class LibraryTests:
    """Tests of every library: a subclass says where its sources are, its module has the fixture ``ask``."""

    SCHEMA: Path
    """Source that holds the schema of the protocol."""
    WORLD: Path
    """The reference world."""
    COMMENT: str
    """How a line of its language begins that is a comment."""

    def test_its_schema_is_that_of_the_protocol(self) -> None:
        assert schema_is_current(self.SCHEMA)

    def test_the_reference_world_is_short(self) -> None:
        lines = [line.strip() for line in self.WORLD.read_text("utf-8").splitlines()]
        assert 40 < sum(bool(line) and not line.startswith(self.COMMENT) for line in lines) <= LONGEST

    def test_vectors_are_read_written_and_refused(self, ask: Ask) -> None:
        check_vectors(ask)
        check_arrays(ask)

    def test_poses_are_converted_to_the_axes_of_engines_and_back(self, ask: Ask) -> None:
        check_axes(ask)

    def test_meshes_are_converted_from_the_axes_and_winding_of_engines(self, ask: Ask) -> None:
        check_engine_meshes(ask)

    def test_an_offered_mesh_says_its_name_sides_and_centre(self, ask: Ask) -> None:
        check_offered(ask)

    def test_devices_are_mounted_as_the_vectors_say(self, ask: Ask) -> None:
        check_mounts(ask)
        check_matches(ask)

    def test_wrong_objects_and_scenery_are_refused(self, ask: Ask) -> None:
        check_wrong_objects(ask)
        check_wrong_scenery(ask)

    def test_meshes_come_and_go_while_a_run_goes_on(self, ask: Ask) -> None:
        check_spawned(ask)
        check_wrong_spawned(ask)

    def test_links_channels_and_actions_are_decoded(self, ask: Ask) -> None:
        check_decoders(ask)


# --- vectors ----------------------------------------------------------------------------------------------


def check_vectors(ask: Ask) -> None:
    """Every vector is read, written and refused as its JSON says."""
    vectors = all_vectors()
    answers = ask("vectors", [_case(vector) for vector in vectors])
    wrong = [
        f"{vector.name}: {answer[:300]}"
        for vector, answer in zip(vectors, answers, strict=True)
        if not (answer == vector.refused if vector.refused else answer.startswith(_expected(vector)))
    ]
    assert not wrong, "\n".join(wrong)
    assert len(vectors) > 100


def _case(vector: Vector) -> str:
    kind = vector.stated["kind"]
    # Parts of zeros are stated by their length, as some are too large to be written out.
    further = [part.hex() if any(part) else f"#{len(part)}" for part in vector.parts[1:]]
    fields = [kind, vector.stated.get("topic", ""), vector.header.hex(), vector.body.hex(), ",".join(further)]
    return "\t".join(fields if kind == "message" else [*fields[:4], ""])


def _expected(vector: Vector) -> str:
    if vector.stated["kind"] == "arrays":
        return "ok"
    header = vector.header if vector.canonical else msgpack.packb(vector.means)
    if vector.stated["kind"] == "message":
        frame = FOLDER / f"{vector.name}.frame"
        return f"ok\t{header.hex()}" + (f"\t{frame.read_bytes().hex()}" if frame.exists() else "")
    if not vector.canonical:
        return "ok"
    return f"ok\t{header.hex()}\t{vector.body.hex()}\t{payload_digest(header, vector.body)}"


def check_arrays(ask: Ask) -> None:
    """Elements of every type are what the vectors state."""
    seen = set()
    for name in ("arrays_every_type", "arrays_complex64"):
        vector = load(name)
        (answer,) = ask("arrays", [f"{vector.header.hex()}\t{vector.body.hex()}"])
        for stated, printed in zip(vector.stated["value"], answer.split("\t"), strict=True):
            floats, _, integers = printed.partition(";")
            expected = array_of(stated).ravel()
            seen.add(stated["dtype"])
            if expected.dtype.kind == "c":
                expected = expected.view("<f8" if expected.dtype.itemsize == 16 else "<f4")
            if expected.dtype.kind in "iu":
                assert [int(word) % 2**64 for word in integers.split()] == [
                    int(x) % 2**64 for x in expected
                ], name
            got = [number(word) for word in floats.split()]
            assert all(
                math.isclose(a, float(b), rel_tol=1e-12) for a, b in zip(got, expected, strict=True)
            ), f"{name}: {got} of {stated}"
    assert seen == set(WIRE_DTYPES)


# --- axes -------------------------------------------------------------------------------------------------


def check_axes(ask: Ask) -> None:
    """Poses and velocities in the axes of each engine, there and back."""
    poses = json.loads((ROOT / "clients" / "axes.json").read_text("utf-8"))["poses"]
    keys = ("position", "orientation", "velocity", "angular_velocity")
    cases = [(engine, pose) for pose in poses for engine in pose if engine != "enu"]
    lines = ["\t".join([engine, *(_numbers(pose["enu"][key]) for key in keys)]) for engine, pose in cases]
    for (engine, pose), answer in zip(cases, ask("axes", lines), strict=True):
        got = [[number(word) for word in field.split()] for field in answer.split("\t")]
        for expected, there in ((pose[engine], got[:4]), (pose["enu"], got[4:])):
            for key, numbers in zip(keys, there, strict=True):
                assert _alike(numbers, expected[key], key == "orientation"), f"{engine} {key}: {numbers}"


def check_engine_meshes(ask: Ask) -> None:
    """Meshes in the axes, unit and winding of each engine."""
    meshes = json.loads((ROOT / "clients" / "axes.json").read_text("utf-8"))["meshes"]
    engines = [key for key in meshes if key not in ("about", "enu")]
    parts = ("vertices", "triangles")
    lines = [
        "\t".join([name, *(_numbers(np.ravel(meshes[name][part])) for part in parts)]) for name in engines
    ]
    for engine, answer in zip(engines, ask("engine_mesh", lines), strict=True):
        for part, field in zip(parts, answer.split("\t"), strict=True):
            got = [number(word) for word in field.split()]
            assert got == np.ravel(meshes["enu"][part]).tolist(), f"{engine} {part}: {got}"


def _alike(got: list[float], expected: list[float], is_rotation: bool) -> bool:
    # q and -q are one rotation.
    if is_rotation and sum(a * b for a, b in zip(got, expected, strict=True)) < 0:
        expected = [-value for value in expected]
    return all(math.isclose(a, b, rel_tol=1e-12, abs_tol=1e-12) for a, b in zip(got, expected, strict=True))


def _numbers(values: Sequence[float]) -> str:
    return " ".join("x" + struct.pack(">d", value).hex() for value in values)


def number(word: str) -> float:
    return float(struct.unpack(">d", bytes.fromhex(word[1:]))[0]) if word.startswith("x") else float(word)


# --- the scene builder --------------------------------------------------------------------------------------


def check_mounts(ask: Ask) -> None:
    """Devices are mounted as the vectors say, also for objects given out of order."""
    scenes = [decode_payload("scene", *_product(f"mounts_{frame}")) for frame in range(len(ARRIVALS))]
    order: list[str] = []
    lines = [f"welcome\t{load('welcome_mounts').header.hex()}"]
    for scene, new in zip(scenes, ARRIVALS, strict=True):
        assert isinstance(scene, Scene)
        order = [name for name in (*order, *new) if name in scene.names]
        lines.append("\t".join(_object(scene, name) for name in order))
    _, *answers = ask("mounts", lines)
    for frame, answer in enumerate(answers):
        header, body = (bytes.fromhex(field) for field in answer.split("\t"))
        expected = _product(f"mounts_{frame}")
        assert _close(msgpack.unpackb(header), msgpack.unpackb(expected[0])), f"frame {frame}"
        assert body == expected[1], f"frame {frame}"


def _product(name: str) -> tuple[bytes, bytes]:
    vector = load(name)
    return vector.header, vector.body


def _object(scene: Scene, name: str) -> str:
    i = scene.names.index(name)
    arrays = (scene.position, scene.orientation, scene.velocity, scene.dimensions)
    return "|".join([name, scene.classes[i], *(_numbers(array[i].tolist()) for array in arrays)])


def _close(got: Any, expected: Any) -> bool:
    """Equal, with order of keys and types; a component of a quaternion may differ in its last digit."""
    if isinstance(expected, float):
        return isinstance(got, float) and math.isclose(got, expected, rel_tol=1e-15, abs_tol=1e-16)
    if isinstance(expected, dict):
        same = isinstance(got, dict) and list(got) == list(expected)
        return same and all(_close(got[key], value) for key, value in expected.items())
    if isinstance(expected, list):
        return len(got) == len(expected) and all(map(_close, got, expected))
    return bool(got == expected)


def check_wrong_objects(ask: Ask) -> None:
    """What a scene may not hold is refused with the object and the field."""
    welcome = f"welcome\t{load('welcome_mounts').header.hex()}"
    right = ["car.1", "car", "0 0 1", "1 0 0 0", "0 0 0", "4 2 2"]
    cases = {
        "is in the frame twice": ["|".join(right), "|".join(right)],
        "object 'car.1': the quaternion has the norm": ["|".join([*right[:3], "2 0 0 0", *right[4:]])],
        "object 'car.1': dimensions": ["|".join([*right[:5], "4 0 2"])],
        "object 'car.1': position": ["|".join([*right[:2], "0 2e9 0", *right[3:]])],
        "object 'car.1': velocity": ["|".join([*right[:4], "0 4e8 0", *right[5:]])],
        "a name has printable characters": ["|".join(["", *right[1:]])],
    }
    _, *answers = ask("mounts", [welcome, *("\t".join(objects) for objects in cases.values())])
    for expected, answer in zip(cases, answers, strict=True):
        assert expected in answer


MATCHES = (
    ("car.*", "car.1", True), ("car.*", "carx1", False), ("car.?", "car.12", False), ("*", "", True),
    ("[bc]ar", "car", True), ("[!bc]ar", "car", False), ("[a-c]ar", "bar", True), ("[a-c]ar", "dar", False),
    ("x[[]y", "x[y", True), ("a[1]", "a[1]", True), ("a[1", "a[1", True), ("*.*.z", "a.b.z", True),
    ("uav", "uav.1", False),
)  # fmt: skip


def check_matches(ask: Ask) -> None:
    """Patterns of ``on`` match the names that SPEC.md says."""
    answers = ask("match", [f"{pattern}\t{name}" for pattern, name, _ in MATCHES])
    assert [answer.lower() == "true" for answer in answers] == [expected for _, _, expected in MATCHES]


def check_wrong_scenery(ask: Ask) -> None:
    """Meshes and materials that no channel could read are refused with the value and the remedy."""
    cases = {
        "are not three of its 3 vertices": "mesh\tcar\t0 1 3",
        "is no name of an asset": "mesh\t../car\t0 1 2",
        "no type is 'stone'": "material\twall\tstone\t0.1",
        "a thickness of 0 m": "material\twall\tbrick\t0",
        "ok": "material\twall\tbrick\t0.1",
    }
    for expected, answer in zip(cases, ask("mesh", list(cases.values())), strict=True):
        assert expected in answer


SPAWNED = (
    # One mesh that is used, and lingers; another one beside it; both go.
    "limit 9|reset 0 0|frame 0 |add 01|frame 1 0|frame 2 0|add 0203|frame 3 1|frame 22 |frame 23 |frame 24 ",
    # A process that was started again says once more what it has; one goes on in an episode.
    "limit 9|reset 1 0|frame 0 |frame 1 |add 01|frame 2 0",
    "limit 9|reset 1 40|add 01|frame 40 |frame 41 |frame 61 |frame 62 ",
    # One that is refused is not announced again; the next episode begins without.
    "limit 9|reset 0 0|add 01|add 02|frame 0 0,1|refuse 0|frame 1 0,1|frame 2 0,1|reset 0 0|frame 0 ",
    # A run that takes none.
    "limit 0|reset 0 0|add 01|frame 0 0",
)


def check_offered(ask: Ask) -> None:
    """Name, sides and centre of meshes, offered before a run, while it goes on, and refused then."""
    nan, sloping, flat = "x7ff8000000000000", "0 0 0.125 4 0 2.125 0 2 1", "0 0 0 4 0 0 0 2 0"
    answers = ask("offered", [f"\t{sloping}", f"9\t{sloping}", f"9\t{flat}", f"9\t{sloping} {nan} 0 0"])
    found = [
        (mesh, *([number(word) for word in field.split()] for field in fields))
        for mesh, *fields in (answer.split("\t") for answer in answers)
    ]
    box = ([4.0, 2.0, 2.0], [2.0, 1.0, 1.125])
    assert found[0] == ("objects/car", *box)
    assert found[1][1:] == box
    assert found[1][0].startswith("objects/")
    # A side of a refused mesh is at least 1 cm.
    assert found[2] == ("", [4.0, 2.0, 0.01], [2.0, 1.0, 0.0])
    assert found[3] == ("", *box)


def check_spawned(ask: Ask) -> None:
    """Meshes are announced, and go, as those of worlds in this repository."""
    answers = ask("spawned", [script.replace("|", "\t") for script in SPAWNED])
    assert answers == ["\t".join(_spawned(script)) for script in SPAWNED]


def _spawned(script: str) -> Iterator[str]:
    meshes, names = RunTimeMeshes(), list[str]()
    for step in script.split("|"):
        what, first, *rest = step.split(" ")
        match what:
            case "limit":
                meshes.max_faces = int(first)
            case "reset":
                limit, refused = meshes.max_faces, meshes
                meshes = RunTimeMeshes(again=first == "1")
                meshes.max_faces = limit
                meshes._refused = refused._refused
                meshes._frame = int(rest[0])
            case "add":
                names.append(meshes.add(bytes.fromhex(first)))
                yield names[-1]
            case "refuse":
                meshes.refuse(digest_in(names[int(first)]), "it is none")
            case "frame":
                there = meshes.at(int(first), [names[int(i)] for i in rest[0].split(",") if i])
                yield "-" if there is None else f"{first}:{','.join(sorted(there))}"


def check_wrong_spawned(ask: Ask) -> None:
    """What a run would refuse of a mesh that comes while it goes on is named."""
    corners = "0 0 0 1 0 0 0 1 0 0 0 1"
    nan = "x7ff8000000000000"
    cases = {
        "mesh 'a': a vertex is not finite": f"a\t9\t{corners} 0 {nan} 0\t0 1 2",
        "mesh 'b': it has no triangle": f"b\t9\t{corners}\t",
        "mesh 'c': it has 2 triangles, and this run takes 1": f"c\t1\t{corners}\t0 1 2 0 2 3",
        "mesh 'd': it is flat": "d\t9\t0 0 0 1 0 0 0 1 0\t0 1 2",
        "ok": f"e\t9\t{corners}\t0 1 2 0 2 3",
    }
    assert ask("spawn", list(cases.values())) == list(cases)


# --- what others made ---------------------------------------------------------------------------------------


def check_decoders(ask: Ask) -> None:
    """Users of a link, paths of a channel and commands of an action are those that our codec reads."""
    link = decode_payload("link", *_product("link_full"))
    assert isinstance(link, Link)
    columns = zip(link.abs_y, link.snr, link.tx_beam, link.rx_beam, strict=True)
    _same(
        ask("users", [_fields("link_full")]),
        [
            [*ends, *numbers]
            for ends, numbers in zip(zip(link.tx, link.rx, link.carrier, strict=True), columns, strict=True)
        ],
    )
    _same(ask("paths", [_fields("channel_full")]), list(_paths()))
    action = decode_payload("action", *_product("action_every_command"))
    assert isinstance(action, Action)
    _same(
        ask("commands", [_fields("action_every_command")]), [_command(command) for command in action.commands]
    )


def _fields(name: str) -> str:
    return "\t".join(part.hex() for part in _product(name))


def _same(answers: list[str], expected: list[list[Any]]) -> None:
    (answer,) = answers
    rows = [row.split() for row in answer.split("\t")]
    assert len(rows) == len(expected) > 0
    for row, words in zip(rows, expected, strict=True):
        assert len(row) == len(words)
        for got, wanted in zip(row, words, strict=True):
            if isinstance(wanted, str):
                assert got == wanted
            else:
                assert math.isclose(number(got), wanted, rel_tol=1e-12), f"{got} in {row}"


def _paths() -> Iterator[list[Any]]:
    channel = decode_payload("channel", *_product("channel_full"))
    assert isinstance(channel, Channel)
    for pair in range(len(channel.offsets) - 1):
        for path in range(*channel.offsets[pair : pair + 2].tolist()):
            ends = [channel.tx[pair // len(channel.rx)], channel.rx[pair % len(channel.rx)]]
            met = channel.interactions[path] > 0
            yield [
                *ends, channel.tau[path], *channel.aod[path],
                *channel.a[:, path].real, *channel.a[:, path].imag, *channel.doppler[:, path],
                *channel.interactions[path][met], *channel.points[path][met].ravel(),
            ]  # fmt: skip


def _command(command: BeamChoice | WaypointCommand | VelocityCommand | UserSchedule) -> list[Any]:
    kind = type(command).__struct_config__.tag
    if isinstance(command, WaypointCommand):
        return [kind, command.object, 0, command.speed, *command.position]
    if isinstance(command, VelocityCommand):
        return [kind, command.object, 0, 0, *command.velocity]
    return [kind, command.tx, command.tx_beam if isinstance(command, BeamChoice) else 0, 0]


# --- conformance and runs -----------------------------------------------------------------------------------


def check_conformance(command: str, folder: Path) -> None:
    """``caviar conform --ws --role world`` has no failure, and plays what a world with state has to know."""
    verdicts = folder / "verdicts.json"
    words = [
        "--ws",
        "--listen",
        "ws://127.0.0.1:0/ws",
        "--role",
        "world",
        "--name",
        "world",
        "--json",
        str(verdicts),
    ]
    done = caviar("conform", *words, "--command", command, timeout=240)
    assert verdicts.exists(), done.output
    found = {entry["case"]: entry for entry in json.loads(verdicts.read_text("utf-8"))["verdicts"]}
    failed = [entry for entry in found.values() if entry["outcome"] == "fail"]
    assert not failed, failed
    played = {
        "garbage", "truncated", "oversized", "undecodable-input", "restore", "sigterm", "scene-turning",
        "run-time-meshes",
    }  # fmt: skip
    assert {case for case in played if found[case]["outcome"] == "pass"} == played
    assert done.status == 0, done.output


@contextmanager
def waiting_run(scenario: Path, folder: Path, *options: str, frames: int = FRAMES) -> Iterator[WebRun]:
    """``caviar run --http`` of a scenario that waits for its world."""
    out = folder / "out"
    options = ("--frames", str(frames), "--http", "127.0.0.1:0", *options)
    with running(scenario, out, *options) as (process, mark):
        yield WebRun(process, mark, out)


def light(scenario: Path, folder: Path) -> Path:
    """A scenario with a recorder for its world, and no service that loads large libraries."""
    text = scenario.read_text("utf-8")
    for name in ("channel", "lidar", "link", "agent"):
        text, count = re.subn(rf"^\[services\.{name}\]\n(.+\n)*\n", "", text, flags=re.MULTILINE)
        assert count == 1, name
    path = folder / "light.toml"
    path.write_text(re.sub("^record = .*", 'record = ["scene"]', text, flags=re.MULTILINE), "utf-8")
    return path


def token_of(folder: Path) -> str:
    """Token of a world, in a new directory of keys."""
    for words in (("new", "broker"), ("token", "world", "--role", "world")):
        done = caviar("keys", *words, "--directory", folder)
        assert done.status == 0, done.output
    return done.output.strip()


def whole_run(scenario: Path, folder: Path, command: Sequence[str], *options: str) -> tuple[str, Path]:
    """Digest and directory of a run whose broker asks for the world's token."""
    keys = folder / "keys"
    token = token_of(keys)
    with waiting_run(scenario, folder, "--keys", str(keys), *options) as run:
        env = environment(run.mark, CAVIAR_TOKEN=token)
        with subprocess.Popen([*command, run.url, "world"], env=env) as world:
            try:
                digest = run.digest()
                assert world.wait(WITHIN_S) == 0
            finally:
                world.kill()
        return digest, next(run.out.glob("*/"))


def check_recording(directory: Path) -> None:
    """A frame has its devices, a channel to three receivers, LIDAR hits on what the world brought."""
    recording = Recording(directory)
    assert len(recording) == FRAMES
    frame = recording.frame(0, 100)
    scene = frame.scene()
    assert scene is not None
    assert scene.names == ("car", "uav", "van")
    # The mesh of the van came while the run went on.
    assert set(recording.meshes) == {scene.assets[2]}
    names = ["bs", "car/lidar", "car/rx", "uav/rx-uav", "van/rx"]
    assert [device.name for device in scene.devices] == names
    before = recording.frame(0, 10).scene()
    assert before is not None
    assert before.names == ("car", "uav")
    channel = recording.product(0, 100, "channel", "channel")
    assert isinstance(channel, Channel)
    assert channel.rx == ("car/rx", "uav/rx-uav", "van/rx")
    lidar = recording.product(0, 100, "lidar", "lidar")
    assert isinstance(lidar, Lidar)
    hit = {lidar.object_names[index] for index in lidar.scans[0].object.tolist()}
    assert {"ground", "van"} <= hit
    link = recording.product(0, 100, "link", "link")
    assert isinstance(link, Link)
    assert link.has_path.all()


class Line:
    """A TCP line to the gateway that can be cut without a closing handshake, as by a network that fails."""

    def __init__(self, url: str) -> None:
        host, port = url.removeprefix("ws://").split("/")[0].split(":")
        self._target = (host, int(port))
        self._listener = socket.create_server(("127.0.0.1", 0))
        self._ends: list[socket.socket] = []
        self.url = f"ws://127.0.0.1:{self._listener.getsockname()[1]}/ws"
        threading.Thread(target=self._accept, daemon=True).start()

    def cut(self) -> None:
        """End all connections that there are; new ones are accepted."""
        ends, self._ends = self._ends, []
        for end in ends:
            with suppress(OSError):
                end.shutdown(socket.SHUT_RDWR)

    def close(self) -> None:
        """Cut, and accept no more."""
        with suppress(OSError):
            self._listener.shutdown(socket.SHUT_RDWR)
        self._listener.close()
        self.cut()

    def _accept(self) -> None:
        with suppress(OSError):
            while True:
                near, _ = self._listener.accept()
                far = socket.create_connection(self._target)
                self._ends += [near, far]
                for source, target in ((near, far), (far, near)):
                    threading.Thread(target=self._copy, args=(source, target), daemon=True).start()

    def _copy(self, source: socket.socket, target: socket.socket) -> None:
        with suppress(OSError), source:
            while data := source.recv(1 << 16):
                target.sendall(data)
        with suppress(OSError):
            target.shutdown(socket.SHUT_RDWR)


def check_kill(scenario: Path, folder: Path, command: Sequence[str], digest: str, *options: str) -> None:
    """Cut off, it comes back by itself; killed and started again, it goes on: the run is the same."""
    with waiting_run(scenario, folder, *options) as run, closing(Line(run.url)) as line:
        with run.agent(*command, line.url, "world") as first:
            eventually(lambda: recorded_below(run.out) >= 25, WITHIN_S, "some frames are recorded")
            before = recorded_below(run.out)
            line.cut()
            eventually(lambda: recorded_below(run.out) >= before + 30, WITHIN_S, "it comes back and goes on")
            first.kill()
        with run.agent(*command, run.url, "world"):
            assert run.digest() == digest
        assert run.output.count("back: world") == 2, run.output


BARE = """
[run]
name = "bare"
frames = 20
frames_in_flight = 1
record = ["scene"]

[services]
world = { role = "world", use = "remote", budget_ms = 1000 }
recorder = { role = "recorder", use = "mcap", budget_ms = 1000 }
"""
"""A run of a world that needs nothing else; each frame is complete before the next one begins."""


def check_slow_and_wrong(folder: Path, command: Sequence[str]) -> None:
    """A world may take several ticks for a frame; its wrong object ends the run, and is named."""
    scenario = folder / "bare.toml"
    scenario.write_text(BARE, "utf-8")
    with waiting_run(scenario, folder) as run, run.agent(*command, run.url, "world") as world:
        output, _ = run.process.communicate(timeout=WITHIN_S)
        assert run.process.returncode == 1, output
        assert world.wait(WITHIN_S) == 1, "it failed itself"
    assert "object 'lorry': no prefix of READY begins its name" in " ".join(output.split())
    scenes = [frame.scene() for frame in Recording(next(run.out.glob("*/")))]
    assert [scene.position[0, 1] for scene in scenes if scene is not None] == [3, 6, 9, 12, 15]


ENDS = {
    "right": (0, "the run is complete"),
    "fail": (1, "world 'world' failed in frame 0, step: it fails"),
    "late": (1, "world 'world' overran its budget (policy abort) in frame 0"),
}
"""Status and last line of a world whose setting ``how`` says what its steps do: ``late`` ones take 1.5 s."""


def ending(folder: Path, how: str) -> Path:
    """A scenario of two episodes for a world of `ENDS`, whose broker is gone before a late step ends."""
    limit = 'budget_ms = 200, policy = "abort"' if how == "late" else "budget_ms = 1000"
    text = BARE.replace("budget_ms = 1000", f'{limit}, settings = {{ how = "{how}" }}', 1)
    text = text.replace("frames = 20", "frames = 3\nepisodes = 2")
    scenario = folder / "ending.toml"
    scenario.write_text(
        text + "\n[timeouts]\nshutdown_s = 0.2\nheartbeat_s = 0.1\nliveness_s = 0.5\n", "utf-8"
    )
    return scenario


def check_end(how: str, command: Sequence[str | Path], mark: str, out: Path) -> None:
    """A world ends as `ENDS` says; times of its steps, x and y of its object, begin at 0 in each episode."""
    done = subprocess.run(
        command, env=environment(mark), capture_output=True, text=True, timeout=WITHIN_S, check=False
    )
    status, line = ENDS[how]
    assert line in done.stderr.splitlines()[-1], done.stderr
    assert done.returncode == status, done.stderr
    if how == "right":
        eventually(lambda: bool(list(out.glob("*/summary.json"))), WITHIN_S, "the run is over")
        scenes = [frame.scene() for frame in Recording(next(out.glob("*/")))]
        times = [tuple(scene.position[0, :2].tolist()) for scene in scenes if scene is not None]
        assert times == [(0, 0), (0.1, 0), (0.2, 0.1)] * 2


def check_no_gateway(command: Sequence[str]) -> None:
    """An address of ZeroMQ, and half of one, are refused at once, with what to write."""
    for address in ("tcp://127.0.0.1:5570", "127.0.0.1:8080"):
        done = subprocess.run(
            [*command, address, "world"], capture_output=True, text=True, timeout=WITHIN_S, check=False
        )
        assert done.returncode == 1, done.stdout + done.stderr
        wanted = f"'{address}' is no address of a gateway; write ws://HOST:PORT/ws"
        assert wanted in done.stdout + done.stderr


def schema_is_current(source: Path) -> bool:
    """Whether a source holds the schema that ``clients/schema.py`` makes today."""
    text = source.read_text("utf-8")
    done = subprocess.run(
        [sys.executable, ROOT / "clients" / "schema.py"], capture_output=True, text=True, check=True
    )
    return done.stdout in text


def block_of(page: Path, name: str, folder: Path) -> Path:
    """A program of a page, the fenced block that begins with a comment of its name, as a file."""
    (text,) = (text for _, text in blocks(page) if text.splitlines()[0].endswith(f" {name}"))
    source = folder / name
    source.write_text(text, "utf-8")
    return source
