"""Observers of a run: peers that see finished frames, come and go at any time, and are waited for by nothing.

Each has one OBSERVE under way at most, and gets the newest finished frame once it has taken that: what one
costs is bounded, however slow it is. Products go to it as the ZeroMQ frames they came in.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from caviar_broker.core.clock import FrameClock
from caviar_broker.core.tasks import FinishedFrame
from caviar_protocol import messages as m
from caviar_protocol.codec import check_version, encode_message, message_type
from caviar_protocol.errors import VersionError

CAPABILITY = "observe"
_NEVER = (-1, -1)
# Of an observer that named none: it learns of each frame, and no product has this topic.
_FRAMES_ALONE = m.Subscription(topic="")


@dataclass(slots=True)
class _Observer:
    name: str
    subscriptions: tuple[m.Subscription, ...]
    # Episode and frame that each of them got last.
    seen: list[tuple[int, int]]
    # Of the next OBSERVE.
    sequence: int = 0
    # When the one under way was sent [ns]; None: there is none.
    sent_at: int | None = None
    # State of the run, whether it is paused, as the observer was told last.
    told: tuple[str, bool] = ("", False)

    def due(self, frame: FinishedFrame) -> list[int]:
        """Indices of the subscriptions that are to get a frame."""
        return [
            index
            for index, (episode, last) in enumerate(self.seen)
            if episode != frame.episode or frame.frame - last >= self.subscriptions[index].every
        ]


@dataclass
class Observers:
    """The observers of one run.

    Args:
        clock: Knows frames and services.
        epoch: Of the run.
        patience_ns: Time that an observer may take for one OBSERVE.
        send: Sends a header and further parts to a routing id; why it did not go, or an empty text.
        cut: Ends the connection of a routing id, for a reason; then the observer is to be forgotten.
        note: Called with a kind and a text for the log, of which it may hold back those of one kind.
    """

    clock: FrameClock
    epoch: int
    patience_ns: int
    send: Callable[[bytes, bytes, list[Any]], str]
    cut: Callable[[bytes, str], None]
    note: Callable[[str, str], None]
    known: dict[bytes, _Observer] = field(default_factory=dict)
    """By routing id; for others to look things up in."""
    # Newest finished frame, while there are observers.
    _newest: FinishedFrame | None = None

    # --- who comes and goes ----------------------------------------------------------------------------

    def join(self, route: bytes, hello: m.Hello, is_open: Callable[[bytes], bool]) -> m.Refuse | None:
        """Welcome an observer; why it is refused, if it is.

        Args:
            route: Routing id of its connection.
            hello: Its HELLO.
            is_open: Whether the connection of another routing id still stands.
        """
        if refusal := self._refusal(hello, is_open):
            return refusal
        plan = self.clock.plan
        welcome = m.Welcome(
            version=m.PROTOCOL_VERSION,
            run=plan.run,
            epoch=self.epoch,
            attempt=1,
            capabilities=tuple(c for c in hello.capabilities if c in m.CAPABILITIES),
            heartbeat_ns=plan.timeouts.heartbeat,
            liveness_ns=plan.timeouts.liveness,
            seed=plan.seed,
            scenario={
                "frames": plan.frames,
                "episodes": plan.episodes,
                "sampling_period_ns": plan.sampling_period_ns,
            },
        )
        if not self.known:
            self._newest = self.clock.newest_frame()
        subscriptions = hello.subscriptions or (_FRAMES_ALONE,)
        observer = _Observer(hello.name, subscriptions, [_NEVER] * len(subscriptions))
        self.known[route] = observer
        self.send(route, encode_message(welcome), [])
        self.note("observers that came", f"observer {hello.name!r} came")
        self._offer(route, observer, time.monotonic_ns())
        return None

    def _refusal(self, hello: m.Hello, is_open: Callable[[bytes], bool]) -> m.Refuse | None:
        try:
            check_version(hello.version)
        except VersionError as error:
            return m.Refuse(code="version", message=str(error))
        if CAPABILITY not in hello.capabilities or hello.inputs or hello.outputs:
            text = f"an observer has the capability {CAPABILITY!r}, subscriptions, and no inputs or outputs"
            return m.Refuse(code="declaration", message=text)
        namesakes = [route for route, other in self.known.items() if other.name == hello.name]
        if self.clock.member(hello.name) or any(map(is_open, namesakes)):
            text = f"the run has a service or an observer named {hello.name!r}; use another name"
            return m.Refuse(code="name-taken", message=text)
        for route in namesakes:
            self.gone(route, "its connection is gone")
        return m.Refuse(code="late", message="the run is over") if self.clock.over else None

    def forget(self, route: bytes) -> str:
        """Forget an observer; its name, or an empty text where the routing id was none's."""
        observer = self.known.pop(route, None)
        if not self.known:
            self._newest = None
        return "" if observer is None else observer.name

    def gone(self, route: bytes, why: str) -> None:
        """Forget an observer that has gone by itself, if the routing id was one's."""
        if name := self.forget(route):
            self.note("observers that went", f"observer {name!r} is gone: {why}")

    def end(self, reason: str) -> None:
        """Send the last frame to all, whatever is under way, and SHUTDOWN."""
        for route, observer in [*self.known.items()]:
            observer.sent_at = None
            self._offer(route, observer, time.monotonic_ns())
            self.send(route, encode_message(m.Shutdown(reason=reason)), [])

    # --- what comes ------------------------------------------------------------------------------------

    def handle(self, route: bytes, message: m.Message) -> None:
        """Take a message of an observer."""
        observer = self.known[route]
        match message:
            case m.Observed(sequence=number) if observer.sent_at and number == observer.sequence - 1:
                observer.sent_at = None
                self._offer(route, observer, time.monotonic_ns())
            case m.Bye(reason=reason):
                self.gone(route, reason or "it left")
            case m.Error():
                text = f"observer {observer.name!r} could not use {message.of}: {message.message}"
                self.note("observers that complain", text)
            case _:
                kind = message_type(message)
                text = f"{kind} has no place on the connection of an observer, or not now"
                self.send(route, encode_message(m.Error(code="unexpected", of=kind, message=text)), [])
                self.note("observers that send", f"observer {observer.name!r}: {text}; not used")

    # --- what goes -------------------------------------------------------------------------------------

    def frame_finished(self) -> None:
        """Send the newest finished frame to those who have taken what they got before."""
        self._newest = self.clock.newest_frame()
        self._offer_all(time.monotonic_ns())

    def check(self, now: int) -> None:
        """Send another state of the run, and disconnect those who have not taken a frame in time."""
        for route, observer in [*self.known.items()]:
            if observer.sent_at and now - observer.sent_at > self.patience_ns:
                limit = f"{self.patience_ns / 1e9:g} s (limits.observer_s)"
                self.cut(route, f"it has not acknowledged OBSERVE {observer.sequence - 1} for {limit}")
        self._offer_all(now)

    def _offer_all(self, now: int) -> None:
        for route, observer in [*self.known.items()]:
            self._offer(route, observer, now)

    def _offer(self, route: bytes, observer: _Observer, now: int) -> None:
        """Send an observer what is new to it, unless it has something under way."""
        if observer.sent_at is not None:
            return
        frame = self._newest
        state = self.clock.state.name.lower(), self.clock.paused
        due = observer.due(frame) if frame is not None else []
        if not due and state == observer.told:
            return
        message = m.Observe(sequence=observer.sequence, state=state[0], paused=state[1])
        parts: list[Any] = []
        if frame is not None:
            wanted = [observer.subscriptions[index] for index in due]
            chosen = [
                decision
                for decision in frame.decisions
                if any(
                    s.topic in ("*", decision.provenance.topic)
                    and s.source in ("", decision.provenance.source)
                    for s in wanted
                )
            ]
            for decision in chosen:
                if decision.product is not None:
                    parts += decision.product.payload
            message = m.Observe(
                sequence=observer.sequence,
                state=state[0],
                paused=state[1],
                episode=frame.episode,
                frame=frame.frame,
                t_ns=frame.t_ns,
                inputs=tuple([decision.provenance for decision in chosen]),
                reports=frame.reports if due else (),
            )
            for index in due:
                observer.seen[index] = frame.episode, frame.frame
        observer.sequence += 1
        observer.sent_at, observer.told = now, state
        if reason := self.send(route, encode_message(message), parts):
            self.gone(route, reason)
