"""The frame clock: one run from the first HELLO to the last BYE, without I/O.

A shell feeds events and the time, performs the actions, and calls `FrameClock.expire` at
`FrameClock.next_deadline`:

>>> clock = FrameClock(plan, now)
>>> clock.receive(event, now)  # as often as something happens
>>> clock.expire(now)  # when next_deadline() has come
>>> [type(action).__name__ for action in clock.actions()]
['Send', 'Send']

Real time is one such shell, the embedded run and the tests in virtual time are others.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from caviar_broker.core import events as ev
from caviar_broker.core.checkpoints import PayloadSize
from caviar_broker.core.episodes import Episodes
from caviar_broker.core.graph import Graph
from caviar_broker.core.membership import Liveness, Registration
from caviar_broker.core.plan import RunPlan
from caviar_broker.core.policy_swaps import PolicyState
from caviar_broker.core.run import Member, Resumption, Run, Snapshot
from caviar_broker.core.status import RunStatus, status_of
from caviar_broker.core.tasks import FinishedFrame
from caviar_broker.core.transitions import RunState, ServiceState
from caviar_protocol.digest import RunDigest
from caviar_protocol.fields import Asset


class FrameClock:
    """The rules of a run. See `caviar_broker.core.events` for what goes in and out.

    Args:
        plan: The run.
        now: The time [ns], of the same monotonic clock as every later ``now``.
        payload_size: Size of a payload [B], for what is kept of a service that may come back.
        resumption: What another broker left of the run.
    """

    def __init__(
        self,
        plan: RunPlan,
        now: int,
        payload_size: PayloadSize = lambda payload: 0,
        resumption: Resumption | None = None,
    ) -> None:
        self.plan = plan
        self._run = Run(plan, now, resumption)
        self._episodes = Episodes(self._run, payload_size)
        self._registration = Registration(self._run, self._episodes)
        self._liveness = Liveness(self._run, self._episodes)
        self._deadline: int | None = None
        self._deadline_is_known = False
        self._handlers: dict[type, Callable[[Any, int], None]] = {
            ev.Joined: self._registration.handle_hello,
            ev.AssetsOffered: self._registration.handle_asset_offer,
            ev.ReadyReceived: self._registration.handle_ready,
            ev.ResetDoneReceived: self._episodes.handle_reset_done,
            ev.DoneReceived: self._episodes.handle_done,
            ev.FaultReceived: self._episodes.handle_fault,
            ev.CheckpointReceived: self._episodes.handle_checkpoint_done,
            ev.GeometryDoneReceived: self._episodes.handle_geometry_done,
            ev.Journaled: self._episodes.handle_journaled,
            ev.Violated: self._liveness.handle_violation,
            ev.Progressed: self._liveness.handle_heartbeat,
            ev.Lost: self._liveness.handle_loss,
            ev.ByeReceived: self._liveness.handle_bye,
            ev.PolicyOffered: lambda event, now: self._run.swaps.offer(event.service, event.digest),
            ev.StopRequested: self._stop_requested,
            ev.PauseRequested: self._episodes.handle_pause,
            ev.ResumeRequested: self._episodes.handle_pause,
            ev.StepRequested: self._episodes.handle_pause,
        }

    # --- the interface of a shell ----------------------------------------------------------------

    @property
    def scenery(self) -> tuple[Asset, ...]:
        """The scenery of all worlds that have announced it."""
        return self._run.scenery()

    def receive(self, event: ev.Event, now: int) -> None:
        """Take in one event.

        Args:
            event: One of those in `caviar_broker.core.events`; its service is one that the plan names.
            now: The time [ns].
        """
        self.handle(event, now)
        self.settle(now)

    def handle(self, event: ev.Event, now: int) -> None:
        """Do the first half of `receive`, for several events that came together: `settle` follows the last.

        What services answer together is dispatched once, which is what keeps a frame of many services cheap.
        """
        # What still arrives after the end of a run is work for nothing, and changes no result.
        handler = self._late if self._run.over else self._handlers[type(event)]
        handler(event, now)

    def expire(self, now: int) -> None:
        """Act on every deadline that has passed at the time ``now`` [ns]."""
        if self._episodes.dispatcher is not None:
            self._episodes.dispatcher.expire(now)
            self._episodes.pump(now)
        self._liveness.expire(now)
        self.settle(now)

    def next_deadline(self) -> int | None:
        """Latest instant at which `expire` has to be called [ns]; None if nothing is awaited."""
        # Kept between looks at the deadlines: only `settle` can change it.
        if not self._deadline_is_known:
            dispatcher = self._episodes.dispatcher
            of_frames = dispatcher.next_deadline() if dispatcher is not None else None
            instants = (self._liveness.next_deadline(), of_frames)
            self._deadline = min((instant for instant in instants if instant is not None), default=None)
            self._deadline_is_known = True
        return self._deadline

    def actions(self) -> list[ev.Action]:
        """Hand out what the shell has to do, in order, each action once; empty once all is handed out."""
        # The list itself stays: dispatcher, decisions and deadlines of the episode append to it.
        waiting = self._run.actions
        if not waiting:
            return []
        actions = waiting.copy()
        waiting.clear()
        return actions

    def settle(self, now: int) -> None:
        """Draw the consequences of the events so far: the dispatcher acts, and a run that is over ends."""
        self._deadline_is_known = False
        self._episodes.pump(now)
        if self._run.over:
            self._episodes.close(now)
            self._run.finish_if_alone(now)

    def _late(self, event: ev.Event, now: int) -> None:
        """Take an event of a run that is over: services that come and go matter, work does not."""
        match event:
            # The run waits for BYE of each service that is present: who comes and goes still counts.
            case ev.Joined() | ev.Lost() | ev.ByeReceived() | ev.Progressed():
                self._handlers[type(event)](event, now)
            case ev.DoneReceived(service=name, message=message):
                if self._episodes.handle_last_recording(event, now):
                    return
                text = f"answered frame {message.frame} after the end of the run; not used"
                self._run.notice("note", name, text, message.frame)
            case ev.FaultReceived(service=name, message=message):
                self._run.notice("fault", name, f"{message.phase}: {message.message}", message.frame)
            case _:
                pass

    def _stop_requested(self, event: ev.StopRequested, now: int) -> None:
        self._run.fail(event.reason, "", now)

    # --- what can be asked -------------------------------------------------------------------------

    @property
    def policies(self) -> Mapping[str, PolicyState]:
        """Agents that serve policies, and which."""
        return {agent: self._run.swaps.state(agent) for agent in self._run.swaps.agents}

    @property
    def state(self) -> RunState:
        """State of the run as a whole."""
        return self._run.state

    @property
    def over(self) -> bool:
        """True if the run has ended, although services may still be leaving."""
        return self._run.over

    @property
    def graph(self) -> Graph | None:
        """Graph of the products that services get of each other; None until all services have joined."""
        return self._run.graph

    @property
    def episode(self) -> int:
        """The present episode, from 0."""
        return self._run.episode

    @property
    def finished_frames(self) -> int:
        """Frames of the present episode that are finished; 0 between episodes."""
        dispatcher = self._episodes.dispatcher
        return 0 if dispatcher is None else dispatcher.table.finished_frames

    def newest_frame(self) -> FinishedFrame | None:
        """The newest finished frame, with what its consumers got; None: none is finished."""
        return self._episodes.newest_frame()

    @property
    def paused(self) -> bool:
        """True if the user has the run begin no frames."""
        return self._run.gate.closed

    def snapshot(self) -> Snapshot | None:
        """The run up to its last finished frame, as a compacted journal opens with it; None without one."""
        run, dispatcher = self._run, self._episodes.dispatcher
        if dispatcher is None or not dispatcher.table.finished_frames:
            return None
        return Snapshot(
            episode=run.episode,
            finished=dispatcher.table.finished_frames,
            finished_before=run.finished_before,
            digest=run.digest.hexdigest(),
            seed=run.seed,
            seed_episode=run.seed_episode,
            frames=dispatcher.table.frames,
            members=dispatcher.graph.order,
        )

    @property
    def waits_for_journal(self) -> bool:
        """True if a grant waits for the journal to be written."""
        dispatcher = self._episodes.dispatcher
        return dispatcher is not None and dispatcher.waits_for_journal

    @property
    def digest(self) -> RunDigest:
        """Chain over the fresh products of all finished frames (clause 20)."""
        return self._run.digest

    @property
    def error(self) -> str:
        """Reason why the run ended early; empty if it did not."""
        return self._run.error

    @property
    def culprit(self) -> str:
        """The service whose fault that was; empty where it was none's."""
        return self._run.culprit

    def member(self, name: str) -> Member | None:
        """A service as the broker knows it; None for a name that the run does not expect."""
        return self._run.members.get(name)

    def status(self, now: int) -> RunStatus:
        """Status of run and services, and the services that are waited for, at the time ``now`` [ns]."""
        return status_of(self._run, self._episodes, now)

    def validate(self) -> None:
        """Cross-field invariants; raises AssertionError naming the one that is broken."""
        run, dispatcher = self._run, self._episodes.dispatcher
        members = run.members.values()
        assert (dispatcher is not None) == (run.state is RunState.RUNNING), "dispatcher outside an episode"
        assert not run.culprit or run.error, "a culprit without an error"
        assert (run.graph is None) == (run.state is RunState.JOINING) or run.over, "a graph too early"
        if dispatcher is not None:
            dispatcher.validate()
            self._episodes.geometry.validate()
            away = [p for p in members if p.state is not ServiceState.ACTIVE and run.takes_part(p)]
            absent = [p.name for p in away if not p.rejoin(self.plan.timeouts)]
            assert not absent, f"{absent} are not in the episode"
        if run.state is RunState.FINISHED:
            assert not any(p.present for p in members), "finished while a service is here"
