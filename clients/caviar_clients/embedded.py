"""A run in one process, without sockets: the same frame clock, the same services, the same digest.

Time stands still here: whoever is granted a frame is waited for, and nothing is ever late. Under
``pace = "realtime"`` the clock jumps to its next deadline once nobody has anything to do.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Generator, Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from caviar_broker.briefing import briefings, with_ownership
from caviar_broker.core import events as ev
from caviar_broker.core.clock import FrameClock
from caviar_broker.core.plan import plan_run
from caviar_broker.journal import JournalFile
from caviar_broker.statistics import Statistics
from caviar_protocol import messages as m
from caviar_protocol.assets import AssetStore
from caviar_protocol.errors import RunError
from caviar_protocol.scenario import Scenario
from caviar_protocol.tables import convert_settings
from caviar_services.answers import Guard
from caviar_services.exchange import (
    done_of,
    frame_of,
    hello_of,
    is_needed,
    preparation_of,
    ready_of,
    run_info,
)
from caviar_services.registry import load
from caviar_services.runner import TRIM_EVERY
from caviar_services.service import Service

Feed = Callable[[ev.Event], None]


class EmbeddedRun:
    """One run of a scenario in this process.

    Parameters
    ----------
    scenario
        Checked, as `caviar_protocol.scenario_loader.load_scenario` returns it.
    directory
        Where the recorder and the journal write.
    on_notice, on_frame
        Told what the user should know, and of each finished frame.
    """

    def __init__(
        self,
        scenario: Scenario,
        directory: Path,
        on_notice: Callable[[ev.Notice], None] = lambda notice: None,
        on_frame: Callable[[ev.FrameFinished], None] = lambda frame: None,
    ) -> None:
        scenario = with_ownership(scenario)
        directory = directory.resolve()
        plan = plan_run(scenario, directory.name, briefings(scenario, directory))
        self.statistics = Statistics({s.name: s.budget_ns for s in plan.services})
        self._now = 0
        self._clock = FrameClock(plan, self._now)
        self._journal = JournalFile(directory / "journal.msgpack", plan.epoch)
        self._on_notice, self._on_frame = on_notice, on_frame
        self.outcome: ev.Finished | None = None
        """How it ended; None until then."""
        self._stop_reason = ""
        self._orders: deque[ev.Send] = deque()
        store = AssetStore()
        self._places = {
            name: _Place(name, spec.role, spec.use, store, self._feed)
            for name, spec in scenario.services.items()
        }

    def run(self) -> ev.Finished:
        """Run to the end."""
        for _ in self.steps():
            pass
        if self.outcome is None:
            raise RunError("the run ended without an outcome")
        return self.outcome

    def steps(self) -> Generator[None, None, None]:
        """Run to the end, and come back behind whatever a service did.

        However the loop is left, every service is closed.
        """
        with ExitStack() as stack:
            stack.callback(self._journal.close)
            for place in self._places.values():
                stack.callback(place.close)
            for place in self._places.values():
                self._feed(ev.Joined(place.hello()))
            while self.outcome is None:
                if self._stop_reason:
                    reason, self._stop_reason = self._stop_reason, ""
                    self._feed(ev.StopRequested(reason))
                elif self._orders:
                    self._obey(self._orders.popleft())
                else:
                    self._skip_time()
                yield

    def stop(self, reason: str) -> None:
        """End the run behind what is being done. May be called from a signal handler."""
        self._stop_reason = reason

    def _obey(self, order: ev.Send) -> None:
        began = time.monotonic_ns()
        self._places[order.service].obey(order)
        if isinstance(order.message, m.Grant):
            self.statistics.latency(order.service, time.monotonic_ns() - began, missed=False)

    def _skip_time(self) -> None:
        """Nobody has anything to do: to the next deadline."""
        deadline = self._clock.next_deadline()
        if deadline is None:
            raise RunError("nobody has anything to do, and the run is not over")
        self._now = max(self._now, deadline)
        self._clock.expire(self._now)
        self._perform()

    def _feed(self, event: ev.Event) -> None:
        self._clock.receive(event, self._now)
        self._perform()

    def _perform(self) -> None:
        while actions := self._clock.actions():
            entries = [action for action in actions if isinstance(action, ev.Journal)]
            for action in actions:
                match action:
                    case ev.Send():
                        self._orders.append(action)
                    case ev.Notice():
                        self._on_notice(action)
                    case ev.FrameFinished():
                        self.statistics.frame(time.monotonic_ns())
                        self._on_frame(action)
                    case ev.Finished():
                        self.outcome = action
                    case ev.TurnAway():
                        raise RunError(f"{action.name!r} is refused: {action.refusal.message}")
                    case _:
                        pass
            if entries:
                self._journal.write(entries)
                self._clock.receive(ev.Journaled(entries[-1].number), self._now)


class _Place:
    """One service, and what it is told by the clock and tells it."""

    def __init__(self, name: str, role: str, use: str, store: AssetStore, feed: Feed) -> None:
        self._name, self._use, self._store, self._feed = name, use, store, feed
        self._cls = load(role, use)
        self._service: Service[Any] | None = None
        self._identity: dict[str, int] = {}
        self._handlers: Mapping[type, Callable[[Any, Sequence[Any]], None]] = {
            m.Welcome: self._welcome,
            m.Prepare: self._prepare,
            m.Reset: self._reset,
            m.Grant: self._grant,
            m.EpisodeEnd: self._episode_end,
            m.Shutdown: self._shutdown,
        }

    def hello(self) -> m.Hello:
        """How it joins."""
        return hello_of(self._name, self._use, self._cls)

    def obey(self, order: ev.Send) -> None:
        """Do what a message says; what else there is needs no answer."""
        handler = self._handlers.get(type(order.message))
        if handler is not None:
            parts = [part for product in order.products for part in product.payload]
            handler(order.message, parts)

    def close(self) -> None:
        """Let the service release what it holds; again: nothing."""
        service, self._service = self._service, None
        if service is not None:
            service.close()

    @property
    def _running(self) -> Service[Any]:
        if self._service is None:
            raise RunError(f"{self._name!r} could not be set up")
        return self._service

    def _guard(self, phase: str, episode: int = 0, frame: int = -1) -> Guard:
        return Guard(self._identity, self._fault, phase, episode, frame)

    def _fault(self, fault: m.Fault) -> None:
        self._feed(ev.FaultReceived(self._name, fault))

    def _welcome(self, message: m.Welcome, _: Sequence[Any]) -> None:
        self._identity = {"epoch": message.epoch, "attempt": message.attempt}
        with self._guard("settings"):
            settings = convert_settings(self._cls.Settings, message.settings)
            self._service = self._cls(settings, run_info(self._name, message, _unwatched))

    def _prepare(self, message: m.Prepare, _: Sequence[Any]) -> None:
        answer: ev.Event | None = None
        with self._guard("prepare"):
            service, assets = self._running, list(message.assets)
            prepared = None
            if is_needed(service, message):
                offered = [self._store.add(n, c) for n, c in sorted(service.scenery().items())]
                if offered:
                    self._feed(ev.AssetsOffered(self._name, tuple(offered)))
                if not service.uses_scenery:
                    assets = offered
                files = self._store.folder_of(assets) if assets else {}
                prepared = service.prepare(preparation_of(message, files))
            answer = ev.ReadyReceived(self._name, ready_of(self._identity, prepared, assets))
        if answer is not None:
            self._feed(answer)

    def _reset(self, message: m.Reset, _: Sequence[Any]) -> None:
        answer: ev.Event | None = None
        with self._guard("reset", message.episode):
            self._running.reset(message.episode, message.seed, message.t0_ns)
            done = m.ResetDone(**self._identity, episode=message.episode)
            answer = ev.ResetDoneReceived(self._name, done)
        if answer is not None:
            self._feed(answer)

    def _grant(self, grant: m.Grant, parts: Sequence[Any]) -> None:
        answer: ev.Event | None = None
        with self._guard("step", grant.episode, grant.frame) as guard:
            frame = frame_of(self._running, grant, parts)
            began = time.monotonic_ns()
            result = self._running.step(frame)
            stepped = time.monotonic_ns()
            guard.phase = "encode"
            done, made = done_of(self._identity, self._use, grant, result, stepped - began)
            payloads = tuple(zip(made[::2], made[1::2], strict=True))
            answer = ev.DoneReceived(self._name, done, payloads)
        if answer is not None:
            self._feed(answer)
        if grant.frame % TRIM_EVERY == TRIM_EVERY - 1:
            with self._guard("release", grant.episode, grant.frame):
                self._running.release_memory()

    def _episode_end(self, message: m.EpisodeEnd, _: Sequence[Any]) -> None:
        with self._guard("end of episode", message.episode):
            self._running.end_episode(message.frames)

    def _shutdown(self, message: m.Shutdown, _: Sequence[Any]) -> None:
        self._feed(ev.ByeReceived(self._name, message.reason))


def _unwatched(phase: str, grace_s: float = 0.0) -> None:
    """Progress that nobody needs to hear of: this process is its own watcher."""
