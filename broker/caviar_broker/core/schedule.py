"""The frames of one episode: who may be granted what, when, and what happens at a deadline.

`EpisodeSchedule` implements clauses 6 to 13 and 16 of the contract for a fixed graph. It knows
nothing of joining, dying or messages; `episodes.Episodes` does that around it.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping

from msgspec.structs import replace

from caviar_broker.core.decisions import DecisionBook
from caviar_broker.core.events import Action, Latency, Notice, Overdue, Product
from caviar_broker.core.gate import Gate
from caviar_broker.core.graph import Graph
from caviar_broker.core.inputs import Gathered, Inputs
from caviar_broker.core.ledger import Ledger
from caviar_broker.core.pace import Pacer
from caviar_broker.core.plan import RunPlan, ServicePlan
from caviar_broker.core.resumption import Resumption
from caviar_broker.core.tasks import Decision, GrantOrder, Task, milliseconds, provenance
from caviar_broker.core.transitions import OUTSTANDING, TaskEvent, TaskState
from caviar_broker.core.turns import Turns
from caviar_protocol.digest import RunDigest
from caviar_protocol.messages import GrantInput, Report, Status

# On the path of every frame: a member that is looked up in its class costs four times as much.
_GRANTED, _OVERDUE, _ABANDONED = TaskState.GRANTED, TaskState.OVERDUE, TaskState.ABANDONED
_GRANT, _ANSWER = TaskEvent.GRANT, TaskEvent.ANSWER


class EpisodeSchedule:
    """Schedule of one episode.

    What it wants done collects in `actions`, `grants`, `cut`, `overruns`, `skips` and `aborted`,
    for the caller to carry out.

    Parameters
    ----------
    graph, plan
        The run.
    capacity
        Grants that each service can have outstanding (clause 7).
    episode
        Number of the episode.
    digest, ledger, gate
        The run's digest and journal, and whether it is paused.
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
        gate: Gate | None = None,
        remembering: Collection[str] = (),
    ) -> None:
        self.graph, self.plan, self.episode = graph, plan, episode
        self.actions: list[Action] = []
        self.grants: list[GrantOrder] = []
        self.cut: list[Task] = []
        """Granted tasks that an early end made useless; to be cancelled."""
        self.overruns: list[tuple[Task, str]] = []
        """Granted tasks whose budget is up, and what is done about it; to be blamed (clause 14)."""
        self.skips: list[tuple[Task, str]] = []
        """Tasks that were never granted and whose budget is up, and why; to be blamed likewise."""
        self.aborted: Task | None = None
        """A task of a service with policy abort that missed its deadline."""
        self._plans: Mapping[str, ServicePlan] = {p.name: p for p in plan.services}
        self._capacity, self._ledger = capacity, ledger
        self._first_entry = ledger.last
        self._pacer, self._gate = Pacer(plan), gate or Gate()
        sources = {edge.source for name in remembering for edge in graph.inputs[name]}
        self._book = DecisionBook(graph, plan, episode, digest, ledger, self.actions, sources)
        self._book.lag_ns = lambda: self._pacer.lag_ns
        self._inputs = Inputs(graph, self._book)
        self._turns = Turns(graph, plan, self._book)
        self._completed = dict.fromkeys(graph.order, -1)
        self._outstanding: dict[str, list[Task]] = {name: [] for name in graph.order}
        self._late: list[Product] = []
        """Late products that the recorder has not been told of (clause 11)."""
        self._paused: set[str] = set()
        self._saving: set[str] = set()

    def go_on(self, resumption: Resumption, completed: Mapping[str, int]) -> None:
        """Go on behind the last finished frame; ``completed`` says how far services got that have state."""
        resumption.restore(self._book)
        self._book.forget_before(resumption.finished - 1)
        self._completed.update(completed)

    # --- what happens ------------------------------------------------------------------------------

    def done(
        self,
        service: str,
        frame: int,
        products: Iterable[Product],
        now: int,
        report: Report | None = None,
        *,
        end: bool = False,
    ) -> None:
        """DONE for the oldest outstanding task. Products are of declared topics (checked by the caller)."""
        task = self._answered(service, frame, now)
        state, by_topic = task.state, {p.topic: p for p in products if p.topic in self.graph.outputs[service]}
        task.move(_ANSWER)
        if state is _ABANDONED:
            self._book.release(task)
            self._notice("discarded", task, "answered behind the end of the episode; not used")
            return
        self._completed[service] = max(self._completed[service], frame)
        self._measure(task, now)
        if state is _OVERDUE:
            self._came_late(task, by_topic, now)
        else:
            task.report = report
            recorded = self.plan.recorded.get((service, self.episode, frame))
            if recorded is None:
                self._book.fresh(task, by_topic, now)
            else:
                self._book.as_recorded(task, recorded, by_topic, now)
            self._turns.decided(task.service)
        if frame >= self._book.frames and by_topic:
            self._notice("discarded", task, f"answered its final grant with {', '.join(sorted(by_topic))}")
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
        self._measure(task, now)
        if state is _OVERDUE:
            self._book.release(task)
        else:
            self._book.substitute(task, f"{service} failed in frame {frame}: {text}", "fault", now)
            self._turns.decided(task.service)

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
            for name in self.graph.order:
                if name in concerned:
                    concerned.discard(name)
                    self._advance_service(name, now)

    def expire(self, now: int) -> None:
        """Act on deadlines that have passed (clause 9)."""
        for name in self.graph.order:
            due = self._due(name)
            if due is not None and due[0] <= now:
                self.actions.append(Overdue(name, self.episode, due[1].frame, due[0]))
                self._expired(due[1], now)
        instant = self._next_release()
        if instant is not None and instant <= now:
            self._turns.wake(self._turns.waiting_for_pace)

    def next_deadline(self) -> int | None:
        """The earliest instant at which `expire` has something to do [ns]."""
        instant = self._next_release()
        for name in self.graph.order:
            due = self._due(name)
            if due is not None and (instant is None or due[0] < instant):
                instant = due[0]
        return instant

    def close(self, now: int) -> None:
        """The episode is over, or the run ends within it: tell what was left unanswered or unused."""
        for product in self._late:
            text = f"{product.topic} came after the recorder's last grant; not recorded"
            self._notice("discarded", Task(product.source, product.frame), text)
        for owed in self._outstanding.values():
            for task in owed:
                if task.overran:
                    self._measure(task, now)
                    self._notice("late", task, "was never answered")

    # --- what can be asked -------------------------------------------------------------------------

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
            in_flight = len([t for t in owed if t.state is _GRANTED]) if owed else 0
            if in_flight and not has_room:
                return  # its answer brings it back
            task = self._turns.candidate(name, in_flight)
            inputs = self._inputs.gathered(task) if task is not None else None
            if task is None or inputs is None:
                return
            if self._ledger.written < max(self._first_entry, inputs.entry):
                self._turns.waiting_for_journal.add(name)
                return
            if (self.plan.realtime or self._gate.closed) and not self._released(task, now):
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

    def _released(self, task: Task, now: int) -> bool:
        """Whether the run is not paused, and real time has come to this frame (clause 8)."""
        if task.frame >= self._book.frames:
            return True
        if not self._gate.admits(task.frame, now):
            self._pacer.withdraw()
            return False
        self._pacer.shift(self._gate.held_ns(now))
        slip = self._pacer.release(task.frame, now)
        if slip is None:
            return False
        self._turns.wake(self._turns.waiting_for_pace)  # whoever asks first releases the frame for all
        if self._pacer.tells(slip):
            behind = milliseconds(self._pacer.lag_ns)
            self._notice("lag", task, f"{milliseconds(slip)} behind real time, {behind} since the start")
        return True

    def _next_release(self) -> int | None:
        """When the frame that somebody waits for will be due; None if nobody does."""
        return self._pacer.next_instant() if self._turns.waiting_for_pace else None

    def _grant(self, task: Task, inputs: Gathered, now: int) -> None:
        owed = self._outstanding[task.service]
        previous = owed[-1].frame if owed else self._completed[task.service]
        task.move(_GRANT)
        task.started_at = now
        task.order = self._order(task, inputs, previous)
        owed.append(task)
        self.grants.append(task.order)

    def _order(self, task: Task, gathered: Gathered, previous: int) -> GrantOrder:
        inputs, products = gathered.provided(task.frame)
        reports: list[Report] = []
        if task.service in self._turns.recorders:
            told = [product for product in self._late if product.frame <= task.frame]
            self._late = [product for product in self._late if product.frame > task.frame]
            inputs += [_late_input(product, task.frame) for product in told]
            products += told
            of_frame = (self._book.find(name, task.frame) for name in self._turns.others)
            reports = sorted((t.report for t in of_frame if t and t.report), key=lambda r: r.source)
        final = task.frame == self._book.frames
        return GrantOrder(
            task.service, task.frame, previous, final, tuple(inputs), tuple(products), tuple(reports)
        )

    # --- answers and deadlines -----------------------------------------------------------------------

    def _answered(self, service: str, frame: int, now: int) -> Task:
        owed = self._outstanding[service]
        task = owed.pop(0)
        assert task.frame == frame, f"{service} answered {frame}, it owes {task.frame}"
        if owed:
            owed[0].started_at = now  # it was queued until now
        task.order = None
        self._turns.concerned.add(service)
        return task

    def _came_late(self, task: Task, products: Mapping[str, Product], now: int) -> None:
        elapsed = milliseconds(now - task.started_at)
        self._notice("late", task, f"answered after {elapsed}; its frame had gone on")
        self._book.late(task, products, now)
        if self._turns.recorders:
            self._late += products.values()
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

    def _due(self, name: str) -> tuple[int, Task] | None:
        """When the budget of what a service has to do next is up."""
        task = self._book.find(name, self._book.next[name])
        if task is None:
            return None
        budget = self._plans[name].budget_ns
        if task.state is _GRANTED:
            return None if task.overran else (task.started_at + budget, task)
        if task.state is TaskState.PENDING and task.eligible_at is not None:
            policy = self._plans[name].policy
            waits = policy == "wait" or (policy == "abort" and name in self._saving)
            return None if waits else (task.eligible_at + budget, task)
        return None

    def _expired(self, task: Task, now: int) -> None:
        plan, granted = self._plans[task.service], task.state is _GRANTED
        budget = milliseconds(plan.budget_ns)
        task.overran = granted
        if plan.policy == "abort":
            self.aborted = self.aborted or task
        elif plan.policy == "wait":
            self.overruns.append((task, "the frame waits"))
        elif granted:
            cause = f"{task.service} missed frame {task.frame} ({plan.policy}, budget {budget})"
            task.move(TaskEvent.DEADLINE)
            self.overruns.append((task, f"the frame goes on ({plan.policy})"))
            self._book.substitute(task, cause, "overdue", now)
            self._turns.decided(task.service)
        else:
            owed = self._outstanding[task.service]
            why = f"still busy with frame {owed[0].frame}" if owed else "not connected"
            if not owed and task.service in self._saving:
                why = "saving its state"
            cause = f"{task.service} missed frame {task.frame} ({plan.policy}, budget {budget}), {why}"
            elapsed = now - (task.eligible_at or now)
            self.actions.append(Latency(task.service, self.episode, task.frame, elapsed, missed=True))
            task.move(TaskEvent.DEADLINE)
            self.skips.append((task, cause))
            self._book.substitute(task, cause, "skipped", now)
            self._turns.decided(task.service)

    def _measure(self, task: Task, now: int) -> None:
        if self.plan.ephemeral:
            return
        elapsed = now - task.started_at
        missed = task.overran or elapsed > self._plans[task.service].budget_ns
        if missed and not task.overran:
            self.overruns.append((task, "answered before the frame went on"))
        self.actions.append(Latency(task.service, self.episode, task.frame, elapsed, missed))

    def _notice(self, kind: str, task: Task, text: str) -> None:
        self.actions.append(Notice(kind, task.service, text, self.episode, task.frame))


def _late_input(product: Product, frame: int) -> GrantInput:
    return provenance(product.topic, product.source, Decision(Status.LATE, product), frame)
