"""Where a service stands in an embedded run: between the frame clock's messages and its methods."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from typing import Any, TypeAlias

from caviar_broker.core import events as ev
from caviar_protocol import messages as m
from caviar_protocol.assets import AssetStore
from caviar_protocol.errors import RunError
from caviar_protocol.scenario.conversion import convert_settings
from caviar_protocol.validation import ContentCheck
from caviar_services.runner import TRIM_EVERY
from caviar_services.service import Frame, FrameInput, Service, StepResult
from caviar_services.session import (
    Guard,
    content_rules_of,
    done_of,
    frame_of,
    hello_of,
    inputs_of,
    is_needed,
    plain_done_of,
    preparation_of,
    ready_of,
    run_info,
)

ABSENT = m.Status.ABSENT
Feed = Callable[[ev.Event], None]
Products: TypeAlias = tuple[ev.Product, ...]


class Place:
    """One service, and what it is told by the clock and tells it."""

    def __init__(
        self,
        name: str,
        use: str,
        cls: type[Service[Any]],
        store: AssetStore,
        feed: Feed,
        check: ContentCheck,
        *,
        digests: bool,
    ) -> None:
        self._name, self._use, self._cls, self._store, self._feed = name, use, cls, store, feed
        self._check = check
        """Of all services of the run, so that a product which several of them consume is checked once."""
        self._digests = digests
        """Whether products are encoded, for their digests; else they are handed over as they are."""
        self._service: Service[Any] | None = None
        self._identity: dict[str, int] = {}
        self._reset_to = m.Reset(epoch=0, attempt=0, episode=0, seed=0, t0_ns=0)
        self._handlers: Mapping[type, Callable[[Any, tuple[ev.Product, ...]], None]] = {
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
            handler(order.message, order.products)

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

    def _welcome(self, message: m.Welcome, _: Products) -> None:
        self._identity = {"epoch": message.epoch, "attempt": message.attempt}
        with self._guard("settings"):
            settings = convert_settings(self._cls.Settings, message.settings)
            self._service = self._cls(settings, run_info(self._name, message, _unwatched))

    def _prepare(self, message: m.Prepare, _: Products) -> None:
        answer: ev.Event | None = None
        with self._guard("prepare"):
            service, assets = self._running, list(message.assets)
            if self._cls.role != "world":  # which are prepared before anything is known about scenes
                self._check.adopt(content_rules_of(service, message))
            prepared = None
            if is_needed(service, message):
                offered = [self._store.add(n, c) for n, c in sorted(service.scenery().items())]
                if offered:
                    self._feed(ev.AssetsOffered(self._name, tuple(offered)))
                if not service.needs_assets:
                    assets = offered
                files = self._store.folder_of(assets) if assets else {}
                prepared = service.prepare(preparation_of(message, files))
            answer = ev.ReadyReceived(self._name, ready_of(self._identity, prepared, assets))
        if answer is not None:
            self._feed(answer)

    def _reset(self, message: m.Reset, _: Products) -> None:
        answer: ev.Event | None = None
        with self._guard("reset", message.episode):
            self._running.reset(message.seed_episode, message.seed, message.t0_ns)
            self._reset_to = message
            done = m.ResetDone(**self._identity, episode=message.episode)
            answer = ev.ResetDoneReceived(self._name, done)
        if answer is not None:
            self._feed(answer)

    def _grant(self, grant: m.Grant, products: Products) -> None:
        answer, phase = None, "step"
        try:
            frame = self._frame(grant, products)
            began = time.monotonic_ns()
            result = self._running.step(frame)
            stepped = time.monotonic_ns()
            phase = "encode"
            answer = self._done(grant, result, stepped - began)
        except Exception:  # told as any other; a guard that is not needed would cost as much as a service
            with self._guard(phase, grant.episode, grant.frame):
                raise
        if answer is not None:
            self._feed(answer)
        if grant.frame % TRIM_EVERY == TRIM_EVERY - 1:
            with self._guard("release", grant.episode, grant.frame):
                self._running.release_memory()

    def _frame(self, grant: m.Grant, products: Products) -> Frame:
        if self._digests:
            inputs = inputs_of(grant, [part for product in products for part in product.payload], self._check)
        else:
            left, check = iter(products), self._check
            inputs = tuple(
                [
                    FrameInput(e)
                    if e.status is ABSENT
                    else FrameInput(e, payload=next(left).payload, check=check)
                    for e in grant.inputs
                ]
            )
        return frame_of(self._running, self._reset_to, grant, inputs)

    def _done(self, grant: m.Grant, result: StepResult, step_ns: int) -> ev.DoneReceived:
        if not self._digests:
            return ev.DoneReceived(self._name, *plain_done_of(self._identity, self._use, grant, result))
        done, made = done_of(self._identity, self._use, grant, result, step_ns)
        return ev.DoneReceived(self._name, done, tuple(zip(made[::2], made[1::2], strict=True)))

    def _episode_end(self, message: m.EpisodeEnd, _: Products) -> None:
        with self._guard("end of episode", message.episode):
            self._running.end_episode(message.frames)

    def _shutdown(self, message: m.Shutdown, _: Products) -> None:
        self._feed(ev.ByeReceived(self._name, message.reason))


class Seat(Place):
    """The place of a service whose frames are answered from outside of the run, by `answer`."""

    _granted: m.Grant | None = None
    frame: Frame | None = None
    """The frame that is granted and not answered."""

    def answer(self, result: StepResult) -> None:
        """Answer the frame that is granted."""
        grant, self._granted, self.frame = self._granted, None, None
        if grant is None:
            raise RunError(f"{self._name!r} was granted no frame that could be answered")
        self._feed(self._done(grant, result, 0))

    def _grant(self, grant: m.Grant, products: Products) -> None:
        with self._guard("step", grant.episode, grant.frame):
            frame = self._frame(grant, products)
            for item in frame.inputs:
                if item.present:
                    item.payload  # noqa: B018 - checked here, where a wrong one ends the run with blame
            self._granted, self.frame = grant, frame


def _unwatched(phase: str, grace_s: float = 0.0) -> None:
    """Progress that nobody needs to hear of: this process is its own watcher."""
