"""How soon the broker knows that a service is gone, and what it does not take for death (clause 15)."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import pytest
from broker_harness import MS, Client, Serving, eventually, plan, serving

from caviar_broker.supervision import describe_exit, watch
from caviar_protocol import messages as m

pytestmark = pytest.mark.slow

PEER = Path(__file__).with_name("broker_peer.py")
LONG = {"heartbeat": 60_000 * MS, "liveness": 120_000 * MS, "stall": 120_000 * MS}
"""Limits that no test waits for: what is known earlier is known without them."""


def losses(broker: Serving) -> int:
    """How often a service was lost so far."""
    return sum(notice.kind == "lost" for notice in broker.witness.notices)


@contextmanager
def peer(broker: Serving, place: str, how: str) -> Iterator[subprocess.Popen[str]]:
    """A world in a process of its own, beside raw sensors, up to the world's first grant."""
    command = [sys.executable, str(PEER), broker.endpoint, place, how]
    with (
        subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process,
        Client(broker.endpoint, "sensors") as sensors,
    ):
        try:
            assert process.stdout is not None
            sensors.join()
            sensors.ready()
            sensors.reset()
            assert process.stdout.readline() == "granted\n"
            yield process
        finally:
            process.kill()


@pytest.mark.parametrize(
    ("number", "words"),
    [(signal.SIGKILL, ()), (signal.SIGSTOP, ("is stopped (SIGSTOP or SIGTSTP)",))],
)
def test_a_local_process_that_dies_or_stops_is_known_without_its_heartbeats(
    tmp_path: Path, number: signal.Signals, words: tuple[str, ...]
) -> None:
    run = plan("world", "sensors", limits=LONG)
    with serving(run, tmp_path) as broker, peer(broker, "local", "wait") as process:
        started = time.monotonic()
        os.kill(process.pid, number)
        eventually(lambda: losses(broker), "the loss is known")
        elapsed = time.monotonic() - started
        sys.stdout.write(f"{number.name} of a local process was known after {elapsed * 1e3:.1f} ms\n")
        outcome = broker.outcome()
    assert outcome.culprit == "world"
    for word in ("world 'world'", "frame 0", "budget 50 ms", "last heartbeat", "phase 'playing'", *words):
        assert word in outcome.error


def test_the_death_of_a_local_process_tells_its_exit_status(tmp_path: Path) -> None:
    with serving(plan("world", "sensors"), tmp_path) as broker, peer(broker, "local", "7"):
        assert "it exited with status 7" in broker.outcome().error


def test_a_supervised_death_is_told_by_the_launcher_or_else_by_the_broker(tmp_path: Path) -> None:
    """The launcher knows the exit status and last words; but it may itself be stopped."""
    with serving(plan("world", "sensors"), tmp_path) as broker:
        broker.server._watchdog.supervised.add("world")
        with peer(broker, "local", "wait") as process:
            started = time.monotonic()
            process.kill()
            assert "killed by SIGKILL" in broker.outcome().error
            assert time.monotonic() - started > 0.9


def test_a_remote_process_that_is_stopped_is_known_within_its_liveness(tmp_path: Path) -> None:
    with serving(plan("world", "sensors"), tmp_path) as broker, peer(broker, "remote", "wait") as process:
        started = time.monotonic()
        os.kill(process.pid, signal.SIGSTOP)
        eventually(lambda: losses(broker), "the loss is known")
        elapsed = time.monotonic() - started
        sys.stdout.write(f"SIGSTOP of a remote process was known after {elapsed:.2f} s\n")
        outcome = broker.outcome()
    assert outcome.culprit == "world"
    assert "unreachable or stopped" in outcome.error
    assert "phase 'playing'" in outcome.error


def test_a_remote_process_that_is_killed_is_known_within_its_liveness(tmp_path: Path) -> None:
    with serving(plan("world", "sensors"), tmp_path) as broker, peer(broker, "remote", "wait") as process:
        started = time.monotonic()
        process.kill()
        eventually(lambda: losses(broker), "the loss is known")
        sys.stdout.write(
            f"the death of a remote process was known after {time.monotonic() - started:.2f} s\n"
        )
        assert "unreachable or stopped" in broker.outcome().error


def test_a_remote_service_that_holds_the_interpreter_is_busy_and_not_dead(tmp_path: Path) -> None:
    """No heartbeat comes for 2 s; libzmq answers for the process (clause 15)."""
    with (
        serving(plan("world", "sensors"), tmp_path) as broker,
        peer(broker, "remote", "hold the interpreter"),
    ):
        started = time.monotonic()
        eventually(lambda: broker.server.statistics.services() or broker.server.outcome, "an answer")
        assert broker.server.outcome is None
        assert time.monotonic() - started > 1.9
        assert not losses(broker)


def test_a_service_that_makes_no_progress_is_blamed_with_all_that_is_known(tmp_path: Path) -> None:
    run = plan("world", "sensors", limits={"stall": 600 * MS})
    with serving(run, tmp_path) as broker, peer(broker, "remote", "wait"):
        error = broker.outcome(within_s=5.0).error
    for word in ("world 'world'", "makes no progress", "stall_s", "frame 0", "budget 50 ms"):
        assert word in error
    assert "last heartbeat" in error
    assert "phase 'playing', progress 0" in error


def test_a_remote_service_that_is_back_before_its_death_is_known_takes_its_place(tmp_path: Path) -> None:
    """A process that starts it again at once is not refused because the name is taken."""
    run = plan("world", "sensors", limits={"heartbeat": 60_000 * MS, "liveness": 120_000 * MS})
    services = [replace(s, remote=True, rejoin=5000 * MS) for s in run.services]
    with serving(replace(run, services=tuple(services)), tmp_path) as broker:
        with Client(broker.endpoint, "world") as first:
            first.join()
            first.attach()
        with Client(broker.endpoint, "world") as second:
            assert second.join().attempt == 2
            second.attach()
            with Client(broker.endpoint, "world") as third:
                third.send(third.hello)
                assert third.expect(m.Refuse).code == "name-taken"
            eventually(lambda: any(n.kind == "refused" for n in broker.witness.notices), "it is reported")
        assert [n.kind for n in broker.witness.notices if n.service == "world"][:3] == [
            "lost",
            "away",
            "back",
        ]


def test_a_remote_service_without_heartbeats_is_noted(tmp_path: Path) -> None:
    run = plan("world", "sensors", limits={"liveness": 200 * MS})
    with serving(run, tmp_path) as broker, Client(broker.endpoint, "world") as world:
        world.join()
        eventually(lambda: "has no heartbeat connection" in broker.witness.texts("world"), "a note")


def test_a_service_that_never_connects_is_named(tmp_path: Path) -> None:
    run = plan("world", "sensors", limits={"connect": 200 * MS})
    with serving(run, tmp_path) as broker, Client(broker.endpoint, "world") as world:
        world.join()
        assert "sensors 'sensors' did not connect within 0.2 s" in broker.outcome().error
        world.expect(m.Shutdown)


def test_exit_statuses_are_words() -> None:
    assert describe_exit(3) == "it exited with status 3"
    assert describe_exit(-signal.SIGKILL) == "it was killed by SIGKILL"
    assert describe_exit(-200) == "it was killed by signal 200"


def test_a_process_that_is_not_there_is_told_apart_from_one_that_cannot_be_watched() -> None:
    with subprocess.Popen([sys.executable, "-c", ""]) as process:
        process.wait()
    for pid in (process.pid, 2**62):
        with pytest.raises(ProcessLookupError):
            watch(pid)


def test_a_process_that_rejoins_is_watched_in_place_of_the_one_before(tmp_path: Path) -> None:
    """The old descriptor is closed while the loop goes on, and the new process is the one that counts."""
    run = plan("world", "sensors", limits={"rejoin": 5000 * MS}, frames=2)
    with serving(run, tmp_path) as broker, peer(broker, "local", "wait") as first:
        os.kill(first.pid, signal.SIGSTOP)
        eventually(lambda: losses(broker) == 1, "the stop is known")
        command = [sys.executable, str(PEER), broker.endpoint, "local", "wait"]
        with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as second:
            assert second.stdout is not None
            assert second.stdout.readline() == "granted\n"
            first.kill()
            first.wait()
            known = broker.server.clock.member("world")
            assert known is not None
            assert (known.attempt, known.present) == (2, True)
            second.kill()
            eventually(lambda: losses(broker) == 2, "the death of the second is known")


def test_a_remote_service_whose_connection_ends_is_missed_at_once(tmp_path: Path) -> None:
    """Its death need not wait for a heartbeat that is missed, nor for a message that finds no peer."""
    run = plan("world", "sensors", limits=LONG)
    with serving(run, tmp_path) as broker, Client(broker.endpoint, "sensors") as sensors:
        with Client(broker.endpoint, "world") as world:
            for client in (world, sensors):
                client.join()
            for client in (world, sensors):
                client.ready()
        outcome = broker.outcome()
    assert outcome.culprit == "world"
    assert "its connection is gone" in outcome.error
