"""What the journal of a run says that a broker needs to go on with it (contract, clause 18)."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from caviar_broker.checkpoints import CheckpointFiles
from caviar_broker.core.events import Product
from caviar_broker.core.resumption import Resumption
from caviar_broker.core.tasks import Decision, Task
from caviar_broker.core.transitions import TaskState
from caviar_broker.journal import JournalEntry, read_journal
from caviar_protocol.digest import RunDigest
from caviar_protocol.messages import GrantInput, Status

_STATES = {
    "done": TaskState.DONE,
    "fault": TaskState.FAILED,
    "overdue": TaskState.LATE,
    "skipped": TaskState.SKIPPED,
}


def read_resumption(journal: Path, checkpoints: CheckpointFiles) -> Resumption | None:
    """The run up to the last frame that was finished; None where no episode had begun.

    Raises `RecordingError` naming what cannot be read.
    """
    found = _Reader()
    for entry in read_journal(journal):
        found.take(entry)
    return found.resumption(checkpoints)


class _Reader:
    """Takes the entries of a journal in order, and keeps of them what may be needed."""

    def __init__(self) -> None:
        self._digest = RunDigest()
        self._entries = 0
        self._finished_before = 0
        self._begin: JournalEntry | None = None
        self._clear()

    def _clear(self) -> None:
        self._finished = 0
        self._tasks: dict[str, dict[int, Task]] = {}
        self._products: dict[tuple[str, str], dict[int, tuple[Product, int]]] = {}
        """By (service, topic) and frame: those in the journal, and their entries."""
        self._answered: dict[str, dict[int, Mapping[str, str] | None]] = {}
        self._states: dict[str, list[tuple[int, str]]] = {}
        """Checkpoints by service: frame, file."""
        self._ends: list[JournalEntry] = []
        """Frames in which agents ended the episode, or chose the next one's seed."""

    def take(self, entry: JournalEntry) -> None:
        """One more entry."""
        self._entries = max(self._entries, entry.number)
        match entry.outcome:
            case "episode":
                self._finished_before += self._finished
                self._begin = entry
                self._clear()
            case "resumed":
                self._forget(entry.frame)
            case "checkpoint":
                self._states.setdefault(entry.service, []).append((entry.frame, entry.file))
            case "end" | "seed":
                self._ends.append(entry)
            case _:
                self._decided(entry)

    def _forget(self, frame: int) -> None:
        """The run went on with this frame: what had been decided from there on does not count."""
        tables: list[dict[int, Any]] = [
            *self._tasks.values(),
            *self._products.values(),
            *self._answered.values(),
        ]
        for table in tables:
            for late in [number for number in table if number >= frame]:
                del table[late]
        for states in self._states.values():
            states[:] = [state for state in states if state[0] < frame]
        self._ends = [entry for entry in self._ends if entry.frame < frame]

    # --- decisions -----------------------------------------------------------------------------------

    def _decided(self, entry: JournalEntry) -> None:
        told = {decision.topic: decision for decision in entry.decisions}
        for topic, header, body in entry.products:
            product = _product(entry.service, told[topic], (header, body))
            self._products.setdefault((entry.service, topic), {})[product.frame] = product, entry.number
        if entry.outcome in ("done", "late"):
            digests = {d.topic: d.digest for d in entry.decisions if d.status in (Status.FRESH, Status.LATE)}
            self._answered.setdefault(entry.service, {})[entry.frame] = digests
        elif entry.outcome == "fault":
            self._answered.setdefault(entry.service, {})[entry.frame] = None
        if entry.outcome != "late":
            task = Task(entry.service, entry.frame, state=_STATES[entry.outcome], journal=entry.number)
            task.decisions = {d.topic: self._decision(entry.service, d) for d in entry.decisions}
            self._tasks.setdefault(entry.service, {})[entry.frame] = task
            self._finish()

    def _decision(self, service: str, told: GrantInput) -> Decision:
        if told.status is Status.ABSENT:
            return Decision(told.status, None, told.cause)
        known = self._products.get((service, told.topic), {}).get(told.frame)
        product, number = known or (_product(service, told, None), 0)
        return Decision(told.status, product, told.cause, number if told.status is Status.HELD else 0)

    def _finish(self) -> None:
        begin = self._begin
        while begin is not None and begin.members and self._finished < self._frames:
            frame = [self._tasks.get(name, {}).get(self._finished) for name in begin.members]
            decided = [task for task in frame if task is not None]
            if len(decided) < len(frame):
                return
            fresh = [
                (topic, task.service, decision.product.digest)
                for task in decided
                for topic, decision in task.decisions.items()
                if decision.status is Status.FRESH and decision.product is not None
            ]
            self._digest.add_frame(begin.episode, self._finished, fresh)
            self._finished += 1
            self._prune()

    @property
    def _frames(self) -> int:
        frames = self._begin.facts["frames"] if self._begin else 0
        ends = [e.facts["frames"] for e in self._ends if e.outcome == "end" and e.frame < self._finished]
        return min([frames, *ends])

    def _prune(self) -> None:
        """Forget what no grant since a checkpoint of a finished frame can hold."""
        bases = [self._base(states)[0] for states in self._states.values()]
        low = min([self._finished - 1, *bases])
        for tasks in self._tasks.values():
            for old in [number for number in tasks if number < low]:
                del tasks[old]
        for products in self._products.values():
            newest = max((number for number in products if number <= low), default=low)
            for old in [number for number in products if number < newest]:
                del products[old]
        for name, answered in self._answered.items():
            base = self._base(self._states[name])[0] if name in self._states else self._finished - 1
            for old in [number for number in answered if number <= base]:
                del answered[old]

    def _base(self, states: list[tuple[int, str]]) -> tuple[int, str]:
        """The newest checkpoint of a finished frame."""
        return max((state for state in states if state[0] < self._finished), default=(-1, ""))

    # --- the outcome ---------------------------------------------------------------------------------

    def resumption(self, checkpoints: CheckpointFiles) -> Resumption | None:
        """All that was taken."""
        begin, finished = self._begin, self._finished
        if begin is None:
            return None
        newest = {}
        for key, products in self._products.items():
            frames = [number for number in products if number < finished]
            if frames:
                newest[key] = products[max(frames)]
        states = {}
        for name, saved in self._states.items():
            frame, file = self._base(saved)
            states[name] = frame, checkpoints.known(name, begin.episode, frame) if file else None
        checkpoints.finished = begin.episode, finished - 1
        wishes = [e for e in self._ends if e.outcome == "seed" and e.frame < finished]
        return Resumption(
            episode=begin.episode,
            seed=begin.facts["seed"],
            seed_episode=begin.facts["seed_episode"],
            frames=self._frames,
            finished=finished,
            finished_before=self._finished_before,
            digest=self._digest,
            entries=self._entries,
            wish=(wishes[-1].facts["seed"], wishes[-1].service) if wishes else None,
            tasks={
                name: {number: task for number, task in tasks.items() if number < finished}
                for name, tasks in self._tasks.items()
            },
            newest=newest,
            answered=self._answered,
            states=states,
        )


def _product(service: str, told: GrantInput, payload: tuple[bytes, bytes] | None) -> Product:
    return Product(told.topic, service, told.frame, told.t_ns, told.digest, told.fidelity, payload)
