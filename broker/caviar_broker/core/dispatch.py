"""The frames of one episode: who may be granted what, and what becomes of answers.

`Dispatcher` implements clauses 6 to 13 and 16 of the contract for a fixed graph. It knows
nothing of joining, dying or messages; `episodes.Episodes` does that around it.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping

from msgspec.structs import replace

from caviar_broker.core.deadlines import Deadlines, PauseGate
from caviar_broker.core.decisions import (
    Decision,
    DecisionTable,
    GrantOrder,
    Inputs,
    Ledger,
    Task,
    TaskInputs,
    milliseconds,
    provenance,
)
from caviar_broker.core.events import Action, Notice, Product
from caviar_broker.core.graph import Graph
from caviar_broker.core.plan import RunPlan, ServicePlan
from caviar_broker.core.run import Resumption
from caviar_broker.core.transitions import OUTSTANDING, TaskEvent, TaskState
from caviar_protocol.digest import RunDigest
from caviar_protocol.messages import GrantInput, Report, Status


class Turns:
    """Turns of the services of one episode (clauses 7 and 16).

    After something happened only services that may be concerned are looked at again. Who waits for another
    service's decision, for the journal, for real time or for frames to be finished is remembered until that
    comes. A service that lacks several inputs waits for one of them at a time, for the last one of a frame
    first, so few answers bring it back in vain.
    """

    def __init__(self, graph: Graph, plan: RunPlan, book: DecisionTable) -> None:
        self._roles = roles = {service.name: service.role for service in plan.services}
        self.agents = tuple(name for name in graph.order if roles[name] == "agent")
        self.recorders = tuple(name for name in graph.order if roles[name] == "recorder")
        self.others = tuple(name for name in reversed(graph.order) if name not in self.recorders)
        """All but the recorders, those behind others in the graph first."""
        self.concerned = set(graph.order)
        """Services for which something may have changed."""
        self.waiting_for_journal: set[str] = set()
        self.waiting_for_pace: set[str] = set()
        self._waiting_for_frames: set[str] = set()
        self._finished = 0
        """Finished frames when somebody was last woken for them."""
        self._awaiting: dict[str, set[str]] = {name: set() for name in graph.order}
        """Who waits for the next decision of each service."""
        self._graph, self._plan, self._book = graph, plan, book

    def candidate(self, name: str, in_flight: int) -> Task | None:
        """The next task of a service behind those in flight; None: it has to wait for others, or is through.

        No agent runs ahead of one that may end the episode, and no recorder of what may be cut then.
        """
        book = self._book
        frame, role = book.next[name] + in_flight, self._roles[name]
        if frame >= book.frames and (role != "agent" or frame > book.frames):
            return None
        if frame >= book.finished_frames + self._plan.frames_in_flight + (frame == book.frames):
            self._waiting_for_frames.add(name)
            return None
        if role == "agent":
            for agent in self.agents:
                if book.next[agent] < frame:
                    self.waits_for(agent, name)
                    return None
        elif role == "recorder":
            for other in self.others:
                if book.next[other] <= frame:
                    self.waits_for(other, name)
                    return None
        return book.task(name, frame)

    def waits_for(self, source: str, name: str) -> None:
        """A service can have no turn before the next decision of another."""
        self._awaiting[source].add(name)

    def decided(self, name: str) -> None:
        """A service's task was decided: whom may that concern?"""
        if not self._waits_for_last_input(name):
            self.concerned.add(name)
        self.wake(self._awaiting[name])
        if self._book.finished_frames != self._finished:
            self._finished = self._book.finished_frames
            self.wake(self._waiting_for_frames)

    def _waits_for_last_input(self, name: str) -> bool:
        """Whether a service, which has just decided a frame, waits for its last input now, as most do."""
        book, edges = self._book, self._graph.latest[name]
        frame = book.next[name]
        if edges and frame < book.frames and not book.decided(edges[0], frame):
            self.waits_for(edges[0].source, name)
            return True
        return False

    def wake(self, waiting: set[str]) -> None:
        """What these services waited for has come."""
        if waiting:
            self.concerned |= waiting
            waiting.clear()

    def wake_all(self) -> None:
        """Everything may have changed."""
        decisions = self._awaiting.values()
        for waiting in (
            self.waiting_for_journal,
            self.waiting_for_pace,
            self._waiting_for_frames,
            *decisions,
        ):
            waiting.clear()
        self.concerned.update(self._graph.order)


class Orders:
    """Writes the grants of one episode."""

    def __init__(self, book: DecisionTable, turns: Turns) -> None:
        self._book, self._turns = book, turns
        self.late: list[Product] = []
        """Late products that the recorder has not been told of (clause 11)."""

    def order(self, task: Task, gathered: TaskInputs, previous: int) -> GrantOrder:
        """The grant of a task to a service whose last frame is ``previous``."""
        inputs, products = gathered.provided(task.frame)
        reports: list[Report] = []
        if task.service in self._turns.recorders:
            told = [product for product in self.late if product.frame <= task.frame]
            self.late = [product for product in self.late if product.frame > task.frame]
            inputs += [_late_input(product, task.frame) for product in told]
            products += told
            of_frame = (self._book.find(name, task.frame) for name in self._turns.others)
            reports = sorted((t.report for t in of_frame if t and t.report), key=lambda r: r.source)
        final = task.frame == self._book.frames
        return GrantOrder(
            task.service, task.frame, previous, final, tuple(inputs), tuple(products), tuple(reports)
        )


def _late_input(product: Product, frame: int) -> GrantInput:
    return provenance(product.topic, product.source, Decision(Status.LATE, product), frame)


# On the path of every frame: a member that is looked up in its class costs four times as much.
_GRANTED, _OVERDUE, _ABANDONED = TaskState.GRANTED, TaskState.OVERDUE, TaskState.ABANDONED
_GRANT, _ANSWER = TaskEvent.GRANT, TaskEvent.ANSWER


class Dispatcher:
    """Schedule of one episode.

    What it wants done collects in ``actions``, `grants` and `cut`, and in its `deadlines`, for the caller to
    carry out.

    Parameters
    ----------
    graph, plan
        The run.
    capacity
        Grants that each service can have outstanding (clause 7).
    episode
        Number of the episode.
    digest, ledger
        The run's digest and journal.
    actions
        Where what is told, recorded and written goes, in order.
    gate
        Whether the run is paused.
    remembering
        Services that save their state.
    """

    def __init__(
        self,
        graph: Graph,
        plan: RunPlan,
        capacity: Mapping[str, int],
        episode: int,
        digest: RunDigest,
        ledger: Ledger,
        actions: list[Action],
        gate: PauseGate | None = None,
        remembering: Collection[str] = (),
    ) -> None:
        self.graph, self.plan, self.episode = graph, plan, episode
        self.grants: list[GrantOrder] = []
        self.cut: list[Task] = []
        """Granted tasks that an early end made useless; to be cancelled."""
        self._plans: Mapping[str, ServicePlan] = {p.name: p for p in plan.services}
        self._capacity, self._ledger, self._actions = capacity, ledger, actions
        self._first_entry = ledger.last
        self._gate = gate or PauseGate()
        sources = {edge.source for name in remembering for edge in graph.inputs[name]}
        self._book = DecisionTable(graph, plan, episode, digest, ledger, actions, sources)
        self._inputs = Inputs(graph, self._book)
        self._turns = Turns(graph, plan, self._book)
        self._wanted = {name: frozenset(topics) for name, topics in graph.outputs.items()}
        self._rank = {name: rank for rank, name in enumerate(graph.order)}
        self._completed = dict.fromkeys(graph.order, -1)
        self._outstanding: dict[str, list[Task]] = {name: [] for name in graph.order}
        self._orders = Orders(self._book, self._turns)
        self._paused: set[str] = set()
        self._saving: set[str] = set()
        self.deadlines = Deadlines(
            plan, episode, self._book, self._turns, self._gate, self._outstanding, self._saving, actions
        )
        """Pace and budgets, and what was overrun."""

    def go_on(self, resumption: Resumption, completed: Mapping[str, int]) -> None:
        """Go on behind the last finished frame; ``completed`` says how far services got that have state."""
        left = resumption
        self._book.go_on(left.finished, left.frames, left.tasks, left.newest)
        self._book.forget_before(resumption.finished - 1)
        self._completed.update(completed)

    # --- what happens ------------------------------------------------------------------------------

    def done(
        self,
        service: str,
        frame: int,
        products: Mapping[str, Product],
        now: int,
        report: Report | None = None,
        *,
        end: bool = False,
    ) -> None:
        """DONE for the oldest outstanding task. Products are of declared topics (checked by the caller)."""
        task, wanted = self._answered(service, frame, now), self._wanted[service]
        if products.keys() != wanted:
            products = {topic: product for topic, product in products.items() if topic in wanted}
        state = task.state
        task.move(_ANSWER)
        if state is _ABANDONED:
            self._book.release(task)
            self._notice("discarded", task, "answered behind the end of the episode; not used")
            return
        self._completed[service] = max(self._completed[service], frame)
        self.deadlines.measure(task, now)
        if state is _OVERDUE:
            self._came_late(task, products, now)
        else:
            task.report = report
            recorded = self.plan.recorded.get((service, self.episode, frame))
            if recorded is None:
                self._book.fresh(task, products, now)
            else:
                self._book.as_recorded(task, recorded, products, now)
            self._turns.decided(task.service)
        if frame >= self._book.frames and products:
            self._notice("discarded", task, f"answered its final grant with {', '.join(sorted(products))}")
        if end and service in self._turns.agents:
            self._end_after(frame)

    def fault(self, service: str, frame: int, text: str, now: int) -> None:
        """FAULT for the oldest outstanding task, of a service the run can do without in this frame."""
        task = self._answered(service, frame, now)
        state = task.state
        task.move(TaskEvent.FAULT)
        self._notice("fault", task, text)
        if state is _ABANDONED:
            self._book.release(task)
            return
        self.deadlines.measure(task, now)
        if state is _OVERDUE:
            self._book.release(task)
        else:
            self._book.substitute(task, f"{service} failed in frame {frame}: {text}", "fault", now)
            self._turns.decided(task.service)

    @property
    def waits_for_journal(self) -> bool:
        """Whether somebody can be granted nothing before more entries of the ledger are safe."""
        return bool(self._turns.waiting_for_journal)

    def journal_written(self) -> None:
        """More entries of the ledger are safe; what waited for them may be granted."""
        self._turns.wake(self._turns.waiting_for_journal)

    def gate_moved(self) -> None:
        """The run was paused, or goes on."""
        self._turns.wake(self._turns.waiting_for_pace)

    def pause(self, service: str) -> None:
        """The service is gone: its outstanding grants stay owed, no new ones are made."""
        self._paused.add(service)

    def resume(self, service: str, now: int, completed: int = -1) -> list[GrantOrder]:
        """The service is back: the grants it owes, to be sent again (clause 18).

        It has got as far as ``completed``; from its reset that is −1, and a world steps the whole gap.
        """
        self._paused.discard(service)
        self._saving.discard(service)
        self._turns.concerned.add(service)
        self._completed[service] = previous = completed
        again = []
        for task in self._outstanding[service]:
            task.started_at = now
            if task.order is not None:
                task.order = replace(task.order, previous=previous)
                again.append(task.order)
            previous = task.frame
        return again

    def save(self, service: str) -> None:
        """The service shall save its state: no new grants are made until `saved`."""
        self._saving.add(service)

    def saved(self, service: str, now: int) -> None:
        """The service has saved its state."""
        self._saving.discard(service)
        self._turns.concerned.add(service)
        task = self._book.find(service, self._book.next[service])
        if task is not None and self._plans[service].policy == "abort" and task.eligible_at is not None:
            task.eligible_at = now  # it could not have been granted before

    def is_through(self, service: str) -> bool:
        """Whether a service has nothing more to do in the episode."""
        return self._book.next[service] >= self._book.frames + (service in self._turns.agents)

    def advance(self, now: int) -> None:
        """Grant and skip whatever can be, until nothing changes."""
        concerned = self._turns.concerned
        while concerned:
            names = sorted(concerned, key=self._rank.__getitem__)
            concerned.clear()
            for name in names:
                self._advance_service(name, now)

    def close(self, now: int) -> None:
        """The episode is over, or the run ends within it: tell what was left unanswered or unused."""
        for product in self._orders.late:
            text = f"{product.topic} came after the recorder's last grant; not recorded"
            self._notice("discarded", Task(product.source, product.frame), text)
        for owed in self._outstanding.values():
            for task in owed:
                if task.overran:
                    self.deadlines.measure(task, now)
                    self._notice("late", task, "was never answered")

    # --- what can be asked -------------------------------------------------------------------------

    @property
    def finished_frames(self) -> int:
        """Frames that everybody has decided."""
        return self._book.finished_frames

    @property
    def frames(self) -> int:
        """Frames of the episode; becomes less when an agent ends it early."""
        return self._book.frames

    @property
    def begun(self) -> int:
        """The last frame that has begun for somebody; −1: none."""
        granted = (owed[-1].frame for owed in self._outstanding.values() if owed)
        begun = max(max(self._book.next.values()) - 1, max(granted, default=-1))
        return min(begun, self._book.frames - 1)

    @property
    def finished(self) -> bool:
        """Whether every frame is decided, final grants are answered, and nobody is waited for."""
        return self._over and not any(owed and self._binds(name) for name, owed in self._outstanding.items())

    @property
    def _over(self) -> bool:
        book, agents = self._book, self._turns.agents
        return book.finished_frames >= book.frames and all(book.next[a] > book.frames for a in agents)

    def _binds(self, service: str) -> bool:
        """Whether the end of the episode waits for what a service still owes.

        Behind the last episode there is no RESET that it had to be ready for, so whom the run can do
        without is not waited for.
        """
        last = self.episode + 1 >= self.plan.episodes
        return not last or self._plans[service].policy in ("wait", "abort")

    def outstanding(self, service: str) -> list[Task]:
        """Tasks of a service for which DONE or FAULT is due, oldest first."""
        return self._outstanding[service]

    def awaited(self, service: str) -> Task | None:
        """The outstanding task of a service without which the run cannot go on: no progress is fatal."""
        owed = self._outstanding[service]
        if not owed:
            return None
        waits = self._plans[service].policy == "wait" and owed[0].state is _GRANTED
        return owed[0] if waits or (self._over and self._binds(service)) else None

    def waiting_for(self, service: str) -> str:
        """Who lacks which input of a service now, for its blame; empty if nobody does."""
        return self._inputs.lacking(service)

    def validate(self) -> None:
        """Cross-field invariants; raises AssertionError naming the one that is broken."""
        self._book.validate()
        for name, owed in self._outstanding.items():
            capacity = self._capacity[name]
            assert len(owed) <= capacity, f"{name} has {len(owed)} grants, at most {capacity} (clause 7)"
            assert all(t.state in OUTSTANDING for t in owed), f"{name} owes an answered task"
            assert all(t.order is not None for t in owed), f"{name} owes what it was not granted"
            assert [t.frame for t in owed] == sorted({t.frame for t in owed}), f"{name} grants out of order"
        for task in self._book.tasks():
            owed = self._outstanding[task.service]
            assert (task.state in OUTSTANDING) == (task in owed), f"{task} miscounted"
            if task.state in (TaskState.GRANTED, TaskState.OVERDUE):
                for edge in self._inputs.taken(task):
                    assert self._book.decided(edge, task.frame), f"{task} granted before {edge} (clause 7)"

    # --- granting ----------------------------------------------------------------------------------

    def _advance_service(self, name: str, now: int) -> None:
        while True:
            owed = self._outstanding[name]
            has_room = len(owed) < self._capacity[name]
            in_flight = 0
            for granted in owed:
                in_flight += granted.state is _GRANTED
            if in_flight and not has_room:
                return  # its answer brings it back
            task = self._turns.candidate(name, in_flight)
            if task is None:
                return
            inputs, task.inputs = task.inputs, None
            if inputs is None:
                if (source := self._inputs.undecided(task)) is not None:
                    self._turns.waits_for(source, name)
                    return
                inputs = self._inputs.gathered(task)
            if self._ledger.written < inputs.entry or self._ledger.written < self._first_entry:
                self._turns.waiting_for_journal.add(name)
                # Behind another frame of the service, which is not decided yet, it will rely on more.
                task.inputs = None if in_flight else inputs
                return
            if (self.plan.realtime or self._gate.closed) and not self.deadlines.released(task, now):
                self._turns.waiting_for_pace.add(name)
                return
            if in_flight and inputs.cause is not None:
                return  # it is skipped when its turn has come
            if task.eligible_at is None:
                task.eligible_at = now
            if inputs.cause is not None:
                task.move(TaskEvent.SKIP)
                self._notice("skipped", task, inputs.cause)
                self._book.consequence(task, inputs.cause, now)
                self._turns.decided(task.service)
            elif has_room and name not in self._paused and name not in self._saving:
                self._grant(task, inputs, now)
            else:
                return

    def _grant(self, task: Task, inputs: TaskInputs, now: int) -> None:
        owed = self._outstanding[task.service]
        previous = owed[-1].frame if owed else self._completed[task.service]
        task.move(_GRANT)
        task.started_at = now
        task.order = self._orders.order(task, inputs, previous)
        owed.append(task)
        self.grants.append(task.order)

    # --- answers -------------------------------------------------------------------------------------

    def _answered(self, service: str, frame: int, now: int) -> Task:
        owed = self._outstanding[service]
        task = owed.pop(0)
        assert task.frame == frame, f"{service} answered {frame}, it owes {task.frame}"
        if owed:
            owed[0].started_at = now  # it was queued until now
        task.order = None
        if task.state is not _GRANTED:
            self._turns.concerned.add(service)  # it was decided before; else that brings it back
        return task

    def _came_late(self, task: Task, products: Mapping[str, Product], now: int) -> None:
        elapsed = milliseconds(now - task.started_at)
        self._notice("late", task, f"answered after {elapsed}; its frame had gone on")
        self._book.late(task, products, now)
        if self._turns.recorders:
            self._orders.late += products.values()
        self._book.release(task)

    def _end_after(self, frame: int) -> None:
        """An agent ends the episode with ``frame`` (clause 16): what lies behind it is cut.

        An agent that is late cannot undo what others did meanwhile: the episode then ends with the
        last frame that any agent was granted.
        """
        in_flight = (t.frame for agent in self._turns.agents for t in self._outstanding[agent])
        reached = max((self._book.next[agent] - 1 for agent in self._turns.agents), default=frame)
        for task in self._book.end_after(max(frame, reached, *in_flight)):
            if task.state in OUTSTANDING:
                task.move(TaskEvent.CUT)
                self.cut.append(task)
        self._turns.wake_all()

    def _notice(self, kind: str, task: Task, text: str) -> None:
        self._actions.append(Notice(kind, task.service, text, self.episode, task.frame))
