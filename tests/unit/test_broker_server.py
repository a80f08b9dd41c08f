"""The broker's port: who is let in, who is turned away, and what wrong messages lead to."""

from __future__ import annotations

import threading
from dataclasses import replace
from pathlib import Path
from typing import Any

import msgspec
import pytest
import zmq
from broker_harness import (
    MS,
    PAIR,
    Client,
    eventually,
    finishes_well,
    plan,
    play_to_the_end,
    playing,
    serving,
)

from caviar_broker.core.plan import ServicePlan
from caviar_broker.server import MESSAGES_A_TURN
from caviar_protocol import messages as m
from caviar_protocol.codec import decode_message, encode_message
from caviar_protocol.digest import RunDigest, payload_digest

pytestmark = pytest.mark.slow

# --- the ordinary course -------------------------------------------------------------------------------


def test_products_reach_their_consumers_byte_for_byte_with_their_provenance(tmp_path: Path) -> None:
    with serving(plan(*PAIR), tmp_path) as broker, playing(broker.endpoint, *PAIR) as (world, sensors):
        digest = RunDigest()
        for frame in range(3):
            header, body = bytes([0x80]), bytes(range(frame, frame + 200))
            world.done(world.expect(m.Grant), ("scene", header, body))
            grant = sensors.expect(m.Grant)
            assert sensors.parts == [header, body]
            (entry,) = grant.inputs
            expected = payload_digest(header, body)
            assert (entry.topic, entry.source, entry.status) == ("scene", "world", m.Status.FRESH)
            assert (entry.frame, entry.t_ns, entry.digest) == (frame, frame * 100 * MS, expected)
            assert (grant.t_ns, grant.previous_frame) == (frame * 100 * MS, frame - 1)
            sensors.done(grant, ("lidar", b"\x80", b"points"))
            lidar = ("lidar", "sensors", payload_digest(b"\x80", b"points"))
            digest.add_frame(0, frame, [("scene", "world", expected), lidar])
        assert [c.expect(m.EpisodeEnd).frames for c in (world, sensors)] == [3, 3]
        world.bye()
        sensors.bye()
        assert broker.outcome().digest == digest.hexdigest()
        assert finishes_well(broker)


def test_shutdown_does_not_wait_for_a_service_that_never_says_bye(tmp_path: Path) -> None:
    with serving(plan(*PAIR), tmp_path) as broker, playing(broker.endpoint, *PAIR) as clients:
        for _ in range(3):
            for client in clients:
                client.answer()
        for client in clients:
            client.expect(m.EpisodeEnd)
            client.expect(m.Shutdown)
        assert broker.outcome(within_s=5.0).error == ""
        assert "did not say BYE in time" in broker.witness.texts("world")


def test_latencies_are_kept_for_every_frame_and_service(tmp_path: Path) -> None:
    import numpy as np

    with serving(plan(*PAIR, frames=5), tmp_path) as broker, playing(broker.endpoint, *PAIR) as clients:
        play_to_the_end(clients, 5)
        assert finishes_well(broker)
    broker.server.statistics.save(tmp_path / "latency.npz")
    with np.load(tmp_path / "latency.npz") as figures:
        assert set(figures) == {
            "finished_ns",
            "latency_ns/world",
            "latency_ns/sensors",
            "answers/world",
            "answers/sensors",
            "decision_lateness_ns",
        }
        assert len(figures["decision_lateness_ns"]) == 0
        assert all(len(figures[f"latency_ns/{name}"]) == 5 for name in ("world", "sensors"))
        assert (np.diff(figures["finished_ns"]) > 0).all()
        p50 = float(np.percentile(figures["latency_ns/world"], 50)) / 1e6
    assert broker.server.statistics.services()["world"].p50_ms == pytest.approx(p50)


# --- HELLO ------------------------------------------------------------------------------------------------


def test_a_second_service_of_the_same_name_is_refused_and_the_first_is_not_disturbed(tmp_path: Path) -> None:
    with serving(plan(*PAIR), tmp_path) as broker, playing(broker.endpoint, *PAIR) as clients:
        with Client(broker.endpoint, "sensors") as intruder:
            intruder.send(intruder.hello)
            refusal = intruder.expect(m.Refuse)
            assert refusal.code == "name-taken"
            assert "'sensors'" in refusal.message
        play_to_the_end(clients, 3)
        assert finishes_well(broker)


def test_hello_said_again_by_a_member_is_out_of_place_and_changes_nothing(tmp_path: Path) -> None:
    with serving(plan(*PAIR), tmp_path) as broker, playing(broker.endpoint, *PAIR) as clients:
        clients[1].send(clients[1].hello)
        assert clients[1].expect(m.Error).code == "unexpected"
        play_to_the_end(clients, 3)
        assert finishes_well(broker)


def test_a_service_of_another_major_version_is_refused_naming_both_and_ends_the_run(tmp_path: Path) -> None:
    with serving(plan(*PAIR), tmp_path) as broker, Client(broker.endpoint, "world") as client:
        client.send(msgspec.structs.replace(client.hello, version=(2, 0)))
        refusal = client.expect(m.Refuse)
        assert refusal.code == "version"
        assert "2.0" in refusal.message
        assert "speaks {}.{}:".format(*m.PROTOCOL_VERSION) in refusal.message
        outcome = broker.outcome()
        assert outcome.culprit == "world"
        assert "2.0" in outcome.error


def test_a_hello_of_another_major_version_that_cannot_be_read_is_refused_too(tmp_path: Path) -> None:
    with serving(plan(*PAIR), tmp_path) as broker, Client(broker.endpoint, "world") as stranger:
        future = {"type": "HELLO", "version": [7, 1], "name": {"first": "world"}}
        stranger.socket.send(msgspec.msgpack.encode(future))
        refusal = stranger.expect(m.Refuse)
        assert refusal.code == "version"
        assert "7.1" in refusal.message
        with playing(broker.endpoint, *PAIR) as clients:
            play_to_the_end(clients, 3)
            assert finishes_well(broker)


def test_any_minor_version_is_accepted_with_fields_that_nobody_knows(tmp_path: Path) -> None:
    with serving(plan("world", "sensors"), tmp_path) as broker, Client(broker.endpoint, "world") as client:
        fields = msgspec.msgpack.decode(encode_message(client.hello))
        client.socket.send(msgspec.msgpack.encode(fields | {"version": [1, 99], "colour": "blue"}))
        assert client.expect(m.Welcome).version == m.PROTOCOL_VERSION


def test_a_name_that_the_run_does_not_have_is_refused_with_the_nearest(tmp_path: Path) -> None:
    with serving(plan(*PAIR), tmp_path) as broker, Client(broker.endpoint, "sensor", "sensors") as client:
        client.send(client.hello)
        refusal = client.expect(m.Refuse)
        assert refusal.code == "unknown-name"
        assert "did you mean 'sensors'?" in refusal.message


def test_a_socket_with_a_routing_id_of_its_own_is_refused_with_the_remedy(tmp_path: Path) -> None:
    """Also one that looks like ROUTER's, as it is not set by mistake, and on the heartbeat connection."""
    with serving(plan(*PAIR), tmp_path) as broker, playing(broker.endpoint, *PAIR) as (world, sensors):
        for own in (b"world", b"\0own", b"\0chosen"):
            with Client(broker.endpoint, "world", routing_id=own) as again:
                again.send(again.hello)
                refusal = again.expect(m.Refuse)
                assert refusal.code == "declaration"
                assert "leave ZMQ_ROUTING_ID unset" in refusal.message
                again.send(m.Attach(**world.ids, name="world"))
                assert again.expect(m.Refuse).message.startswith("ATTACH of 'world'")
        assert "routing id of its own" in broker.witness.texts()
        play_to_the_end([world, sensors], 3)
        assert finishes_well(broker)


def test_an_absurd_process_id_is_a_death_and_no_crash(tmp_path: Path) -> None:
    from caviar_protocol.host import host_identity

    with (
        serving(plan(*PAIR), tmp_path) as broker,
        Client(broker.endpoint, "world", host=host_identity(), pid=2**62) as client,
    ):
        client.send(client.hello)
        assert f"no process {2**62}" in broker.outcome().error


# --- noise ------------------------------------------------------------------------------------------------

GARBAGE: dict[str, list[bytes]] = {
    "nothing": [b""],
    "noise": [b"\xff\x00\xff"],
    "unknown type": [msgspec.msgpack.encode({"type": "GREET"})],
    "not a map": [msgspec.msgpack.encode([1, 2])],
    "too many parts": [encode_message(m.Heartbeat(sequence=0)), b"more"],
    "nested": [b"\x91" * 5000],
    "lying length": [b"\xdf\xff\xff\xff\xff"],
}


def test_noise_of_strangers_is_answered_and_harms_nobody(tmp_path: Path) -> None:
    with serving(plan(*PAIR), tmp_path) as broker, playing(broker.endpoint, *PAIR) as clients:
        with Client(broker.endpoint, "world") as stranger:
            for parts in GARBAGE.values():
                stranger.socket.send_multipart(parts)
                assert stranger.expect(m.Error).code in ("malformed", "limit")
        play_to_the_end(clients, 3)
        assert finishes_well(broker)
        shown = [notice.text for notice in broker.witness.notices if notice.kind == "refused"]
        assert any("a connection from 127.0.0.1 sent what is not in the protocol" in text for text in shown)


@pytest.mark.parametrize("parts", GARBAGE.values(), ids=GARBAGE)
def test_noise_of_a_member_ends_the_run_with_blame(tmp_path: Path, parts: list[bytes]) -> None:
    with serving(plan(*PAIR), tmp_path) as broker, playing(broker.endpoint, *PAIR) as (world, sensors):
        world.expect(m.Grant)
        world.socket.send_multipart(parts)
        assert world.expect(m.Error).code in ("malformed", "limit")
        outcome = broker.outcome()
        assert outcome.culprit == "world"
        assert "world 'world' sent what is not in the protocol" in outcome.error
        sensors.expect(m.Shutdown)


def test_a_flood_neither_holds_up_a_deadline_nor_fills_the_log(tmp_path: Path) -> None:
    """One stranger sends as fast as it can and never reads; a service stalls meanwhile."""
    enough = threading.Event()

    def flood(endpoint: str) -> None:
        context: zmq.Context[Any] = zmq.Context()
        with context.socket(zmq.DEALER) as socket:
            socket.linger, socket.sndtimeo, socket.rcvhwm = 0, 100, 1
            socket.connect(endpoint)
            while not enough.is_set():
                try:
                    socket.send(b"\xffnoise")
                except zmq.Again:
                    continue
        context.term()

    run = plan(*PAIR, limits={"stall": 500 * MS})
    with serving(run, tmp_path) as broker, playing(broker.endpoint, *PAIR) as (world, _):
        thread = threading.Thread(target=flood, args=(broker.endpoint,))
        thread.start()
        try:
            world.expect(m.Grant)  # and is never answered
            outcome = broker.outcome(within_s=5.0)
        finally:
            enough.set()
            thread.join()
        assert outcome.culprit == "world"
        assert "makes no progress" in outcome.error
        assert len(broker.witness.notices) < 20


# --- messages in the wrong place ------------------------------------------------------------------------


def test_what_comes_before_hello_is_answered_and_not_used(tmp_path: Path) -> None:
    with serving(plan(*PAIR), tmp_path) as broker, Client(broker.endpoint, "world") as stranger:
        for message in (
            m.Done(epoch=1, attempt=1, episode=0, frame=0),
            m.Bye(epoch=1, attempt=1),
            m.Heartbeat(sequence=0),
            m.AssetGet(digest="0" * 64),
        ):
            stranger.send(message)
            error = stranger.expect(m.Error)
            assert (error.code, error.of) == ("unknown-peer", str(type(message).__struct_config__.tag))


def test_attach_needs_a_living_member_with_its_epoch_and_attempt(tmp_path: Path) -> None:
    with serving(plan(*PAIR), tmp_path) as broker, Client(broker.endpoint, "world") as world:
        with Client(broker.endpoint, "sensors") as stranger:
            stranger.send(m.Attach(epoch=1, attempt=1, name="world"))
            assert stranger.expect(m.Error).code == "unknown-peer"
            world.join()
            for epoch, attempt in ((2, 1), (1, 2)):
                stranger.send(m.Attach(epoch=epoch, attempt=attempt, name="world"))
                assert stranger.expect(m.Error).code == "unknown-peer"
        world.send(m.Attach(**world.ids, name="world"))  # on its ordered connection
        assert world.expect(m.Error).code == "unexpected"


def test_each_connection_carries_only_what_belongs_on_it(tmp_path: Path) -> None:
    with serving(plan(*PAIR), tmp_path) as broker, playing(broker.endpoint, *PAIR) as clients:
        world = clients[0]
        pulse = world.attach()
        pulse.send(encode_message(m.Done(**world.ids, episode=0, frame=0)))
        assert pulse.poll(5000)
        error = decode_message(pulse.recv())
        assert isinstance(error, m.Error)
        assert (error.code, error.of) == ("unexpected", "DONE")
        pulse.send(encode_message(m.Heartbeat(sequence=5, progress=3, phase="thinking")))
        assert pulse.poll(5000)
        assert decode_message(pulse.recv()) == m.HeartbeatAck(sequence=5)
        grant = world.expect(m.Grant)
        for message in (m.Heartbeat(sequence=6), m.Cancel(**world.ids, episode=0, frame=0)):
            world.send(message)
            assert world.expect(m.Error).code == "unexpected"
        world.done(grant, ("scene", b"\x80", b""))
        clients[1].answer()
        play_to_the_end(clients, 2)
        assert finishes_well(broker)


@pytest.mark.parametrize("wrong", [{"attempt": 2}, {"epoch": 2}, {"episode": 1}, {"frame": 1}])
def test_done_of_another_incarnation_or_frame_is_stale_and_not_used(
    tmp_path: Path, wrong: dict[str, int]
) -> None:
    with serving(plan(*PAIR), tmp_path) as broker, playing(broker.endpoint, *PAIR) as (world, sensors):
        grant = world.expect(m.Grant)
        world.done(grant, ("scene", b"\x80", b"wrong"), **wrong)
        stale = world.expect(m.Stale)
        assert (stale.of, stale.frame, stale.attempt) == ("DONE", 0, 1)
        assert sensors.quiet()
        world.done(grant, ("scene", b"\x80", b"right"))
        sensors.expect(m.Grant)
        assert sensors.parts == [b"\x80", b"right"]
        world.done(grant, ("scene", b"\x80", b"again"))
        assert {type(world.receive()), type(world.receive())} == {m.Grant, m.Stale}


def test_a_topic_that_was_not_declared_ends_the_run_with_blame(tmp_path: Path) -> None:
    with serving(plan(*PAIR), tmp_path) as broker, playing(broker.endpoint, *PAIR) as (world, _):
        world.done(world.expect(m.Grant), ("camera", b"\x80", b""))
        outcome = broker.outcome()
        assert outcome.culprit == "world"
        assert "'camera'" in outcome.error


def test_a_fault_outside_a_frame_ends_the_run_with_its_phase_and_text(tmp_path: Path) -> None:
    with serving(plan(*PAIR), tmp_path) as broker, Client(broker.endpoint, "world") as world:
        world.join()
        with Client(broker.endpoint, "sensors") as sensors:
            sensors.join()
            world.expect(m.Prepare)
            world.send(m.Fault(**world.ids, phase="prepare", message="no map of that town"))
            outcome = broker.outcome()
    assert outcome.culprit == "world"
    assert "prepare: no map of that town" in outcome.error


def test_errors_of_a_member_are_noted_and_counted_rather_than_repeated(tmp_path: Path) -> None:
    with serving(plan(*PAIR), tmp_path) as broker, playing(broker.endpoint, *PAIR) as clients:
        for number in range(10 * MESSAGES_A_TURN):
            clients[1].send(m.Error(code="malformed", of="RESET", message=f"complaint {number}"))
        play_to_the_end(clients, 3)
        assert finishes_well(broker)
        assert sum("complaint" in notice.text for notice in broker.witness.notices) == 1


# --- who is slow, and who is gone -----------------------------------------------------------------------


def test_a_service_that_closes_its_connection_is_unreachable_at_the_next_grant(tmp_path: Path) -> None:
    with serving(plan(*PAIR), tmp_path) as broker, playing(broker.endpoint, *PAIR) as (world, sensors):
        grant = world.expect(m.Grant)
        sensors.close()
        world.done(grant, ("scene", b"\x80", b""))
        outcome = broker.outcome()
        assert outcome.culprit == "sensors"
        assert "unreachable" in outcome.error


def test_misses_under_drop_are_told_one_by_one_and_do_not_slow_the_run(tmp_path: Path) -> None:
    """A service that never answers again: 2,000 frames go on without it."""
    services = (
        ServicePlan(name="world", role="world", budget_ns=1000 * MS),
        ServicePlan(name="sensors", role="sensors", budget_ns=1, policy="drop"),
    )
    run = replace(plan(*PAIR, frames=2000), services=services)
    with (
        serving(run, tmp_path) as broker,
        playing(broker.endpoint, *PAIR) as (world, sensors),
    ):
        for _ in range(2000):
            world.answer()
        sensors.expect(m.Grant)
        eventually(lambda: broker.witness.frames == 2000, "all frames are finished")
        told = [notice for notice in broker.witness.notices if notice.kind in ("miss", "skipped")]
        assert len(told) >= 1999
        assert broker.server.statistics.services()["sensors"].misses == 2000
