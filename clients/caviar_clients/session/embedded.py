"""A run in one process, without sockets, and the session that steps it: same clock, services and digest.

Time stands still here: the run waits for each service it grants a frame, and nothing is ever late. Under
``pace = "realtime"`` the clock jumps to its next deadline when no service has work left.
"""

from __future__ import annotations

import logging
import math
import time
from collections import deque
from collections.abc import Callable, Generator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

from msgspec.structs import replace as replace_field

from caviar_broker.core import events as ev
from caviar_broker.core.clock import FrameClock
from caviar_broker.core.plan import with_ownership
from caviar_broker.journal import JournalFile
from caviar_broker.journal_format import NO_BROKER
from caviar_broker.run_record import planned_run
from caviar_broker.statistics import Statistics
from caviar_clients.files import make_folder_of
from caviar_clients.session.base import Frame, Session, declared, failure_of
from caviar_clients.session.direct import DirectFrames, plays_directly
from caviar_clients.session.prepared import PreparedScenario, implemented
from caviar_clients.session.watchdog import Watchdog, Work
from caviar_protocol import messages as m
from caviar_protocol.assets import AssetStore, MeshCheck
from caviar_protocol.errors import RunError
from caviar_protocol.messages import Input
from caviar_protocol.recording.reader import Imposed
from caviar_protocol.run_directory import RunDirectory
from caviar_protocol.scenario import Scenario
from caviar_protocol.validation import ProductCheck
from caviar_services.conversion import Answer, sorted_products
from caviar_services.registry import with_inputs
from caviar_services.service import Service, StepResult
from caviar_services.session import ServiceSession

S = TypeVar("S", bound=ServiceSession)

_RECEIVED: Mapping[type[m.Message], Callable[[str, Any], ev.Event]] = {
    m.GeometryDone: ev.GeometryDoneReceived,
    m.ResetDone: ev.ResetDoneReceived,
    m.Ready: ev.ReadyReceived,
    m.Fault: ev.FaultReceived,
}

# Without a handler of the program, its warnings go to standard error.
_log = logging.getLogger("caviar.session")


class OutsideSession(ServiceSession):
    """The session of a service whose frames are answered from outside of the run, by `answer`."""

    frame: Frame | None = None
    """The frame that is granted and not answered."""
    _granted: m.Grant | None = None
    _direct: bool = False  # whether the frame came without a GRANT
    _answer: StepResult | None = None

    def answer(self, result: StepResult) -> None:
        """Answer `frame`.

        Raises:
            RunError: No frame is granted.
            PayloadError: A product is not its topic's.
        """
        grant, self._granted, self.frame = self._granted, None, None
        if self._direct:
            self._direct = False
            sorted_products(self.use, result)
            self._answer = result
            return
        if grant is None:
            raise RunError(f"{self.name!r} was granted no frame that could be answered")
        self._send(*self._done(grant, result, 0))

    def compute(self, frame: Frame) -> StepResult | None:
        """Offer a frame to the program outside, which has to `answer` it."""
        try:
            _check_inputs(frame)
        except Exception as error:
            self.report(error, "step", frame.episode, frame.number)
            return None
        self.frame, self._direct, self._answer = frame, True, None
        return None

    def answered(self) -> StepResult | None:
        """The answer to the frame that was offered last."""
        return self._answer

    def _step(self, reset: m.Reset, grant: m.Grant, parts: Sequence[Any]) -> Answer | None:
        # Without `_reporting`, as in a service that computes: its context costs 5 µs in each step.
        try:
            frame = self._frame(reset, grant, parts)
            _check_inputs(frame)
            self._granted, self.frame = grant, frame
        except Exception as error:
            self.report(error, "step", grant.episode, grant.frame)
        return None


def _check_inputs(frame: Frame) -> None:
    """Check the products that a program outside gets, here where a wrong one ends the run with blame."""
    for item in frame.inputs:
        if item.present:
            item.payload  # noqa: B018 - checked on first use


class EmbeddedRun:
    """One run of a scenario in this process.

    Args:
        scenario: Checked, as `caviar_clients.session.prepared.prepare` returns it.
        directory: Where the recorder and the journal write. None: nothing is written, recorders are left
            out, and products go from service to service as they are, so that the outcome has no digest and
            `statistics` stay empty.
        on_notice, on_frame: Called with each notice to the user, and with each finished frame.
        on_wait: Called with what the run waits for, where that takes seconds: from another thread, since the
            service has this one. By default a warning of the logger ``caviar.session``.
        wait_again_s: Time from one such call to the next at most [s]; by default it doubles.
        seats: By name, services that decide outside of the run (`OutsideSession`), and classes that declare
            them.
        imposed: Decisions that services take over in place of their own, as
            `caviar_protocol.recording.reader.recorded_decisions` finds them.
        episode: The one episode that is played, with the seeds that it has in a run of many; None: all.
        with_journal: Whether the decisions of the clock are written beside the recording.

    Example:
        >>> from caviar_clients.session.prepared import prepare
        >>> outcome = EmbeddedRun(prepare("smoke", frames=3), directory=None).run()
        >>> outcome.error
        ''
    """

    def __init__(
        self,
        scenario: Scenario | PreparedScenario,
        directory: Path | None,
        on_notice: Callable[[ev.Notice], None] = lambda notice: None,
        on_frame: Callable[[ev.FrameFinished], None] = lambda frame: None,
        on_wait: Callable[[str], None] = _log.warning,
        wait_again_s: float = math.inf,
        seats: Mapping[str, type[Service[Any]]] | None = None,
        imposed: Imposed | None = None,
        episode: int | None = None,
        with_journal: bool = True,
    ) -> None:
        prepared, seats = implemented(scenario), seats or {}
        scenario = prepared.scenario
        if directory is None:
            kept = {name: spec for name, spec in scenario.services.items() if spec.role != "recorder"}
            run = replace_field(scenario.run, record=())
            scenario = replace_field(scenario, services=kept, run=run)
        for name in seats:
            # Settings of the implementation whose place is taken are not for the service outside.
            seated = replace_field(scenario.services[name], settings={})
            scenario = replace_field(scenario, services={**scenario.services, name: seated})
        scenario = with_ownership(scenario)
        folder = (directory or Path()).resolve()
        store = AssetStore()
        plan = planned_run(scenario, folder.name, folder, store, keeps=directory is not None)
        self._meshes = MeshCheck(store, plan.max_faces)
        if episode is not None:
            plan = replace(plan, first_episode=episode, episodes=episode + 1)
        plan = replace(
            plan,
            # A service that runs ahead gains nothing in one process, and computes in vain where an agent ends
            # the episode.
            frames_in_flight=1,
            # No service can be lost and come back: where this process dies, all of them do.
            checkpoint_frames=0,
            ephemeral=directory is None,
            imposed=plan.imposed if imposed is None else imposed,
        )
        self.statistics = Statistics({s.name: s.budget_ns for s in plan.services})
        self._services = {service.name: service for service in plan.services}
        self._now = 0
        self._plan, self._clock = plan, FrameClock(plan, self._now)
        self._journal = (
            JournalFile(RunDirectory(folder).journal, NO_BROKER, run=plan.run)
            if directory and with_journal
            else None
        )
        self._on_notice, self._on_frame = on_notice, on_frame
        self.outcome: ev.Finished | None = None
        """How it ended; None until then."""
        self._stop_reason = ""
        self._orders: deque[ev.Send] = deque()
        # Not fed at once: a service answers within `handle`, and the clock must not be entered twice.
        self._events: deque[ev.Event] = deque()
        # Without a recorder nothing needs bytes: products go to their consumers as the objects that they are.
        self._encodes = directory is not None
        # Seats alone: a run that plays by itself is measured and watched frame by frame, by the clock.
        self._without_clock = directory is None and bool(seats) and plays_directly(plan)
        self._reset: m.Reset | None = None  # the last one
        self._check = check = ProductCheck()

        def session(kind: type[S], name: str, cls: type[Service[Any]]) -> S:
            use, send = scenario.services[name].use, partial(self._take, name)

            def progress(phase: str, grace_s: float = 0.0) -> None:
                self._watchdog.progress(name, phase)

            return kind(name, use, cls, send, store, progress=progress, check=check, encodes=self._encodes)

        def implementation(name: str) -> type[Service[Any]]:
            cls = prepared.services[name].cls
            return with_inputs(cls, cls.inputs_with(scenario.services[name].settings))

        self.seats = {name: session(OutsideSession, name, cls) for name, cls in seats.items()}
        """Services that decide outside of the run."""
        self._sessions: dict[str, ServiceSession] = {
            name: self.seats.get(name) or session(ServiceSession, name, implementation(name))
            for name in scenario.services
        }
        self.at_work: Work | None = None
        """What a service handles just now, for the watchdog; None between services."""
        self._direct: DirectFrames | None = None
        classes = {name: session.cls for name, session in self._sessions.items()}
        # Which meshes there are in a frame is the clock's to say.
        settings = {name: spec.settings for name, spec in scenario.services.items()}
        if any(c.role == "world" and c.changes_geometry_with(settings[n]) for n, c in classes.items()):
            self._without_clock = False
        self._watchdog = Watchdog(
            plan, classes, lambda: (self._direct or self).at_work, on_wait, wait_again_s
        )

    def run(self) -> ev.Finished:
        """Run to the end.

        Returns:
            How the run ended: its digest, and an error with the service to blame, both empty where there is
            none.
        """
        for _ in self.steps():
            pass
        if self.outcome is None:
            raise RunError("the run ended without an outcome")
        return self.outcome

    def steps(self) -> Generator[None, None, None]:
        """Run to the end, and yield after each step of a service or of the clock.

        A frame of a seat has to be answered before the next step. However the loop is left, every service is
        closed.
        """
        with self._watchdog, ExitStack() as stack:
            if self._journal is not None:
                stack.callback(self._journal.close)
            for session in self._sessions.values():
                stack.callback(self._close, session)
            for session in self._sessions.values():
                self._feed(ev.Joined(session.hello()))
            while self.outcome is None:
                # Answers before orders: the clock decides what is granted next from all that is known.
                if self._events:
                    self._feed(self._events.popleft())
                elif self._stop_reason:
                    reason, self._stop_reason = self._stop_reason, ""
                    self._feed(ev.StopRequested(reason))
                elif self._orders:
                    order = self._orders.popleft()
                    if self._without_clock and type(order.message) is m.Grant:
                        yield from self._play_directly()
                    else:
                        self._obey(order)
                else:
                    self._skip_time()
                yield

    def service(self, name: str) -> Service[Any]:
        """A service of the run, from its WELCOME to the end.

        Args:
            name: Of the service.

        Raises:
            RunError: It has not joined, or could not be set up.
        """
        return self._sessions[name].running

    def stop(self, reason: str) -> None:
        """End the run after the present step, for a reason that its outcome gets. May be called from a signal
        handler."""
        self._stop_reason = reason
        self._watchdog.stop()

    def _obey(self, order: ev.Send) -> None:
        session = self._sessions[order.service]
        if type(order.message) is m.Refuse:
            # Of declarations that contradict each other: the run ends with both names.
            self._events.append(ev.ByeReceived(order.service))
            return
        payloads = [product.payload for product in order.products]
        parts = [part for payload in payloads for part in payload] if self._encodes else payloads
        if type(order.message) is m.Reset:
            self._reset = order.message
        # What a service sends comes back through `_take` before this call returns.
        began = time.monotonic_ns()
        self.at_work = order.service, order.message
        try:
            session.handle(order.message, parts)
        except (SystemExit, KeyboardInterrupt) as error:
            failure = failure_of(error)
            phase, episode, frame = "start", 0, -1
            if isinstance(order.message, m.Grant):
                phase, episode, frame = "step", order.message.episode, order.message.frame
            session.report(failure, phase, episode, frame)
        self.at_work = None
        if self._encodes and type(order.message) is m.Grant:
            now, plan = time.monotonic_ns(), self._services[order.service]
            elapsed = now - began
            grant = order.message
            missed = elapsed > plan.budget_ns
            missed = missed and not self._plan.is_warm_up(plan, grant.episode, grant.frame)
            self.statistics.latency(order.service, elapsed, missed, grant.episode, grant.frame, now)

    def _close(self, session: ServiceSession) -> None:
        self._direct, self.at_work = None, (session.name, None)
        session.close()
        self.at_work = None

    def _play_directly(self) -> Generator[None, None, None]:
        """Play on without the clock, which granted the first frame of the first episode."""
        graph, reset = self._clock.graph, self._reset
        if graph is None or reset is None:
            raise RunError("a frame was granted before the first episode began")
        sessions, tell = self._sessions, self._on_notice
        direct = DirectFrames(self._plan, graph, sessions, self._check, reset, self._events, tell)
        self._direct = direct
        for _ in direct.play():
            if self._stop_reason:
                self.outcome = ev.Finished(self._stop_reason, "", "")
                return
            yield
        self.outcome = direct.outcome

    def _take(self, name: str, message: m.Message, parts: Sequence[Any]) -> None:
        """Keep what a service sends as an event, for the clock to receive once the service has returned."""
        event: ev.Event
        match message:
            case m.Done():
                payloads = tuple(zip(parts[::2], parts[1::2], strict=True)) if self._encodes else tuple(parts)
                new = message.geometry  # of a world that announces meshes
                refused = None if new is None else self._meshes.refusals(new.assets)
                event = ev.DoneReceived(name, message, payloads, refused)
            case m.GeometryDone() | m.ResetDone() | m.Ready() | m.Fault():
                event = _RECEIVED[type(message)](name, message)
            case m.AssetOffer():
                event = ev.AssetsOffered(name, message.assets)
            case m.Bye():
                event = ev.ByeReceived(name, message.reason)
            case _:
                raise RunError(f"{name!r} sent {message}, which a run in one process has no use for")
        self._events.append(event)

    def _skip_time(self) -> None:
        """No service has work left: move the clock to its next deadline."""
        deadline = self._clock.next_deadline()
        if deadline is None:
            raise RunError("no service has work left, and the run is not over")
        self._now = max(self._now, deadline)
        self._clock.expire(self._now)
        self._perform()

    def _feed(self, event: ev.Event) -> None:
        self._clock.receive(event, self._now)
        self._perform()

    def _perform(self) -> None:
        while actions := self._clock.actions():
            entries: list[ev.Journal] = []
            for action in actions:
                # The two kinds that every frame has, before the others and without a match statement.
                kind = type(action)
                if kind is ev.Send:
                    self._orders.append(action)  # type: ignore[arg-type]  # its type was looked at
                elif kind is ev.Journal:
                    entries.append(action)  # type: ignore[arg-type]
                elif kind is not ev.Latency:
                    self._tell(action)
            # One write for all entries of a turn, and one event for the clock: the last number covers all.
            if entries:
                if self._journal is not None:
                    self._journal.write(entries)
                self._clock.receive(ev.Journaled(entries[-1].number), self._now)

    def _tell(self, action: ev.Action) -> None:
        match action:
            case ev.FrameFinished():
                if self._encodes:
                    self.statistics.frame(time.monotonic_ns(), action.episode, action.lag_ns)
                self._on_frame(action)
            case ev.Notice():
                self._on_notice(action)
            case ev.Finished():
                self.outcome = action
            case ev.TurnAway():
                raise RunError(f"{action.name!r} is refused: {action.refusal.message}")
            case _:
                pass


ENDLESS = 2**53
"""Episodes of a run that goes on until it is closed."""
KEPT_NOTICES = 100
"""Notices that a session keeps: the newest."""


class EmbeddedSession(Session):
    """A run in this process that plays as many episodes as are asked for.

    Args:
        scenario: Checked, as `caviar_clients.session.prepared.prepare` returns it.
        agent: Name of the agent whose place is taken.
        inputs: What it consumes.
        directory: Where recorder and journal write; None: nothing is written, which is a lot faster.
        with_scenery: Whether `Session.scenery` is looked up.
        beside: Further agents whose places are taken.

    Raises:
        DeclarationError: What services declare does not make a run.
    """

    def __init__(
        self,
        scenario: Scenario | PreparedScenario,
        agent: str,
        inputs: tuple[Input, ...],
        directory: Path | None = None,
        with_scenery: bool = False,
        beside: Sequence[str] = (),
    ) -> None:
        super().__init__(beside)
        self.notices: deque[str] = deque(maxlen=KEPT_NOTICES)
        """Notices of the run, the newest last."""
        if directory is not None:
            make_folder_of(RunDirectory(directory).journal)
        prepared = implemented(scenario)
        plain = prepared.scenario
        plain = replace_field(plain, run=replace_field(plain.run, episodes=ENDLESS))
        self._seed = -1
        scenery_here = self._take_scenery if with_scenery else None
        cls = declared(inputs, lambda: self._seed, _decided_outside, scenery_here)
        others = declared(inputs, lambda: self._seed, _decided_outside)
        seats = {agent: cls, **dict.fromkeys(beside, others)}
        self._run = EmbeddedRun(replace(prepared, scenario=plain), directory, self._notice, seats=seats)
        self._seat = self._run.seats[agent]
        self._seats_beside = {name: self._run.seats[name] for name in beside}
        self._steps = self._run.steps()

    def service(self, name: str) -> Service[Any]:
        """A service of the run, which is prepared after the first `reset`.

        Args:
            name: Of the service.
        """
        return self._run.service(name)

    def close(self) -> None:
        """End the run and close its services."""
        self._steps.close()

    def _begin(self, seed: int) -> None:
        self._seed = seed

    def _answer(self, result: StepResult, beside: Mapping[str, StepResult]) -> None:
        if self._run.outcome is not None:
            raise self._over()
        self._seat.answer(result)
        for name, seat in self._seats_beside.items():
            seat.answer(beside[name])

    def _granted(self) -> Frame:
        for _ in self._steps:
            if self._seat.frame is None:
                continue
            if all(seat.frame is not None for seat in self._seats_beside.values()):
                return self._seat.frame
        raise self._over()

    def _over(self) -> RunError:
        outcome = self._run.outcome
        return RunError(outcome.error if outcome and outcome.error else "the run is over; begin a new one")

    def _notice(self, notice: ev.Notice) -> None:
        self.notices.append(f"{notice.kind}: {notice.service}: {notice.text}")


def _decided_outside(_: Frame) -> StepResult:
    raise RunError("an embedded session answers through its seat")
