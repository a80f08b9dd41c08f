"""The frame clock: one run from the first HELLO to the last BYE, without I/O.

A shell feeds events and the time, performs the actions, and calls `FrameClock.expire` at
`FrameClock.next_deadline`::

    clock = FrameClock(plan, now)
    clock.receive(event, now)      # as often as something happens
    clock.expire(now)              # when next_deadline() has come
    for action in clock.actions(): ...

Real time is one such shell, the embedded run and the tests in virtual time are others.
"""

from __future__ import annotations

import difflib
from collections.abc import Callable, Iterable
from typing import Any

from caviar_broker.core import events as ev
from caviar_broker.core.graph import Graph, build_graph, check_actuators, check_prefixes
from caviar_broker.core.peers import Peer
from caviar_broker.core.plan import RunPlan
from caviar_broker.core.schedule import EpisodeSchedule, GrantOrder
from caviar_broker.core.transitions import (
    RUN,
    RunEvent,
    RunState,
    ServiceEvent,
    ServiceState,
    step,
)
from caviar_protocol.codec import check_version
from caviar_protocol.digest import RunDigest, geometry_digest
from caviar_protocol.errors import DeclarationError, VersionError
from caviar_protocol.messages import (
    CAPABILITIES,
    PROTOCOL_VERSION,
    Asset,
    Cancel,
    EpisodeEnd,
    Error,
    Grant,
    Hello,
    Message,
    Prepare,
    Refuse,
    Report,
    Reset,
    Shutdown,
    Stale,
    Welcome,
)


class FrameClock:
    """The rules of a run. See `caviar_broker.core.events` for what goes in and out."""

    def __init__(self, plan: RunPlan, now: int) -> None:
        self.plan = plan
        self.state = RunState.JOINING
        self.digest = RunDigest()
        self.graph: Graph | None = None
        self.episode = 0
        self.schedule: EpisodeSchedule | None = None
        self.error = ""
        self.culprit = ""
        self._peers = {service.name: Peer(service) for service in plan.services}
        self._since = now
        """When the present state of the run began [ns]."""
        self._actions: list[ev.Action] = []
        self._next_journal = 1
        self._reports: dict[int, dict[str, Report]] = {}
        self._handlers: dict[type, Callable[[Any, int], None]] = {
            ev.Joined: self._joined,
            ev.AssetsOffered: self._assets_offered,
            ev.ReadyReceived: self._ready,
            ev.ResetDoneReceived: self._reset_done,
            ev.DoneReceived: self._done,
            ev.FaultReceived: self._fault,
            ev.Violated: self._violated,
            ev.Progressed: self._progressed,
            ev.Lost: self._lost,
            ev.ByeReceived: self._bye,
            ev.Journaled: self._journaled,
            ev.StopRequested: self._stop_requested,
        }

    # --- the interface of a shell --------------------------------------------------------------

    def receive(self, event: ev.Event, now: int) -> None:
        """Take in one event at the time ``now`` [ns, monotonic]."""
        self._handlers[type(event)](event, now)
        self._pump(now)

    def expire(self, now: int) -> None:
        """Act on every deadline that has passed."""
        if self.state is RunState.RUNNING and self.schedule is not None:
            self.schedule.expire(now)
        for deadline, act in self._run_deadlines():
            if deadline <= now and self.state is not RunState.FINISHED:
                act(now)
        self._pump(now)

    def next_deadline(self) -> int | None:
        """When `expire` has to be called at the latest [ns]; None if nothing is awaited."""
        instants = [deadline for deadline, _ in self._run_deadlines()]
        if self.state is RunState.RUNNING and self.schedule is not None:
            instant = self.schedule.next_deadline()
            if instant is not None:
                instants.append(instant)
        return min(instants, default=None)

    def actions(self) -> list[ev.Action]:
        """What the shell has to do, in order; each is handed out once."""
        actions, self._actions = self._actions, []
        return actions

    def peer(self, name: str) -> Peer | None:
        """What is known of a service; None for a name that the run does not expect."""
        return self._peers.get(name)

    def validate(self) -> None:
        """Cross-field invariants; raises AssertionError naming the one that is broken."""
        if self.schedule is not None and self.state is RunState.RUNNING:
            self.schedule.validate()
        present = {peer.name for peer in self._peers.values() if peer.present}
        match self.state:
            case RunState.JOINING:
                assert self.graph is None
                assert any(p.state is ServiceState.EXPECTED for p in self._peers.values())
            case RunState.RUNNING:
                assert self.graph is not None
                active = {p.name for p in self._peers.values() if p.state is ServiceState.ACTIVE}
                coming_back = {n for n in present - active if n in self.graph.order}
                assert not coming_back or self.plan.limits.rejoin, f"{coming_back} are not in the episode"
            case RunState.FINISHED:
                assert not present, f"finished while {present} are here"
        assert bool(self.culprit) <= bool(self.error), "a culprit without an error"

    # --- joining ---------------------------------------------------------------------------------

    def _joined(self, event: ev.Joined, now: int) -> None:
        hello = event.hello
        refusal = self._refusal(hello)
        if refusal is not None:
            self._actions.append(ev.TurnAway(hello.name, refusal))
            if (
                refusal.code == "version"
                and hello.name in self._peers
                and not self._peers[hello.name].present
            ):
                self._fail(f"{hello.role} {hello.name!r}: {refusal.message}", hello.name, now)
            return
        peer = self._peers[hello.name]
        peer.move(ServiceEvent.HELLO)
        peer.hello, peer.attempt = hello, peer.attempt + 1
        peer.advanced_at, peer.heard_at, peer.lost_at = now, None, None
        limits = self.plan.limits
        self._send(
            peer,
            Welcome(
                version=PROTOCOL_VERSION,
                run=self.plan.run,
                epoch=self.plan.epoch,
                attempt=peer.attempt,
                capabilities=tuple(c for c in hello.capabilities if c in CAPABILITIES),
                heartbeat_ns=limits.heartbeat,
                liveness_ns=limits.liveness,
                seed=self.plan.seed,
                settings=dict(peer.plan.settings),
                scenario=dict(peer.plan.scenario),
            ),
        )
        if self.state is RunState.JOINING:
            if all(p.state is ServiceState.JOINED for p in self._peers.values()):
                self._all_joined(now)
        else:
            self._prepare(peer, now)

    def _refusal(self, hello: Hello) -> Refuse | None:
        try:
            check_version(hello.version)
        except VersionError as error:
            return Refuse(code="version", message=str(error))
        peer = self._peers.get(hello.name)
        if peer is None:
            near = difflib.get_close_matches(hello.name, self._peers, n=1)
            hint = f"did you mean {near[0]!r}? " if near else ""
            expected = ", ".join(sorted(self._peers))
            return Refuse(
                code="unknown-name",
                message=f"the run has no service {hello.name!r}; {hint}it expects: {expected}",
            )
        if peer.state is not ServiceState.EXPECTED and peer.state is not ServiceState.LOST:
            return Refuse(
                code="name-taken",
                message=f"a service named {hello.name!r} takes part already; end it or use another name",
            )
        if hello.role != peer.plan.role:
            return Refuse(
                code="declaration",
                message=f"{hello.name!r} is the run's {peer.plan.role}, this one says it is a {hello.role}",
            )
        if peer.hello is not None and (hello.inputs, hello.outputs) != (
            peer.hello.inputs,
            peer.hello.outputs,
        ):
            return Refuse(
                code="declaration",
                message=f"{hello.name!r} came back with other inputs or outputs than it had before",
            )
        if self.state in (RunState.STOPPING, RunState.FINISHED):
            return Refuse(code="late", message="the run is over")
        return None

    def _all_joined(self, now: int) -> None:
        hellos = {name: peer.hello for name, peer in self._peers.items() if peer.hello}
        try:
            self.graph = build_graph(hellos, self.plan.record)
        except DeclarationError as error:
            self._fail(str(error), "", now)
            return
        self._enter(RunEvent.ALL_JOINED, now)
        for name in self.graph.idle:
            outputs = ", ".join(hellos[name].outputs)
            self._notice("idle", name, f"nobody asks for its {outputs}, so it is not run (see run.record)")
        worlds = [p for p in self._peers.values() if p.plan.role == "world"]
        for peer in worlds or self._peers.values():
            self._prepare(peer, now)

    def _prepare(self, peer: Peer, now: int) -> None:
        graph = self._graph()
        peer.move(ServiceEvent.PREPARE)
        peer.advanced_at = now
        self._send(
            peer,
            Prepare(
                epoch=self.plan.epoch,
                attempt=peer.attempt,
                demand=graph.demand[peer.name],
                assets=() if peer.plan.role == "world" else self._assets(),
                producers=dict(graph.producers),
            ),
        )

    def _assets(self) -> tuple[Asset, ...]:
        """The scenery of all worlds, each file once."""
        found = {asset.name: asset for peer in self._peers.values() for asset in peer.assets}
        return tuple(found[name] for name in sorted(found))

    def _assets_offered(self, event: ev.AssetsOffered, now: int) -> None:
        peer = self._peers[event.service]
        for other in self._peers.values():
            theirs = {asset.name: asset.digest for asset in other.assets}
            for asset in event.assets if other is not peer else ():
                if theirs.get(asset.name, asset.digest) != asset.digest:
                    self._fail(
                        f"worlds {other.name!r} and {peer.name!r} bring different files named "
                        f"{asset.name!r}; rename one of them",
                        peer.name,
                        now,
                    )
                    return
        peer.assets, peer.advanced_at = event.assets, now

    def _ready(self, event: ev.ReadyReceived, now: int) -> None:
        peer, message = self._peers[event.service], event.message
        if not self._current(peer, message.epoch, message.attempt, "READY"):
            return
        if peer.state is not ServiceState.PREPARING:
            self._unexpected(peer, "READY", "only once after PREPARE")
            return
        expected = geometry_digest(self._assets())
        if peer.plan.role != "world" and message.geometry and message.geometry != expected:
            self._fail(
                f"{peer.plan.role} {peer.name!r} holds scenery {message.geometry[:12]}…, the worlds announced "
                f"{expected[:12] or 'none'}…; clear its asset cache and start it again",
                peer.name,
                now,
            )
            return
        peer.move(ServiceEvent.READY)
        peer.ready, peer.advanced_at = message, now
        for note in message.notes:
            self._notice("note", peer.name, note)
        if self.state is RunState.PREPARING:
            self._prepared(now)
        elif self.state is RunState.RUNNING:
            self._reset(peer)

    def _prepared(self, now: int) -> None:
        ready = {n: p.ready for n, p in self._peers.items() if p.state is ServiceState.READY and p.ready}
        try:
            check_prefixes({n: r.prefixes for n, r in ready.items() if self._peers[n].plan.role == "world"})
            check_actuators({n: r.actuators for n, r in ready.items()})
        except DeclarationError as error:
            self._fail(str(error), "", now)
            return
        waiting = [p for p in self._peers.values() if p.state is ServiceState.JOINED]
        if any(p.plan.role == "world" and p.name not in ready for p in self._peers.values()):
            return
        for peer in waiting:
            self._prepare(peer, now)
        if len(ready) == len(self._peers):
            self._enter(RunEvent.ALL_READY, now)
            self._begin_episode()

    # --- episodes --------------------------------------------------------------------------------

    def _begin_episode(self) -> None:
        for name in self._graph().order:
            self._reset(self._peers[name])

    def _reset(self, peer: Peer) -> None:
        if peer.name not in self._graph().order:
            return
        peer.move(ServiceEvent.RESET)
        self._send(
            peer,
            Reset(
                epoch=self.plan.epoch,
                attempt=peer.attempt,
                episode=self.episode,
                seed=self.plan.seed,
                t0_ns=self.plan.t_ns(0),
            ),
        )

    def _reset_done(self, event: ev.ResetDoneReceived, now: int) -> None:
        peer, message = self._peers[event.service], event.message
        if not self._current(peer, message.epoch, message.attempt, "RESET_DONE"):
            return
        if peer.state is not ServiceState.RESETTING or message.episode != self.episode:
            self._unexpected(peer, "RESET_DONE", f"only after RESET of episode {self.episode}")
            return
        peer.move(ServiceEvent.RESET_DONE)
        peer.advanced_at = now
        graph = self._graph()
        if self.state is RunState.RUNNING:
            for order in self._schedule().resume(peer.name):
                self._grant(order)
        elif all(self._peers[n].state is ServiceState.ACTIVE for n in graph.order):
            self._enter(RunEvent.ALL_RESET, now)
            self._reports.clear()
            self.schedule = EpisodeSchedule(graph, self.plan, self.episode, self.digest, self._next_journal)

    def _episode_over(self, now: int) -> None:
        schedule = self._schedule()
        self._actions.append(ev.EpisodeFinished(self.episode, schedule.frames))
        for name in self._graph().order:
            peer = self._peers[name]
            end = EpisodeEnd(
                epoch=self.plan.epoch, attempt=peer.attempt, episode=self.episode, frames=schedule.frames
            )
            if peer.state is ServiceState.ACTIVE:
                peer.move(ServiceEvent.EPISODE_END)
                self._send(peer, end)
        self.episode += 1
        if self.episode < self.plan.episodes:
            self._enter(RunEvent.NEXT_EPISODE, now)
            self._begin_episode()
        else:
            self._stop("the run is complete", now)

    # --- frames ----------------------------------------------------------------------------------

    def _done(self, event: ev.DoneReceived, now: int) -> None:
        peer, message = self._peers[event.service], event.message
        frame = self._owed(peer, message.epoch, message.attempt, message.episode, message.frame, "DONE")
        if frame is None:
            return
        schedule = self._schedule()
        hello = peer.hello
        topics = [header.topic for header in message.products]
        strange = [t for t in topics if hello is None or t not in hello.outputs or topics.count(t) > 1]
        if strange:
            self._fail(
                f"{peer.plan.role} {peer.name!r} answered frame {frame} with topic {strange[0]!r}, "
                "which it did not declare once",
                peer.name,
                now,
            )
            return
        peer.advanced_at = now
        t_ns = self.plan.t_ns(frame)
        products = [
            ev.Product(h.topic, peer.name, frame, t_ns, h.digest, h.fidelity, payload)
            for h, payload in zip(message.products, event.payloads, strict=True)
        ]
        if message.decisions or message.counts or message.measured:
            self._reports.setdefault(frame, {})[peer.name] = Report(
                source=peer.name,
                decisions=message.decisions,
                counts=message.counts,
                measured=message.measured,
            )
        schedule.done(peer.name, frame, products, now, end=message.end_episode)

    def _fault(self, event: ev.FaultReceived, now: int) -> None:
        peer, message = self._peers[event.service], event.message
        if message.frame < 0:
            if self._current(peer, message.epoch, message.attempt, "FAULT"):
                self._fail(
                    f"{peer.plan.role} {peer.name!r} failed in {message.phase}: {message.message}",
                    peer.name,
                    now,
                )
            return
        frame = self._owed(peer, message.epoch, message.attempt, message.episode, message.frame, "FAULT")
        if frame is None:
            return
        text = f"{message.phase}: {message.message}"
        if peer.plan.policy in ("wait", "abort"):
            self._fail(f"{peer.plan.role} {peer.name!r} failed in frame {frame}, {text}", peer.name, now)
        else:
            peer.advanced_at = now
            self._schedule().fault(peer.name, frame, text, now)

    def _owed(self, peer: Peer, epoch: int, attempt: int, episode: int, frame: int, kind: str) -> int | None:
        """The frame, if this answer is to the oldest outstanding grant (clause 1); else None."""
        if not self._current(peer, epoch, attempt, kind):
            return None
        owed = (
            self.schedule.outstanding(peer.name) if self.schedule and self.state is RunState.RUNNING else []
        )
        if peer.state is ServiceState.ACTIVE and owed and (episode, frame) == (self.episode, owed[0].frame):
            return frame
        self._stale(peer, kind, owed[0].frame if owed else -1, f"{kind} for episode {episode} frame {frame}")
        return None

    def _grant(self, order: GrantOrder) -> None:
        peer = self._peers[order.service]
        reports: Iterable[Report] = ()
        if peer.plan.role == "recorder":
            reports = self._reports.pop(order.frame, {}).values()
        self._send(
            peer,
            Grant(
                epoch=self.plan.epoch,
                attempt=peer.attempt,
                episode=self.episode,
                frame=order.frame,
                previous_frame=order.previous,
                t_ns=self.plan.t_ns(order.frame),
                budget_ns=peer.plan.budget_ns,
                inputs=order.inputs,
                final=order.final,
                reports=tuple(sorted(reports, key=lambda r: r.source)),
            ),
            order.products,
        )

    def _pump(self, now: int) -> None:
        """Let the schedule act, and carry out what it wants."""
        schedule = self.schedule
        if schedule is None or self.state is not RunState.RUNNING:
            return
        schedule.advance(now)
        for action in schedule.actions:
            if isinstance(action, ev.Journal):
                self._next_journal = action.number + 1
            elif isinstance(action, ev.FrameFinished):
                self._reports.pop(action.frame, None)
            self._actions.append(action)
        schedule.actions.clear()
        for order in schedule.grants:
            self._grant(order)
        schedule.grants.clear()
        for task in schedule.cut:
            peer = self._peers[task.service]
            cancel = Cancel(
                epoch=self.plan.epoch, attempt=peer.attempt, episode=self.episode, frame=task.frame
            )
            if peer.present:
                self._send(peer, cancel)
        schedule.cut.clear()
        if schedule.aborted is not None:
            peer = self._peers[schedule.aborted.service]
            self._fail(peer.blame_task(schedule.aborted, "overran (policy abort)", now), peer.name, now)
        elif schedule.finished:
            self._episode_over(now)

    # --- liveness and the end ------------------------------------------------------------------------

    def _progressed(self, event: ev.Progressed, now: int) -> None:
        self._peers[event.service].heartbeat(event.progress, event.phase, event.grace_ns, now)

    def _journaled(self, event: ev.Journaled, now: int) -> None:
        if self.schedule is not None:
            self.schedule.journal_written(event.number)

    def _violated(self, event: ev.Violated, now: int) -> None:
        peer = self._peers[event.service]
        self._fail(f"{peer.plan.role} {peer.name!r} {event.text}", peer.name, now)

    def _lost(self, event: ev.Lost, now: int) -> None:
        peer = self._peers[event.service]
        if peer.state in (ServiceState.LOST, ServiceState.LEFT):
            return
        frames = [t.frame for t in self._schedule().outstanding(peer.name)] if self._in_graph(peer) else []
        where = f" with frame {frames[0]} outstanding" if frames else f" while {_doing(peer)}"
        peer.verdict = event.verdict
        peer.move(ServiceEvent.LOST)
        peer.lost_at = now
        if self.state is RunState.STOPPING:
            self._check_gone()
            return
        text = f"{peer.plan.role} {peer.name!r} died{where}: {event.verdict}; {peer.last_words(now)}"
        self._notice("lost", peer.name, text)
        if self.plan.limits.rejoin and self.state is RunState.RUNNING:
            if self._in_graph(peer):
                self._schedule().pause(peer.name)
        else:
            self._fail(text, peer.name, now)

    def _in_graph(self, peer: Peer) -> bool:
        return self.schedule is not None and self.graph is not None and peer.name in self.graph.order

    def _bye(self, event: ev.ByeReceived, now: int) -> None:
        peer = self._peers[event.service]
        if not peer.present:
            return
        if self.state is not RunState.STOPPING:
            self._lost(ev.Lost(event.service, f"it left: {event.reason or 'no reason given'}"), now)
            return
        peer.move(ServiceEvent.BYE)
        self._check_gone()

    def _stop_requested(self, event: ev.StopRequested, now: int) -> None:
        if self.state not in (RunState.STOPPING, RunState.FINISHED):
            self._fail(event.reason, "", now)

    def _fail(self, error: str, culprit: str, now: int) -> None:
        """End the run with blame; the first blame counts."""
        if self.state in (RunState.STOPPING, RunState.FINISHED):
            return
        self.error, self.culprit = error, culprit
        self._stop(error, now)

    def _stop(self, reason: str, now: int) -> None:
        self._enter(RunEvent.STOP, now)
        for peer in self._peers.values():
            if peer.present:
                self._send(peer, Shutdown(reason=reason, grace_ns=self.plan.limits.shutdown))
        self._check_gone()

    def _check_gone(self) -> None:
        if not any(peer.present for peer in self._peers.values()):
            self.state = step(RUN, self.state, RunEvent.ALL_GONE)
            self._actions.append(ev.Finished(self.error, self.culprit, self.digest.hexdigest()))

    # --- deadlines of the run ------------------------------------------------------------------------

    def _run_deadlines(self) -> list[tuple[int, Callable[[int], None]]]:
        """(deadline, what then) of whatever the run waits for besides the schedule."""
        limits, found = self.plan.limits, list[tuple[int, Callable[[int], None]]]()
        match self.state:
            case RunState.JOINING:
                found.append((self._since + limits.connect, self._connect_expired))
            case RunState.PREPARING | RunState.RESETTING:
                stage, limit = (
                    (ServiceState.PREPARING, limits.ready)
                    if self.state is RunState.PREPARING
                    else (ServiceState.RESETTING, limits.reset)
                )
                for peer in self._peers.values():
                    if peer.state is stage:
                        found.append((peer.silent_until(self._since, limit), self._silence(peer)))
            case RunState.RUNNING:
                schedule = self._schedule()
                for name in self._graph().order:
                    peer = self._peers[name]
                    if peer.state is ServiceState.LOST and peer.lost_at is not None:
                        found.append((peer.lost_at + limits.rejoin, self._silence(peer)))
                    elif peer.state in (ServiceState.PREPARING, ServiceState.RESETTING):
                        found.append((peer.silent_until(self._since, limits.ready), self._silence(peer)))
                    owed = schedule.outstanding(name)
                    if owed and peer.state is ServiceState.ACTIVE and schedule.must_answer(owed[0]):
                        until = peer.silent_until(owed[0].granted_at or 0, limits.stall)
                        found.append((until, self._silence(peer)))
            case RunState.STOPPING:
                found.append((self._since + limits.shutdown, self._shutdown_expired))
        return found

    def _connect_expired(self, now: int) -> None:
        missing = [p for p in self._peers.values() if p.state is ServiceState.EXPECTED]
        names = ", ".join(f"{p.plan.role} {p.name!r}" for p in missing)
        waited = self.plan.limits.connect / 1e9
        self._fail(f"{names} did not connect within {waited:g} s (timeouts.connect_s)", missing[0].name, now)

    def _silence(self, peer: Peer) -> Callable[[int], None]:
        def blame(now: int) -> None:
            if peer.state is ServiceState.LOST:
                text = f"{peer.plan.role} {peer.name!r} died and did not come back: {peer.verdict}"
            elif peer.state is ServiceState.ACTIVE:
                task = self._schedule().outstanding(peer.name)[0]
                text = peer.blame_task(task, "makes no progress", now)
            else:
                text = peer.blame(f"makes no progress while {_doing(peer)}", now)
            self._fail(text, peer.name, now)

        return blame

    def _shutdown_expired(self, now: int) -> None:
        for peer in self._peers.values():
            if peer.present:
                self._notice("lost", peer.name, peer.blame("did not say BYE in time", now))
                peer.move(ServiceEvent.LOST)
        self._check_gone()

    # --- small things ----------------------------------------------------------------------------------

    def _graph(self) -> Graph:
        assert self.graph is not None
        return self.graph

    def _schedule(self) -> EpisodeSchedule:
        assert self.schedule is not None
        return self.schedule

    def _enter(self, event: RunEvent, now: int) -> None:
        self.state, self._since = step(RUN, self.state, event), now

    def _send(self, peer: Peer, message: Message, products: tuple[ev.Product, ...] = ()) -> None:
        self._actions.append(ev.Send(peer.name, message, products))

    def _notice(self, kind: str, service: str, text: str) -> None:
        self._actions.append(ev.Notice(kind, service, text, self.episode))

    def _current(self, peer: Peer, epoch: int, attempt: int, kind: str) -> bool:
        """Clause 1: whether a message is of this broker's and this service's present incarnation."""
        if peer.present and (epoch, attempt) == (self.plan.epoch, peer.attempt):
            return True
        self._stale(peer, kind, -1, f"{kind} of epoch {epoch}, attempt {attempt}")
        return False

    def _stale(self, peer: Peer, kind: str, outstanding: int, what: str) -> None:
        self._notice("stale", peer.name, f"{what} matches nothing that is outstanding; not used")
        if peer.present:
            self._send(
                peer,
                Stale(
                    of=kind,
                    epoch=self.plan.epoch,
                    attempt=peer.attempt,
                    episode=self.episode,
                    frame=outstanding,
                ),
            )

    def _unexpected(self, peer: Peer, kind: str, when: str) -> None:
        self._notice("stale", peer.name, f"{kind} came out of turn: {when}")
        self._send(peer, Error(code="unexpected", of=kind, message=f"{kind} is expected {when}"))


def _doing(peer: Peer) -> str:
    return {
        ServiceState.EXPECTED: "it was awaited",
        ServiceState.JOINED: "waiting for the others",
        ServiceState.PREPARING: f"preparing ({peer.phase or 'no phase told'})",
        ServiceState.READY: "ready",
        ServiceState.RESETTING: "resetting",
        ServiceState.ACTIVE: "idle in an episode",
        ServiceState.LOST: "lost",
        ServiceState.LEFT: "gone",
    }[peer.state]
