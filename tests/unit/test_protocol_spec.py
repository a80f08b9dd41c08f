"""SPEC.md says what the code does: its tables, its examples, its numbers and its client."""

from __future__ import annotations

import hashlib
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
import zmq

from caviar_protocol import messages as m
from caviar_protocol import spec
from caviar_protocol.codec import check_parts, decode_message, decode_payload, encode_message, encode_payload
from caviar_protocol.digest import RunDigest, geometry_digest, payload_digest
from caviar_protocol.errors import DecodeError, LimitError, VersionError
from caviar_protocol.topics import Action, AntennaDevice, BeamChoice, Scene

SPEC = Path(__file__).resolve().parents[2] / "protocol" / "SPEC.md"
TEXT = SPEC.read_text("utf-8")
CLASSES = spec.classes()


def section(title: str) -> str:
    """Text below a heading of the second level."""
    return TEXT.split(f"\n## {title}\n")[1].split("\n## ")[0]


def test_the_generated_blocks_are_those_of_the_types_and_vectors() -> None:
    """After a change of a field: ``python -m caviar_protocol.spec protocol/SPEC.md``."""
    assert spec.render(TEXT, SPEC.parent / "vectors") == TEXT


def test_a_changed_block_is_noticed_and_mended(tmp_path: Path) -> None:
    changed = TEXT.replace("| budget_ns |", "| budget_ms |")
    assert changed != TEXT
    copy = tmp_path / "SPEC.md"
    copy.write_text(changed, "utf-8")
    (tmp_path / "vectors").symlink_to(SPEC.parent / "vectors")
    spec.main(copy)
    assert copy.read_text("utf-8") == TEXT


def test_every_class_on_the_wire_has_a_table() -> None:
    assert set(re.findall(r"<!-- fields: (\w+) -->", TEXT)) == set(CLASSES)


@pytest.mark.parametrize("cls", CLASSES.values(), ids=CLASSES)
def test_every_field_says_what_it_means_and_every_number_has_a_unit(cls: type[msgspec.Struct]) -> None:
    assert cls.__doc__
    for name, kind, unit, default, since, meaning in spec.rows(cls):
        assert meaning, f"{cls.__name__}.{name}"
        assert default
        assert re.fullmatch(r"1\.\d+", since)
        if re.search(r"\b(int|float|array)\b|#field-types\)", kind) and not re.search(
            r"\[(Name|NewName|AssetName|NamePattern|Text|Word)\]", kind
        ):
            assert unit, f"{cls.__name__}.{name} is {kind}"


def test_every_clause_of_the_contract_is_told() -> None:
    told = re.findall(r"\*\*Clause (\d+)\.\*\*", section("The contract of a frame"))
    assert told == [str(number) for number in range(1, 22)]


def test_the_version_and_capabilities_are_those_of_the_package() -> None:
    major, minor = m.PROTOCOL_VERSION
    assert TEXT.startswith(f"# The CAVIAR wire protocol, version {major}.{minor}\n")
    assert f"**({major}, {minor})**" in section("Versions")
    named = re.findall(r"^\| `(\w+)` \| 1\.", section("Versions"), re.MULTILINE)
    assert set(named) == set(m.CAPABILITIES)


def test_every_error_code_is_in_the_table() -> None:
    table = dict(re.findall(r"^\| `([a-z-]+)` \| (ERROR, REFUSE|ERROR|REFUSE) \|", TEXT, re.MULTILINE))
    for cls, kind in ((m.Error, "ERROR"), (m.Refuse, "REFUSE")):
        meaning = next(row[5] for row in spec.rows(cls) if row[0] == "code")
        told = set(re.findall(r"``([a-z-]+)``", meaning))
        assert told == {code for code, where in table.items() if kind in where}
    assert {error.code for error in (DecodeError, LimitError, VersionError)} <= set(table)


def test_the_digests_are_right() -> None:
    stated = re.findall(r"`([0-9a-f]{64})`", section("Digests"))
    vectors = SPEC.parent / "vectors"
    product = payload_digest(
        (vectors / "scene_one_object.msgpack").read_bytes(), (vectors / "scene_one_object.body").read_bytes()
    )
    mesh = m.Asset(name="objects/car.ply", digest=hashlib.sha256(b"abc").hexdigest(), size=3)
    run = RunDigest()
    run.add_frame(0, 7, [("scene", "traffic", product)])
    assert stated == [product, geometry_digest([mesh]), run.hexdigest()]


def test_links_lead_to_headings() -> None:
    headings = re.findall(r"^#+ (.+)$", TEXT, re.MULTILINE)
    anchors = {re.sub(r"[^\w -]", "", heading).lower().replace(" ", "-") for heading in headings}
    assert set(re.findall(r"\]\(#([^)]+)\)", TEXT)) <= anchors


# --- the minimal client ---------------------------------------------------------------------------


class Script:
    """A broker that follows a script."""

    def __init__(self, context: zmq.Context[Any]) -> None:
        self.socket = context.socket(zmq.ROUTER)
        self.socket.linger = 0
        self.port = self.socket.bind_to_random_port("tcp://127.0.0.1")
        self.beats: list[m.Message] = []
        self.route = b""

    def receive(self, kind: type[m.Message], timeout_s: float = 20.0) -> tuple[Any, list[bytes]]:
        """The next message, past heartbeats unless one is asked for; each is checked as a broker does."""
        while True:
            assert self.socket.poll(round(timeout_s * 1000)), f"no {kind.__name__} came"
            route, *parts = self.socket.recv_multipart()
            message = decode_message(parts[0])
            check_parts(message, parts)
            if isinstance(message, m.Attach | m.Heartbeat):
                self.beats.append(message)
                sequence = message.sequence if isinstance(message, m.Heartbeat) else 0
                self.socket.send_multipart([route, encode_message(m.HeartbeatAck(sequence=sequence))])
                if kind is m.Heartbeat and isinstance(message, kind):
                    return message, parts
                continue
            assert isinstance(message, kind), message
            self.route = route
            return message, parts

    def send(self, message: m.Message, *parts: bytes) -> None:
        """To the ordered connection."""
        self.socket.send_multipart([self.route, encode_message(message), *parts])


@pytest.fixture
def script() -> Iterator[Script]:
    with zmq.Context() as context:
        broker = Script(context)
        try:
            yield broker
        finally:
            broker.socket.close()


@pytest.fixture
def client(tmp_path: Path, script: Script) -> Iterator[subprocess.Popen[bytes]]:
    """The client of SPEC.md, word for word, as a process."""
    code = re.search(r"```python\n(.*?)```", section("A minimal client"), re.DOTALL)
    assert code is not None
    source = tmp_path / "client.py"
    source.write_text(code[1], "utf-8")
    process = subprocess.Popen([sys.executable, source, f"tcp://127.0.0.1:{script.port}", "mine"])
    try:
        yield process
    finally:
        process.kill()
        process.wait(10)


def scene() -> tuple[bytes, bytes]:
    """A scene with a base station and two receivers."""
    return encode_payload(
        Scene(
            names=(),
            classes=(),
            assets=(),
            position=np.zeros((0, 3)),
            orientation=np.zeros((0, 4)),
            velocity=np.zeros((0, 3)),
            dimensions=np.zeros((0, 3)),
            devices=(
                AntennaDevice(name="bs", role="tx"),
                AntennaDevice(name="car.1", role="rx"),
                AntennaDevice(name="car.2", role="rx"),
            ),
        )
    )


def test_the_minimal_client_lives_through_a_run(script: Script, client: subprocess.Popen[bytes]) -> None:
    hello, _ = script.receive(m.Hello)
    assert (hello.version, hello.name, hello.role) == ((1, 4), "mine", "agent")
    script.send(
        m.Welcome(version=(1, 0), run="r", epoch=3, attempt=2, heartbeat_ns=20_000_000, liveness_ns=10**9)
    )
    who = {"epoch": 3, "attempt": 2}
    script.send(m.Prepare(**who))
    ready, _ = script.receive(m.Ready)
    assert (ready.epoch, ready.attempt) == (3, 2)
    assert script.receive(m.Heartbeat)[0] == m.Heartbeat(sequence=0)
    assert script.beats[0] == m.Attach(**who, name="mine")
    script.send(m.Reset(**who, episode=1, seed=1, t0_ns=0))
    done, _ = script.receive(m.ResetDone)
    assert done == m.ResetDone(**who, episode=1)

    parts = scene()
    entry = m.GrantInput(
        topic="scene", source="world", status=m.Status.FRESH, frame=0, digest=payload_digest(*parts)
    )
    grant = m.Grant(**who, episode=1, frame=0, t_ns=0, inputs=(entry,))
    script.send(grant, *parts)
    report, first = script.receive(m.Done)
    assert (report.episode, report.frame) == (1, 0)
    assert report.products[0].digest == payload_digest(first[1], first[2])
    action = decode_payload("action", first[1], first[2])
    assert action == Action(
        commands=(
            BeamChoice(tx="bs", rx="car.1", tx_beam=0),
            BeamChoice(tx="bs", rx="car.2", tx_beam=0),
        )
    )
    assert encode_payload(action) == (first[1], first[2]), "the client's bytes are canonical"

    script.send(grant, *parts)
    assert script.receive(m.Done)[1] == first, "a repeated grant is answered with the stored DONE"
    script.send(m.Grant(**who, episode=1, frame=1, t_ns=1, final=True))
    assert script.receive(m.Done)[0] == m.Done(**who, episode=1, frame=1)
    script.send(m.EpisodeEnd(**who, episode=1, frames=1))
    script.send(m.Shutdown(reason="over"))
    assert script.receive(m.Bye)[0] == m.Bye(**who)
    assert client.wait(10) == 0


def test_the_minimal_client_exits_when_it_is_refused(script: Script, client: subprocess.Popen[bytes]) -> None:
    script.receive(m.Hello)
    script.send(m.Refuse(code="unknown-name", message="the run has no service 'mine'"))
    assert client.wait(10) == 1
