"""State of a run by its journal, from which a broker resumes it, after ``kill -9`` too (contract, clause 18).

1. `launch` finds the directory of a run that did not end, and calls `read_resumption`.
2. `journal_format.JournalReader` reads the journal's entries, up to the first one that is damaged.
3. `read_resumption` makes a `Resumption` of them, with the states that `journal.CheckpointFiles` kept.
4. `core.checkpoints` gives services their states back, and `core.dispatch` goes on after the last finished
   frame.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from caviar_broker.core.events import Product
from caviar_broker.core.run import Resumption
from caviar_broker.core.tasks import Decision, Task
from caviar_broker.core.transitions import TaskState
from caviar_broker.journal import CheckpointFiles
from caviar_broker.journal_format import JournalEntry, JournalReader
from caviar_protocol.digest import RunDigest, payload_digest
from caviar_protocol.errors import RecordingError
from caviar_protocol.messages import GrantInput, Status

_STATES = {
    "done": TaskState.DONE,
    "fault": TaskState.FAILED,
    "overdue": TaskState.LATE,
    "skipped": TaskState.SKIPPED,
}


@dataclass(frozen=True)
class ResumeState:
    """State in which another broker left a run."""

    resumption: Resumption | None
    """None where no episode had begun."""
    end: int | None
    """Where the journal goes on [B]; None: where its log ends."""
    losses: tuple[str, ...]
    """What is lost, a line each."""
    is_cut: bool = False
    """Whether the recording lacks frames that were finished."""


def read_resumption(
    journal: Path, checkpoints: CheckpointFiles, recorded: tuple[int, int] | None = None
) -> ResumeState:
    """The run up to the last frame that was finished and, where there is a recording, is in it.

    Args:
        journal, checkpoints: Files of the run.
        recorded: Last episode in the recording, and how many of its frames are; None: nothing is known of
            one.

    Raises:
        RecordingError: The journal cannot be read, or something that is needed is gone.
    """
    reader, found = JournalReader(journal), _Reader(checkpoints, recorded)
    end = reader.end
    for entry in reader:
        if found.is_cut and entry.outcome == "episode":
            break  # frames before it are run again
        found.add(entry)
        end = reader.end
    resumption = found.resumption()
    losses = []
    at = f"episode {resumption.episode}, frame {resumption.finished}" if resumption else "the first frame"
    if reader.problem:
        losses.append(f"{reader.problem}; {reader.lost} B after it are lost, and the run continues with {at}")
    if found.is_cut:
        losses.append(f"the recording ends before {at}: what the journal has from there on is run again")
    return ResumeState(resumption, end, tuple(losses), found.is_cut)


class _Reader:
    """Takes the entries of a journal in order, and keeps of them what may be needed."""

    def __init__(self, checkpoints: CheckpointFiles, recorded: tuple[int, int] | None) -> None:
        self._checkpoints, self._recorded = checkpoints, recorded
        # Whether the journal has finished frames that the recording lacks.
        self.is_cut = False
        self._digest = RunDigest()
        self._entries = 0
        self._finished_before = 0
        # Frame from which the journal has all entries.
        self._complete_from = -1
        self._begin: JournalEntry | None = None
        self._clear()

    def _clear(self) -> None:
        self._finished = 0
        self._tasks: dict[str, dict[int, Task]] = {}
        # By (service, topic) and frame: those in the journal, and their entries.
        self._products: dict[tuple[str, str], dict[int, tuple[Product, int]]] = {}
        self._answered: dict[str, dict[int, Mapping[str, str] | None]] = {}
        self._chosen: dict[str, dict[int, Mapping[str, str]]] = {}
        # Checkpoints of each service by frame.
        self._states: dict[str, dict[int, JournalEntry]] = {}
        # Of the files of states that were looked at; None where one is gone, or damaged.
        self._contents: dict[str, bytes | None] = {}
        # Frames in which agents ended the episode, or chose the next one's seed.
        self._ends: list[JournalEntry] = []
        # What worlds announced of meshes.
        self._geometry: list[JournalEntry] = []

    def add(self, entry: JournalEntry) -> None:
        """One more entry."""
        self._entries = max(self._entries, entry.number)
        match entry.outcome:
            case "episode":
                self._finished_before += self._finished
                self._begin, self._complete_from = entry, -1
                self._clear()
            case "snapshot":
                # A compacted journal: the run up to a frame.
                if self._recorded is not None and self._recorded < (entry.episode, entry.frame):
                    raise RecordingError(
                        f"the recording has {self._recorded[1]} frames of episode {self._recorded[0]}, and "
                        f"the journal begins after frame {entry.frame - 1} of episode {entry.episode}: what "
                        "is between is lost, and the run cannot go on"
                    )
                self._begin, self._digest = entry, RunDigest(entry.digest)
                self._clear()
                self._finished, self._finished_before = entry.frame, entry.facts["finished_before"]
                self._complete_from = entry.facts["base"]
            case "resumed":
                self._forget(entry.frame)
            case "checkpoint":
                self._states.setdefault(entry.service, {})[entry.frame] = entry
            case "end" | "seed":
                self._ends.append(entry)
            case "geometry":
                self._geometry.append(entry)
            case _:
                self._decided(entry)

    def _forget(self, frame: int) -> None:
        """The run was resumed with this frame: what had been decided from there on does not count."""
        tables: list[dict[int, Any]] = [
            *self._tasks.values(),
            *self._products.values(),
            *self._answered.values(),
            *self._chosen.values(),
            *self._states.values(),
        ]
        for table in tables:
            for late in [number for number in table if number >= frame]:
                del table[late]
        self._ends = [entry for entry in self._ends if entry.frame < frame]
        self._geometry = [entry for entry in self._geometry if entry.frame < frame]

    # --- decisions -----------------------------------------------------------------------------------

    def _decided(self, entry: JournalEntry) -> None:
        entered = {decision.topic: decision for decision in entry.decisions}
        for topic, header, body in entry.products:
            if payload_digest(header, body) != entered[topic].digest:
                raise RecordingError(
                    f"{topic} of {entry.service!r} in frame {entered[topic].frame} is not the one whose "
                    "digest the journal has: it cannot be granted again, and the run cannot go on"
                )
            product = _product(entry.service, entered[topic], (header, body))
            self._products.setdefault((entry.service, topic), {})[product.frame] = product, entry.number
        if entry.outcome in ("done", "late"):
            digests = {d.topic: d.digest for d in entry.decisions if d.status in (Status.FRESH, Status.LATE)}
            self._answered.setdefault(entry.service, {})[entry.frame] = digests
            if entry.chosen:
                self._chosen.setdefault(entry.service, {})[entry.frame] = entry.chosen
        elif entry.outcome == "fault":
            self._answered.setdefault(entry.service, {})[entry.frame] = None
        if entry.outcome != "late":
            task = Task(entry.service, entry.frame, state=_STATES[entry.outcome], journal=entry.number)
            task.decisions = {d.topic: self._decision(entry.service, d) for d in entry.decisions}
            self._tasks.setdefault(entry.service, {})[entry.frame] = task
            self._finish()

    def _decision(self, service: str, entered: GrantInput) -> Decision:
        if entered.status is Status.ABSENT:
            return Decision(entered)
        known = self._products.get((service, entered.topic), {}).get(entered.frame)
        product, number = known or (_product(service, entered, None), 0)
        return Decision(entered, product, number if entered.status is Status.HELD else 0)

    def _finish(self) -> None:
        begin = self._begin
        while begin is not None and begin.members and self._finished < self._frames:
            frame = [self._tasks.get(name, {}).get(self._finished) for name in begin.members]
            decided = [task for task in frame if task is not None]
            if len(decided) < len(frame):
                return
            if self._recorded is not None and (begin.episode, self._finished) >= self._recorded:
                self.is_cut = True
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
        tables: list[dict[str, dict[int, Any]]] = [self._answered, self._chosen]
        for table in tables:
            for name, of_frames in table.items():
                base = self._base(self._states[name])[0] if name in self._states else self._finished - 1
                for old in [number for number in of_frames if number <= base]:
                    del of_frames[old]

    def _base(self, states: dict[int, JournalEntry]) -> tuple[int, bytes | None]:
        """Frame and content of the newest usable state of a finished frame; −1 where there is none."""
        for frame in sorted((f for f in states if 0 <= f < self._finished), reverse=True):
            state = self._content(states[frame])
            if state is not None:
                return frame, state
            del states[frame]  # it was removed after a newer one, or is damaged
        return -1, None

    def _content(self, saved: JournalEntry) -> bytes | None:
        if saved.file not in self._contents:
            state = self._checkpoints.load(saved.service, saved.file, saved.digest)
            self._contents[saved.file] = state
        return self._contents[saved.file]

    # --- the outcome ---------------------------------------------------------------------------------

    def resumption(self) -> Resumption | None:
        """All that was taken."""
        begin, finished = self._begin, self._finished
        if begin is None:
            return None
        newest = {}
        for key, products in self._products.items():
            frames = [number for number in products if number < finished]
            if frames:
                newest[key] = products[max(frames)]
        states = {name: self._base(saved) for name, saved in self._states.items()}
        for name, (frame, _) in states.items():
            if frame < self._complete_from:
                raise RecordingError(
                    f"the states of {name!r} in checkpoints/ are gone or damaged, from frame "
                    f"{self._complete_from} of episode {begin.episode} on: the run cannot go on"
                )
        self._checkpoints.finished = begin.episode, finished - 1
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
            chosen=self._chosen,
            states=states,
            geometry=tuple(
                (entry.service, entry.geometry)
                for entry in self._geometry
                if entry.geometry is not None and entry.frame < finished
            ),
        )


def _product(service: str, entered: GrantInput, payload: tuple[bytes, bytes] | None) -> Product:
    return Product(
        entered.topic,
        service,
        entered.frame,
        entered.t_ns,
        entered.digest,
        entered.fidelity,
        payload,
        entered.geometry,
    )
