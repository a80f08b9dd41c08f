"""Clause 18: a broker resumes a run from its journal, in virtual time."""

from __future__ import annotations

import hashlib
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest
from core_harness import MS, SECOND, Simulation, loop

from caviar_broker.core import events as ev
from caviar_broker.core.plan import Timeouts
from caviar_broker.core.run import Resumption
from caviar_broker.journal import CheckpointFiles, JournalFile
from caviar_broker.journal_format import JournalReader
from caviar_broker.resume import read_resumption
from caviar_protocol import messages as m
from caviar_protocol.digest import RunDigest

pytestmark = pytest.mark.slow

STATEFUL: dict[str, dict[str, Any]] = {
    "world": {"stateful": True},
    "channel": {"latency": 3 * MS},
    "agent": {"stateful": True, "latency": 2 * MS},
    "link": {"stateful": True, "saving": 7 * MS},
}
ENDING = STATEFUL | {
    "agent": {
        "stateful": True,
        "ends": frozenset({(0, 3)}),
        "report": lambda episode, frame: {"seed": 77} if (episode, frame) == (0, 3) else {},
    }
}


class Runs:
    """One run under one broker after the other."""

    def __init__(self, folder: Path, services: dict[str, dict[str, Any]], **plan: Any) -> None:
        self.folder, self.services = folder, services
        self.plan = {"frames": 9, "checkpoint_frames": 3, "timeouts": Timeouts(rejoin=5 * SECOND)} | plan
        self.epoch = 0

    def go(self, until: int | None = None) -> Simulation:
        """Under another broker, for so long [ns], or to the end."""
        self.epoch += 1
        files = CheckpointFiles(self.folder)
        path = self.folder / "journal.msgpack"
        before: Resumption | None = None
        if self.epoch > 1:
            before = read_resumption(path, files).resumption
        with closing(JournalFile(path, self.epoch, files)) as journal:
            settings = {"journal": journal, "resumption": before, "epoch": self.epoch, "strict": False}
            run = Simulation(loop(**self.services), **settings, **self.plan).join()
            run.run() if until is None else run.run_to(run.now + until)
        if before is not None:
            assert [(f.episode, f.frame) for f in run.seen(ev.FrameFinished)][:1] in (
                [],
                [(before.episode, before.finished)],
                [(before.episode + 1, 0)],
            )
        return run


def undisturbed(services: dict[str, dict[str, Any]], **plan: Any) -> str:
    run = Simulation(loop(**services), **({"frames": 9, "checkpoint_frames": 3} | plan)).join().run()
    assert run.outcome.error == ""
    return str(run.outcome.digest)


@pytest.mark.parametrize("period", [0, 1, 3])
@pytest.mark.parametrize("services", [{}, STATEFUL, ENDING], ids=["plain", "stateful", "ending"])
def test_whenever_a_broker_dies_the_next_one_ends_the_run_with_the_same_digest(
    tmp_path: Path, services: dict[str, dict[str, Any]], period: int
) -> None:
    plan: dict[str, Any] = {"episodes": 2, "checkpoint_frames": period}
    expected = undisturbed(services, **plan) if period or not services else None
    for instant in range(0, 130, 7):
        folder = tmp_path / str(instant)
        folder.mkdir()
        runs = Runs(folder, services, journal_after=MS, **plan)
        runs.go(instant * MS)
        run = runs.go()
        assert run.outcome.error == ""
        if expected is not None:
            assert run.outcome.digest == expected, f"killed after {instant} ms"
            assert run.notices("differs") == []


def test_broker_after_broker_dies_and_the_digest_is_the_same(tmp_path: Path) -> None:
    runs = Runs(tmp_path, STATEFUL, episodes=2)
    for instant in (40, 33, 61, 20, 70):
        run = runs.go(instant * MS)
    run = runs.go()
    assert run.outcome.error == ""
    assert run.outcome.digest == undisturbed(STATEFUL, episodes=2)


def test_services_are_restored_from_their_last_state_and_get_the_grants_since(tmp_path: Path) -> None:
    runs = Runs(tmp_path, STATEFUL)
    first = runs.go(30 * MS)
    finished = first.seen(ev.FrameFinished)[-1].frame
    assert finished > 3
    run = runs.go()
    restored = run.seen(m.Restore, "link")[0].frame
    saved = [
        e.frame
        for e in JournalReader(tmp_path / "journal.msgpack")
        if (e.service, e.epoch) == ("link", 1) and e.file
    ]
    assert restored == max(frame for frame in saved if frame <= finished) >= 2
    assert [g.frame for g in run.grants("link")][:2] == [restored + 1, restored + 2]
    assert next(f.frame for f in run.seen(ev.FrameFinished)) == finished + 1
    assert run.seen(m.Grant, "channel")[0].frame == finished + 1


def test_a_journal_that_breaks_off_is_continued_after_its_last_whole_entry(tmp_path: Path) -> None:
    runs = Runs(tmp_path, STATEFUL)
    runs.go(60 * MS)
    path = tmp_path / "journal.msgpack"
    data = path.read_bytes()
    path.write_bytes(data[:-5])
    before = len(list(JournalReader(path)))
    run = runs.go()
    assert run.outcome.digest == undisturbed(STATEFUL)
    entries = list(JournalReader(path))
    assert entries[before - 1].epoch == 1
    assert entries[before].epoch == 2


def test_only_the_states_that_may_be_needed_are_kept(tmp_path: Path) -> None:
    runs = Runs(tmp_path, STATEFUL, checkpoint_frames=1)
    runs.go(60 * MS)
    assert len(list((tmp_path / "checkpoints").glob("link-*.bin"))) <= 6


def test_services_that_come_back_while_a_resumed_run_goes_on_are_restored_too(tmp_path: Path) -> None:
    runs = Runs(tmp_path, STATEFUL)
    runs.go(50 * MS)
    files = CheckpointFiles(tmp_path)
    path = tmp_path / "journal.msgpack"
    before = read_resumption(path, files).resumption
    with closing(JournalFile(path, 2, files)) as journal:
        run = Simulation(
            loop(**STATEFUL), journal=journal, resumption=before, epoch=2, strict=False, **runs.plan
        ).join()
        run.run(lambda r: len(r.seen(ev.FrameFinished)) == 1)
        run.kill("link")
        run.hello("link")
        run.run()
    assert run.outcome.error == ""
    assert run.outcome.digest == undisturbed(STATEFUL)
    assert run.notices("differs") == []


def test_what_a_broker_decided_anew_counts_and_not_what_the_one_before_had_decided(tmp_path: Path) -> None:
    def entry(number: int, outcome: str, service: str = "", said: str = "", **fields: Any) -> ev.Journal:
        digest = hashlib.sha256(said.encode()).hexdigest()
        told = m.GrantInput(topic="lidar", source=service, status=m.Status.FRESH, frame=0, digest=digest)
        decisions = (told,) if service else ()
        return ev.Journal(number, 0, 0, service, outcome, decisions=decisions, **fields)

    facts = {"seed": 1, "seed_episode": 0, "frames": 3}
    path = tmp_path / "journal.msgpack"
    with closing(JournalFile(path, 1)) as journal:
        journal.write([entry(1, "episode", facts=facts, members=("a", "b")), entry(2, "done", "a", "before")])
        journal.write([entry(3, "resumed", facts=facts), entry(4, "done", "b", "b")])
        journal.write([entry(5, "done", "a", "anew")])
    found = read_resumption(path, CheckpointFiles(tmp_path)).resumption
    expected = RunDigest()
    said = {"a": "anew", "b": "b"}
    products = [("lidar", name, hashlib.sha256(text.encode()).hexdigest()) for name, text in said.items()]
    expected.add_frame(0, 0, products)
    assert found is not None
    assert (found.finished, found.entries) == (1, 5)
    assert found.digest.hexdigest() == expected.hexdigest()
