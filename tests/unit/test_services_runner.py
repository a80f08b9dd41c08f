"""The real runner in a process of its own, and a raw ROUTER that plays the broker: the course of a run."""

from __future__ import annotations

import time

import pytest
from runner_harness import IDS, MS, Broker, ends, hears, played_broker, service

from caviar_protocol import messages as m
from caviar_protocol.codec import decode_payload, encode_message
from caviar_protocol.digest import payload_digest
from caviar_protocol.topics import Lidar
from caviar_services.session import TRIM_EVERY

pytestmark = pytest.mark.slow

__all__ = ["played_broker"]


def test_a_service_joins_prepares_steps_and_leaves(broker: Broker) -> None:
    with service(broker.endpoint) as process:
        hello = broker.welcome()
        assert (hello.version, hello.name, hello.role) == (m.PROTOCOL_VERSION, "sick", "sensors")
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


def test_kept_memory_is_asked_for_between_frames(broker: Broker) -> None:
    """After the answer, so that no frame waits for it; what fails there is a fault of that frame."""
    with service(broker.endpoint, "sensors:Keeps") as process:
        broker.start()
        for frame in range(TRIM_EVERY):
            broker.grant(frame)
            broker.expect(m.Done)
        fault = broker.expect(m.Fault)
        assert (fault.phase, fault.frame) == ("release", TRIM_EVERY - 1)
        assert "MemoryError: nothing to give" in fault.message
        hears(process, f"released after {TRIM_EVERY}")


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
