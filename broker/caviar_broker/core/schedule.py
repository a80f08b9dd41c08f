"""The frames of one episode: who may be granted what, and what becomes of every product.

`EpisodeSchedule` implements clauses 6 to 13 and 16 of the contract for a fixed graph. It knows
nothing of joining, dying or messages; `clock.FrameClock` does that around it.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

from caviar_broker.core.events import (
    Action,
    FrameFinished,
    Journal,
    Latency,
    Notice,
    Product,
)
from caviar_broker.core.graph import Edge, Graph
from caviar_broker.core.pace import Pacer
from caviar_broker.core.plan import RunPlan, ServicePlan
from caviar_broker.core.tasks import Decision, Task, milliseconds, provenance, validate_decision
from caviar_broker.core.transitions import DECIDED, OUTSTANDING, TaskEvent, TaskState
from caviar_protocol.digest import RunDigest
from caviar_protocol.messages import GrantInput, Status


@dataclass(frozen=True, slots=True)
class GrantOrder:
    """A grant that the schedule wants sent."""

    service: str
    frame: int
    previous: int
    final: bool
    inputs: tuple[GrantInput, ...]
    products: tuple[Product, ...]


class EpisodeSchedule:
    """Schedule of one episode.

    Parameters
    ----------
    graph, plan
        The run.
    episode
        Number of the episode.
    digest
        The run's chain; finished frames are added to it.
    first_journal
        Number of the first journal entry.
    """

    def __init__(
        self, graph: Graph, plan: RunPlan, episode: int, digest: RunDigest, first_journal: int
    ) -> None:
        self.graph = graph
        self.plan = plan
        self.episode = episode
        self.frames = plan.frames
        """Frames of the episode; becomes less when an agent ends it early."""
        self.finished_frames = 0
        self.journaled = first_journal - 1
        self.grants: list[GrantOrder] = []
        self.cut: list[Task] = []
        """Granted tasks that an early end made useless; to be cancelled."""
        self.aborted: Task | None = None
        """A task of a service with policy abort that missed its deadline."""
        self.actions: list[Action] = []
        self._digest = digest
        self._next_journal = first_journal
        self._plans: Mapping[str, ServicePlan] = {p.name: p for p in plan.services}
        self._agents = frozenset(n for n in graph.order if self._plans[n].role == "agent")
        self._recorders = frozenset(n for n in graph.order if self._plans[n].role == "recorder")
        self._tasks: dict[tuple[str, int], Task] = {}
        self._next: dict[str, int] = dict.fromkeys(graph.order, 0)
        """First frame of each service that is not decided yet."""
        self._completed: dict[str, int] = dict.fromkeys(graph.order, -1)
        self._outstanding: dict[str, list[Task]] = {name: [] for name in graph.order}
        self._newest: dict[tuple[str, str], Product] = {}
        """Newest product by (service, topic), late ones included (clauses 9 and 12)."""
        self._late: list[Product] = []
        """Late products that the recorder has not been told of (clause 11)."""
        self._pacer = Pacer(plan)
        self._dirty: set[str] = set(graph.order)
        self._paused: set[str] = set()

    # --- what happens ------------------------------------------------------------------------

    def done(
        self, service: str, frame: int, products: Iterable[Product], now: int, *, end: bool = False
    ) -> None:
        """DONE for an outstanding task. Products are of declared topics (checked by the caller)."""
        task = self._answered(service, frame)
        by_topic = {p.topic: p for p in products if p.topic in self.graph.outputs[service]}
        if task.state is TaskState.ABANDONED:
            task.move(TaskEvent.ANSWER)
            self._notice("discarded", task, "answered behind the end of the episode; not used")
            return
        late = task.state is TaskState.OVERDUE
        for topic, product in by_topic.items():
            key = (service, topic)
            if key not in self._newest or self._newest[key].frame < product.frame:
                self._newest[key] = product
        task.move(TaskEvent.ANSWER)
        if late:
            elapsed = now - (task.granted_at or now)
            self._late += by_topic.values() if self._recorders else ()
            self._notice("late", task, f"answered after {milliseconds(elapsed)}; its frame had gone on")
        else:
            self._measure(task, now)
            self._decide(task, self._fresh(task, by_topic), "done")
        self._completed[service] = max(self._completed[service], frame)
        if end and service in self._agents:
            self._end_after(frame)
        self._dirty.add(service)

    def fault(self, service: str, frame: int, text: str, now: int) -> None:
        """FAULT for an outstanding task of a service with policy hold or drop."""
        task = self._answered(service, frame)
        abandoned, overdue = task.state is TaskState.ABANDONED, task.state is TaskState.OVERDUE
        task.move(TaskEvent.FAULT)
        self._notice("fault", task, text)
        self._dirty.add(service)
        if not abandoned and not overdue:
            self._measure(task, now)
            self._decide(task, self._substitute(task, f"{service} failed in frame {frame}: {text}"), "fault")

    def journal_written(self, number: int) -> None:
        """Entries up to ``number`` are safe; what waited for them may be granted."""
        if number > self.journaled:
            self.journaled = number
            self._dirty.update(self.graph.order)

    def pause(self, service: str) -> None:
        """The service is gone: its outstanding grants stay owed, no new ones are made."""
        self._paused.add(service)

    def resume(self, service: str) -> list[GrantOrder]:
        """The service is back: the grants it owes, to be sent again (clause 18).

        It starts from its reset, so ``previous`` is −1 and a world steps the whole gap.
        """
        self._paused.discard(service)
        self._dirty.add(service)
        owed = self._outstanding[service]
        previous = [-1, *(task.frame for task in owed)]
        return [self._order(task, before) for task, before in zip(owed, previous, strict=False)]

    def advance(self, now: int) -> None:
        """Grant and skip whatever can be, until nothing changes."""
        while self._dirty:
            name = min(self._dirty)
            self._dirty.discard(name)
            self._advance_service(name, now)

    def expire(self, now: int) -> None:
        """Act on deadlines that have passed (clause 9)."""
        for deadline, task in self._deadlines():
            if deadline > now:
                continue
            granted = task.state is TaskState.GRANTED
            plan = self._plans[task.service]
            if plan.policy == "abort":
                self.aborted = self.aborted or task
                continue
            cause = f"{task.service} missed frame {task.frame} ({plan.policy}, budget {milliseconds(plan.budget_ns)})"
            if not granted:
                owed = self._outstanding[task.service]
                cause += f", still busy with frame {owed[0].frame}" if owed else ", not connected"
            self._measure(task, now)
            task.move(TaskEvent.DEADLINE)
            self._notice("miss" if granted else "skipped", task, cause)
            self._decide(task, self._substitute(task, cause), "overdue" if granted else "skipped")
            self._dirty.add(task.service)
        instant = self._pacer.next_instant()
        if instant is not None and instant <= now:
            self._dirty.update(self.graph.order)
        self.advance(now)

    def next_deadline(self) -> int | None:
        """The earliest instant at which `expire` has something to do [ns]."""
        instants = [deadline for deadline, _ in self._deadlines()]
        pace = self._pacer.next_instant()
        if pace is not None:
            instants.append(pace)
        return min(instants, default=None)

    # --- what can be asked ---------------------------------------------------------------------

    @property
    def finished(self) -> bool:
        """Every frame is decided, final grants are answered, nothing is outstanding."""
        return (
            self.finished_frames >= self.frames
            and all(self._next[a] > self.frames for a in self._agents)
            and not any(self._outstanding.values())
        )

    @property
    def lag_ns(self) -> int:
        """How far real time has slipped [ns] (clause 8)."""
        return self._pacer.lag_ns

    def outstanding(self, service: str) -> list[Task]:
        """Tasks of a service for which DONE or FAULT is due, oldest first."""
        return self._outstanding[service]

    def must_answer(self, task: Task) -> bool:
        """Whether the run cannot go on without this outstanding task, so that a stall is fatal."""
        waits = self._plans[task.service].policy == "wait"
        return (waits and task.state is TaskState.GRANTED) or self.finished_frames >= self.frames

    def validate(self) -> None:
        """Cross-field invariants; raises AssertionError naming the one that is broken."""
        for name, owed in self._outstanding.items():
            plan = self._plans[name]
            capacity = plan.max_in_flight if plan.policy == "wait" else 1
            assert len(owed) <= capacity, f"{name} has {len(owed)} grants, at most {capacity} (clause 7)"
            assert all(t.state in OUTSTANDING for t in owed), f"{name} owes an answered task"
            assert [t.frame for t in owed] == sorted({t.frame for t in owed}), f"{name} grants out of order"
        for (name, frame), task in self._tasks.items():
            assert (task.state in OUTSTANDING) == (task in self._outstanding[name]), f"{task} miscounted"
            decided = task.state in DECIDED
            assert decided == (frame < self._next[name]) or task.state in (
                TaskState.ABANDONED,
                TaskState.CANCELLED,
            ), f"{task} decided out of order"
            for topic, decision in task.decisions.items():
                validate_decision(name, frame, topic, decision)
            if task.state in OUTSTANDING and task.state is not TaskState.ABANDONED and frame < self.frames:
                for edge in self.graph.inputs[name]:
                    assert self._decision_ready(edge, frame), f"{task} granted before {edge} (clause 7)"
        assert self.finished_frames <= self.frames
        assert all(n >= min(self.finished_frames, self.frames) for n in self._next.values())
        window = self.plan.frames_in_flight + 2
        assert len(self._tasks) <= len(self.graph.order) * window, "tasks are not released"
        assert all(n <= self.finished_frames + self.plan.frames_in_flight + 1 for n in self._next.values())

    # --- granting ------------------------------------------------------------------------------

    def _advance_service(self, name: str, now: int) -> None:
        while True:
            task = self._candidate(name)
            if task is None or task.state is not TaskState.PENDING:
                return
            if not self._inputs_decided(task) or not self._safe(task) or not self._released(task, now):
                return
            if task.eligible_at is None:
                task.eligible_at = now
            missing = self._missing(task)
            if missing is not None:
                task.move(TaskEvent.SKIP)
                self._notice("skipped", task, missing)
                absent = {t: Decision(Status.ABSENT, None, missing) for t in self._due_topics(task)}
                self._decide(task, absent, "skipped")
                continue
            if name in self._paused or not self._has_room(name):
                return
            task.move(TaskEvent.GRANT)
            task.granted_at = now
            in_flight = (t.frame for t in self._outstanding[name] if t.state is TaskState.GRANTED)
            previous = max(in_flight, default=self._completed[name])
            self._outstanding[name].append(task)
            self.grants.append(self._order(task, previous))

    def _candidate(self, name: str) -> Task | None:
        """The next task of a service that is not granted: behind those in flight."""
        frame = self._next[name] + sum(t.state is TaskState.GRANTED for t in self._outstanding[name])
        last = self.frames if name in self._agents else self.frames - 1
        if frame > last or frame >= self.finished_frames + self.plan.frames_in_flight + (
            frame == self.frames
        ):
            return None
        return self._tasks.setdefault((name, frame), Task(name, frame))

    def _has_room(self, name: str) -> bool:
        plan = self._plans[name]
        capacity = plan.max_in_flight if plan.policy == "wait" else 1
        return len(self._outstanding[name]) < capacity

    def _inputs_decided(self, task: Task) -> bool:
        return all(self._decision_ready(edge, task.frame) for edge in self._taken(task))

    def _taken(self, task: Task) -> tuple[Edge, ...]:
        """Edges that count in this frame: behind the last frame only those with lag 1 (clause 16)."""
        edges = self.graph.inputs[task.service]
        return edges if task.frame < self.frames else tuple(e for e in edges if e.lag == 1)

    def _decision_ready(self, edge: Edge, frame: int) -> bool:
        return frame - edge.lag < self._next[edge.source] or frame < edge.lag

    def _safe(self, task: Task) -> bool:
        """Clause 18: what this grant relies on from the frame before is in the journal."""
        relied = [e.source for e in self._taken(task) if e.lag == 1] + [task.service]
        earlier = (self._tasks.get((name, task.frame - 1)) for name in relied)
        return all(t is None or t.journal <= self.journaled for t in earlier)

    def _missing(self, task: Task) -> str | None:
        """Cause of the first required input that is absent (clause 10); the first frame has no earlier one."""
        for edge in self._taken(task):
            if edge.required and task.frame >= edge.lag:
                decision = self._decision(edge, task.frame)
                if decision.product is None:
                    return decision.cause
        return None

    def _decision(self, edge: Edge, frame: int) -> Decision:
        if frame < edge.lag:
            return Decision(Status.ABSENT, None, "there is no earlier frame")
        return self._tasks[edge.source, frame - edge.lag].decisions[edge.topic]

    def _order(self, task: Task, previous: int) -> GrantOrder:
        inputs: list[GrantInput] = []
        products: list[Product] = []
        for edge in self._taken(task):
            decision = self._decision(edge, task.frame)
            inputs.append(provenance(edge.topic, edge.source, decision, task.frame))
            if decision.product is not None:
                products.append(decision.product)
        if task.service in self._recorders:
            for product in self._late:
                late = Decision(Status.LATE, product)
                inputs.append(provenance(product.topic, product.source, late, task.frame))
                products.append(product)
            self._late = []
        return GrantOrder(
            task.service, task.frame, previous, task.frame == self.frames, tuple(inputs), tuple(products)
        )

    def _released(self, task: Task, now: int) -> bool:
        """Whether real time has come to this frame (clause 8)."""
        if task.frame >= self.frames:
            return True
        slip = self._pacer.release(task.frame, now)
        if slip is None:
            return False
        if slip > self.plan.sampling_period_ns // 10:
            behind = milliseconds(self._pacer.lag_ns)
            self._notice("lag", task, f"{milliseconds(slip)} behind real time, {behind} since the start")
        return True

    # --- deciding ----------------------------------------------------------------------------------

    def _answered(self, service: str, frame: int) -> Task:
        owed = self._outstanding[service]
        task = next(t for t in owed if t.frame == frame)
        owed.remove(task)
        return task

    def _fresh(self, task: Task, products: Mapping[str, Product]) -> dict[str, Decision]:
        return {
            topic: Decision(Status.FRESH, products[topic])
            if topic in products
            else Decision(Status.ABSENT, None, f"{task.service} produced no {topic} in frame {task.frame}")
            for topic in self._due_topics(task)
        }

    def _due_topics(self, task: Task) -> tuple[str, ...]:
        """Topics that consumers expect of a task; none of a final one."""
        return self.graph.outputs[task.service] if task.frame < self.frames else ()

    def _substitute(self, task: Task, cause: str) -> dict[str, Decision]:
        """What consumers get instead (clause 9): the newest earlier product under hold, else nothing."""
        hold = self._plans[task.service].policy == "hold"
        found = {}
        for topic in self._due_topics(task):
            held = self._newest.get((task.service, topic)) if hold else None
            status = Status.ABSENT if held is None else Status.HELD
            found[topic] = Decision(status, held, cause)
        return found

    def _decide(self, task: Task, decisions: dict[str, Decision], outcome: str) -> None:
        task.decisions = decisions
        task.journal = self._next_journal
        self._next_journal += 1
        keep = task.service in self.graph.retained or self._plans[task.service].policy == "hold"
        self.actions.append(
            Journal(
                number=task.journal,
                episode=self.episode,
                frame=task.frame,
                service=task.service,
                outcome=outcome,
                decisions=tuple(
                    provenance(topic, task.service, decision, task.frame)
                    for topic, decision in decisions.items()
                ),
                products=tuple(
                    d.product for d in decisions.values() if keep and d.status is Status.FRESH and d.product
                ),
            )
        )
        self._next[task.service] = task.frame + 1
        self._dirty.add(task.service)
        self._dirty.update(self.graph.consumers[task.service])
        self._finish_frames()

    def _finish_frames(self) -> None:
        while self.finished_frames < self.frames and all(
            n > self.finished_frames for n in self._next.values()
        ):
            frame = self.finished_frames
            self._digest.add_frame(
                self.episode,
                frame,
                (
                    (topic, name, decision.product.digest)
                    for name in self.graph.order
                    for topic, decision in self._tasks[name, frame].decisions.items()
                    if decision.status is Status.FRESH and decision.product is not None
                ),
            )
            self.actions.append(FrameFinished(self.episode, frame, self.plan.t_ns(frame), self._pacer.lag_ns))
            self.finished_frames += 1
            self._dirty.update(self.graph.order)
            for name in self.graph.order:  # lag 1 still needs this frame, nothing needs the one before
                old = self._tasks.get((name, frame - 1))
                if old is not None and old.state not in OUTSTANDING:
                    del self._tasks[name, frame - 1]

    def _end_after(self, frame: int) -> None:
        """The episode ends with ``frame`` (clause 16): what lies behind it is cut."""
        self.frames = min(self.frames, frame + 1)
        for (name, number), task in list(self._tasks.items()):
            if number < self.frames or (number == self.frames and name in self._agents):
                continue
            if task.state in (TaskState.GRANTED, TaskState.OVERDUE):
                task.move(TaskEvent.CUT)
                self.cut.append(task)
            elif task.state is not TaskState.ABANDONED:
                del self._tasks[name, number]
        for name in self._next:
            self._next[name] = min(self._next[name], self.frames + (name in self._agents))
        self._finish_frames()

    # --- bookkeeping -----------------------------------------------------------------------------

    def _deadlines(self) -> list[tuple[int, Task]]:
        """(deadline, task) of everything that does not wait."""
        found = []
        for name in self.graph.order:
            plan = self._plans[name]
            if plan.policy == "wait":
                continue
            task = self._tasks.get((name, self._next[name]))
            if task is None or task.eligible_at is None:
                continue
            if task.state in (TaskState.PENDING, TaskState.GRANTED):
                found.append((task.eligible_at + plan.budget_ns, task))
        return found

    def _measure(self, task: Task, now: int) -> None:
        start = task.granted_at if task.granted_at is not None else task.eligible_at
        elapsed = now - (now if start is None else start)
        missed = elapsed > self._plans[task.service].budget_ns or task.granted_at is None
        self.actions.append(Latency(task.service, self.episode, task.frame, elapsed, missed))

    def _notice(self, kind: str, task: Task, text: str) -> None:
        self.actions.append(Notice(kind, task.service, text, self.episode, task.frame))
