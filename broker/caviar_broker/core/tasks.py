"""Tasks of an episode, their decisions, and the ledger that says which of these are safe.

A *task* is one service's part of one frame. Once it is decided, each of its topics has a `Decision`: what
consumers get: a fresh product, a *held* one (the newest of an earlier frame again), or its absence.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import msgspec

from caviar_broker.core.events import Product
from caviar_broker.core.graph import Edge
from caviar_broker.core.plan import ServicePlan
from caviar_broker.core.transitions import TASK, TaskEvent, TaskState, step
from caviar_protocol.messages import GrantInput, Report, Status


class Ledger:
    """Counts the entries of the run's journal (contract, clause 18).

    Entries become safe in order, so one number says which are: all up to and including `written`.

    Args:
        kept: Whether there is a journal; without one every entry is as safe as it will be.
    """

    def __init__(self, *, kept: bool = True) -> None:
        self._kept = kept
        self.last = 0
        """Number of the last entry; 0: none yet."""
        self.written = 0
        """All entries up to this number are with the operating system."""
        self.waiting_since: int | None = None
        """Since when no entry was confirmed though some are outstanding [ns]; None: none is."""

    def enter(self, now: int) -> int:
        """Number of a new entry, made at the time ``now`` [ns]."""
        self.last += 1
        if not self._kept:
            self.written = self.last
        elif self.waiting_since is None:
            self.waiting_since = now
        return self.last

    def confirm(self, number: int, now: int) -> bool:
        """Note that entries up to ``number`` are written; whether that is news."""
        if number <= self.written:
            return False
        self.written = number
        self.waiting_since = now if number < self.last else None
        return True


class Decision(msgspec.Struct, frozen=True):
    """Decision about one (topic, source) of a frame: what its consumers get."""

    provenance: GrantInput
    """As a consumer in the same frame is granted it, and as the journal has it."""
    product: Product | None = None
    journal: int = 0
    """Number of the journal entry in which a held product stands; 0: in this decision's own entry."""

    @property
    def status(self) -> Status:
        """Fresh, held, absent or late."""
        return self.provenance.status


class FinishedFrame(msgspec.Struct, frozen=True):
    """A frame that every service is through with, as observers see it."""

    episode: int
    frame: int
    t_ns: int
    decisions: tuple[Decision, ...]
    reports: tuple[Report, ...]


class GrantOrder(msgspec.Struct, frozen=True):
    """A grant that the dispatcher wants sent."""

    service: str
    frame: int
    previous: int
    """Frame that the service completed before; −1: none."""
    final: bool
    inputs: tuple[GrantInput, ...]
    products: tuple[Product, ...]
    reports: tuple[Report, ...] = ()


class TaskInputs(msgspec.Struct, frozen=True):
    """Inputs of a task, all of them decided."""

    inputs: tuple[GrantInput, ...]
    products: tuple[Product, ...]
    """Those of the inputs that are not absent, in the same order."""
    cause: str | None
    """Why the first required input is absent (clause 10); frame 0 has no earlier one."""
    entry: int
    """Number of the last journal entry that a grant relies on from before its frame (clause 18): the
    service's own, lag 1 inputs and held products."""


@dataclass(slots=True, eq=False)
class Task:
    """One service's part of one frame."""

    service: str
    frame: int
    state: TaskState = TaskState.PENDING
    eligible_at: int | None = None
    """When it could first have been granted, or skipped, had its service been there and not late [ns]."""
    started_at: int = 0
    """When it was granted or, where grants queue, when the one before it was answered [ns]."""
    inputs: TaskInputs | None = None
    """Kept while its grant waits for the journal."""
    overran: bool = False
    """Whether its budget is up."""
    order: GrantOrder | None = None
    """As granted, until it is answered: a service that rejoins gets it again."""
    decisions: dict[str, Decision] = field(default_factory=dict)
    """By topic, once decided."""
    journal: int = 0
    """Number of the journal entry of its decisions; 0: not decided."""
    report: Report | None = None

    def move(self, event: TaskEvent) -> None:
        """Take a transition of the table in `caviar_broker.core.transitions`."""
        self.state = step(TASK, self.state, event)


@dataclass(slots=True, eq=False)
class Participant:
    """One service in an episode."""

    plan: ServicePlan
    rank: int
    """Place in the graph's order: producers come before the consumers of their frame."""
    outputs: tuple[str, ...]
    """Topics in demand."""
    capacity: int = 1
    """Grants that may be outstanding (clause 7)."""
    tasks: dict[int, Task] = field(default_factory=dict)
    """By frame, as far as anything still needs them."""
    next_frame: int = 0
    """First frame that is not decided."""
    completed: int = -1
    """Last frame that the service answered."""
    outstanding: list[Task] = field(default_factory=list)
    """Tasks for which DONE or FAULT is due, oldest first."""
    suspended: bool = False
    """Whether the service is gone: its outstanding grants stay owed, no new ones are made."""
    saving: bool = False
    """Whether the service saves its state, and is granted nothing until it has."""
    inputs: tuple[tuple[Edge, Participant], ...] = ()
    """Its edges with their sources, sorted by (topic, source)."""
    lagged: tuple[tuple[Edge, Participant], ...] = ()
    """Those of lag 1, which alone count after the last frame (clause 16)."""
    latest: tuple[tuple[Edge, Participant], ...] = ()
    """All of them, those first that are decided last in a frame."""
    waiting: set[Participant] = field(default_factory=set)
    """Services that can be granted nothing before this one's next decision."""

    def task(self, frame: int) -> Task:
        """Its task in a frame; a new one where there is none."""
        found = self.tasks.get(frame)
        if found is None:
            found = self.tasks[frame] = Task(self.plan.name, frame)
        return found

    def has_decided(self, edge: Edge, frame: int) -> bool:
        """Return whether it is known what a consumer gets over one of this source's edges in a frame."""
        return frame - edge.lag < self.next_frame or frame < edge.lag


def provenance_of(product: Product, status: Status, frame: int, cause: str = "") -> GrantInput:
    """Provenance of a product, as a consumer in ``frame`` is granted it."""
    return GrantInput(
        topic=product.topic,
        source=product.source,
        status=status,
        frame=product.frame,
        t_ns=product.t_ns,
        age=frame - product.frame,
        fidelity=product.fidelity,
        digest=product.digest,
        cause=cause,
        geometry=product.geometry,
    )
