"""The real runner in a process of its own, and a raw ROUTER that plays the broker."""

from __future__ import annotations

import hashlib
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeVar

import msgspec
import pytest
import zmq

from caviar_protocol import messages as m
from caviar_protocol.codec import check_parts, decode_message, decode_payload, encode_message
from caviar_protocol.digest import geometry_digest, payload_digest
from caviar_protocol.limits import MAX_ASSET_CHUNK
from caviar_protocol.topics import Lidar

HERE = Path(__file__).parent
MS = 1_000_000
PATIENCE_S = 15.0
M = TypeVar("M", bound=m.Message)
IDS: dict[str, int] = {"epoch": 4, "attempt": 2}


class Broker:
    """A broker played by hand, for one service. Heartbeats are answered while it waits for something."""

    def __init__(self, port: int = 0) -> None:
        self.context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
        self.socket = self.context.socket(zmq.ROUTER)
        self.socket.linger = 0
        self.socket.bind(f"tcp://127.0.0.1:{port}")
        self.endpoint = self.socket.getsockopt_string(zmq.LAST_ENDPOINT)
        self.route = b""
        self.pulse = b""
        self.answering = True
        self.beats: list[m.Heartbeat] = []
        self.parts: list[bytes] = []

    def close(self) -> None:
        self.socket.close()
        self.context.term()

    def send(self, message: m.Message, *parts: bytes) -> None:
        self.socket.send_multipart([self.route, encode_message(message), *parts])

    def receive(self, within_s: float = PATIENCE_S) -> m.Message:
        until = time.monotonic() + within_s
        while True:
            left = until - time.monotonic()
            assert left > 0, f"nothing came within {within_s} s"
            if not self.socket.poll(left * 1000):
                continue
            route, *parts = self.socket.recv_multipart()
            message = decode_message(parts[0])
            check_parts(message, parts)
            if isinstance(message, m.Attach | m.Heartbeat):
                self._beat(route, message)
                continue
            self.route, self.parts = route, parts[1:]
            return message

    def _beat(self, route: bytes, message: m.Attach | m.Heartbeat) -> None:
        self.pulse = route
        sequence = 0
        if isinstance(message, m.Heartbeat):
            self.beats.append(message)
            sequence = message.sequence
        if self.answering:
            ack = encode_message(m.HeartbeatAck(sequence=sequence))
            self.socket.send_multipart([route, ack])

    def expect(self, cls: type[M], within_s: float = PATIENCE_S) -> M:
        message = self.receive(within_s)
        assert isinstance(message, cls), f"expected {cls.__name__}, got {message}"
        return message

    def until(self, condition: Callable[[], object], within_s: float = PATIENCE_S) -> None:
        """Answer heartbeats until a condition holds; nothing else may come."""
        until = time.monotonic() + within_s
        while not condition():
            assert time.monotonic() < until
            if self.socket.poll(20):
                route, header = self.socket.recv_multipart()
                message = decode_message(header)
                assert isinstance(message, m.Attach | m.Heartbeat), message
                self._beat(route, message)

    # --- the ordinary course -------------------------------------------------------------------------

    def welcome(self, **values: Any) -> m.Hello:
        hello = self.expect(m.Hello)
        told = {"heartbeat_ns": 50 * MS, "liveness_ns": 10_000 * MS, "run": "test", "seed": 9} | values
        self.send(m.Welcome(version=m.PROTOCOL_VERSION, **IDS, **told))
        return hello

    def prepare(self, assets: tuple[m.Asset, ...] = ()) -> None:
        demand = (m.Demand(topic="lidar"), m.Demand(topic="scene"))
        self.send(m.Prepare(**IDS, demand=demand, assets=assets))

    def start(self, **values: Any) -> None:
        """Up to the first grant."""
        self.welcome(**values)
        self.prepare()
        self.expect(m.Ready)
        self.reset()

    def reset(self, episode: int = 0) -> None:
        self.send(m.Reset(**IDS, episode=episode, seed=9, t0_ns=0))
        assert self.expect(m.ResetDone) == m.ResetDone(**IDS, episode=episode)

    def grant(self, frame: int, *, episode: int = 0, **ids: int) -> None:
        header, body = b"\x80", b""
        entry = m.GrantInput(
            topic="scene",
            source="world",
            status=m.Status.FRESH,
            frame=frame,
            digest=payload_digest(header, body),
        )
        grant = m.Grant(**(IDS | ids), episode=episode, frame=frame, t_ns=frame, inputs=(entry,))
        self.send(grant, header, body)

    def shutdown(self) -> None:
        self.send(m.Shutdown(reason="enough"))
        assert self.expect(m.Bye).reason == "enough"


@pytest.fixture
def broker() -> Iterator[Broker]:
    played = Broker()
    yield played
    played.close()


@contextmanager
def service(
    endpoint: str, use: str = "sensors:Sensors", *arguments: str, cache: Path | None = None
) -> Iterator[subprocess.Popen[str]]:
    """A service in a process of its own: ``role:Class`` of `runner_services`."""
    role, _, name = use.partition(":")
    command = [sys.executable, "-m", "caviar_services", "sick", "--broker", endpoint, *arguments]
    command += ["--use", f"{role}:runner_services:{name}"]
    environment = os.environ | {"PYTHONPATH": str(HERE)}
    if cache is not None:
        environment["XDG_CACHE_HOME"] = str(cache)
    process = subprocess.Popen(
        command, env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    with process:
        try:
            yield process
        finally:
            process.kill()


def ends(process: subprocess.Popen[str], status: int, within_s: float = PATIENCE_S) -> str:
    """What the process says until it ends, with that status, in time."""
    output, errors = process.communicate(timeout=within_s)
    assert process.returncode == status, errors
    return output + errors


def hears(process: subprocess.Popen[str], word: str) -> None:
    assert process.stdout is not None
    assert process.stdout.readline() == f"{word}\n"


# --- the ordinary course ------------------------------------------------------------------------------------


def test_a_service_joins_prepares_steps_and_leaves(broker: Broker) -> None:
    with service(broker.endpoint) as process:
        hello = broker.welcome()
        assert (hello.version, hello.name, hello.role) == ((1, 0), "sick", "sensors")
        assert (hello.inputs, hello.outputs) == ((m.Input(topic="scene"),), ("lidar",))
        assert hello.pid == process.pid
        assert hello.host
        broker.prepare()
        assert broker.expect(m.Ready) == m.Ready(**IDS)
        broker.reset()
        for frame in range(3):
            broker.grant(frame)
            done = broker.expect(m.Done)
            assert (done.epoch, done.attempt, done.episode, done.frame) == (4, 2, 0, frame)
            (header,) = done.products
            assert header.digest == payload_digest(*broker.parts)
            lidar = decode_payload("lidar", *broker.parts)
            assert isinstance(lidar, Lidar)
            assert lidar.scans[0].points[0, 0] == frame + 1
            assert done.decisions == {"rung": "fast"}
            assert done.counts == {"steps": frame + 1}
        broker.send(m.EpisodeEnd(**IDS, episode=0, frames=3))
        broker.shutdown()
        assert "closed" in ends(process, 0)


def test_measured_times_stand_beside_the_products_and_never_in_them(broker: Broker) -> None:
    """Two lives of one service: what was measured differs, the products do not (clauses 6 and 20)."""
    products, measured = set(), set()
    for _ in range(2):
        with service(broker.endpoint) as process:
            broker.start()
            broker.grant(0)
            done = broker.expect(m.Done)
            assert set(done.measured) == {"step", "encode", "scan"}
            measured.add(done.measured["scan"])
            products.add((done.products, *broker.parts))
            broker.shutdown()
            ends(process, 0)
    assert (len(products), len(measured)) == (1, 2)


def test_heartbeats_come_as_often_as_told_with_phase_and_progress(broker: Broker) -> None:
    with service(broker.endpoint):
        broker.start(heartbeat_ns=100 * MS)
        broker.grant(7)
        broker.expect(m.Done)
        first = len(broker.beats)
        started = time.monotonic()
        broker.until(lambda: len(broker.beats) >= first + 10)
        elapsed = time.monotonic() - started
        assert 0.85 < elapsed < 1.6
        last = broker.beats[-1]
        assert last.phase == "frame 7"
        assert last.progress == 2
        sequences = [beat.sequence for beat in broker.beats]
        assert sequences == list(range(len(sequences)))


def test_a_second_episode_begins_anew(broker: Broker) -> None:
    with service(broker.endpoint):
        broker.start()
        broker.grant(0)
        first = broker.expect(m.Done)
        broker.send(m.EpisodeEnd(**IDS, episode=0, frames=1))
        broker.reset(episode=1)
        broker.grant(0, episode=1)
        second = broker.expect(m.Done)
        assert (first.counts["steps"], second.counts["steps"]) == (1, 2)


# --- what comes twice, or out of turn -----------------------------------------------------------------------


def test_a_repeated_grant_is_answered_with_the_stored_done_byte_for_byte(broker: Broker) -> None:
    with service(broker.endpoint):
        broker.start()
        answers: dict[int, list[tuple[m.Message, list[bytes]]]] = {0: [], 1: []}
        for frame in (0, 1, 1, 0, 1):
            broker.grant(frame)
            answers[frame].append((broker.expect(m.Done), broker.parts))
        for found in answers.values():
            assert all(answer == found[0] for answer in found)
        assert [found[0][0].counts for found in answers.values()] == [{"steps": 1}, {"steps": 2}]  # type: ignore[union-attr]


def test_a_repeated_grant_that_failed_fails_alike_without_a_step(broker: Broker) -> None:
    with service(broker.endpoint):
        broker.start(settings={"wrong": "step"})
        broker.grant(0)
        fault = broker.expect(m.Fault)
        broker.grant(0)
        assert broker.expect(m.Fault) == fault


def test_what_is_not_due_is_unexpected_and_not_used(broker: Broker) -> None:
    with service(broker.endpoint):
        broker.start()
        broker.grant(0, episode=1)
        assert "no RESET to episode 1" in broker.expect(m.Error).message
        broker.grant(0, attempt=1)
        assert "this is attempt 2 in epoch 4" in broker.expect(m.Error).message
        broker.grant(0, epoch=3)
        assert broker.expect(m.Error).code == "unexpected"
        broker.send(m.Done(**IDS, episode=0, frame=0))
        error = broker.expect(m.Error)
        assert (error.code, error.of) == ("unexpected", "DONE")
        broker.send(m.Cancel(**IDS, episode=0, frame=5))
        broker.send(m.Stale(of="DONE", **IDS, episode=0, frame=-1))
        broker.send(m.Error(code="unexpected", message="what was that?"))
        broker.grant(0)
        assert broker.expect(m.Done).counts == {"steps": 1}


def test_noise_from_the_broker_is_answered_and_borne(broker: Broker) -> None:
    with service(broker.endpoint):
        broker.start()
        for parts in ([b""], [b"\xff\xff"], [encode_message(m.Shutdown(reason="x")), b"more"]):
            broker.socket.send_multipart([broker.route, *parts])
            assert broker.expect(m.Error).code == "malformed"
        broker.grant(0)
        broker.expect(m.Done)


# --- faults -------------------------------------------------------------------------------------------------

FAULTS = {
    "prepare": ("prepare", "ZeroDivisionError: nothing to divide in prepare"),
    "reset": ("reset", "ZeroDivisionError: nothing to divide in reset"),
    "step": ("step", "ZeroDivisionError: nothing to divide in step"),
    "told by name": ("step", "town.toml:7: devices.0: the mast is 3 m too low"),
    "non-finite": ("encode", "scans[0].points[0, 0] is nan"),
    "wrong type": ("encode", "a payload Action for the topic 'lidar'"),
}


@pytest.mark.parametrize(("wrong", "phase", "words"), [(w, *f) for w, f in FAULTS.items()], ids=FAULTS)
def test_a_failure_becomes_a_fault_with_phase_and_text(
    broker: Broker, wrong: str, phase: str, words: str
) -> None:
    with service(broker.endpoint) as process:
        broker.welcome(settings={"wrong": wrong})
        broker.prepare()
        if wrong != "prepare":
            broker.expect(m.Ready)
            broker.send(m.Reset(**IDS, episode=0, seed=9, t0_ns=0))
        if wrong not in ("prepare", "reset"):
            broker.expect(m.ResetDone)
            broker.grant(3)
        fault = broker.expect(m.Fault)
        assert fault.phase == phase
        assert words in fault.message
        assert fault.frame == (3 if phase in ("step", "encode") else -1)
        assert ("Traceback" in fault.detail) == ("ZeroDivision" in words)
        broker.shutdown()
        ends(process, 0)


def test_a_setting_that_does_not_exist_is_a_fault(broker: Broker) -> None:
    with service(broker.endpoint):
        broker.welcome(settings={"wrogn": "x"})
        fault = broker.expect(m.Fault)
        assert fault.phase == "settings"
        assert "wrogn" in fault.message


def test_a_service_that_cannot_be_made_is_a_fault_and_leaves_when_told(broker: Broker) -> None:
    with service(broker.endpoint, "sensors:Environment") as process:
        broker.welcome()
        assert "OSError: no GPU in" in broker.expect(m.Fault).message
        broker.shutdown()
        ends(process, 0)


def test_an_input_that_cannot_be_decoded_is_a_fault(broker: Broker) -> None:
    with service(broker.endpoint, "link:Reader") as process:
        broker.start()
        entry = m.GrantInput(topic="scene", source="world", status=m.Status.FRESH, frame=0, digest="0" * 64)
        broker.send(m.Grant(**IDS, episode=0, frame=0, t_ns=0, inputs=(entry,)), b"\xff", b"")
        fault = broker.expect(m.Fault)
        assert fault.phase == "step"
        assert "scene payload" in fault.message
        broker.shutdown()
        ends(process, 0)


def test_a_process_that_ends_itself_ends_with_that_status(broker: Broker) -> None:
    with service(broker.endpoint, "sensors:Leaves") as process:
        broker.start()
        broker.grant(0)
        assert "the simulator has quit" in ends(process, 1)


# --- the broker: absent, late, refusing, gone ---------------------------------------------------------------


def test_without_a_broker_it_waits_as_long_as_told_and_says_where(broker: Broker) -> None:
    endpoint = broker.endpoint
    broker.socket.unbind(endpoint)
    started = time.monotonic()
    with service(endpoint, "sensors:Sensors", "--connect-timeout", "0.5") as process:
        said = ends(process, 1)
    assert f"no answer from a broker at {endpoint} within 0.5 s; is `caviar broker` running there?" in said
    assert "Traceback" not in said
    assert time.monotonic() - started > 0.5


def test_a_broker_that_starts_later_is_found(broker: Broker) -> None:
    endpoint = broker.endpoint
    broker.socket.unbind(endpoint)
    with service(endpoint, "sensors:SlowStart") as process:
        hears(process, "loaded")  # by now it is about to connect
        with pytest.raises(AssertionError, match="nothing came"):
            broker.receive(within_s=0.5)
        broker.socket.bind(endpoint)
        broker.start()
        broker.shutdown()
        ends(process, 0)


def test_an_address_that_is_none_is_named() -> None:
    with service("tpc:/nowhere") as process:
        said = ends(process, 1)
    assert "cannot connect to 'tpc:/nowhere'" in said
    assert "Traceback" not in said


def test_a_refusal_ends_it_with_the_reason(broker: Broker) -> None:
    with service(broker.endpoint) as process:
        broker.expect(m.Hello)
        broker.send(m.Refuse(code="name-taken", message="a service named 'sick' takes part already"))
        said = ends(process, 1)
    assert "(name-taken): a service named 'sick' takes part already" in said
    assert "Traceback" not in said


def test_a_refusal_at_ready_ends_it_with_the_reason(broker: Broker) -> None:
    """As where its actuators clash with those of another agent."""
    with service(broker.endpoint) as process:
        broker.welcome()
        broker.prepare()
        broker.send(m.Refuse(code="clash", message="agents 'a' and 'b' own the same"))
        said = ends(process, 1)
    assert "(clash): agents 'a' and 'b' own the same" in said


def test_a_broker_of_another_major_version_is_left_naming_both(broker: Broker) -> None:
    with service(broker.endpoint) as process:
        broker.expect(m.Hello)
        welcome = m.Welcome(version=(3, 1), run="x", **IDS, heartbeat_ns=1, liveness_ns=1)
        broker.send(welcome)
        said = ends(process, 1)
    assert "3.1" in said
    assert "1.0" in said


def test_a_run_that_is_over_before_it_began_ends_it(broker: Broker) -> None:
    with service(broker.endpoint) as process:
        broker.expect(m.Hello)
        broker.send(m.Shutdown(reason="the world did not come"))
        assert "the run ended before 'sick' was in it: the world did not come" in ends(process, 1)


def test_a_broker_that_does_not_know_it_any_more_ends_it(broker: Broker) -> None:
    with service(broker.endpoint) as process:
        broker.start()
        broker.send(m.Error(code="unknown-peer", of="DONE", message="DONE came before HELLO"))
        assert "does not know 'sick' any more" in ends(process, 1)


def test_a_service_ends_when_its_broker_dies(broker: Broker) -> None:
    with service(broker.endpoint) as process:
        broker.start(heartbeat_ns=100 * MS, liveness_ns=1000 * MS)
        broker.socket.unbind(broker.endpoint)
        started = time.monotonic()
        said = ends(process, 1)
        elapsed = time.monotonic() - started
    sys.stdout.write(f"the death of the broker was noticed after {elapsed:.2f} s with a liveness of 1 s\n")
    assert "has been silent for 1." in said
    assert "closed" in said
    assert "Traceback" not in said
    assert 0.9 < elapsed < 2.0


def test_a_service_that_is_stuck_ends_too_when_its_broker_dies(broker: Broker) -> None:
    with service(broker.endpoint, "sensors:SleepsInC") as process:
        broker.start(heartbeat_ns=100 * MS, liveness_ns=1000 * MS)
        broker.grant(0)
        hears(process, "stuck")
        started = time.monotonic()
        said = ends(process, 1)
        assert "has been silent" in said
        assert time.monotonic() - started < 1.0 + 1.0 + 0.7


def test_a_service_that_held_the_interpreter_does_not_take_its_broker_for_dead(broker: Broker) -> None:
    """Answers waited in the socket while nobody could look (clause 15, the other way round)."""
    with service(broker.endpoint, "sensors:HoldsTheInterpreter") as process:
        broker.start(heartbeat_ns=50 * MS, liveness_ns=400 * MS)
        for frame in range(3):
            broker.grant(frame)
            hears(process, "stuck")
            broker.expect(m.Done)
        broker.shutdown()
        ends(process, 0)


# --- SIGTERM ------------------------------------------------------------------------------------------------


def terminated(process: subprocess.Popen[str], number: int = signal.SIGTERM) -> str:
    """What it says until it has ended, within 2 s."""
    started = time.monotonic()
    process.send_signal(number)
    said = ends(process, 143, within_s=5.0)
    elapsed = time.monotonic() - started
    sys.stdout.write(f"ended {elapsed:.2f} s after the signal\n")
    assert elapsed < 2.0
    return said


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_signal_between_frames_ends_it_with_bye(broker: Broker, number: signal.Signals) -> None:
    with service(broker.endpoint) as process:
        broker.start()
        process.send_signal(number)
        assert broker.expect(m.Bye).reason == "SIGTERM"
        assert "closed" in ends(process, 143, within_s=2.0)


def test_sigterm_while_it_waits_for_a_broker_ends_it(broker: Broker) -> None:
    with service(broker.endpoint) as process:
        broker.expect(m.Hello)  # and no WELCOME
        terminated(process)


@pytest.mark.parametrize("name", ["WaitsForever", "SleepsInC", "ComputesInC", "HoldsTheInterpreter"])
def test_sigterm_ends_a_service_that_is_stuck_in_a_frame(broker: Broker, name: str) -> None:
    with service(broker.endpoint, f"sensors:{name}") as process:
        broker.start()
        broker.grant(0)
        hears(process, "stuck")
        terminated(process)


def test_sigterm_ends_a_service_that_is_stuck_in_prepare(broker: Broker) -> None:
    with service(broker.endpoint, "sensors:SleepsInC") as process:
        broker.welcome(settings={"wrong": "prepare"})
        broker.prepare()
        hears(process, "stuck")
        assert "in the middle of a call that does not return" in terminated(process)


def test_sigterm_ends_a_service_that_hangs_when_it_closes(broker: Broker) -> None:
    with service(broker.endpoint, "sensors:IgnoresClosing") as process:
        broker.start()
        terminated(process)


# --- scenery ------------------------------------------------------------------------------------------------


def manifest(files: dict[str, bytes]) -> tuple[m.Asset, ...]:
    return tuple(
        m.Asset(name=name, digest=hashlib.sha256(content).hexdigest(), size=len(content))
        for name, content in files.items()
    )


def deliver(broker: Broker, contents: Sequence[bytes], first: m.Message | None = None) -> m.Message:
    """Answer ASSET_GETs until something else comes."""
    by_digest = {hashlib.sha256(content).hexdigest(): content for content in contents}
    message = first or broker.receive()
    while isinstance(message, m.AssetGet):
        content = by_digest[message.digest]
        chunk = content[message.offset : message.offset + MAX_ASSET_CHUNK]
        data = m.AssetData(digest=message.digest, offset=message.offset, size=len(content))
        broker.send(data, chunk)
        message = broker.receive()
    return message


def test_scenery_is_fetched_chunk_by_chunk_and_only_once(broker: Broker, tmp_path: Path) -> None:
    files = {"a.ply": os.urandom(MAX_ASSET_CHUNK + 3), "scenery/empty": b""}
    for fetches in (True, False):
        with service(broker.endpoint, cache=tmp_path) as process:
            broker.welcome()
            broker.prepare(manifest(files))
            first = broker.receive()
            assert isinstance(first, m.AssetGet) == fetches
            ready = deliver(broker, list(files.values()), first)
            assert isinstance(ready, m.Ready)
            assert ready.geometry == geometry_digest(manifest(files))
            assert ready.notes == (f"a.ply={files['a.ply'][:20]!r}", "scenery/empty=b''")
            broker.shutdown()
            ends(process, 0)


def test_a_truncated_file_in_the_cache_is_fetched_again(broker: Broker, tmp_path: Path) -> None:
    files = {"a.ply": b"plaza"}
    (asset,) = manifest(files)
    folder = tmp_path / "caviar" / "assets"
    folder.mkdir(parents=True)
    (folder / asset.digest).write_bytes(b"pla")
    with service(broker.endpoint, cache=tmp_path):
        broker.welcome()
        broker.prepare((asset,))
        ready = deliver(broker, [b"plaza"])
        assert isinstance(ready, m.Ready)
        assert ready.notes == ("a.ply=b'plaza'",)


BAD_DATA = {
    "digest": ({}, b"plazA", "announced was"),
    "offset": ({"offset": 1}, b"laza", "expected them at 0"),
    "nothing": ({}, b"", "got 0 B"),
}


@pytest.mark.parametrize(("change", "chunk", "words"), BAD_DATA.values(), ids=BAD_DATA)
def test_wrong_scenery_is_a_fault(
    broker: Broker, tmp_path: Path, change: dict[str, int], chunk: bytes, words: str
) -> None:
    (asset,) = manifest({"a.ply": b"plaza"})
    with service(broker.endpoint, cache=tmp_path):
        broker.welcome()
        broker.prepare((asset,))
        broker.expect(m.AssetGet)
        data = m.AssetData(digest=asset.digest, offset=0, size=5)
        broker.send(msgspec.structs.replace(data, **change), chunk)
        fault = broker.expect(m.Fault)
        assert fault.phase == "prepare"
        assert "'a.ply'" in fault.message
        assert words in fault.message


def test_scenery_that_the_broker_does_not_have_is_a_fault(broker: Broker, tmp_path: Path) -> None:
    (asset,) = manifest({"a.ply": b"plaza"})
    with service(broker.endpoint, cache=tmp_path):
        broker.welcome()
        broker.prepare((asset,))
        get = broker.expect(m.AssetGet)
        broker.send(m.Error(code="unknown-asset", of="ASSET_GET", subject=get.digest, message="not here"))
        assert "cannot deliver asset 'a.ply': not here" in broker.expect(m.Fault).message


def test_scenery_that_never_comes_is_a_fault_in_time(broker: Broker, tmp_path: Path) -> None:
    (asset,) = manifest({"a.ply": b"plaza"})
    with service(broker.endpoint, "sensors:Sensors", "--connect-timeout", "3", cache=tmp_path):
        broker.welcome()
        broker.prepare((asset,))
        broker.expect(m.AssetGet)
        started = time.monotonic()
        assert broker.expect(m.Fault).phase == "prepare"
        assert 2.5 < time.monotonic() - started < 5.0


def test_shutdown_while_scenery_is_fetched_is_obeyed(broker: Broker, tmp_path: Path) -> None:
    with service(broker.endpoint, cache=tmp_path) as process:
        broker.welcome()
        broker.prepare(manifest({"a.ply": b"plaza"}))
        broker.expect(m.AssetGet)
        broker.shutdown()
        ends(process, 0)


def test_a_world_offers_its_scenery_and_serves_it(broker: Broker, tmp_path: Path) -> None:
    with service(broker.endpoint, "world:World", cache=tmp_path) as process:
        broker.welcome()
        broker.prepare()
        offer = broker.expect(m.AssetOffer)
        assert offer.assets == manifest({"empty": b"", "scenery/town.xml": b"<scene/>"})
        ready = broker.expect(m.Ready)
        assert ready.geometry == geometry_digest(offer.assets)
        assert (ready.prefixes, ready.notes) == (("town/",), ("empty", "scenery/town.xml"))
        for asset, content in zip(offer.assets, (b"", b"<scene/>"), strict=True):
            broker.send(m.AssetGet(digest=asset.digest))
            data = broker.expect(m.AssetData)
            assert (data.digest, data.offset, data.size) == (asset.digest, 0, len(content))
            assert broker.parts == [content]
        broker.send(m.AssetGet(digest="0" * 64))
        error = broker.expect(m.Error)
        assert (error.code, error.subject) == ("unknown-asset", "0" * 64)
        broker.shutdown()
        ends(process, 0)


def test_a_world_whose_names_lead_out_of_the_folder_is_a_fault(broker: Broker, tmp_path: Path) -> None:
    with service(broker.endpoint, "world:World", cache=tmp_path):
        broker.welcome(settings={"wrong": "name"})
        broker.prepare()
        assert "'../escape.ply' is not a relative path" in broker.expect(m.Fault).message
        assert not (tmp_path / "caviar" / "escape.ply").exists()
