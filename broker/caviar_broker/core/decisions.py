"""What becomes of every product of an episode: decided once, in order, and entered in the journal."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field

import msgspec
from msgspec.structs import replace

from caviar_broker.core.events import Action, FrameFinished, Journal, Product
from caviar_broker.core.graph import Edge, Graph
from caviar_broker.core.plan import RunPlan
from caviar_broker.core.transitions import DECIDED, OUTSTANDING, TASK, TaskEvent, TaskState, step
from caviar_protocol.digest import RunDigest
from caviar_protocol.messages import GrantInput, Report, Status


class Ledger:
    """Counts the entries of the run's journal.

    Entries become safe in order, so one number says which are: all up to and including `written`.
    """

    def __init__(self, *, kept: bool = True) -> None:
        self._kept = kept
        """Whether there is a journal; without one every entry is as safe as it will be."""
        self.last = 0
        """Number of the last entry; 0: none yet."""
        self.written = 0
        """All entries up to this number are with the operating system."""
        self.waiting_since: int | None = None
        """Since when no entry was confirmed though some are outstanding [ns]; None: none is."""

    def enter(self, now: int) -> int:
        """Number of a new entry."""
        self.last += 1
        if not self._kept:
            self.written = self.last
        elif self.waiting_since is None:
            self.waiting_since = now
        return self.last

    def confirm(self, number: int, now: int) -> bool:
        """Entries up to ``number`` are written; whether that is news."""
        if number <= self.written:
            return False
        self.written = number
        self.waiting_since = now if number < self.last else None
        return True


class Decision(msgspec.Struct, frozen=True):
    """What consumers of a frame get of one (topic, source)."""

    status: Status
    product: Product | None
    cause: str = ""
    journal: int = 0
    """Journal entry that holds a held product; 0: the one of this decision, as for one that is replayed."""


class GrantOrder(msgspec.Struct, frozen=True):
    """A grant that the schedule wants sent."""

    service: str
    frame: int
    previous: int
    final: bool
    inputs: tuple[GrantInput, ...]
    products: tuple[Product, ...]
    reports: tuple[Report, ...]


class TaskInputs(msgspec.Struct, frozen=True):
    """Inputs of a task, all of them decided."""

    decisions: list[tuple[Edge, Decision]]
    cause: str | None
    """Why the first required input is absent (clause 10); frame 0 has no earlier one."""
    entry: int
    """Number of the last journal entry that a grant relies on from before its frame (clause 18): the
    service's own, lag 1 inputs and held products."""

    def provided(self, frame: int) -> tuple[list[GrantInput], list[Product]]:
        """Provenance of every input, and the products of those that are not absent."""
        inputs = [provenance(edge.topic, edge.source, decision, frame) for edge, decision in self.decisions]
        return inputs, [decision.product for _, decision in self.decisions if decision.product is not None]


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
        """Take a transition of the table."""
        self.state = step(TASK, self.state, event)


def provenance(topic: str, source: str, decision: Decision, frame: int) -> GrantInput:
    """What a consumer in ``frame`` is told about where its input comes from."""
    product = decision.product
    if product is None:
        return GrantInput(topic=topic, source=source, status=decision.status, cause=decision.cause)
    return GrantInput(
        topic=topic,
        source=source,
        status=decision.status,
        frame=product.frame,
        t_ns=product.t_ns,
        age=frame - product.frame,
        fidelity=product.fidelity,
        digest=product.digest,
        cause=decision.cause,
    )


def validate_decision(service: str, frame: int, topic: str, decision: Decision) -> None:
    """Raise AssertionError where a decision contradicts itself (clauses 9 to 12)."""
    what = f"{topic} of {service} in frame {frame}"
    match decision.status:
        case Status.FRESH:
            assert decision.product is not None, f"{what} is fresh without a product"
            assert decision.product.frame == frame, f"{what} is not fresh"
        case Status.HELD:
            assert decision.product is not None, f"{what} is held without a product"
            assert decision.product.frame < frame, f"{what} is not an earlier one"
            assert decision.cause, f"{what} is held without a cause"
        case _:
            assert decision.product is None, f"{what} is absent with a product"
            assert decision.cause, f"{what} is absent without a cause"


def milliseconds(ns: int) -> str:
    """A duration for people."""
    return f"{ns / 1e6:.1f} ms"


_FRESH = Status.FRESH
_FIRST = Decision(Status.ABSENT, None, "there is no earlier frame")


class DecisionTable:
    """Decisions of one episode, by service and frame (contract, clauses 9 to 12, 18 and 20).

    A service decides its frames one after the other. A frame is finished once every service has
    decided it; the fresh products of finished frames make the digest of the run.

    Parameters
    ----------
    graph, plan
        The run.
    episode
        Number of the episode.
    digest
        The run's chain; finished frames are added to it.
    ledger
        The run's journal.
    actions
        Where journal entries and finished frames are put.
    sources
        Services whose products stand in the journal because those that take them remember them.
    """

    def __init__(
        self,
        graph: Graph,
        plan: RunPlan,
        episode: int,
        digest: RunDigest,
        ledger: Ledger,
        actions: list[Action],
        sources: Collection[str] = (),
    ) -> None:
        self.frames = plan.frames
        """Frames of the episode; becomes less when an agent ends it early."""
        self.finished_frames = 0
        self.next = dict.fromkeys(graph.order, 0)
        """First frame of each service that is not decided yet."""
        self.lag_ns: Callable[[], int] = lambda: 0
        """How far real time has slipped, for the report on a frame."""
        self._graph, self._plan, self._episode = graph, plan, episode
        self._digest, self._ledger, self._actions = digest, ledger, actions
        self._holding = frozenset(p.name for p in plan.services if p.policy == "hold")
        self._kept = self._holding | graph.retained | frozenset(sources)
        self._tasks: dict[str, dict[int, Task]] = {name: {} for name in graph.order}
        self._last = graph.order[-1]
        """A service that has not decided the first frame yet that is not finished."""
        self._newest: dict[tuple[str, str], tuple[Product, int]] = {}
        """Newest product and its journal entry by (service, topic), late ones included (clause 12)."""

    def go_on(
        self,
        finished: int,
        frames: int,
        tasks: Mapping[str, Mapping[int, Task]],
        newest: Mapping[tuple[str, str], tuple[Product, int]],
    ) -> None:
        """Go on with an episode of which so many frames are finished; the book must be new."""
        assert not self.finished_frames, "only a new book can go on"
        self.finished_frames, self.frames = finished, frames
        for name in self.next:
            self.next[name] = finished
            self._tasks[name] = dict(tasks.get(name, {}))
        self._newest = {key: known for key, known in newest.items() if key[0] in self._holding}

    def forget_before(self, frame: int) -> None:
        """Nothing needs tasks of earlier frames any more."""
        for tasks in self._tasks.values():
            for old in [number for number in tasks if number < frame]:
                del tasks[old]

    # --- tasks -----------------------------------------------------------------------------------

    def task(self, service: str, frame: int) -> Task:
        """The task of a service in a frame; a new one where there is none."""
        tasks = self._tasks[service]
        found = tasks.get(frame)
        if found is None:
            found = tasks[frame] = Task(service, frame)
        return found

    def find(self, service: str, frame: int) -> Task | None:
        """The task of a service in a frame, if there is one."""
        return self._tasks[service].get(frame)

    def release(self, task: Task) -> None:
        """Forget a task that was answered when its frame had been over already."""
        if not self.finished_frames - 1 <= task.frame < self.frames:
            del self._tasks[task.service][task.frame]

    def tasks(self) -> Iterable[Task]:
        """All tasks that are not forgotten."""
        return (task for tasks in self._tasks.values() for task in tasks.values())

    # --- what consumers get ------------------------------------------------------------------------

    def decided(self, edge: Edge, frame: int) -> bool:
        """Whether it is known what a consumer gets over an edge in a frame."""
        return frame - edge.lag < self.next[edge.source] or frame < edge.lag

    def decision(self, edge: Edge, frame: int) -> Decision:
        """What a consumer gets over an edge in a frame."""
        if frame < edge.lag:
            return _FIRST
        return self._tasks[edge.source][frame - edge.lag].decisions[edge.topic]

    def entry(self, service: str, frame: int) -> int:
        """Journal entry of a service's decisions about a frame; 0 where there is none."""
        task = self._tasks[service].get(frame)
        return 0 if task is None else task.journal

    # --- deciding ----------------------------------------------------------------------------------

    def fresh(self, task: Task, products: Mapping[str, Product], now: int) -> None:
        """The task was answered in time; a declared product that is missing is absent."""
        decisions = {}
        for topic in self._due_topics(task):
            product = products.get(topic)
            if product is not None:
                decisions[topic] = Decision(_FRESH, product)
            else:
                cause = f"{task.service} produced no {topic} in frame {task.frame}"
                decisions[topic] = Decision(Status.ABSENT, None, cause)
        self._decide(task, decisions, "done", now)
        if task.service in self._holding:
            self._renew(products.values(), task.journal)

    def as_recorded(
        self, task: Task, entries: Iterable[GrantInput], products: Mapping[str, Product], now: int
    ) -> None:
        """A replayed service: its products are held or absent where they were, with the recorded cause."""
        recorded, decisions = {entry.topic: entry for entry in entries}, {}
        for topic in self._due_topics(task):
            entry, product = recorded.get(topic), products.get(topic)
            status = entry.status if entry is not None else _FRESH
            cause = entry.cause if entry is not None else ""
            if product is None or status is Status.ABSENT:
                cause = cause or f"{task.service} produced no {topic} in frame {task.frame}"
                decisions[topic] = Decision(Status.ABSENT, None, cause)
            elif entry is not None and status is Status.HELD:
                product = replace(product, frame=entry.frame, t_ns=entry.t_ns)
                decisions[topic] = Decision(Status.HELD, product, cause)
            else:
                decisions[topic] = Decision(_FRESH, product)
        self._decide(task, decisions, "done", now)

    def substitute(self, task: Task, cause: str, outcome: str, now: int) -> None:
        """Clause 9: under hold consumers get the newest earlier product; else, or without one, nothing."""
        decisions = {}
        for topic in self._due_topics(task):
            held = self._newest.get((task.service, topic))
            if held is None:
                decisions[topic] = Decision(Status.ABSENT, None, cause)
            else:
                decisions[topic] = Decision(Status.HELD, held[0], cause, held[1])
        self._decide(task, decisions, outcome, now)

    def consequence(self, task: Task, cause: str, now: int) -> None:
        """Clause 10: a required input is absent, so its products are; the blame stays at the origin."""
        absent = {topic: Decision(Status.ABSENT, None, cause) for topic in self._due_topics(task)}
        self._decide(task, absent, "skipped", now)

    def late(self, task: Task, products: Mapping[str, Product], now: int) -> None:
        """Clause 11: products whose frame went on without them; later frames may hold them."""
        number = self._ledger.enter(now)
        decisions = {topic: Decision(Status.LATE, product) for topic, product in products.items()}
        self._journal(task, decisions, "late", number)
        if task.service in self._holding:
            self._renew(products.values(), number)

    def end_after(self, frame: int) -> list[Task]:
        """The episode ends with ``frame`` (clause 16); the tasks behind it, forgotten unless outstanding."""
        if frame + 1 >= self.frames:
            return []
        self.frames = frame + 1
        cut = [task for task in self.tasks() if task.frame >= self.frames]
        for task in cut:
            if task.state not in OUTSTANDING:
                del self._tasks[task.service][task.frame]
        for name in self.next:
            self.next[name] = min(self.next[name], self.frames)
        return cut

    def _due_topics(self, task: Task) -> tuple[str, ...]:
        """Topics that consumers expect of a task; none of a final one."""
        return self._graph.outputs[task.service] if task.frame < self.frames else ()

    def _renew(self, products: Iterable[Product], number: int) -> None:
        for product in products:
            key = (product.source, product.topic)
            known = self._newest.get(key)
            # Nobody is granted a frame before an earlier one is answered, so products come in order.
            assert known is None or known[0].frame < product.frame, f"{product} is not newer (clause 12)"
            self._newest[key] = product, number

    def _decide(self, task: Task, decisions: dict[str, Decision], outcome: str, now: int) -> None:
        task.decisions = decisions
        task.journal = self._ledger.enter(now)
        self._journal(task, decisions, outcome, task.journal)
        self.next[task.service] = task.frame + 1
        self._finish_frames()

    def _journal(self, task: Task, decisions: Mapping[str, Decision], outcome: str, number: int) -> None:
        """Products of earlier frames stand in entries of their own; others only if they may be used later."""
        if self._plan.ephemeral:
            return
        products: tuple[Product, ...] = ()
        if task.service in self._kept:
            products = tuple([d.product for d in decisions.values() if d.product and not d.journal])
        told = [provenance(topic, task.service, d, task.frame) for topic, d in decisions.items()]
        self._actions.append(
            Journal(
                number=number,
                episode=self._episode,
                frame=task.frame,
                service=task.service,
                outcome=outcome,
                decisions=tuple(told),
                products=products,
                chosen=task.report.decisions if task.report else None,
            )
        )

    def _finish_frames(self) -> None:
        if self.next[self._last] <= self.finished_frames:
            return
        for frame in range(self.finished_frames, min(self.frames, *self.next.values())):
            if not self._plan.ephemeral:
                self._digest.add_frame(self._episode, frame, self._fresh(frame))
            t_ns = self._plan.t_ns(frame)
            self._actions.append(FrameFinished(self._episode, frame, t_ns, self.lag_ns()))
            self.finished_frames += 1
            for tasks in self._tasks.values():  # lag 1 still needs this frame, nothing needs the one before
                old = tasks.get(frame - 1)
                if old is not None and old.state not in OUTSTANDING:
                    del tasks[frame - 1]
        self._last = min(reversed(self.next), key=self.next.__getitem__)

    def _fresh(self, frame: int) -> Iterable[tuple[str, str, str]]:
        """(topic, source, digest) of the fresh products of a frame that everybody has decided."""
        decided = [self._tasks[name][frame] for name in self._graph.order]
        return (
            (topic, task.service, decision.product.digest)
            for task in decided
            for topic, decision in task.decisions.items()
            if decision.status is Status.FRESH and decision.product is not None
        )

    # --- invariants ----------------------------------------------------------------------------------

    def validate(self) -> None:
        """Cross-field invariants; raises AssertionError naming the one that is broken."""
        for task in self.tasks():
            decided = task.state in DECIDED
            beyond = task.state in (TaskState.ABANDONED, TaskState.DISCARDED)
            assert beyond or decided == (task.frame < self.next[task.service]), f"{task} decided out of order"
            assert decided == bool(task.journal) or beyond, f"{task} is not in the journal"
            for topic, decision in task.decisions.items():
                validate_decision(task.service, task.frame, topic, decision)
        assert self.finished_frames <= self.frames
        assert all(n >= self.finished_frames for n in self.next.values()), "finished, but not decided"
        window = self.finished_frames + self._plan.frames_in_flight + 1
        assert all(n <= window for n in self.next.values()), "too many frames overlap"
        kept = [task for task in self.tasks() if task.state not in OUTSTANDING]
        assert all(task.frame >= self.finished_frames - 1 for task in kept), "tasks are not released"


class Inputs:
    """Inputs of the tasks of one episode, as far as they are decided (clauses 6, 7, 10 and 18)."""

    def __init__(self, graph: Graph, book: DecisionTable) -> None:
        self._book = book
        self._all, self._consumers = graph.inputs, graph.consumers
        self._latest = graph.latest
        self._lagged = {name: tuple(e for e in edges if e.lag) for name, edges in graph.inputs.items()}

    def taken(self, task: Task) -> Sequence[Edge]:
        """Edges that count in this frame: behind the last frame only those with lag 1 (clause 16)."""
        edges = self._all if task.frame < self._book.frames else self._lagged
        return edges[task.service]

    def undecided(self, task: Task) -> str | None:
        """A source that has not decided yet what this task gets of it; None: all have (clause 7)."""
        frame, undecided = task.frame, self._book.next
        # From behind: once the last one is decided, so are mostly the others, and nobody looks in vain.
        edges = self._latest[task.service] if frame < self._book.frames else self._lagged[task.service]
        for edge in edges:
            if frame - edge.lag >= undecided[edge.source] and frame >= edge.lag:
                return edge.source
        return None

    def gathered(self, task: Task) -> TaskInputs:
        """What is decided about its inputs; all of them must be."""
        # The service's own last decision is relied on too. What was decided in this very frame would be
        # decided again. Entries become safe in order, so nothing is missing between them.
        book, frame = self._book, task.frame
        cause, entry = None, book.entry(task.service, frame - 1)
        decisions = []
        for edge in self.taken(task):
            decision = book.decision(edge, frame)
            decisions.append((edge, decision))
            if decision.product is None and edge.required and frame >= edge.lag and cause is None:
                cause = decision.cause
            if edge.lag and (of_input := book.entry(edge.source, frame - edge.lag)) > entry:
                entry = of_input
            if decision.journal > entry:
                entry = decision.journal
        return TaskInputs(decisions, cause, entry)

    def lacking(self, source: str) -> str:
        """Who waits for which input of a source now; empty if nobody does."""
        found = []
        for name in self._consumers[source]:
            frame = self._book.next[name]
            for edge in self._all[name]:
                lacks = frame <= self._book.frames and not self._book.decided(edge, frame)
                if lacks and edge.source == source:
                    found.append(f"{name} waits for {edge.topic} of frame {frame - edge.lag}")
        return ", ".join(found)
