"""The conformance kit for clients passes those that are right, and fails each kind of fault."""

from __future__ import annotations

import contextlib
import json
import shlex
import socket
import subprocess
import sys
import threading
import tomllib
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import msgspec
import pytest
import zmq
from client_nursery import Forked, Nursery

from caviar_clients.cli.main import app
from caviar_labs.conform import Verdict, cases, conform, street
from caviar_labs.conform.case import as_markdown, repeated
from caviar_labs.conform.client import End, Rules, Started, Wire, unpack
from caviar_labs.conform.session import Seen, Session
from caviar_protocol.codec import decode_payload, encode_payload
from caviar_protocol.errors import RunError, SetupError
from caviar_protocol.topics import Scene

ROOT = Path(__file__).resolve().parents[2]
VECTORS = ROOT / "protocol" / "vectors"
BROKEN = Path(__file__).with_name("broken_client.py")
ANY = "tcp://127.0.0.1:0"
FLIGHT = {
    "flown": [{"name": "uav", "start_m": [1.0, 2.0, 3.0], "max_speed_m_s": 5.0, "max_acceleration_m_s2": 2.0}]
}
TRAJECTORY = tomllib.loads((ROOT / "deploy/caviar_scenarios/remote.toml").read_text())["services"]["world"]


def python(*words: object) -> str:
    """Command line of a Python program."""
    return shlex.join([sys.executable, *map(str, words)])


def failures(verdicts: list[Verdict]) -> dict[str, str]:
    """What went wrong, by case."""
    return {v.case: f"expected {v.expected}; got {v.got}" for v in verdicts if v.outcome == "fail"}


# --- clients that are right -------------------------------------------------------------------------

RIGHT = {
    "agent.py": (python(ROOT / "clients/minimal/agent.py", "{endpoint}", "{name}"), {}),
    "world.py": (python(ROOT / "clients/python/world.py", "{endpoint}", "{name}"), {}),
    "control": (python(BROKEN, "{endpoint}", "{name}", "none"), {}),
    "control-world": (python(BROKEN, "{endpoint}", "{name}", "none", "world"), {}),
    "control-recorder": (python(BROKEN, "{endpoint}", "{name}", "none", "recorder"), {}),
} | {
    use: (
        python("-m", "caviar_services", "{name}", "--use", use, "--broker", "{endpoint}"),
        {"world:trajectory": TRAJECTORY["settings"], "world:flight": FLIGHT}.get(use, {}),
    )
    for use in (
        "world:trajectory",
        "world:flight",
        "channel:free-space",
        "link:beams",
        "agent:los-beam",
        "recorder:mcap",
    )
}


@pytest.fixture(scope="module", autouse=True)
def nursery(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Clients in Python are forks of one process, and scenery of the kit goes to a folder of the tests."""
    Forked.nursery = Nursery()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("caviar_labs.conform.Started", Forked)
        patch.setenv("XDG_CACHE_HOME", str(tmp_path_factory.mktemp("cache")))
        yield
    Forked.nursery.close()


AT_ONCE = 4
"""Clients that are judged side by side: kit and client mostly wait for each other, and for time-outs."""


@pytest.fixture(scope="module")
def judged(nursery: None, request: pytest.FixtureRequest) -> Iterator[dict[str, Future[list[Verdict]]]]:
    """The verdicts that the tests of this session ask for, by the test's name, as they become known."""
    with ThreadPoolExecutor(AT_ONCE) as pool:
        found = {
            item.name: pool.submit(play, **item.callspec.params)
            for item in request.session.items
            if isinstance(item, pytest.Function) and item.get_closest_marker("skip") is None
            for play in [PLAYED.get(item.function)]
            if play is not None and item.module is request.module
        }
        yield found
        for future in found.values():
            future.cancel()


LONG_FORM = {"control", "control-recorder", "world:trajectory"}
"""Clients whose role another one has too."""


def right(client: str) -> list[Verdict]:
    """Verdicts on a client that is right."""
    command, settings = RIGHT[client]
    return conform(ANY, command=command, rules=Rules(name="mine", settings=settings))


@pytest.mark.parametrize(
    "client",
    [pytest.param(name, marks=[pytest.mark.exhaustive] if name in LONG_FORM else []) for name in RIGHT],
)
def test_a_right_client_fails_nothing(
    client: str, judged: dict[str, Future[list[Verdict]]], request: pytest.FixtureRequest
) -> None:
    verdicts = judged[request.node.name].result()
    assert failures(verdicts) == {}
    assert [v.case for v in verdicts] == [case.name for case in cases()]
    assert sum(v.outcome == "pass" for v in verdicts) >= 25


LOOK = """import sys
from caviar_protocol.observer import Observer
with Observer(sys.argv[1], sys.argv[2]) as observer:
    for observation in observer:
        [product.payload for product in observation.products.values()]
"""


@pytest.mark.parametrize(
    "command",
    [
        python("-c", LOOK, "{endpoint}", "{name}"),
        python(BROKEN, "{endpoint}", "{name}", "none", "observer"),
    ],
    ids=["library", "control"],
)
def test_an_observer_fails_nothing(command: str) -> None:
    verdicts = conform(ANY, command=command, rules=Rules(name="mine", role="observer"))
    assert failures(verdicts) == {}
    passed = [v.case for v in verdicts if v.outcome == "pass"]
    assert passed == ["hello", "observe", "other-major", "refused", "canonical"]


@pytest.fixture
def node_client(
    tmp_path_factory: pytest.TempPathFactory, pytestconfig: pytest.Config
) -> Callable[[str], str]:
    """Command line of a script of ``clients/minimal/node``; skips by name where Node or npm is missing."""
    from node_project import node_project

    cache = pytestconfig.cache
    folder = cache.mkdir("minimal-node") if cache is not None else tmp_path_factory.mktemp("node")

    def command(script: str) -> str:
        project = node_project(ROOT / "clients/minimal/node", script, folder)
        return shlex.join(["node", str(project / script), "{endpoint}", "{name}"])

    return command


@pytest.mark.parametrize(
    ("script", "role"),
    [pytest.param("agent.mjs", "agent", marks=pytest.mark.exhaustive), ("world.mjs", "world")],
)
def test_the_clients_for_node_fail_nothing(node_client: Callable[[str], str], script: str, role: str) -> None:
    verdicts = conform(ANY, command=node_client(script), rules=Rules(name="mine", role=role))
    assert failures(verdicts) == {}


def test_the_world_for_node_mounts_the_devices_of_the_vectors(
    node_client: Callable[[str], str], tmp_path: Path
) -> None:
    """`welcome_mounts` and the first four of its scenes; an object of this world does not come back."""
    dimensions = {
        "car.2": [5.0, 2.0, 2.5],
        "uav": [0.5, 0.5, 0.25],
        "car.1": [4.25, 1.75, 1.25],
        "car.0": [4.5, 1.8, 1.5],
    }
    stay = {"car.2": (0.0, 0.25), "uav": (0.0, 9.0), "car.1": (0.05, 9.0), "car.0": (0.15, 9.0)}
    circle = {"class": "car", "centre_m": [0.0, 0.0, 1.0], "radius_m": 9.0, "speed_m_s": 3.0}
    objects = [
        circle | {"name": name, "dimensions_m": size, "from_s": stay[name][0], "until_s": stay[name][1]}
        for name, size in dimensions.items()
    ]
    welcome = unpack((VECTORS / "welcome_mounts.msgpack").read_bytes())
    wire = Wire(ANY)
    client = Started(node_client("world.mjs"), wire.endpoint, "city", tmp_path)
    session = Session(wire, client, Rules(name="city"), Seen())
    try:
        session.begin()
        session.welcome(scenario=welcome["scenario"], settings={"objects": objects})
        session.prepare()
        session.reset(0)
        for frame in range(4):
            answer = session.step()
            scene = decode_payload("scene", *answer.parts[1:3])
            expected = decode_payload("scene", *(read_vector(f"mounts_{frame}")))
            assert isinstance(scene, Scene)
            assert isinstance(expected, Scene)
            assert scene.names == expected.names
            assert_same_devices(scene.devices, expected.devices)
    finally:
        session.close()
        wire.close()


def read_vector(name: str) -> tuple[bytes, bytes]:
    return (VECTORS / f"{name}.msgpack").read_bytes(), (VECTORS / f"{name}.body").read_bytes()


def assert_same_devices(got: tuple[Any, ...], expected: tuple[Any, ...]) -> None:
    """Equal, where the last digit of a quaternion may differ."""
    plain = [
        [msgspec.structs.replace(device, orientation=(1.0, 0.0, 0.0, 0.0)) for device in devices]
        for devices in (got, expected)
    ]
    assert plain[0] == plain[1]
    for mine, theirs in zip(got, expected, strict=True):
        assert mine.orientation == pytest.approx(theirs.orientation, abs=1e-15)


def test_a_world_that_brings_scenery_is_asked_for_all_of_it(tmp_path: Path) -> None:
    for name, data in street.scenery("of the test").items():
        file = tmp_path / name
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_bytes(data)
    settings = {**TRAJECTORY["settings"], "scenery": str(tmp_path / "scenery/street.xml")}
    command, _ = RIGHT["world:trajectory"]
    names = ["ready", "scenery", "frames", "no-demand"]
    verdicts = conform(ANY, command=command, names=names, rules=Rules(name="mine", settings=settings))
    assert failures(verdicts) == {}
    assert next(v.got for v in verdicts if v.case == "scenery").startswith("offers 5 files")


def test_a_right_client_that_speaks_websocket_fails_nothing(tmp_path: Path) -> None:
    """The same agent, over WebSockets: the kit plays behind the gateway."""
    from typer.testing import CliRunner

    agent = python(ROOT / "tests/scenarios/websocket_zmq.py", ROOT / "clients/minimal/agent.py")
    file = tmp_path / "verdicts.json"
    words = ["--ws", "--listen", "ws://127.0.0.1:0/ws", "--name", "mine", "--json", str(file)]
    result = CliRunner().invoke(app, ["conform", *words, "--command", f"{agent} {{endpoint}} {{name}}"])
    found = json.loads(file.read_text())
    assert failures([Verdict(**verdict) for verdict in found["verdicts"]]) == {}, result.output
    assert found["pass"] >= 30


@pytest.mark.parametrize("more", [[], ["--ws"]])
def test_a_client_that_is_given_the_address_is_judged_while_the_usual_port_is_taken(more: list[str]) -> None:
    from typer.testing import CliRunner

    wrapper = ["tests/scenarios/websocket_zmq.py"] if more else []
    agent = python(*(ROOT / part for part in (*wrapper, "clients/minimal/agent.py")))
    with socket.socket() as taken:
        with contextlib.suppress(OSError):  # another program has it: as good
            taken.bind(("127.0.0.1", 5590))
            taken.listen()
        words = ["conform", *more, "--name", "mine", "--case", "hello"]
        judged = CliRunner().invoke(app, [*words, "--command", f"{agent} {{endpoint}} {{name}}"])
        assert judged.exit_code == 0, judged.output
        # A client that has the address in itself gets the usual one.
        refused = CliRunner().invoke(app, [*words, "--command", str(agent)])
        assert "5590" in f"{refused.output}{refused.exception}"


def test_python_in_a_command_is_the_one_that_runs_where_no_environment_is_activated(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv("PATH", "/nowhere")
    command = f"python {ROOT}/clients/minimal/agent.py {{endpoint}} {{name}}"
    verdicts = conform(ANY, command=command, names=["hello"], rules=Rules(name="mine"))
    assert failures(verdicts) == {}


def test_what_the_gateway_says_of_a_client_is_shown_with_the_verdicts() -> None:
    from caviar_broker.http.process import gateway_in_front

    script = (
        "import struct, sys; from websockets.sync.client import connect; "
        "connect(sys.argv[1]).__enter__().send(struct.pack('>II', 1, 3) + b'abc')"
    )
    told: list[str] = []
    verdicts = conform(
        ANY,
        command=python("-c", script, "{endpoint}"),
        names=["hello"],
        front=lambda endpoint: gateway_in_front(endpoint, "127.0.0.1:0", told.append),
    )
    assert [verdict.outcome for verdict in verdicts] == ["fail"]
    assert "big-endian" in "".join(told)


# --- clients that are not ---------------------------------------------------------------------------

FAULTS: dict[str, tuple[str, ...]] = {
    "hello": (
        "declares an unknown topic",
        "speaks another version",
        "has another name",
        "has another role",
    ),
    "attach": ("never attaches", "attaches to another epoch"),
    "heartbeats": (
        "skips sequence numbers",
        "progress falls",
        "says BYE on the heartbeat connection",
        "beats too slowly",
        "floods with heartbeats",
    ),
    "ready": ("asks for scenery again and again", "is READY in another epoch", "holds another geometry"),
    "scenery": ("claims scenery that it did not fetch", "passes over unknown assets/world"),
    "early-grant": ("takes grants of other episodes",),
    "reset": ("resets another episode",),
    "frames": (
        "answers another frame",
        "answers another episode",
        "answers in another epoch",
        "writes digests in capitals",
        "states a false digest",
        "makes what it did not declare",
        "makes a topic twice",
        "makes no product",
        "makes what is no payload",
        "writes out a default in a payload",
        "pads the body",
    ),
    "repeated-grant": ("computes anew",),
    "heartbeats-in-frames": ("stops beating in frames",),
    "cancel": ("complains of CANCEL",),
    "queued-grants": ("answers the newest grant first",),
    "gap": ("wants frames in order",),
    "reordered-grants": ("ends at a frame of the past",),
    "held-inputs": ("ends at a held input",),
    "absent-inputs": ("ends at an absent input",),
    "late-inputs": ("ends at a late input/recorder",),
    "unknown-fields": ("ends at an unknown field",),
    "episodes": ("remembers the episode before",),
    "stale-grant": ("takes grants of other epochs",),
    "other-episode": ("takes grants of other episodes",),
    "unexpected": ("passes over what is not due",),
    "undecodable-input": ("does not say which input",),
    "deep": ("crashes at nonsense",),
    "garbage": (
        "crashes at nonsense",
        "hangs at nonsense",
        "ends well at nonsense",
        "passes over nonsense",
    ),
    "truncated": ("does not count parts",),
    "lying-counts": ("allocates what is announced",),
    "oversized": ("takes oversized headers",),
    "heartbeat-noise": ("stops beating at noise",),
    "complaints": ("answers complaints",),
    "checkpoint": ("saves no state", "saves the state of another frame"),
    "restore": ("forgets its state", "is not READY after RESTORE"),
    "wrong-state": ("takes any state",),
    "shutdown": (
        "stays after SHUTDOWN",
        "leaves without BYE",
        "talks after BYE",
        "ends badly after SHUTDOWN",
    ),
    "early-shutdown": ("does not leave before PREPARE",),
    "sigterm": ("ignores SIGTERM", "dies of SIGTERM"),
    "silence": ("bears silence", "ends well in silence"),
    "other-major": ("stays with another major version",),
    "refused": ("ends well when refused", "says nothing when refused"),
    "later-minor": ("accepts its own minor version only",),
    "no-demand": ("wants demand/world",),
    "final-grant": ("acts in the final grant",),
    "observe": ("acknowledges another/observer",),
    "several-sources": ("wants one source of each topic",),
    "canonical": ("writes out a default",),
    "scene-orientations": (
        "publishes quaternions of length 2/world",
        "publishes quaternions of zeros/world",
    ),
    "scene-places": ("publishes NaN/world", "publishes cars that are faster than light/world"),
    "scene-dimensions": ("publishes negative dimensions/world", "publishes flat boxes/world"),
    "scene-names": (
        "does not sort names/world",
        "publishes a name twice/world",
        "does not sort devices/world",
    ),
    "scene-prefixes": ("forgets its prefixes/world",),
    "scene-meshes": ("names meshes that it did not offer/world",),
    "scene-devices": ("publishes no devices/world", "passes over count/world"),
    "scene-device-poses": (
        "mounts devices on absent objects/world",
        "publishes devices with quaternions of length 2/world",
    ),
    "scene-mounts": (
        "ignores mounts/world",
        "mounts on the roof what is on the floor/world",
        "takes the array of another device/world",
        "doubles yaw/world",
        "lifts the nose where it is to be lowered/world",
        "ignores roll/world",
        "forgets to convert degrees/world",
        "drops panels/world",
        "drops dual polarizations/world",
        "drops pattern files/world",
    ),
    "scene-carriers": ("hands devices around/world",),
    "scene-turning": ("turns the other way/world", "gives degrees per second/world"),
    "channel-parts": (
        "leaves hf out/channel",
        "forgets a subcarrier/channel",
        "transposes hf/channel",
        "leaves taps out/channel",
    ),
    "channel-consistency": (
        "doubles hf/channel",
        "conjugates h/channel",
        "begins taps at the first path/channel",
    ),
}


def broken(fault: str, *names: str) -> list[Verdict]:
    """Verdicts on the client with this fault."""
    fault, _, role = fault.partition("/")
    command = python(BROKEN, "{endpoint}", "{name}", fault, role or "agent")
    patience = 0.5 if "again and again" in fault else 1.5
    rules = Rules(name="mine", role=role or "agent", timeout_s=patience)
    return conform(ANY, command=command, names=names, rules=rules)


@pytest.mark.parametrize(
    ("case", "fault"), [(case, fault) for case, faults in FAULTS.items() for fault in faults]
)
def test_each_fault_is_found_by_its_case(
    case: str, fault: str, judged: dict[str, Future[list[Verdict]]], request: pytest.FixtureRequest
) -> None:
    verdicts = judged[request.node.name].result()
    assert list(failures(verdicts)) == [case]
    assert verdicts[-1].got


PLAYED: dict[Callable[..., None], Callable[..., list[Verdict]]] = {
    test_a_right_client_fails_nothing: right,
    test_each_fault_is_found_by_its_case: lambda case, fault: broken(
        fault, *(["hello"] if case == "canonical" else []), case
    ),
}
"""What the fixture `judged` plays for a test, with the same parameters."""


def test_a_failed_case_is_not_blamed_on_the_next_one() -> None:
    """The client is strict: it answers RESET in an episode that did not end with ERROR."""
    verdicts = broken("ends at an unknown field", "unknown-fields", "episodes")
    assert {v.case: v.outcome for v in verdicts} == {"unknown-fields": "fail", "episodes": "pass"}


def test_what_fails_alike_is_told_once_at_the_end() -> None:
    verdicts = broken("states a false digest", "frames", "repeated-grant", "hello")
    (line,) = repeated(verdicts)
    assert line.startswith("2 cases failed with the same words (frames, repeated-grant)")
    assert "hash the length of the header (8 bytes, little-endian), the header and the body" in line
    assert f"- {line}" in as_markdown(verdicts).splitlines()


def test_there_is_a_fault_for_every_case() -> None:
    """So that no verdict is one that cannot fail; of run-time meshes see test_geometry_cases.py."""
    meshes = {"geometry", "later-geometry", "geometry-gone", "run-time-meshes"}
    assert set(FAULTS) | meshes == {case.name for case in cases()}


# --- what the kit is made of, and its command -------------------------------------------------------


@pytest.mark.parametrize("topic", street.SOURCES)
def test_the_products_of_the_kit_are_canonical(topic: str) -> None:
    for source in street.DOUBLED[topic]:
        for frame in (0, 3):
            header, body = street.product(topic, source, frame)
            assert encode_payload(decode_payload(topic, header, body)) == (header, body)
        assert street.product(topic, source, 0) != street.product(topic, source, 3)


def test_a_client_that_never_says_hello_ends_every_case_at_once() -> None:
    verdicts = conform(ANY, command=python("-c", "print('I am no client')"))
    assert {v.outcome for v in verdicts[:-1]} == {"fail"}
    assert "«I am no client»" in verdicts[0].got
    assert sum(v.seconds for v in verdicts) < 10


def test_what_a_life_still_sends_when_it_is_over_is_not_taken_for_the_next_one() -> None:
    class Gone:
        """A client that has ended, of which a heartbeat is on its way."""

        start_s = 0.0

        def ended(self) -> End:
            return End(0)

        start = terminate = memory = dispose = Mock()

    wire = Wire(ANY)
    with zmq.Context() as context, context.socket(zmq.DEALER) as pulse:
        pulse.connect(wire.endpoint)
        pulse.send(b"first")
        assert wire.poll(5.0)

        def leave() -> None:
            pulse.send(b"last")
            pulse.close()

        late = threading.Timer(0.2, leave)
        late.start()
        Session(wire, Gone(), Rules(), Seen()).close()
        late.join()
        assert wire.connections == 0
        assert wire.poll(0.1) is None
    wire.close()


def test_an_unknown_case_a_bad_address_and_a_missing_program_are_named() -> None:
    with pytest.raises(SetupError, match="did you mean 'garbage'"):
        conform(ANY, names=["garbages"])
    with pytest.raises(RunError, match="tcp://nowhere"):
        conform("tcp://nowhere", command="true")
    with pytest.raises(RunError, match="'no-such-program'"):
        conform(ANY, command="no-such-program {endpoint}")
    judged: list[Verdict] = []
    with pytest.raises(RunError, match=r"status 2 .*no-such-file\.py"):
        conform(ANY, command=python("no-such-file.py", "{endpoint}"), each=judged.append)
    assert judged == []


def test_a_client_started_by_hand_is_told_when(tmp_path: Path) -> None:
    """The kit says when; here a test starts what a user would."""
    started: list[subprocess.Popen[bytes]] = []

    def tell(text: str) -> None:
        if text.startswith("start your client"):
            endpoint = text.split()[-1]
            command = [sys.executable, str(ROOT / "clients/minimal/agent.py"), endpoint, "mine"]
            started.append(subprocess.Popen(command, stderr=subprocess.DEVNULL))

    names = ["hello", "frames", "shutdown", "refused", "sigterm"]
    verdicts = conform(ANY, names=names, tell=tell)
    outcomes = {v.case: v.outcome for v in verdicts}
    assert outcomes == dict.fromkeys(names, "pass") | {"sigterm": "not applicable"}
    assert len(started) == 3
    assert [process.wait(10) == 0 for process in started] == [True, True, False]


def test_the_command_prints_a_table_writes_files_and_tells_by_its_status(tmp_path: Path) -> None:
    from typer.testing import CliRunner

    def invoke(fault: str) -> Any:
        command = python(BROKEN, "{endpoint}", "{name}", fault)
        words = ["--listen", ANY, "--command", command, "--case", "reset", "--case", "no-demand"]
        files = ["--json", str(tmp_path / "v.json"), "--markdown", str(tmp_path / "v.md")]
        return CliRunner().invoke(app, ["conform", *words, *files])

    assert invoke("none").exit_code == 0
    found = json.loads((tmp_path / "v.json").read_text())
    assert (found["pass"], found["fail"], found["not applicable"]) == (1, 0, 1)
    result = invoke("resets another episode")
    assert result.exit_code == 1
    assert "1 failed" in result.output
    found = json.loads((tmp_path / "v.json").read_text())
    verdict = found["verdicts"][0]
    assert (verdict["case"], verdict["outcome"], verdict["clauses"]) == ("reset", "fail", "clauses 1, 16")
    assert "| reset: RESET is answered with RESET_DONE | clauses 1, 16 | fail |" in (
        tmp_path / "v.md"
    ).read_text("utf-8")
    listed = CliRunner().invoke(app, ["conform", "--list"])
    assert all(case.name in listed.output for case in cases())


@pytest.mark.parametrize("option", ["--json", "--markdown"])
def test_a_file_that_cannot_be_written_is_named_before_the_first_case(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, option: str
) -> None:
    monkeypatch.setattr("caviar_labs.conform.conform", lambda *_, **__: pytest.fail("a case was played"))
    with pytest.raises(RunError, match=r"cannot write .*: Is a directory"):
        app(["conform", "--listen", ANY, option, str(tmp_path)], standalone_mode=False)
