"""The broker and its journal: what is written when, and what waits for it."""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import pytest
from broker_harness import PAIR, Client, eventually, finishes_well, plan, play_to_the_end, playing, serving

from caviar_broker import journal, server
from caviar_broker.core.events import Journal, StopRequested
from caviar_broker.journal import JournalFile
from caviar_broker.journal_format import JournalReader
from caviar_protocol import messages as m
from caviar_protocol.codec import decode_message
from caviar_protocol.errors import RunError


class Diary(JournalFile):
    """A journal that remembers when it was written, relative to what was sent."""

    def __init__(self, path: Path) -> None:
        super().__init__(path, 1)
        self.events: list[tuple[str, str, int]] = []

    def write(self, entries: Iterable[Journal]) -> None:
        written = list(entries)
        super().write(written)
        self.events += [("written", entry.service, entry.frame) for entry in written]


def test_a_decision_is_in_the_journal_soon_though_nobody_waits_for_it(tmp_path: Path) -> None:
    """While another service keeps the frame from being finished, and nothing is sent."""
    services = ("world", "sensors:left", "sensors:right")

    def journaled(service: str) -> bool:
        entries = JournalReader(tmp_path / "journal.msgpack")
        return any((e.service, e.frame) == (service, 0) for e in entries)

    with (
        serving(plan(*services, frames=2), tmp_path) as broker,
        playing(broker.endpoint, *services) as clients,
    ):
        world, left, right = clients
        world.answer()
        left.answer()
        eventually(lambda: journaled("left"), "an entry of left", within_s=2.0)
        assert not journaled("right")
        right.answer()
        play_to_the_end(clients, 1)
        assert finishes_well(broker)


def test_no_grant_overtakes_the_journal_entries_that_it_relies_on(tmp_path: Path) -> None:
    """Clause 18, with a world that takes its own scene of the frame before."""
    diaries: list[Diary] = []

    def diary(path: Path) -> Diary:
        diaries.append(Diary(path))
        return diaries[0]

    with serving(plan(*PAIR, frames=20), tmp_path, diary) as broker:
        events, send = diaries[0].events, broker.server._router.send

        def recorded(route: bytes, header: bytes, parts: Any = (), earns: bool = True) -> str:
            message = decode_message(header)
            if isinstance(message, m.Grant):
                events.append(("granted", "", message.frame))
            return send(route, header, parts, earns)

        broker.server._router.send = recorded  # type: ignore[method-assign]
        feedback = (m.Input(topic="lidar", lag=1, required=False),)
        with (
            Client(broker.endpoint, "world", inputs=feedback) as world,
            Client(broker.endpoint, "sensors") as sensors,
        ):
            for client in (world, sensors):
                client.join()
            for client in (world, sensors):
                client.ready()
            for client in (world, sensors):
                client.reset()
            play_to_the_end([world, sensors], 20)
            assert finishes_well(broker)
    for frame in range(1, 20):
        before = events[: events.index(("granted", "", frame))]
        assert ("written", "world", frame - 1) in before
        assert ("written", "sensors", frame - 1) in before
    entries = list(JournalReader(tmp_path / "journal.msgpack"))
    assert [(e.service, e.frame) for e in entries if e.service == "world"] == [
        ("world", k) for k in range(20)
    ]
    kept = {(e.service, e.frame): e.products for e in entries if e.products}
    assert kept["sensors", 3] == (("lidar", b"\x80", (b"sensors 3 " * 25)[:100]),)
    assert not any(service == "world" for service, _ in kept)  # no service takes the scene later


def test_a_journal_that_cannot_be_written_ends_the_run_in_order(tmp_path: Path) -> None:
    class Full(JournalFile):
        def write(self, entries: Iterable[Journal]) -> None:
            written = list(entries)
            if any(entry.frame == 1 for entry in written):
                raise RunError("cannot write the journal: no space left")
            super().write(written)

    with (
        serving(plan(*PAIR), tmp_path, lambda path: Full(path, 1)) as broker,
        playing(broker.endpoint, *PAIR) as (world, sensors),
    ):
        world.answer()
        sensors.answer()
        world.answer()
        assert "no space left" in world.bye().reason
        last = sensors.receive()
        while isinstance(last, m.Grant):  # of the same frame: may rely on nothing that was not written
            last = sensors.receive()
        assert isinstance(last, m.Shutdown)
        sensors.send(m.Bye(**sensors.ids))
        assert "no space left" in broker.outcome().error


class Frozen(JournalFile):
    """A journal on a disk that takes nothing of a frame until the test says so."""

    def __init__(self, path: Path) -> None:
        super().__init__(path, 1)
        self.thawed, self.reached = threading.Event(), threading.Event()

    def write(self, entries: Iterable[Journal]) -> None:
        written = list(entries)
        if any(entry.frame == 1 for entry in written):
            self.reached.set()
            self.thawed.wait(60)
        super().write(written)


@pytest.mark.parametrize("thaws", [True, False])
def test_a_disk_that_does_not_answer_is_told_of_and_holds_up_only_what_relies_on_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, thaws: bool
) -> None:
    monkeypatch.setattr(server, "DISK_NOTE_S", 0.5)
    monkeypatch.setattr(journal, "END_S", 0.1)
    made: list[Frozen] = []

    def frozen(path: Path) -> Frozen:
        made.append(Frozen(path))
        return made[0]

    with (
        serving(plan(*PAIR), tmp_path, frozen) as broker,
        playing(broker.endpoint, *PAIR) as (world, sensors),
    ):
        world.answer()
        sensors.answer()
        path = tmp_path / "journal.msgpack"
        eventually(
            lambda: {"world", "sensors"} <= {e.service for e in JournalReader(path)}, "frame 0 is in it"
        )
        world.answer()
        sensors.answer()
        assert made[0].reached.wait(30)
        told = "the disk does not answer: write of"
        eventually(lambda: told in broker.witness.texts(), "the disk is reported")
        assert "mounted at" in broker.witness.texts()
        assert broker.server.clock.status(time.monotonic_ns()).frame == 1  # it can be asked
        if thaws:
            made[0].thawed.set()
            play_to_the_end([world, sensors], 1)
            assert finishes_well(broker)
            assert "the disk answers again" in broker.witness.texts()
            return
        broker.server.loop.watch(stop := os.eventfd(1), lambda: _stop(broker.server, stop))
        for client in (world, sensors):
            assert "stopped by Ctrl-C" in client.bye().reason
        assert broker.outcome().error == "stopped by Ctrl-C"
        assert not broker.server.disk_answers
        made[0].thawed.set()


def _stop(broker: server.BrokerServer, fd: int) -> None:
    broker.loop.unwatch(fd)
    os.close(fd)
    broker.feed(StopRequested("stopped by Ctrl-C"))


def test_a_write_that_waits_for_a_sync_that_fails_ends_with_its_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """No other sync comes after it; the entry is in the file, and does not count as handed over."""
    monkeypatch.setattr(journal, "SYNC_PERIOD_S", 0.02)
    asked, fails = threading.Event(), threading.Event()

    def sync_recording() -> None:
        asked.set()
        fails.wait(30)
        raise RunError("cannot write the recording: input/output error")

    file = JournalFile(tmp_path / "journal.msgpack", 1)
    writer = journal.JournalWriter(file, "periodic", sync_recording)
    writer.write([Journal(1, 0, 0, "world", "done")], (0, 0))
    assert asked.wait(30)
    eventually(writer._is_overdue, "the sync takes longer than a period")
    waiting = threading.Thread(
        target=writer.write, args=([Journal(2, 0, 1, "world", "done")], (0, 1)), daemon=True
    )
    waiting.start()
    eventually(lambda: writer.doing == "fsync", "the write waits")
    fails.set()
    waiting.join(30)
    assert not waiting.is_alive()
    assert "input/output error" in str(writer.error)
    assert writer.confirmed == 1
    file.close()
