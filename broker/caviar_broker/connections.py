"""Connections of a run: whose each one is, and the answer to those who have no place in it."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field

from caviar_broker.assets import AssetExchange
from caviar_broker.core import events as ev
from caviar_broker.core.clock import FrameClock
from caviar_broker.event_loop import EventLoop
from caviar_broker.router import Router, is_assigned
from caviar_broker.security.limits import NoticeThrottle
from caviar_broker.supervision import Watchdog
from caviar_protocol import messages as m
from caviar_protocol.codec import encode_message, message_type
from caviar_protocol.errors import ProtocolError, VersionError
from caviar_protocol.host import host_identity

COMPLAINTS = (m.Error, m.Stale, m.Refuse, m.HeartbeatAck)
"""Messages that have no answer: they give no right to a further message."""


@dataclass(slots=True)
class Connection:
    """A connection, by its routing id."""

    service: str
    heartbeat: bool


@dataclass
class Connections:
    """The connections of one run, from HELLO or ATTACH until they end.

    The tables `known` and `routes` are for others to look things up in, and are changed only here.

    Args:
        clock: Who is in the run.
        epoch: Of the run.
        router: Where messages come and go.
        loop: Where processes are watched.
        watchdog, assets: Follow incarnations that come and go.
        feed: Gives the clock an event, and does what it wants.
        perform: Does what the clock wants.
        note: Called with service, text and kind of something that the user should know.
    """

    clock: FrameClock
    epoch: int
    router: Router
    loop: EventLoop
    watchdog: Watchdog
    assets: AssetExchange
    feed: Callable[[ev.Event], None]
    perform: Callable[[], None]
    note: Callable[[str, str, str], None]
    known: dict[bytes, Connection] = field(default_factory=dict)
    """Routing id to whose it is."""
    routes: dict[str, bytes] = field(default_factory=dict)
    """Service to the routing id of its ordered connection."""

    def __post_init__(self) -> None:
        self._guard = self.router.guard
        self._throttle = NoticeThrottle()
        self._host = host_identity()
        # Whose HELLO the clock looks at.
        self._replying = b""
        self._guard.start(self.loop, self._cut_off, self._gone, self._refused)

    # --- what comes ----------------------------------------------------------------------------------

    def from_stranger(self, route: bytes, message: m.Message) -> None:
        """A message on a connection that has not said who it is."""
        if not isinstance(message, m.Hello | m.Attach):
            kind = message_type(message)
            text = f"{kind} came before HELLO or ATTACH"
            self.reply(route, m.Error(code="unknown-peer", of=kind, message=text))
            self._refused("strangers", f"{self._stranger(route)}: {text}; not used")
        elif not is_assigned(route):
            # It could be one that another connection has just had, and what is known of it would be of both.
            text = f"{message_type(message)} of {message.name!r}: its socket has a routing id of its own; "
            text += "leave ZMQ_ROUTING_ID unset: who it is, it says with HELLO and ATTACH"
            self.reply(route, m.Refuse(code="declaration", message=text))
            self._refused("routing id", f"{self._stranger(route)} was refused: {text}")
        elif isinstance(message, m.Hello):
            self._hello(route, message)
        else:
            self._attach(route, message)

    def from_pulse(self, route: bytes, service: str, message: m.Message) -> None:
        """A message on the heartbeat connection of a service."""
        if isinstance(message, m.Heartbeat):
            self.reply(route, m.HeartbeatAck(sequence=message.sequence))
            self.watchdog.heard(service)
            self.feed(ev.Progressed(service, message.progress, message.phase, message.grace_ns))
        else:
            self.unexpected(route, message, "a heartbeat connection")

    def unexpected(self, route: bytes, message: m.Message, where: str) -> None:
        """A message on a known connection where it has no place."""
        kind = message_type(message)
        self.reply(route, m.Error(code="unexpected", of=kind, message=f"{kind} has no place on {where}"))
        service = self.known[route].service
        self.note_rarely(
            f"unexpected {service}", f"sent {kind}, which has no place on {where}; not used", service
        )

    def unreadable(self, route: bytes, error: ProtocolError) -> None:
        """Answer a message that is not in the protocol."""
        answer: m.Message = m.Error(code=error.code, message=str(error))
        if isinstance(error, VersionError):
            answer = m.Refuse(code=error.code, message=str(error))
        self.reply(route, answer)
        connection = self.known.get(route)
        if connection is not None:
            self.feed(ev.Violated(connection.service, f"sent what is not in the protocol: {error}"))
        else:
            self._refused("garbage", f"{self._stranger(route)} sent what is not in the protocol: {error}")

    # --- who comes -----------------------------------------------------------------------------------

    def _hello(self, route: bytes, hello: m.Hello) -> None:
        if why := self._guard.refusal(route, hello.name, hello.role, hello.outputs):
            self._unauthorized(route, f"HELLO as {hello.name!r} ({hello.role}): {why}")
            return
        before = self.clock.member(hello.name)
        attempt = before.attempt if before else 0
        self._replying = route
        # The clock decides; whether it did is seen by the attempt, which counts incarnations.
        if before is not None and before.present:
            self.watchdog.recheck(hello.name)  # one that was killed may be back before its death shows
        local = bool(hello.pid and hello.host and hello.host == self._host)
        self.clock.receive(ev.Joined(hello, local), time.monotonic_ns())
        member = self.clock.member(hello.name)
        if member is not None and member.attempt > attempt:
            # A new incarnation is in the run: nothing counts any more that comes from the one before.
            name = hello.name
            self.assets.forget(name)
            earlier = self.watchdog.forget(name)
            if earlier is not None:
                self.loop.unwatch(earlier)
            for old in [r for r, c in self.known.items() if c.service == name]:
                del self.known[old]
            self.routes[name] = route
            self.known[route] = Connection(name, heartbeat=False)
            self._guard.admit_service(route, name)
            fd = self.watchdog.welcome(name, hello.pid if local else None)
            if fd is not None:
                self.loop.watch(fd, lambda: self._died(name, fd))
        self.perform()  # WELCOME goes to an admitted service; one turned away changes nothing

    def _attach(self, route: bytes, attach: m.Attach) -> None:
        if why := self._guard.refusal(route, attach.name):
            self._unauthorized(route, f"ATTACH to {attach.name!r}: {why}")
            return
        name, member = attach.name, self.clock.member(attach.name)
        current = member is not None and member.present and name in self.routes
        if member is None or not current or (attach.epoch, attach.attempt) != (self.epoch, member.attempt):
            text = f"{name!r} is not in the run as attempt {attach.attempt} of epoch {attach.epoch}"
            self.reply(route, m.Error(code="unknown-peer", of="ATTACH", message=text))
            self._refused("strangers", f"ATTACH of {self._stranger(route)} was refused: {text}")
            return
        earlier = self.watchdog.attach(name, route)
        if earlier is not None:
            self.known.pop(earlier, None)
        self.known[route] = Connection(name, heartbeat=True)
        self._guard.admit_service(route, name, pulse=True)
        self.reply(route, m.HeartbeatAck(sequence=0))

    def _unauthorized(self, route: bytes, text: str) -> None:
        self.reply(route, m.Refuse(code="unauthorized", message=text))
        self._refused("unauthorized", f"{self._stranger(route)} was refused: {text}")

    def turn_away(self, action: ev.TurnAway) -> None:
        """The clock does not take whose HELLO it looks at."""
        self.reply(self._replying, action.refusal)
        text = f"HELLO of {self._stranger(self._replying)} was refused: {action.refusal.message}"
        self._tell(f"refused {action.refusal.code}", text, action.name, "refused")

    # --- who goes ------------------------------------------------------------------------------------

    def _died(self, service: str, fd: int) -> None:
        self.loop.unwatch(fd)
        self.watchdog.died(service)

    def _cut_off(self, route: bytes, why: str) -> bool:
        """A peer took more than its share, or may not take part any more: whether it was a service."""
        connection = self.known.pop(route, None)
        if connection is None:
            return False
        for other in [r for r, c in self.known.items() if c.service == connection.service]:
            self._guard.cut(other, why)
        self.feed(ev.Lost(connection.service, f"it was cut off: {why}"))
        return True

    def _gone(self, route: bytes) -> None:
        """A connection has ended: a remote service is lost; of a local one the operating system tells."""
        connection = self.known.get(route)
        if connection is None:
            return
        service = connection.service
        if connection.heartbeat:
            self.watchdog.recheck(service)
        elif not self.watchdog.cut_off(service):
            self.feed(ev.Lost(service, f"it is unreachable or stopped: {self._guard.gone_words}"))

    # --- what is said --------------------------------------------------------------------------------

    def reply(self, route: bytes, message: m.Message, *parts: bytes) -> None:
        """Answer a routing id; a peer that is gone meanwhile needs no answer."""
        reason = self.router.send(route, encode_message(message), parts, not isinstance(message, COMPLAINTS))
        if reason:
            connection = self.known.get(route)
            service = connection.service if connection else ""
            self.note_rarely(
                f"reply {service}", f"{message_type(message)} was not delivered: {reason}", service
            )

    def note_rarely(self, kind: str, text: str, service: str = "") -> None:
        """Note something that may come often: the same kind is noted once in a while."""
        self._tell(kind, text, service, "note")

    def _refused(self, kind: str, text: str) -> None:
        """Show on the console that a stranger's connection was refused: each kind once in a while."""
        self._tell(kind, text, "", "refused")

    def _stranger(self, route: bytes) -> str:
        """Name of a connection that is no service's, for messages."""
        origin = self._guard.origin(route)
        return f"a connection from {origin}" if origin else "a connection"

    def _tell(self, kind: str, text: str, service: str, notice: str) -> None:
        text = self._throttle.tell(kind, text, time.monotonic_ns())
        if text:
            self.note(service, text, notice)
