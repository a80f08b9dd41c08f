"""Dispatch of the frames of one episode: which service is granted what and when, and what becomes of answers.

`Dispatcher` implements clauses 6 to 13 and 16 of the contract for a fixed graph. It knows nothing of joining,
dying or messages; `caviar_broker.core.episodes.Episodes` does that around it.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping

from msgspec.structs import replace

from caviar_broker.core.decisions import Deadlines, DecisionTable
from caviar_broker.core.events import Product
from caviar_broker.core.geometry import GeometryLedger
from caviar_broker.core.pace import Pacer
from caviar_broker.core.plan import milliseconds
from caviar_broker.core.run import Resumption, Run
from caviar_broker.core.tasks import GrantOrder, Participant, Task, TaskInputs, provenance_of
from caviar_broker.core.transitions import OUTSTANDING, TaskEvent, TaskState
from caviar_protocol.messages import Cancel, Report, Status

# On the path of every frame: a member that is looked up in its class costs four times as much.
_GRANTED, _OVERDUE, _ABANDONED = TaskState.GRANTED, TaskState.OVERDUE, TaskState.ABANDONED
_GRANT, _ANSWER = TaskEvent.GRANT, TaskEvent.ANSWER


class Dispatcher:
    """Grants the frames of one episode.

    After an event only services that it may concern are looked at again. A service that waits for another
    one's decision, for the journal, for real time or for frames to be finished is noted until that comes. One
    that lacks several inputs waits for one of them at a time, for the last one of a frame first: few answers
    bring it back in vain.

    Args:
        run: The run, whose actions it appends to.
        capacity: Grants that each service can have outstanding (clause 7).
        geometry: Meshes that services have yet to load.
        stateful: Services that save their state.
    """

    def __init__(
        self, run: Run, capacity: Mapping[str, int], geometry: GeometryLedger, stateful: Collection[str] = ()
    ) -> None:
        assert run.graph is not None
        self.graph, self.plan, self.episode = run.graph, run.plan, run.episode
        self._run, self._ledger, self._gate, self._geometry = run, run.ledger, run.gate, geometry
        self._first_entry = run.ledger.last
        pacer = Pacer(run.plan)
        sources = {edge.source for name in stateful for edge in run.graph.inputs[name]}
        self.table = DecisionTable(run, pacer, sources)
        self.deadlines = Deadlines(run, self.table, pacer)
        self._participants = self.table.participants
        for name, participant in self._participants.items():
            participant.capacity = capacity[name]
        everyone = self._participants.values()
        self._agents = tuple(p for p in everyone if p.plan.role == "agent")
        self._recorders = tuple(p for p in everyone if p.plan.role == "recorder")
        # All but the recorders, those after others in the graph first.
        self._others = tuple(p for p in reversed(everyone) if p.plan.role != "recorder")
        # Late products that no recorder has been granted (clause 11).
        self._late: list[Product] = []
        self._waiting_for_journal: set[Participant] = set()
        self._waiting_for_pace: set[Participant] = set()
        self._waiting_for_geometry: set[Participant] = set()

    def resume(self, before: Resumption, completed: Mapping[str, int]) -> None:
        """Continue after the last finished frame; ``completed`` says how far services got that have state."""
        self.table.resume(before.finished, before.frames, before.tasks, before.newest)
        for participant in self._participants.values():  # lag 1 needs the last frame, nothing an earlier one
            tasks = participant.tasks
            participant.tasks = {n: task for n, task in tasks.items() if n >= before.finished - 1}
        for name, frame in completed.items():
            self._participants[name].completed = frame

    # --- answers -----------------------------------------------------------------------------------

    def handle_done(
        self,
        service: str,
        products: Mapping[str, Product],
        now: int,
        report: Report | None = None,
        *,
        end: bool = False,
    ) -> None:
        """Take DONE for the oldest outstanding task of a service.

        Args:
            service: Who answers.
            products: By topic, all of them declared (checked by the caller).
            now: The time [ns].
            report: What goes to recorders about the answer.
            end: Whether an agent ends the episode with this frame.
        """
        participant = self._participants[service]
        task = self._answered(participant, now)
        products = {topic: product for topic, product in products.items() if topic in participant.outputs}
        state = task.state
        task.move(_ANSWER)
        if state is _ABANDONED:
            self.table.release(task)
            self._notice("discarded", task, "answered after the end of the episode; not used")
            return
        participant.completed = max(participant.completed, task.frame)
        self.deadlines.measure(task, now)
        if state is _OVERDUE:
            elapsed = milliseconds(now - task.started_at)
            self._notice("late", task, f"answered after {elapsed}; its frame had gone on")
            self.table.record_late(task, products, now)
            if self._recorders:
                self._late += products.values()
            self.table.release(task)
        else:
            task.report = report
            recorded = self.plan.recorded.get((service, self.episode, task.frame), ())
            self.table.decide_answered(task, products, now, recorded)
        if task.frame >= self.table.frames and products:
            self._notice("discarded", task, f"answered its final grant with {', '.join(sorted(products))}")
        if end and participant in self._agents:
            self._end_after(task.frame)

    def handle_fault(self, service: str, text: str, now: int) -> None:
        """Take FAULT for the oldest outstanding task of a service that its frame can do without.

        Args:
            service: Which answers.
            text: Phase and message of the FAULT.
            now: The time [ns].
        """
        task = self._answered(self._participants[service], now)
        state = task.state
        task.move(TaskEvent.FAULT)
        self._notice("fault", task, text)
        if state is not _ABANDONED:
            self.deadlines.measure(task, now)
        if state is _GRANTED:
            cause = f"{service} failed in frame {task.frame}: {text}"
            self.table.decide_without_answer(task, cause, "fault", now)
        else:
            self.table.release(task)

    def _answered(self, participant: Participant, now: int) -> Task:
        task = participant.outstanding.pop(0)
        if participant.outstanding:
            participant.outstanding[0].started_at = now  # it was queued until now
        task.order = None
        if task.state is not _GRANTED:
            self.table.ready.add(participant)  # it was decided before; else its decision brings it back
        return task

    def _end_after(self, frame: int) -> None:
        """Cut what comes after ``frame``, with which an agent ends the episode (clause 16).

        An agent that is late cannot undo what others did meanwhile: the episode then ends with the
        last frame that any agent was granted.
        """
        reached = [agent.next_frame - 1 for agent in self._agents]
        reached += [task.frame for agent in self._agents for task in agent.outstanding]
        for task in self.table.end_after(max(frame, *reached)):
            if task.state in OUTSTANDING:
                task.move(TaskEvent.CUT)
                member = self._run.members[task.service]
                if member.present:
                    self._run.send(member, Cancel(**self._run.ids(member), frame=task.frame))
        self.wake_all()

    # --- services that come and go -------------------------------------------------------------------

    def suspend_service(self, service: str) -> None:
        """Make no new grants to a service that is gone; its outstanding grants stay owed."""
        self._participants[service].suspended = True

    def resume_service(self, service: str, now: int, completed: int = -1) -> list[GrantOrder]:
        """Take back a service that was gone: the grants that it owes, to be sent again (clause 18).

        It has got as far as ``completed``; from its reset that is −1, and a world steps the whole gap.

        Args:
            service: Its name.
            now: The time [ns].
            completed: Frame that it has got to; −1: none.

        Returns:
            The grants in the order in which they are owed.
        """
        participant = self._participants[service]
        participant.suspended = participant.saving = False
        self.table.ready.add(participant)
        participant.completed = previous = completed
        again = []
        for task in participant.outstanding:
            task.started_at = now
            if task.order is not None:
                task.order = replace(task.order, previous=previous)
                again.append(task.order)
            previous = task.frame
        return again

    def begin_save(self, service: str) -> None:
        """Make no new grants to a service until `end_save`: it saves its state."""
        self._participants[service].saving = True

    def end_save(self, service: str, now: int) -> None:
        """Grant again to a service that has saved its state."""
        participant = self._participants[service]
        participant.saving = False
        self.table.ready.add(participant)
        task = participant.tasks.get(participant.next_frame)
        if task is not None and participant.plan.ends_run_when_late and task.eligible_at is not None:
            task.eligible_at = now  # it could not have been granted before

    # --- who is looked at next -----------------------------------------------------------------------

    @property
    def waits_for_journal(self) -> bool:
        """Whether a service can be granted nothing before more entries of the ledger are safe."""
        return bool(self._waiting_for_journal)

    def wake_for_journal(self) -> None:
        """Look again at what waited for entries of the ledger to be safe."""
        self.table.wake(self._waiting_for_journal)

    def wake_for_pace(self) -> None:
        """Look again at what waited for real time, or for the user's pause to end."""
        self.table.wake(self._waiting_for_pace)

    def wake_for_geometry(self) -> None:
        """Look again at what waited for meshes to be loaded."""
        self.table.wake(self._waiting_for_geometry)

    def wake_all(self) -> None:
        """Look at every service again, and forget what they waited for."""
        for waiting in self.waiting():
            waiting.clear()
        self.table.ready.update(self._participants.values())

    def waiting(self) -> list[set[Participant]]:
        """The sets of services that wait: for the journal, real time, frames, meshes, and each decision."""
        decisions = [participant.waiting for participant in self._participants.values()]
        return [
            self._waiting_for_journal,
            self._waiting_for_pace,
            self.table.waiting_for_frames,
            self._waiting_for_geometry,
            *decisions,
        ]

    # --- granting ------------------------------------------------------------------------------------

    def advance(self, now: int) -> None:
        """Grant and skip whatever can be, until nothing changes."""
        ready = self.table.ready
        while ready:
            batch = sorted(ready, key=_rank) if len(ready) > 1 else tuple(ready)
            ready.clear()
            for participant in batch:
                self._advance_service(participant, now)

    def expire(self, now: int) -> None:
        """Act on every deadline that has passed."""
        self.deadlines.expire(now)
        release = self.deadlines.next_release()
        if release is not None and release <= now:
            self.wake_for_pace()

    def next_deadline(self) -> int | None:
        """Earliest instant at which `expire` has something to do [ns]; None: never."""
        instants = [self.deadlines.next(), self.deadlines.next_release() if self._waiting_for_pace else None]
        return min((instant for instant in instants if instant is not None), default=None)

    def _advance_service(self, participant: Participant, now: int) -> None:
        owed, table, written = participant.outstanding, self.table, self._ledger.written
        while True:
            has_room = len(owed) < participant.capacity
            in_flight = 0
            for granted in owed:
                in_flight += granted.state is _GRANTED
            if in_flight and not has_room:
                return  # its answer brings it back
            frame = participant.next_frame + in_flight
            if not self._is_turn(participant, frame):
                return
            task = participant.task(frame)
            inputs, task.inputs = task.inputs, None
            if inputs is None:
                if (source := table.undecided_source(participant, frame)) is not None:
                    source.waiting.add(participant)
                    return
                inputs = table.gather_inputs(participant, frame)
            if written < inputs.entry or written < self._first_entry:
                self._waiting_for_journal.add(participant)
                # After another frame of the service, which is not decided yet, it will rely on more.
                task.inputs = None if in_flight else inputs
                return
            if self._geometry.has_changed and self._awaits_geometry(participant, frame):
                task.inputs = None if in_flight else inputs
                return
            if (self.plan.realtime or self._gate.closed) and not self._release(participant, task, now):
                return
            if in_flight and inputs.cause is not None:
                return  # it is skipped when its turn has come
            if task.eligible_at is None:
                task.eligible_at = now
            if inputs.cause is not None:
                task.move(TaskEvent.SKIP)
                self._notice("skipped", task, inputs.cause)
                table.decide_consequence(task, inputs.cause, now)
                written = self._ledger.written
            elif has_room and not participant.suspended and not participant.saving:
                self._grant(participant, task, inputs, now)
            else:
                return

    def _is_turn(self, participant: Participant, frame: int) -> bool:
        """Whether a service may have a frame; else it waits for others, or has nothing more to do.

        No agent runs ahead of one that may end the episode, and no recorder of what may be cut then.
        """
        table, role = self.table, participant.plan.role
        if frame >= table.frames and (role != "agent" or frame > table.frames):
            return False
        if frame >= table.finished_frames + self.plan.frames_in_flight + (frame == table.frames):
            table.waiting_for_frames.add(participant)
            return False
        if role == "agent":
            before, reached = self._agents, frame
        elif role == "recorder":
            before, reached = self._others, frame + 1
        else:
            return True
        for other in before:
            if other.next_frame < reached:
                other.waiting.add(participant)
                return False
        return True

    def _awaits_geometry(self, participant: Participant, frame: int) -> bool:
        """Whether a frame waits until its service has loaded its meshes; one that may miss it need not."""
        if not participant.plan.is_indispensable:
            return False
        # One that is gone is sent the meshes again when it comes back, and its grants after them.
        if not self._geometry.is_lacking(participant.plan.name, frame):
            return False
        self._waiting_for_geometry.add(participant)
        return True

    def _release(self, participant: Participant, task: Task, now: int) -> bool:
        if not self.deadlines.release(task, now):
            self._waiting_for_pace.add(participant)
            return False
        self.wake_for_pace()  # the first service to ask releases the frame for all
        return True

    def _grant(self, participant: Participant, task: Task, inputs: TaskInputs, now: int) -> None:
        owed = participant.outstanding
        previous = owed[-1].frame if owed else participant.completed
        task.move(_GRANT)
        task.started_at = now
        final = task.frame == self.table.frames
        order = GrantOrder(task.service, task.frame, previous, final, inputs.inputs, inputs.products)
        task.order = order if participant.plan.role != "recorder" else self._with_reports(order)
        owed.append(task)
        self._run.grant(task.order)

    def _with_reports(self, order: GrantOrder) -> GrantOrder:
        """A recorder's grant, with what came late and what the services of its frame reported."""
        late = [product for product in self._late if product.frame <= order.frame]
        self._late = [product for product in self._late if product.frame > order.frame]
        of_frame = [participant.tasks.get(order.frame) for participant in self._others]
        reports = sorted((t.report for t in of_frame if t and t.report), key=lambda report: report.source)
        return replace(
            order,
            inputs=(*order.inputs, *(provenance_of(product, Status.LATE, order.frame) for product in late)),
            products=(*order.products, *late),
            reports=tuple(reports),
        )

    # --- the end -------------------------------------------------------------------------------------

    def close(self, now: int) -> None:
        """Report what was left unanswered or unused when the episode, or the run within it, is over."""
        for product in self._late:
            text = f"{product.topic} came after the recorder's last grant; not recorded"
            self._notice("discarded", Task(product.source, product.frame), text)
        for participant in self._participants.values():
            for task in participant.outstanding:
                if task.overran:
                    self.deadlines.measure(task, now)
                    self._notice("late", task, "was never answered")

    @property
    def finished(self) -> bool:
        """Whether every frame is decided, final grants are answered, and no service is waited for."""
        if not self._all_decided:
            return False
        return not any(p.outstanding and self._must_answer(p) for p in self._participants.values())

    @property
    def _all_decided(self) -> bool:
        table = self.table
        return table.finished_frames >= table.frames and all(
            a.next_frame > table.frames for a in self._agents
        )

    def _must_answer(self, participant: Participant) -> bool:
        """Whether the end of the episode waits for what a service still owes.

        After the last episode there is no RESET that it had to be ready for, so a service that the run can
        do without is not waited for.
        """
        last = self.episode + 1 >= self.plan.episodes
        return not last or participant.plan.is_indispensable

    # --- what can be asked ---------------------------------------------------------------------------

    @property
    def begun(self) -> int:
        """The last frame that has begun for any service; −1: none."""
        everyone = self._participants.values()
        reached = [p.next_frame - 1 for p in everyone]
        reached += [p.outstanding[-1].frame for p in everyone if p.outstanding]
        return min(max(reached), self.table.frames - 1)

    def is_through(self, service: str) -> bool:
        """Whether a service has nothing more to do in the episode."""
        participant = self._participants[service]
        return participant.next_frame >= self.table.frames + (participant in self._agents)

    def outstanding(self, service: str) -> list[Task]:
        """Tasks of a service for which DONE or FAULT is due, oldest first."""
        return self._participants[service].outstanding

    def awaited(self, service: str) -> Task | None:
        """The outstanding task of a service without which the run cannot go on: no progress is fatal."""
        participant = self._participants[service]
        owed = participant.outstanding
        if not owed:
            return None
        waits = participant.plan.waits_for_answer and owed[0].state is _GRANTED
        return owed[0] if waits or (self._all_decided and self._must_answer(participant)) else None

    def validate(self) -> None:
        """Check cross-field invariants; raises AssertionError naming the one that is broken."""
        self.table.validate()
        for name, participant in self._participants.items():
            owed, capacity = participant.outstanding, participant.capacity
            assert len(owed) <= capacity, f"{name} has {len(owed)} grants, at most {capacity} (clause 7)"
            assert all(t.state in OUTSTANDING for t in owed), f"{name} owes an answered task"
            assert all(t.order is not None for t in owed), f"{name} owes what it was not granted"
            assert [t.frame for t in owed] == sorted({t.frame for t in owed}), f"{name} grants out of order"
            for task in participant.tasks.values():
                assert (task.state in OUTSTANDING) == (task in owed), f"{task} miscounted"
                if task.state in (TaskState.GRANTED, TaskState.OVERDUE):
                    edges = participant.inputs if task.frame < self.table.frames else participant.lagged
                    for edge, source in edges:
                        known = source.has_decided(edge, task.frame)
                        assert known, f"{task} granted before {edge} (clause 7)"

    def _notice(self, kind: str, task: Task, text: str) -> None:
        self._run.notice(kind, task.service, text, task.frame)


def _rank(participant: Participant) -> int:
    return participant.rank
