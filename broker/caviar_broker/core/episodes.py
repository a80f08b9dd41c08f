"""The episodes of a run: RESET, grants and their answers, EPISODE_END."""

from __future__ import annotations

from collections.abc import Mapping

from caviar_broker.core import events as ev
from caviar_broker.core.checkpoints import Checkpoints, PayloadSize
from caviar_broker.core.dispatch import Dispatcher
from caviar_broker.core.mesh_changes import GeometryLedger
from caviar_broker.core.run import Member, Run
from caviar_broker.core.tasks import FinishedFrame
from caviar_broker.core.transitions import RunEvent, RunState, ServiceEvent, ServiceState, TaskState
from caviar_protocol.errors import one_line
from caviar_protocol.messages import (
    RUN_COMPLETE,
    Done,
    EpisodeEnd,
    Fault,
    GeometryChange,
    Report,
    Reset,
)
from caviar_protocol.scenario.conversion import located

# On the path of every frame: a member that is looked up in its class costs four times as much.
_ACTIVE, _RUNNING = ServiceState.ACTIVE, RunState.RUNNING


class Episodes:
    """Drives the dispatcher of one episode after the other (clauses 1, 6, 16 and 18).

    Args:
        run: The run.
        payload_size: Size of a payload [B].
    """

    def __init__(self, run: Run, payload_size: PayloadSize = lambda payload: 0) -> None:
        self._run = run
        self.checkpoints = Checkpoints(run, self._return_service, payload_size)
        """What is kept for services that may come back."""
        self.geometry = GeometryLedger(run)
        """Meshes that worlds announced in the episode."""
        self.dispatcher: Dispatcher | None = None
        """Of the episode that is under way; None between episodes."""
        # Of the episode that was under way before.
        self._ended: Dispatcher | None = None

    # --- from one episode to the next ----------------------------------------------------------------

    def begin(self, now: int) -> None:
        """Send RESET to every service that is ready; one that is not gets it when it is."""
        if self._run.resumption is None:
            self._run.next_seed()
        self.checkpoints.begin_episode()
        self.geometry.begin_episode()
        for member in self._members():
            if member.state is ServiceState.READY:
                self.reset(member, now)

    def reset(self, member: Member, now: int) -> None:
        """Send RESET to one service, if it takes part in episodes at all."""
        run = self._run
        if run.takes_part(member) and not run.over:
            member.move(ServiceEvent.RESET, now)
            self.geometry.forget(member)
            self.checkpoints.reset(member, begins=self.dispatcher is None)
            # t0_ns: the first instant may be a later one.
            run.send(member, Reset(**run.ids(member), seed=run.seed, t0_ns=0, seed_episode=run.seed_episode))

    def handle_reset_done(self, event: ev.ResetDoneReceived, now: int) -> None:
        """Take RESET_DONE: the episode starts once all are there; one that rejoins gets what it owes."""
        run, member, message = self._run, self._run.members[event.service], event.message
        if not run.current(member, message.epoch, message.attempt, "RESET_DONE"):
            return
        if member.state is not ServiceState.RESETTING or message.episode != run.episode:
            run.unexpected(member, "RESET_DONE", f"after RESET of episode {run.episode}")
            return
        # Before its state and its grants: a frame that is granted again has the meshes that it had.
        if self.geometry.bring_back(member, self._resumes_with(member), now):
            member.since = now
            return
        self._go_on(member, now)

    def _go_on(self, member: Member, now: int) -> None:
        """Restore a service that was reset and has the meshes of its next frame, or grant what it owes."""
        if not self.checkpoints.restore(member, now):
            member.move(ServiceEvent.RESET_DONE, now)
            self._return_service(member, now)

    def _resumes_with(self, member: Member) -> int:
        """The first frame that a service is granted after its reset."""
        first = self.checkpoints.resumes_with(member)
        if first is not None:
            return first
        if self.dispatcher is None:
            return self._run.resumption.finished if self._run.resumption is not None else 0
        owed = self.dispatcher.outstanding(member.name)
        return owed[0].frame if owed else self.dispatcher.table.participants[member.name].next_frame

    def handle_geometry_done(self, event: ev.GeometryDoneReceived, now: int) -> None:
        """Take GEOMETRY_DONE: the service may be granted the frames that it was for."""
        member = self._run.members[event.service]
        if not self.geometry.handle_done(member, event.message, now):
            return
        if member.state is ServiceState.RESETTING:
            if self.geometry.awaited_since(member) is None:
                self._go_on(member, now)
        elif self.dispatcher is not None:
            self.dispatcher.wake_for_geometry()

    def _return_service(self, member: Member, now: int) -> None:
        """Grant what a service owes that is where it has to be, or start the episode."""
        run, history = self._run, self.checkpoints.histories.get(member.name)
        if self.dispatcher is not None:
            for order in self.dispatcher.resume_service(member.name, now, history.last if history else -1):
                run.grant(order)
        elif all(p.state is ServiceState.ACTIVE for p in self._members()):
            run.enter(RunEvent.ALL_RESET, now)
            self._start(now)

    def _start(self, now: int) -> None:
        """Start the episode, or go on where it was, now that all services are there."""
        run, histories = self._run, self.checkpoints.histories
        assert run.graph is not None
        capacity = {p.name: _capacity(p) for p in self._members()}
        dispatcher = self.dispatcher = Dispatcher(run, capacity, self.geometry, histories)
        # After the dispatcher, so that frame 0 need not wait for these entries.
        facts = {"seed": run.seed, "seed_episode": run.seed_episode, "frames": dispatcher.table.frames}
        before, run.resumption = run.resumption, None
        if before is not None:
            dispatcher.resume(before, {name: history.last for name, history in histories.items()})
            run.enter_journal("resumed", "", before.finished, now, facts=facts, members=run.graph.order)
            return
        run.enter_journal("episode", "", 0, now, facts=facts, members=run.graph.order)
        for name in histories:
            run.enter_journal("checkpoint", name, -1, now)

    def _end(self, frames: int, now: int) -> None:
        """Send EPISODE_END, and begin the next episode or end the run."""
        run = self._run
        self.close(now)
        run.actions.append(ev.EpisodeFinished(run.episode, frames))
        run.finished_before += frames
        for member in self._members():
            if member.state in (ServiceState.ACTIVE, ServiceState.RESETTING, ServiceState.RESTORING):
                member.move(ServiceEvent.EPISODE_END, now)
                run.send(member, EpisodeEnd(**run.ids(member), frames=frames))
        if run.episode + 1 < run.plan.episodes:
            run.episode += 1
            run.gate.next_episode()
            run.enter(RunEvent.NEXT_EPISODE, now)
            self.begin(now)
        else:
            run.stop(RUN_COMPLETE, now)

    def close(self, now: int) -> None:
        """Put the dispatcher away: the episode is over, or the run ended within it."""
        if self.dispatcher is not None:
            self.dispatcher.close(now)
            self._ended, self.dispatcher = self.dispatcher, None
            self.geometry.end_episode()

    def newest_frame(self) -> FinishedFrame | None:
        """The newest finished frame of this episode, or of the one before; None: there is none."""
        tables = [d.table for d in (self.dispatcher, self._ended) if d is not None]
        return next((frame for table in tables if (frame := table.newest()) is not None), None)

    def handle_last_recording(self, event: ev.DoneReceived, now: int) -> bool:
        """Take a recorder's DONE after the end of the run: whether it was such a one.

        What the recorder wrote counts, so that the digest of the run is that of the recording.
        """
        run, member, message, ended = self._run, self._run.members[event.service], event.message, self._ended
        owed = ended.outstanding(member.name) if ended and member.plan.role == "recorder" else []
        asked = (run.plan.epoch, member.attempt, run.episode, owed[0].frame if owed else -1)
        if ended is None or (message.epoch, message.attempt, message.episode, message.frame) != asked:
            return False
        ended.handle_done(member.name, {}, now)
        return True

    def _members(self) -> list[Member]:
        assert self._run.graph is not None
        return [self._run.members[name] for name in self._run.graph.order]

    # --- answers -------------------------------------------------------------------------------------

    def handle_done(self, event: ev.DoneReceived, now: int) -> None:
        """Take DONE: its products are decided, or it is stale."""
        # An answer of a service that gets its state back was decided before: it is compared, and not used.
        run, member, message = self._run, self._run.members[event.service], event.message
        if member.state is ServiceState.RESTORING:
            self.checkpoints.handle_repeated_answer(member, message, now)
            return
        dispatcher = self._owing(member, message, "DONE", now)
        if dispatcher is None:
            return
        t_ns = run.plan.t_ns(message.frame)
        used = self.geometry.used_by(member, message) if self.geometry.has_changed else ""
        products = {
            h.topic: ev.Product(
                h.topic, member.name, message.frame, t_ns, h.digest, h.fidelity, payload, used
            )
            for h, payload in zip(message.products, event.payloads, strict=True)
        }
        if len(products) < len(message.products) or not products.keys() <= member.outputs:
            self._refuse_products(member, message, now)
            return
        # It got somewhere since its last loss: `MAX_LOSSES` counts only losses in a row.
        member.losses = 0
        announced: GeometryChange | None = None
        if message.geometry is not None:
            announced = self._announce(member, message, event.refused or {}, dispatcher, now)
        report: Report | None = None
        if message.decisions or message.counts or message.measured or announced:
            report = Report(
                source=member.name,
                decisions=message.decisions,
                counts=message.counts,
                measured=message.measured,
                geometry=announced,
            )
        if member.name in run.plan.policies:
            news = run.swaps.note(member.name, message.decisions, message.frame)
            if news:
                run.notice("note", member.name, news, message.frame)
        if message.seed >= 0:
            self._choose_seed(member, message, dispatcher, now)
        # Before the answer is taken: that forgets the order it answers.
        if self.checkpoints.histories:
            self._remember(member, dispatcher, message)
        dispatcher.handle_done(member.name, products, now, report, end=message.end_episode)
        # After the decision of its task, so that a broker that resumes reads them in this order.
        if message.end_episode and member.role == "agent":
            facts = {"frames": dispatcher.table.frames}
            run.enter_journal("end", member.name, message.frame, now, facts=facts)
        if self.checkpoints.histories:
            self._save_if_due(member, dispatcher, now)

    def _announce(
        self,
        member: Member,
        message: Done,
        refused: Mapping[str, str],
        dispatcher: Dispatcher,
        now: int,
    ) -> GeometryChange | None:
        """Take the meshes that a world announces; None where nothing follows from them."""
        if dispatcher.outstanding(member.name)[0].state is TaskState.ABANDONED:
            return None
        bases = [h.frame for h in self.checkpoints.histories.values()]
        needed = min([dispatcher.table.finished_frames - 1, *bases]) + 1
        return self.geometry.announce(member, message, refused, needed, now)

    def _refuse_products(self, member: Member, message: Done, now: int) -> None:
        topics = [header.topic for header in message.products]
        strange = next(t for t in topics if t not in member.outputs or topics.count(t) > 1)
        problem = "twice" if strange in member.outputs else "which it did not declare"
        self._run.fail(
            f"{member} answered frame {message.frame} with {strange!r}, {problem}", member.name, now
        )

    def _remember(self, member: Member, dispatcher: Dispatcher, answer: Done | Fault) -> None:
        order = dispatcher.outstanding(member.name)[0].order
        if order is not None:
            self.checkpoints.add(member, order, answer)

    def _save_if_due(self, member: Member, dispatcher: Dispatcher, now: int) -> None:
        if not self._run.over and self.checkpoints.is_due(member) and not dispatcher.is_through(member.name):
            dispatcher.begin_save(member.name)
            if not dispatcher.outstanding(member.name):
                self.checkpoints.request(member, now)

    def handle_checkpoint_done(self, event: ev.CheckpointReceived, now: int) -> None:
        """Take CHECKPOINT_DONE: the service may be granted again."""
        if self.checkpoints.handle_checkpoint_done(event, now) and self.dispatcher is not None:
            self.dispatcher.end_save(event.service, now)

    def _choose_seed(self, member: Member, message: Done, dispatcher: Dispatcher, now: int) -> None:
        ends = message.end_episode or message.frame >= dispatcher.table.frames
        if ends and member.role == "agent":
            self._run.wish(message.seed, member, now)
            self._run.enter_journal("seed", member.name, message.frame, now, facts={"seed": message.seed})
        else:
            text = (
                f"chose the seed {message.seed}, which only an agent may where it ends an episode; not used"
            )
            self._run.notice("discarded", member.name, text, message.frame)

    def handle_fault(self, event: ev.FaultReceived, now: int) -> None:
        """Take FAULT: fatal, unless it is in a frame that the run can do without."""
        run, member, message = self._run, self._run.members[event.service], event.message
        text = one_line(f"{message.phase}: {located(message.message, member.name, run.plan.source)}")
        if message.frame < 0 or self.checkpoints.concerns(member, message):
            if not run.current(member, message.epoch, message.attempt, "FAULT"):
                return
            if run.takes_part(member):
                run.fail(f"{member} failed in {text}", member.name, now)
            else:
                run.notice("fault", member.name, text)
            return
        if member.state is ServiceState.RESTORING:
            self.checkpoints.handle_repeated_answer(member, message, now)
            return
        dispatcher = self._owing(member, message, "FAULT", now)
        if dispatcher is None:
            return
        task = dispatcher.outstanding(member.name)[0]
        # A consumer found the product of another wrong: that service has the blame, if it is one of its
        # inputs.
        if message.culprit and task.order and any(i.source == message.culprit for i in task.order.inputs):
            wrong = run.members[message.culprit]
            text = f"{wrong} made a wrong product: {message.message} (refused by {member})"
            run.fail(text, wrong.name, now)
            return
        needed = task.state is not TaskState.ABANDONED
        if needed and member.plan.is_indispensable:
            run.fail(f"{member} failed in frame {message.frame}, {text}", member.name, now)
        else:
            self._remember(member, dispatcher, message)
            dispatcher.handle_fault(member.name, text, now)
            self._save_if_due(member, dispatcher, now)

    def _owing(self, member: Member, answer: Done | Fault, kind: str, now: int) -> Dispatcher | None:
        """The dispatcher, if this answers the oldest outstanding grant (clause 1), in time or late."""
        # One comparison of tuples is the usual way; which part differs is looked for only where one does.
        run, dispatcher = self._run, self.dispatcher
        participant = dispatcher.table.participants.get(member.name) if dispatcher else None
        outstanding = -1
        if dispatcher is not None and participant is not None and participant.outstanding:
            outstanding = participant.outstanding[0].frame
            asked = (run.plan.epoch, member.attempt, run.episode, outstanding)
            answered = (answer.epoch, answer.attempt, answer.episode, answer.frame)
            if member.state is _ACTIVE and answered == asked:
                dispatcher.deadlines.expire_before_answer(participant, now)
                return dispatcher
        if not run.current(member, answer.epoch, answer.attempt, kind, outstanding):
            return None
        run.stale(member, kind, f"{kind} for episode {answer.episode} frame {answer.frame}", outstanding)
        return None

    # --- what the dispatcher wants ---------------------------------------------------------------------

    def handle_journaled(self, event: ev.Journaled, now: int) -> None:
        """Note that decisions are safe; what waited for that may be granted."""
        if self._run.ledger.confirm(event.number, now) and self.dispatcher is not None:
            self.dispatcher.wake_for_journal()

    def handle_pause(
        self, event: ev.PauseRequested | ev.ResumeRequested | ev.StepRequested, now: int
    ) -> None:
        """Pause the run for the user, or let it go on."""
        gate, dispatcher = self._run.gate, self.dispatcher
        match event:
            case ev.PauseRequested():
                gate.pause(dispatcher.begun if dispatcher is not None else -1)
            case ev.ResumeRequested():
                gate.resume()
            case ev.StepRequested(frames=frames):
                gate.step(frames)
        if dispatcher is not None:
            dispatcher.wake_for_pace()

    def pump(self, now: int) -> None:
        """Let the dispatcher grant, and end an episode that is over."""
        run, dispatcher = self._run, self.dispatcher
        if dispatcher is None or run.state is not _RUNNING:
            return
        dispatcher.advance(now)
        # Cheap tests first: this is asked after every event, and holds once an episode.
        table = dispatcher.table
        if table.finished_frames >= table.frames and not run.over and dispatcher.finished:
            self._end(table.frames, now)


def _capacity(member: Member) -> int:
    """Grants that a service may have outstanding: one, or under wait as planned and as it says it can."""
    if not member.plan.waits_for_answer or member.hello is None:
        return 1
    return min(member.plan.max_in_flight, member.hello.max_in_flight)
