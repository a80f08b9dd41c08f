"""The episodes of a run: RESET, grants and their answers, EPISODE_END."""

from __future__ import annotations

from collections.abc import Mapping

from caviar_broker.core import events as ev
from caviar_broker.core.checkpoints import Checkpoints, PayloadSize
from caviar_broker.core.decisions import GrantOrder
from caviar_broker.core.dispatch import Dispatcher
from caviar_broker.core.run import Peer, Run
from caviar_broker.core.transitions import RunEvent, RunState, ServiceEvent, ServiceState, TaskState
from caviar_protocol.messages import RUN_COMPLETE, Cancel, Done, EpisodeEnd, Fault, Grant, Report, Reset
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
        self.checkpoints = Checkpoints(run, self._grant, self._return_service, payload_size)
        """What is kept for services that may come back."""
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
        for peer in self._members():
            if peer.state is ServiceState.READY:
                self.reset(peer, now)

    def reset(self, peer: Peer, now: int) -> None:
        """Send RESET to one service, if it takes part in episodes at all."""
        run = self._run
        if run.takes_part(peer) and not run.over:
            peer.move(ServiceEvent.RESET, now)
            self.checkpoints.reset(peer, begins=self.dispatcher is None)
            # t0_ns: the first instant may be a later one.
            run.send(peer, Reset(**run.ids(peer), seed=run.seed, t0_ns=0, seed_episode=run.seed_episode))

    def handle_reset_done(self, event: ev.ResetDoneReceived, now: int) -> None:
        """Take RESET_DONE: the episode starts once all are there; one that rejoins gets what it owes."""
        run, peer, message = self._run, self._run.peers[event.service], event.message
        if not run.current(peer, message.epoch, message.attempt, "RESET_DONE"):
            return
        if peer.state is not ServiceState.RESETTING or message.episode != run.episode:
            run.unexpected(peer, "RESET_DONE", f"after RESET of episode {run.episode}")
            return
        if not self.checkpoints.restore(peer, now):
            peer.move(ServiceEvent.RESET_DONE, now)
            self._return_service(peer, now)

    def _return_service(self, peer: Peer, now: int) -> None:
        """Grant what a service owes that is where it has to be, or start the episode."""
        run, history = self._run, self.checkpoints.histories.get(peer.name)
        if self.dispatcher is not None:
            for order in self.dispatcher.resume_service(peer.name, now, history.last if history else -1):
                self._grant(order)
        elif all(p.state is ServiceState.ACTIVE for p in self._members()):
            run.enter(RunEvent.ALL_RESET, now)
            self._start(now)

    def _start(self, now: int) -> None:
        """Start the episode, or go on where it was, now that all services are there."""
        run, histories = self._run, self.checkpoints.histories
        assert run.graph is not None
        capacity = {p.name: _capacity(p) for p in self._members()}
        dispatcher = self.dispatcher = Dispatcher(
            run.graph,
            run.plan,
            capacity,
            run.episode,
            run.digest,
            run.ledger,
            run.actions,
            run.gate,
            histories,
        )
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
        for peer in self._members():
            if peer.state in (ServiceState.ACTIVE, ServiceState.RESETTING, ServiceState.RESTORING):
                peer.move(ServiceEvent.EPISODE_END, now)
                run.send(peer, EpisodeEnd(**run.ids(peer), frames=frames))
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

    def handle_last_recording(self, event: ev.DoneReceived, now: int) -> bool:
        """Take a recorder's DONE after the end of the run: whether it was such a one.

        What the recorder wrote counts, so that the digest of the run is that of the recording.
        """
        run, peer, message, ended = self._run, self._run.peers[event.service], event.message, self._ended
        owed = ended.outstanding(peer.name) if ended and peer.plan.role == "recorder" else []
        asked = (run.plan.epoch, peer.attempt, run.episode, owed[0].frame if owed else -1)
        if ended is None or (message.epoch, message.attempt, message.episode, message.frame) != asked:
            return False
        ended.handle_done(peer.name, {}, now)
        return True

    def _members(self) -> list[Peer]:
        assert self._run.graph is not None
        return [self._run.peers[name] for name in self._run.graph.order]

    # --- answers -------------------------------------------------------------------------------------

    def handle_done(self, event: ev.DoneReceived, now: int) -> None:
        """Take DONE: its products are decided, or it is stale."""
        # An answer of a service that gets its state back was decided before: it is compared, and not used.
        run, peer, message = self._run, self._run.peers[event.service], event.message
        if peer.state is ServiceState.RESTORING:
            self.checkpoints.handle_repeated_answer(peer, message, now)
            return
        dispatcher = self._owing(peer, message, "DONE", now)
        if dispatcher is None:
            return
        t_ns = run.plan.t_ns(message.frame)
        products = {
            h.topic: ev.Product(h.topic, peer.name, message.frame, t_ns, h.digest, h.fidelity, payload)
            for h, payload in zip(message.products, event.payloads, strict=True)
        }
        if len(products) < len(message.products) or not products.keys() <= peer.outputs:
            self._refuse_products(peer, message, now)
            return
        # It got somewhere since its last loss: `MAX_LOSSES` counts only losses in a row.
        peer.losses = 0
        report: Report | None = None
        if message.decisions or message.counts or message.measured:
            report = Report(
                source=peer.name,
                decisions=message.decisions,
                counts=message.counts,
                measured=message.measured,
            )
        if message.seed >= 0:
            self._choose_seed(peer, message, dispatcher, now)
        # Before the answer is taken: that forgets the order it answers.
        if self.checkpoints.histories:
            self._remember(peer, dispatcher, message)
        dispatcher.handle_done(peer.name, products, now, report, end=message.end_episode)
        # After the decision of its task, so that a broker that resumes reads them in this order.
        if message.end_episode and peer.role == "agent":
            facts = {"frames": dispatcher.table.frames}
            run.enter_journal("end", peer.name, message.frame, now, facts=facts)
        if self.checkpoints.histories:
            self._save_if_due(peer, dispatcher, now)

    def _refuse_products(self, peer: Peer, message: Done, now: int) -> None:
        topics = [header.topic for header in message.products]
        strange = next(t for t in topics if t not in peer.outputs or topics.count(t) > 1)
        problem = "twice" if strange in peer.outputs else "which it did not declare"
        self._run.fail(f"{peer} answered frame {message.frame} with {strange!r}, {problem}", peer.name, now)

    def _remember(self, peer: Peer, dispatcher: Dispatcher, answer: Done | Fault) -> None:
        order = dispatcher.outstanding(peer.name)[0].order
        if order is not None:
            self.checkpoints.add(peer, order, answer)

    def _save_if_due(self, peer: Peer, dispatcher: Dispatcher, now: int) -> None:
        if self.checkpoints.is_due(peer) and not dispatcher.is_through(peer.name):
            dispatcher.begin_save(peer.name)
            if not dispatcher.outstanding(peer.name):
                self.checkpoints.request(peer, now)

    def handle_checkpoint_done(self, event: ev.CheckpointReceived, now: int) -> None:
        """Take CHECKPOINT_DONE: the service may be granted again."""
        if self.checkpoints.handle_checkpoint_done(event, now) and self.dispatcher is not None:
            self.dispatcher.end_save(event.service, now)

    def _choose_seed(self, peer: Peer, message: Done, dispatcher: Dispatcher, now: int) -> None:
        ends = message.end_episode or message.frame >= dispatcher.table.frames
        if ends and peer.role == "agent":
            self._run.wish(message.seed, peer, now)
            self._run.enter_journal("seed", peer.name, message.frame, now, facts={"seed": message.seed})
        else:
            text = (
                f"chose the seed {message.seed}, which only an agent may where it ends an episode; not used"
            )
            self._run.notice("discarded", peer.name, text, message.frame)

    def handle_fault(self, event: ev.FaultReceived, now: int) -> None:
        """Take FAULT: fatal, unless it is in a frame that the run can do without."""
        run, peer, message = self._run, self._run.peers[event.service], event.message
        text = f"{message.phase}: {located(message.message, peer.name, run.plan.source)}"
        if message.frame < 0 or self.checkpoints.concerns(peer, message):
            if not run.current(peer, message.epoch, message.attempt, "FAULT"):
                return
            if run.takes_part(peer):
                run.fail(f"{peer} failed in {text}", peer.name, now)
            else:
                run.notice("fault", peer.name, text)
            return
        if peer.state is ServiceState.RESTORING:
            self.checkpoints.handle_repeated_answer(peer, message, now)
            return
        dispatcher = self._owing(peer, message, "FAULT", now)
        if dispatcher is None:
            return
        task = dispatcher.outstanding(peer.name)[0]
        # A consumer found the product of another wrong: that service has the blame, if it is one of its
        # inputs.
        if message.culprit and task.order and any(i.source == message.culprit for i in task.order.inputs):
            wrong = run.peers[message.culprit]
            text = f"{wrong} made a wrong product: {message.message} (refused by {peer})"
            run.fail(text, wrong.name, now)
            return
        needed = task.state is not TaskState.ABANDONED
        if needed and peer.plan.is_indispensable:
            run.fail(f"{peer} failed in frame {message.frame}, {text}", peer.name, now)
        else:
            self._remember(peer, dispatcher, message)
            dispatcher.handle_fault(peer.name, text, now)
            self._save_if_due(peer, dispatcher, now)

    def _owing(self, peer: Peer, answer: Done | Fault, kind: str, now: int) -> Dispatcher | None:
        """The dispatcher, if this answers the oldest outstanding grant (clause 1), in time or late."""
        # One comparison of tuples is the usual way; which part differs is looked for only where one does.
        run, dispatcher = self._run, self.dispatcher
        participant = dispatcher.table.participants.get(peer.name) if dispatcher else None
        outstanding = -1
        if dispatcher is not None and participant is not None and participant.outstanding:
            outstanding = participant.outstanding[0].frame
            asked = (run.plan.epoch, peer.attempt, run.episode, outstanding)
            answered = (answer.epoch, answer.attempt, answer.episode, answer.frame)
            if peer.state is _ACTIVE and answered == asked:
                dispatcher.deadlines.expire_before_answer(participant, now)
                return dispatcher
        if not run.current(peer, answer.epoch, answer.attempt, kind, outstanding):
            return None
        run.stale(peer, kind, f"{kind} for episode {answer.episode} frame {answer.frame}", outstanding)
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
        """Let the dispatcher act, and carry out what it wants."""
        run, dispatcher = self._run, self.dispatcher
        if dispatcher is None or run.state is not _RUNNING:
            return
        # Grants first: services work while notices are written.
        dispatcher.advance(now)
        for order in dispatcher.grants:
            self._grant(order)
        dispatcher.grants.clear()
        deadlines = dispatcher.deadlines
        if deadlines.overruns or deadlines.skips or dispatcher.cut or deadlines.aborted:
            self._blame_overruns(dispatcher, now)
        # Cheap tests first: this is asked after every event, and holds once an episode.
        table = dispatcher.table
        if table.finished_frames >= table.frames and not run.over and dispatcher.finished:
            self._end(table.frames, now)

    def _blame_overruns(self, dispatcher: Dispatcher, now: int) -> None:
        """Say which budgets are up, cancel what is cut, and end the run where the policy is abort."""
        run, deadlines = self._run, dispatcher.deadlines
        for task, remedy in deadlines.overruns:
            peer = run.peers[task.service]
            waiting = dispatcher.table.describe_waiting(task.service)
            text = peer.blame_task(task, "overran its budget", now, waiting)
            run.notice("miss", task.service, f"{text}; {remedy}", task.frame)
        for task, cause in deadlines.skips:
            heard = run.peers[task.service].last_words(now)
            run.notice("skipped", task.service, f"{cause}; {heard}", task.frame)
        for task in dispatcher.cut:
            peer = run.peers[task.service]
            if peer.present:
                run.send(peer, Cancel(**run.ids(peer), frame=task.frame))
        deadlines.overruns.clear()
        deadlines.skips.clear()
        dispatcher.cut.clear()
        if deadlines.aborted is not None:
            peer = run.peers[deadlines.aborted.service]
            waiting = dispatcher.table.describe_waiting(peer.name)
            text = peer.blame_task(deadlines.aborted, "overran its budget (policy abort)", now, waiting)
            run.fail(text, peer.name, now)

    def _grant(self, order: GrantOrder, chosen: Mapping[str, str] | None = None) -> None:
        """Send GRANT; with ``chosen`` it was answered before, after these decisions."""
        run, peer = self._run, self._run.peers[order.service]
        # A replay imposes what was recorded; what a service chose before its restart goes before that.
        decisions = run.plan.imposed.get((order.service, run.episode, order.frame), {})
        grant = Grant(
            epoch=run.plan.epoch,
            attempt=peer.attempt,
            episode=run.episode,
            frame=order.frame,
            previous_frame=order.previous,
            t_ns=run.plan.t_ns(order.frame),
            budget_ns=peer.plan.budget_ns,
            inputs=order.inputs,
            final=order.final,
            decisions={**decisions, **chosen} if chosen else dict(decisions),
            reports=order.reports,
        )
        run.actions.append(ev.Send(peer.name, grant, order.products))


def _capacity(peer: Peer) -> int:
    """Grants that a service may have outstanding: one, or under wait as planned and as it says it can."""
    if not peer.plan.waits_for_answer or peer.hello is None:
        return 1
    return min(peer.plan.max_in_flight, peer.hello.max_in_flight)
