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

_ACTIVE, _RUNNING = ServiceState.ACTIVE, RunState.RUNNING


class Episodes:
    """Drives the schedule of one episode after the other (clauses 1, 6, 16 and 18)."""

    def __init__(self, run: Run, weigh: PayloadSize = lambda payload: 0) -> None:
        self._run = run
        self.recall = Checkpoints(run, self._grant, self._returned, weigh)
        """What is kept for services that may come back."""
        self.schedule: Dispatcher | None = None
        """Of the episode that is under way; None between episodes."""
        self._ended: Dispatcher | None = None
        """Of the episode that was under way before."""

    # --- from one episode to the next ----------------------------------------------------------------

    def begin(self, now: int) -> None:
        """RESET for everybody who is ready; who is not, gets it when it is."""
        if self._run.resumption is None:
            self._run.next_seed()
        self.recall.begin()
        for peer in self._members():
            if peer.state is ServiceState.READY:
                self.reset(peer, now)

    def reset(self, peer: Peer, now: int) -> None:
        """RESET for one service, if it takes part in episodes at all."""
        run = self._run
        if run.takes_part(peer) and not run.over:
            peer.move(ServiceEvent.RESET, now)
            self.recall.reset(peer, begins=self.schedule is None)
            message = Reset(
                epoch=run.plan.epoch,
                attempt=peer.attempt,
                episode=run.episode,
                seed=run.seed,
                t0_ns=0,  # the first instant may be a later one
                seed_episode=run.seed_episode,
            )
            run.send(peer, message)

    def reset_done(self, event: ev.ResetDoneReceived, now: int) -> None:
        """RESET_DONE: the episode starts once all are there; one that rejoins gets what it owes."""
        run, peer, message = self._run, self._run.peers[event.service], event.message
        if not run.current(peer, message.epoch, message.attempt, "RESET_DONE"):
            return
        if peer.state is not ServiceState.RESETTING or message.episode != run.episode:
            run.unexpected(peer, "RESET_DONE", f"after RESET of episode {run.episode}")
            return
        if not self.recall.bring_back(peer, now):
            peer.move(ServiceEvent.RESET_DONE, now)
            self._returned(peer, now)

    def _returned(self, peer: Peer, now: int) -> None:
        """A service is where it has to be: it gets what it owes, or the episode starts."""
        run, memory = self._run, self.recall.of(peer.name)
        if self.schedule is not None:
            for order in self.schedule.resume(peer.name, now, memory.last if memory else -1):
                self._grant(order)
        elif all(p.state is ServiceState.ACTIVE for p in self._members()):
            run.enter(RunEvent.ALL_RESET, now)
            self._start(now)

    def _start(self, now: int) -> None:
        """Everybody is there: the episode starts, or goes on where it was."""
        run, memories = self._run, self.recall.memories
        assert run.graph is not None
        capacity = {p.name: _capacity(p) for p in self._members()}
        self.schedule = Dispatcher(
            run.graph,
            run.plan,
            capacity,
            run.episode,
            run.digest,
            run.ledger,
            run.actions,
            run.gate,
            memories,
        )
        # Behind the schedule, so that frame 0 need not wait for these entries.
        facts = {"seed": run.seed, "seed_episode": run.seed_episode, "frames": self.schedule.frames}
        before, run.resumption = run.resumption, None
        if before is not None:
            self.schedule.go_on(before, {name: memory.last for name, memory in memories.items()})
            run.enter_journal("resumed", "", before.finished, now, facts=facts, members=run.graph.order)
            return
        run.enter_journal("episode", "", 0, now, facts=facts, members=run.graph.order)
        for name in memories:
            run.enter_journal("checkpoint", name, -1, now)

    def _over(self, schedule: Dispatcher, now: int) -> None:
        run = self._run
        self.close(now)
        run.actions.append(ev.EpisodeFinished(run.episode, schedule.frames))
        run.finished_before += schedule.frames
        for peer in self._members():
            if peer.state in (ServiceState.ACTIVE, ServiceState.RESETTING, ServiceState.RESTORING):
                peer.move(ServiceEvent.EPISODE_END, now)
                end = EpisodeEnd(
                    epoch=run.plan.epoch, attempt=peer.attempt, episode=run.episode, frames=schedule.frames
                )
                run.send(peer, end)
        if run.episode + 1 < run.plan.episodes:
            run.episode += 1
            run.gate.next_episode()
            run.enter(RunEvent.NEXT_EPISODE, now)
            self.begin(now)
        else:
            run.stop(RUN_COMPLETE, now)

    def close(self, now: int) -> None:
        """The episode is over, or the run ended within it."""
        if self.schedule is not None:
            self.schedule.close(now)
            self._ended, self.schedule = self.schedule, None

    def recorded(self, event: ev.DoneReceived, now: int) -> bool:
        """A recorder's DONE behind the end of the run: what it wrote counts, so that the digest of the
        run is that of the recording. Whether it was such a one."""
        run, peer, message, ended = self._run, self._run.peers[event.service], event.message, self._ended
        owed = ended.outstanding(peer.name) if ended and peer.plan.role == "recorder" else []
        asked = (run.plan.epoch, peer.attempt, run.episode, owed[0].frame if owed else -1)
        if ended is None or (message.epoch, message.attempt, message.episode, message.frame) != asked:
            return False
        ended.done(peer.name, message.frame, {}, now)
        return True

    def _members(self) -> list[Peer]:
        assert self._run.graph is not None
        return [self._run.peers[name] for name in self._run.graph.order]

    # --- answers -------------------------------------------------------------------------------------

    def done(self, event: ev.DoneReceived, now: int) -> None:
        """DONE: its products are decided, or it is stale."""
        run, peer, message = self._run, self._run.peers[event.service], event.message
        if peer.state is ServiceState.RESTORING:
            self.recall.repeated(peer, message, now)
            return
        schedule = self._owing(peer, message, "DONE", now)
        if schedule is None:
            return
        t_ns = run.plan.t_ns(message.frame)
        products = {
            h.topic: ev.Product(h.topic, peer.name, message.frame, t_ns, h.digest, h.fidelity, payload)
            for h, payload in zip(message.products, event.payloads, strict=True)
        }
        if len(products) < len(message.products) or not products.keys() <= peer.outputs:
            self._strange_products(peer, message, now)
            return
        peer.losses = 0
        told: Report | None = None
        if message.decisions or message.counts or message.measured:
            told = Report(
                source=peer.name,
                decisions=message.decisions,
                counts=message.counts,
                measured=message.measured,
            )
        if message.seed >= 0:
            self._seed_chosen(peer, message, schedule, now)
        remembers = self.recall.of(peer.name) is not None
        if remembers:
            self._remember(peer, schedule, self.recall.digests(peer, message), message.decisions)
        schedule.done(peer.name, message.frame, products, now, told, end=message.end_episode)
        if message.end_episode and peer.role == "agent":
            run.enter_journal("end", peer.name, message.frame, now, facts={"frames": schedule.frames})
        if remembers:
            self._save_if_due(peer, schedule, now)

    def _strange_products(self, peer: Peer, message: Done, now: int) -> None:
        topics = [header.topic for header in message.products]
        strange = next(t for t in topics if t not in peer.outputs or topics.count(t) > 1)
        problem = "twice" if strange in peer.outputs else "which it did not declare"
        self._run.fail(f"{peer} answered frame {message.frame} with {strange!r}, {problem}", peer.name, now)

    def _remember(
        self,
        peer: Peer,
        schedule: Dispatcher,
        digests: Mapping[str, str] | None,
        chosen: Mapping[str, str],
    ) -> None:
        order = schedule.outstanding(peer.name)[0].order
        if order is not None:
            self.recall.answered(peer, order, digests, chosen)

    def _save_if_due(self, peer: Peer, schedule: Dispatcher, now: int) -> None:
        if self.recall.is_due(peer) and not schedule.is_through(peer.name):
            schedule.save(peer.name)
            if not schedule.outstanding(peer.name):
                self.recall.ask(peer, now)

    def checkpointed(self, event: ev.CheckpointReceived, now: int) -> None:
        """CHECKPOINT_DONE: the service may be granted again."""
        if self.recall.saved(event, now) and self.schedule is not None:
            self.schedule.saved(event.service, now)

    def _seed_chosen(self, peer: Peer, message: Done, schedule: Dispatcher, now: int) -> None:
        ends = message.end_episode or message.frame >= schedule.frames
        if ends and peer.role == "agent":
            self._run.wish(message.seed, peer, now)
            self._run.enter_journal("seed", peer.name, message.frame, now, facts={"seed": message.seed})
        else:
            text = (
                f"chose the seed {message.seed}, which only an agent may where it ends an episode; not used"
            )
            self._run.notice("discarded", peer.name, text, message.frame)

    def fault(self, event: ev.FaultReceived, now: int) -> None:
        """FAULT: fatal, unless it is in a frame that the run can do without."""
        run, peer, message = self._run, self._run.peers[event.service], event.message
        text = f"{message.phase}: {located(message.message, peer.name, run.plan.source)}"
        if message.frame < 0 or self.recall.is_concerned(peer, message):
            if not run.current(peer, message.epoch, message.attempt, "FAULT"):
                return
            if run.takes_part(peer):
                run.fail(f"{peer} failed in {text}", peer.name, now)
            else:
                run.notice("fault", peer.name, text)
            return
        if peer.state is ServiceState.RESTORING:
            self.recall.repeated(peer, message, now)
            return
        schedule = self._owing(peer, message, "FAULT", now)
        if schedule is None:
            return
        task = schedule.outstanding(peer.name)[0]
        if message.culprit and task.order and any(i.source == message.culprit for i in task.order.inputs):
            wrong = run.peers[message.culprit]
            text = f"{wrong} made a wrong product: {message.message} (refused by {peer})"
            run.fail(text, wrong.name, now)
            return
        needed = task.state is not TaskState.ABANDONED
        if needed and peer.plan.policy in ("wait", "abort"):
            run.fail(f"{peer} failed in frame {message.frame}, {text}", peer.name, now)
        else:
            self._remember(peer, schedule, None, {})
            schedule.fault(peer.name, message.frame, text, now)
            self._save_if_due(peer, schedule, now)

    def _owing(self, peer: Peer, answer: Done | Fault, kind: str, now: int) -> Dispatcher | None:
        """The schedule, if this answers the oldest outstanding grant (clause 1), in time or late."""
        run, schedule = self._run, self.schedule
        owed = schedule.outstanding(peer.name) if schedule and run.takes_part(peer) else []
        outstanding = owed[0].frame if owed else -1
        if schedule is not None and owed and peer.state is _ACTIVE:
            asked = (run.plan.epoch, peer.attempt, run.episode, outstanding)
            if (answer.epoch, answer.attempt, answer.episode, answer.frame) == asked:
                schedule.deadlines.expire_before_answer(owed[0], now)
                return schedule
        if not run.current(peer, answer.epoch, answer.attempt, kind, outstanding):
            return None
        run.stale(peer, kind, f"{kind} for episode {answer.episode} frame {answer.frame}", outstanding)
        return None

    # --- what the schedule wants -----------------------------------------------------------------------

    def journaled(self, event: ev.Journaled, now: int) -> None:
        """Decisions are safe; what waited for that may be granted."""
        if self._run.ledger.confirm(event.number, now) and self.schedule is not None:
            self.schedule.journal_written()

    def paused(self, event: ev.PauseRequested | ev.ResumeRequested | ev.StepRequested, now: int) -> None:
        """The user pauses the run, or lets it go on."""
        gate, schedule = self._run.gate, self.schedule
        match event:
            case ev.PauseRequested():
                gate.pause(schedule.begun if schedule is not None else -1)
            case ev.ResumeRequested():
                gate.resume()
            case ev.StepRequested(frames=frames):
                gate.step(frames)
        if schedule is not None:
            schedule.gate_moved()

    def pump(self, now: int) -> None:
        """Let the schedule act, and carry out what it wants."""
        run, schedule = self._run, self.schedule
        if schedule is None or run.state is not _RUNNING:
            return
        deadlines = schedule.deadlines
        schedule.advance(now)
        for task, remedy in deadlines.overruns:
            peer = run.peers[task.service]
            waiting = schedule.waiting_for(task.service)
            text = peer.blame_task(task, "overran its budget", now, waiting)
            run.notice("miss", task.service, f"{text}; {remedy}", task.frame)
        for task, cause in deadlines.skips:
            told = run.peers[task.service].last_words(now)
            run.notice("skipped", task.service, f"{cause}; {told}", task.frame)
        for order in schedule.grants:
            self._grant(order)
        schedule.grants.clear()
        for task in schedule.cut:
            peer = run.peers[task.service]
            if peer.present:
                ids = {"epoch": run.plan.epoch, "attempt": peer.attempt, "episode": run.episode}
                run.send(peer, Cancel(**ids, frame=task.frame))
        deadlines.overruns.clear()
        deadlines.skips.clear()
        schedule.cut.clear()
        if deadlines.aborted is not None:
            peer = run.peers[deadlines.aborted.service]
            waiting = schedule.waiting_for(peer.name)
            text = peer.blame_task(deadlines.aborted, "overran its budget (policy abort)", now, waiting)
            run.fail(text, peer.name, now)
        elif schedule.finished:
            self._over(schedule, now)

    def _grant(self, order: GrantOrder, chosen: Mapping[str, str] | None = None) -> None:
        """GRANT; with ``chosen`` it was answered before, after these decisions."""
        run, peer = self._run, self._run.peers[order.service]
        imposed = run.plan.imposed.get((order.service, run.episode, order.frame), {})
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
            decisions={**imposed, **(chosen or {})},
            reports=order.reports,
        )
        run.send(peer, grant, order.products)


def _capacity(peer: Peer) -> int:
    """Grants that a service may have outstanding: one, or under wait as planned and as it says it can."""
    if peer.plan.policy != "wait" or peer.hello is None:
        return 1
    return min(peer.plan.max_in_flight, peer.hello.max_in_flight)
