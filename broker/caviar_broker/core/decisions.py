"""The table of an episode's decisions, each made once, in order, and entered in the journal; and the budgets
of an episode: when one is up, and what follows from that (`Deadlines`).
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping

from msgspec.structs import replace

from caviar_broker.core.events import FrameFinished, Journal, Latency, Overdue, Product
from caviar_broker.core.graph import Edge
from caviar_broker.core.pace import Pacer
from caviar_broker.core.plan import milliseconds
from caviar_broker.core.run import Run
from caviar_broker.core.tasks import Decision, FinishedFrame, Participant, Task, TaskInputs, provenance_of
from caviar_broker.core.transitions import DECIDED, OUTSTANDING, TaskEvent, TaskState
from caviar_protocol.messages import GrantInput, Status

_ABSENT, _FRESH = Status.ABSENT, Status.FRESH
_NO_EARLIER_FRAME = "there is no earlier frame"


class DecisionTable:
    """Decisions of one episode, by service and frame (contract, clauses 6, 7, 9 to 12, 18 and 20).

    A service decides its frames one after the other. A frame is finished once every service has
    decided it; the fresh products of finished frames make the digest of the run.

    Args:
        run: The run, whose graph is known.
        pacer: Says how far real time has slipped, for the report on a frame.
        sources: Services whose products stand in the journal because those that take them save their state.
    """

    def __init__(self, run: Run, pacer: Pacer, sources: Collection[str] = ()) -> None:
        assert run.graph is not None
        plan, graph = run.plan, run.graph
        self.frames = plan.frames
        """Frames of the episode; becomes less when an agent ends it early."""
        self.finished_frames = 0
        plans = {service.name: service for service in plan.services}
        self.participants = {
            name: Participant(plans[name], rank, graph.outputs[name]) for rank, name in enumerate(graph.order)
        }
        self.ready = set(self.participants.values())
        """Services for which something may have changed, to be looked at by the dispatcher."""
        self.waiting_for_frames: set[Participant] = set()
        """Services that wait for frames to be finished."""
        for name, participant in self.participants.items():
            participant.inputs = self._with_sources(graph.inputs[name])
            participant.lagged = tuple(pair for pair in participant.inputs if pair[0].lag)
            participant.latest = self._with_sources(graph.latest[name])
        self._graph, self._plan, self._episode, self._pacer = graph, plan, run.episode, pacer
        self._digest, self._ledger, self._actions = run.digest, run.ledger, run.actions
        self._holding = frozenset(p.name for p in plan.services if p.holds_last_product)
        self._kept = self._holding | graph.retained | frozenset(sources)
        # A service that has not decided the first frame yet that is not finished.
        self._last = self.participants[graph.order[-1]]
        # Newest product and its journal entry by (service, topic), late ones included (clause 12).
        self._newest: dict[tuple[str, str], tuple[Product, int]] = {}

    def _with_sources(self, edges: Iterable[Edge]) -> tuple[tuple[Edge, Participant], ...]:
        return tuple((edge, self.participants[edge.source]) for edge in edges)

    def resume(
        self,
        finished: int,
        frames: int,
        tasks: Mapping[str, Mapping[int, Task]],
        newest: Mapping[tuple[str, str], tuple[Product, int]],
    ) -> None:
        """Continue after the last finished frame, with what `Resumption` has; the table must be new."""
        assert not self.finished_frames, "only a new table can go on"
        self.finished_frames, self.frames = finished, frames
        for name, participant in self.participants.items():
            participant.next_frame = finished
            participant.tasks = dict(tasks.get(name, {}))
        self._newest = {key: known for key, known in newest.items() if key[0] in self._holding}

    def release(self, task: Task) -> None:
        """Forget a task that was answered when its frame had been over already."""
        if not self.finished_frames - 1 <= task.frame < self.frames:
            del self.participants[task.service].tasks[task.frame]

    def tasks(self) -> Iterable[Task]:
        """All tasks that are not forgotten."""
        return (task for participant in self.participants.values() for task in participant.tasks.values())

    def newest(self) -> FinishedFrame | None:
        """The newest finished frame; None: there is none, or a broker before finished it."""
        frame = self.finished_frames - 1
        tasks = [p.tasks[frame] for p in self.participants.values() if frame in p.tasks]
        if not tasks:
            return None
        return FinishedFrame(
            self._episode,
            frame,
            self._plan.t_ns(frame),
            # Of a run that goes on the journal has only products that later frames may need.
            tuple([d for t in tasks for d in t.decisions.values() if d.product or d.status is _ABSENT]),
            tuple([task.report for task in tasks if task.report is not None]),
        )

    # --- what consumers get ------------------------------------------------------------------------

    def undecided_source(self, participant: Participant, frame: int) -> Participant | None:
        """A source that has not decided what a service gets of it in a frame; None: all have (clause 7)."""
        # From the last on: once the last one is decided, so are mostly the others, and few looks are in vain.
        for edge, source in participant.latest if frame < self.frames else participant.lagged:
            if frame - edge.lag >= source.next_frame and frame >= edge.lag:
                return source
        return None

    def gather_inputs(self, participant: Participant, frame: int) -> TaskInputs:
        """Inputs of a service in a frame; all of them must be decided."""
        # The service's own last decision is relied on too. What was decided in this very frame would be
        # decided again. Entries become safe in order, so nothing is missing between them.
        before = participant.tasks.get(frame - 1)
        entry = 0 if before is None else before.journal
        cause = None
        inputs: list[GrantInput] = []
        products: list[Product] = []
        for edge, source in participant.inputs if frame < self.frames else participant.lagged:
            if frame < edge.lag:
                inputs.append(
                    GrantInput(topic=edge.topic, source=edge.source, status=_ABSENT, cause=_NO_EARLIER_FRAME)
                )
                continue
            origin = source.tasks[frame - edge.lag]
            decision = origin.decisions[edge.topic]
            granted, product = decision.provenance, decision.product
            if product is not None:
                products.append(product)
                if edge.lag:
                    granted = provenance_of(product, granted.status, frame, granted.cause)
            elif edge.required and cause is None:
                cause = granted.cause
            inputs.append(granted)
            if edge.lag and origin.journal > entry:
                entry = origin.journal
            if decision.journal > entry:
                entry = decision.journal
        return TaskInputs(tuple(inputs), tuple(products), cause, entry)

    def describe_waiting(self, source: str) -> str:
        """Services that wait for an input of a source now, for its blame; empty if none does."""
        found = []
        for name in self._graph.consumers[source]:
            consumer = self.participants[name]
            frame = consumer.next_frame
            for edge, origin in consumer.inputs:
                lacks = frame <= self.frames and not origin.has_decided(edge, frame)
                if lacks and edge.source == source:
                    found.append(f"{name} waits for {edge.topic} of frame {frame - edge.lag}")
        return ", ".join(found)

    # --- deciding ----------------------------------------------------------------------------------

    def decide_answered(
        self, task: Task, products: Mapping[str, Product], now: int, recorded: Iterable[GrantInput] = ()
    ) -> None:
        """Decide a task that was answered in time; a declared product that is missing is absent.

        Args:
            task: The task.
            products: By topic.
            now: The time [ns].
            recorded: Of a replayed service: what became of its products then. They are held or absent again
                where they were, with the recorded cause.
        """
        entries, decisions = {entry.topic: entry for entry in recorded}, {}
        for topic in self._due_topics(task):
            product, entry = products.get(topic), entries.get(topic)
            status, cause = (_FRESH, "") if entry is None else (entry.status, entry.cause)
            if product is None or status is _ABSENT:
                cause = cause or f"{task.service} produced no {topic} in frame {task.frame}"
                decisions[topic] = _absent(task, topic, cause)
            elif entry is not None and status is Status.HELD:
                product = replace(product, frame=entry.frame, t_ns=entry.t_ns)
                decisions[topic] = Decision(provenance_of(product, status, task.frame, cause), product)
            else:
                decisions[topic] = Decision(provenance_of(product, _FRESH, task.frame), product)
        self._decide(task, decisions, "done", now)
        # A replayed service holds what it held, whatever came last.
        if task.service in self._holding and not entries:
            self._renew(products.values(), task.journal)

    def decide_without_answer(self, task: Task, cause: str, outcome: str, now: int) -> None:
        """Decide for a late service (clause 9): its newest earlier product is held under the policy ``hold``,
        where there is one; else the product is absent."""
        decisions = {}
        for topic in self._due_topics(task):
            held = self._newest.get((task.service, topic))
            if held is None:
                decisions[topic] = _absent(task, topic, cause)
            else:
                product, number = held
                granted = provenance_of(product, Status.HELD, task.frame, cause)
                decisions[topic] = Decision(granted, product, number)
        self._decide(task, decisions, outcome, now)

    def decide_consequence(self, task: Task, cause: str, now: int) -> None:
        """Decide that products are absent as a required input is (clause 10); its source keeps the blame."""
        absent = {topic: _absent(task, topic, cause) for topic in self._due_topics(task)}
        self._decide(task, absent, "skipped", now)

    def record_late(self, task: Task, products: Mapping[str, Product], now: int) -> None:
        """Enter products whose frame went on without them (clause 11); later frames may hold them."""
        number = self._ledger.enter(now)
        decisions = [
            Decision(provenance_of(product, Status.LATE, task.frame), product)
            for product in products.values()
        ]
        self._journal(task, decisions, "late", number)
        if task.service in self._holding:
            self._renew(products.values(), number)

    def end_after(self, frame: int) -> list[Task]:
        """End the episode with ``frame`` (clause 16); the tasks after it, forgotten unless outstanding."""
        if frame + 1 >= self.frames:
            return []
        self.frames = frame + 1
        cut = [task for task in self.tasks() if task.frame >= self.frames]
        for task in cut:
            if task.state not in OUTSTANDING:
                del self.participants[task.service].tasks[task.frame]
        for participant in self.participants.values():
            participant.next_frame = min(participant.next_frame, self.frames)
        return cut

    def _due_topics(self, task: Task) -> tuple[str, ...]:
        """Topics that consumers expect of a task; none of a final one."""
        return self.participants[task.service].outputs if task.frame < self.frames else ()

    def _renew(self, products: Iterable[Product], number: int) -> None:
        for product in products:
            key = (product.source, product.topic)
            known = self._newest.get(key)
            # No service is granted a frame before it has answered an earlier one, so products come in order.
            assert known is None or known[0].frame < product.frame, f"{product} is not newer (clause 12)"
            self._newest[key] = product, number

    def _decide(self, task: Task, decisions: dict[str, Decision], outcome: str, now: int) -> None:
        task.decisions = decisions
        task.journal = self._ledger.enter(now)
        self._journal(task, decisions.values(), outcome, task.journal)
        participant = self.participants[task.service]
        participant.next_frame = task.frame + 1
        if self._last.next_frame > self.finished_frames:
            self._finish_frames()
        # Have the dispatcher look again at the services that a decision may concern.
        latest, frame = participant.latest, participant.next_frame
        # Most services wait for the last input of their next frame now, and need not be looked at for that.
        if latest and frame < self.frames and not latest[0][1].has_decided(latest[0][0], frame):
            latest[0][1].waiting.add(participant)
        else:
            self.ready.add(participant)
        self.wake(participant.waiting)

    def wake(self, waiting: set[Participant]) -> None:
        """Have the dispatcher look again at services that waited; empties the set."""
        if waiting:
            self.ready |= waiting
            waiting.clear()

    def _journal(self, task: Task, decisions: Collection[Decision], outcome: str, number: int) -> None:
        """Products of earlier frames stand in entries of their own; others only if they may be used later."""
        if self._plan.ephemeral:
            return
        products: tuple[Product, ...] = ()
        if task.service in self._kept:
            products = tuple([d.product for d in decisions if d.product and not d.journal])
        self._actions.append(
            Journal(
                number=number,
                episode=self._episode,
                frame=task.frame,
                service=task.service,
                outcome=outcome,
                decisions=tuple([decision.provenance for decision in decisions]),
                products=products,
                chosen=task.report.decisions if task.report else None,
            )
        )

    def _finish_frames(self) -> None:
        participants = self.participants.values()
        reached = min(self.frames, *[participant.next_frame for participant in participants])
        for frame in range(self.finished_frames, reached):
            if not self._plan.ephemeral:
                self._digest.add_frame(self._episode, frame, self._fresh(frame))
            t_ns = self._plan.t_ns(frame)
            self._actions.append(FrameFinished(self._episode, frame, t_ns, self._pacer.lag_ns))
            self.finished_frames += 1
            for participant in participants:  # lag 1 still needs this frame, nothing needs the one before
                old = participant.tasks.get(frame - 1)
                if old is not None and old.state not in OUTSTANDING:
                    del participant.tasks[frame - 1]
        self.wake(self.waiting_for_frames)
        # Looked for from the last on: as long as this service lags, no other can have finished one.
        self._last = min(reversed(participants), key=lambda participant: participant.next_frame)

    def _fresh(self, frame: int) -> Iterable[tuple[str, str, str]]:
        """(topic, source, digest) of the fresh products of a frame that every service has decided."""
        return [
            (topic, participant.plan.name, decision.product.digest)
            for participant in self.participants.values()
            for topic, decision in participant.tasks[frame].decisions.items()
            if decision.provenance.status is _FRESH and decision.product is not None
        ]

    # --- invariants ----------------------------------------------------------------------------------

    def validate(self) -> None:
        """Check cross-field invariants; raises AssertionError naming the one that is broken."""
        for task in self.tasks():
            decided = task.state in DECIDED
            beyond = task.state in (TaskState.ABANDONED, TaskState.DISCARDED)
            known = task.frame < self.participants[task.service].next_frame
            assert beyond or decided == known, f"{task} decided out of order"
            assert decided == bool(task.journal) or beyond, f"{task} is not in the journal"
            for topic, decision in task.decisions.items():
                _validate_decision(f"{topic} of {task.service} in frame {task.frame}", task.frame, decision)
        assert self.finished_frames <= self.frames
        reached = [participant.next_frame for participant in self.participants.values()]
        assert all(n >= self.finished_frames for n in reached), "finished, but not decided"
        window = self.finished_frames + self._plan.frames_in_flight + 1
        assert all(n <= window for n in reached), "too many frames overlap"
        kept = [task for task in self.tasks() if task.state not in OUTSTANDING]
        assert all(task.frame >= self.finished_frames - 1 for task in kept), "tasks are not released"


def _absent(task: Task, topic: str, cause: str) -> Decision:
    return Decision(GrantInput(topic=topic, source=task.service, status=_ABSENT, cause=cause))


def _validate_decision(what: str, frame: int, decision: Decision) -> None:
    """Raise AssertionError where a decision contradicts itself (clauses 9 to 12)."""
    product, cause = decision.product, decision.provenance.cause
    match decision.provenance.status:
        case Status.FRESH:
            assert product is not None, f"{what} is fresh without a product"
            assert product.frame == frame, f"{what} is not fresh"
        case Status.HELD:
            assert product is not None, f"{what} is held without a product"
            assert product.frame < frame, f"{what} is not an earlier one"
            assert cause, f"{what} is held without a cause"
        case _:
            assert product is None, f"{what} is absent with a product"
            assert cause, f"{what} is absent without a cause"


# On the path of every frame: a member that is looked up in its class costs four times as much.
_GRANTED, _PENDING = TaskState.GRANTED, TaskState.PENDING


class Deadlines:
    """Pace and budgets of one episode (clauses 8, 9 and 13).

    Args:
        run: The run.
        table: The services' tasks; a deadline that a policy lets pass is decided there.
        pacer: Releases the frames of the episode.
    """

    def __init__(self, run: Run, table: DecisionTable, pacer: Pacer) -> None:
        self._run, self._table, self._pacer = run, table, pacer
        self._plan, self._episode, self._gate, self._actions = run.plan, run.episode, run.gate, run.actions

    # --- pace --------------------------------------------------------------------------------------

    def release(self, task: Task, now: int) -> bool:
        """Return whether the run is not paused, and real time has come to the task's frame (clause 8)."""
        if task.frame >= self._table.frames:
            return True
        if not self._gate.admits(task.frame, now):
            self._pacer.withdraw()
            return False
        self._pacer.shift(self._gate.held_ns(now))
        slip = self._pacer.release(task.frame, now)
        if slip is None:
            return False
        if self._pacer.is_notable(slip):
            behind = milliseconds(self._pacer.lag_ns)
            text = f"{milliseconds(slip)} behind real time, {behind} since the start"
            self._run.notice("lag", task.service, text, task.frame)
        return True

    def next_release(self) -> int | None:
        """Instant at which the frame is due that a service asked for in vain [ns]; None if there is none."""
        return self._pacer.next_instant()

    # --- budgets -----------------------------------------------------------------------------------

    def measure(self, task: Task, now: int) -> None:
        """Report how long a task took that was answered, or never will be."""
        # No reader gets the latencies of a run in one process that writes no files.
        if self._plan.ephemeral:
            return
        elapsed = now - task.started_at
        plan = self._table.participants[task.service].plan
        missed = task.overran or elapsed > plan.budget_ns
        missed = missed and not self._plan.is_warm_up(plan, self._episode, task.frame)
        if missed and not task.overran:
            self._blame_overrun(task, "answered before the frame went on", now)
        self._actions.append(Latency(task.service, self._episode, task.frame, elapsed, missed))

    def next(self) -> int | None:
        """The earliest instant at which a budget is up [ns]; None if none runs."""
        # A loop, not `min` over a generator: asked once in `LOOK_NS` for every service.
        instant = None
        for participant in self._table.participants.values():
            due = _budget_end(participant)
            if due is not None and (instant is None or due[0] < instant):
                instant = due[0]
        return instant

    def expire(self, now: int) -> None:
        """Act on budgets that are up (clause 9)."""
        for participant in self._table.participants.values():
            due = _budget_end(participant)
            if due is not None and due[0] <= now:
                self._expire(participant, due[1], due[0], now)

    def expire_before_answer(self, participant: Participant, now: int) -> None:
        """Act on the budget of the task that is answered now, if it is up: that answer is late (clause 11).

        The shell looks at deadlines every few milliseconds; an answer must not gain by coming in between.
        Under ``wait`` there is nothing to decide: `measure` counts the miss.
        """
        task, plan = participant.outstanding[0], participant.plan
        deadline = task.started_at + plan.budget_ns
        if now > deadline and not plan.waits_for_answer and task.state is _GRANTED and not task.overran:
            self._expire(participant, task, deadline, now)

    def _expire(self, participant: Participant, task: Task, deadline: int, now: int) -> None:
        plan, granted = participant.plan, task.state is _GRANTED
        # Noted before the policy is asked: `measure` counts a miss under each of them.
        task.overran = granted
        if self._plan.is_warm_up(plan, self._episode, task.frame):
            return
        self._actions.append(Overdue(task.service, self._episode, task.frame, deadline))
        if plan.ends_run_when_late:
            member = self._run.members[task.service]
            waiting = self._table.describe_waiting(task.service)
            text = member.blame_task(task, "overran its budget (policy abort)", now, waiting)
            self._run.fail(text, task.service, now)
            return
        if plan.waits_for_answer:
            self._blame_overrun(task, "the frame waits", now)
            return
        # The cause travels with the held or absent product to consumers and into the recording (clause 9).
        cause = (
            f"{task.service} missed frame {task.frame} ({plan.policy}, budget {milliseconds(plan.budget_ns)})"
        )
        task.move(TaskEvent.DEADLINE)
        if granted:
            self._blame_overrun(task, f"the frame goes on ({plan.policy})", now)
            self._table.decide_without_answer(task, cause, "overdue", now)
            return
        if participant.outstanding:
            cause += f", still busy with frame {participant.outstanding[0].frame}"
        else:
            cause += ", saving its state" if participant.saving else ", not connected"
        elapsed = now - (task.eligible_at or now)
        self._actions.append(Latency(task.service, self._episode, task.frame, elapsed, missed=True))
        heard = self._run.members[task.service].last_words(now)
        self._run.notice("skipped", task.service, f"{cause}; {heard}", task.frame)
        self._table.decide_without_answer(task, cause, "skipped", now)

    def _blame_overrun(self, task: Task, remedy: str, now: int) -> None:
        """Report a granted task whose budget is up, and what is done about it (clause 14)."""
        waiting = self._table.describe_waiting(task.service)
        text = self._run.members[task.service].blame_task(task, "overran its budget", now, waiting)
        self._run.notice("miss", task.service, f"{text}; {remedy}", task.frame)


def _budget_end(participant: Participant) -> tuple[int, Task] | None:
    """End of the budget of the next task of a service [ns], and the task; None: no budget runs."""
    task, plan = participant.tasks.get(participant.next_frame), participant.plan
    if task is None:
        return None
    if task.state is _GRANTED:
        return None if task.overran else (task.started_at + plan.budget_ns, task)
    if task.state is _PENDING and task.eligible_at is not None:
        waits = plan.waits_for_answer or (plan.ends_run_when_late and participant.saving)
        return None if waits else (task.eligible_at + plan.budget_ns, task)
    return None
