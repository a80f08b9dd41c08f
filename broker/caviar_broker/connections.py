"""Connections of a run: whose each one is, and the answer to those who have no place in it.

`Router` is the one ROUTER port of a broker: parts in, parts out, and never a wait of more than a millisecond.
"""

from __future__ import annotations

import secrets
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import zmq
from zmq.backend import zmq_poll

from caviar_broker.assets import AssetExchange
from caviar_broker.core import events as ev
from caviar_broker.core.clock import FrameClock
from caviar_broker.event_loop import EventLoop
from caviar_broker.observers import Observers
from caviar_broker.security.access import Access, check_bind
from caviar_broker.security.limits import FRAMING, NoticeThrottle, PeerGuard, PeerLimits
from caviar_broker.supervision import Watchdog
from caviar_protocol import messages as m
from caviar_protocol.codec import encode_message, message_type
from caviar_protocol.errors import ProtocolError, RunError, VersionError
from caviar_protocol.fields import MAX_PARTS
from caviar_protocol.host import host_identity

# Plain integers: pyzmq's flags are enumerations, and combining those costs more than a small send.
_NOBLOCK = int(zmq.NOBLOCK)
_POLLIN = int(zmq.POLLIN)
_NOBLOCK_MORE = int(zmq.NOBLOCK) | int(zmq.SNDMORE)

WAIT_MS = 1
"""[ms] for which `Router.receive` waits, if it does."""
LINGER_MS = 500
"""[ms] that closing waits until the last messages are on their way."""
HANDSHAKE_MS = 5000
"""[ms] after which a connection is closed that has not shaken hands."""


PORT_RANGE = Path("/proc/sys/net/ipv4/ip_local_port_range")
"""Where Linux says which ports it gives to outgoing connections."""
TRIES = 50
"""Ports that are tried before the operating system is left to choose one."""


def free_endpoints(endpoint: str) -> Iterator[str]:
    """Addresses to try in turn for one that asks for any free port (port 0); any other address as it is.

    They lie outside the range of ports for outgoing connections: a broker that is started again has to listen
    where its services know it, and must not find that port taken by a connection that a program opened in
    between. The last address leaves the choice to the operating system.
    """
    if endpoint.endswith(":0"):
        try:
            first, last = map(int, PORT_RANGE.read_text().split())
        except (OSError, ValueError):
            first, last = 32768, 60999  # Linux by default
        ports = [port for port in range(10_000, 65_536) if not first <= port <= last]
        for _ in range(TRIES if ports else 0):
            yield f"{endpoint[:-1]}{secrets.choice(ports)}"
    yield endpoint


def is_assigned(route: bytes) -> bool:
    """Return whether a routing id is ROUTER's choice, and not the peer's: a zero byte and four others.

    libzmq counts these from a random number, so a peer does not hit upon another's.
    """
    return len(route) == 5 and route[0] == 0


class Router:
    """A bound ROUTER socket.

    Args:
        endpoint: Address to bind, ``tcp://127.0.0.1:0`` for any free port.
        liveness_ns: A peer that is stopped or unreachable loses its connection before this is over, and the
            next `send` to it says so. libzmq's own thread answers for a peer that is merely busy, so a slow
            service is never taken for a dead one (contract, clause 15).
        access: The keys of those who may connect; None: none are asked for, and only this machine can
            connect.
        peer_limits: What each peer may use.

    Raises:
        RunError: The address cannot be bound, or may not without keys.
    """

    def __init__(
        self,
        endpoint: str,
        liveness_ns: int,
        access: Access | None = None,
        peer_limits: PeerLimits | None = None,
    ) -> None:
        check_bind(endpoint, keys=access is not None)
        self._context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
        self.socket = self._context.socket(zmq.ROUTER)
        liveness_ms = liveness_ns // 1_000_000
        # Without it a message to a peer that is gone would be dropped in silence.
        self.socket.setsockopt(zmq.ROUTER_MANDATORY, 1)
        # A third and a half: a peer that answers none of the probes is cut off within the liveness time.
        self.socket.setsockopt(zmq.HEARTBEAT_IVL, max(1, liveness_ms // 3))
        self.socket.setsockopt(zmq.HEARTBEAT_TIMEOUT, max(1, liveness_ms // 2))
        # What waits of a peer is bounded by the guard. A queue that is full would have libzmq 4.3.5 abort
        # when the peer goes: its heartbeats then write to a connection that has ended (libzmq issue 4841).
        self.socket.setsockopt(zmq.RCVHWM, 0)
        self.socket.setsockopt(zmq.HANDSHAKE_IVL, HANDSHAKE_MS)
        self.socket.setsockopt(zmq.IPV6, int("[" in endpoint))
        self.socket.linger = LINGER_MS
        self.socket.rcvtimeo = WAIT_MS
        # A level below a wrapper in Python, which only sees to options that no ROUTER has.
        self._send = super(zmq.Socket, self.socket).send
        self._polled = [(self.socket, _POLLIN)]
        self.guard = PeerGuard(self._context, self.socket, access, peer_limits)
        """Watches over the peers."""
        self.socket.setsockopt(zmq.MAXMSGSIZE, self.guard.limits.part + FRAMING)
        self._bind(endpoint)
        self.endpoint = self.socket.getsockopt_string(zmq.LAST_ENDPOINT)
        """Where services connect to."""
        try:
            check_bind(self.endpoint, keys=access is not None)  # what a name has come to
        except RunError:
            self.close()
            raise

    def _bind(self, endpoint: str) -> None:
        for candidate in free_endpoints(endpoint):
            try:
                self.socket.bind(candidate)
            except zmq.ZMQError as error:
                if error.errno == zmq.EADDRINUSE and candidate != endpoint:
                    continue
                self.close()
                remedy = "end what uses that port, or choose" if error.errno == zmq.EADDRINUSE else "choose"
                raise RunError(
                    f"cannot listen on {candidate}: {zmq.strerror(error.errno or 0)}; {remedy} another "
                    "with --bind tcp://127.0.0.1:PORT (0: any free one)"
                ) from error
            return

    @property
    def readable(self) -> bool:
        """True if a message is here; cheaper than `receive` where there is none."""
        # 2.8 µs. Asking for EVENTS takes 4.4 µs, since pyzmq makes an enumeration of each option's number; an
        # exception of `receive` takes 7.6 µs.
        return bool(zmq_poll(self._polled, 0))

    def receive(self, wait: bool = False) -> tuple[bytes, list[zmq.Frame]] | None:
        """Routing id and parts of the next message; None where there is none now, or one to be dropped.

        With ``wait`` there is none if none comes within `WAIT_MS`. That is far cheaper than any way to
        wait for several sockets, or to a finer instant.

        Of a message with more parts than any may have, one part too many is returned.
        """
        receive = self.socket.recv
        try:
            route = receive(0 if wait else _NOBLOCK)
        except zmq.Again:
            return None
        parts: list[zmq.Frame] = []
        more, size = True, 0
        while more:
            # Not copied: a product of 10 MB goes to its consumers from where libzmq put it.
            part = receive(_NOBLOCK, False)
            more = part.more
            size += len(part)
            if len(parts) <= MAX_PARTS:
                parts.append(part)
        return (route, parts) if self.guard.admits(route, parts, size) else None

    def send(
        self, route: bytes, header: bytes, parts: Sequence[bytes | zmq.Frame] = (), earns: bool = True
    ) -> str:
        """Send a message to a routing id; why it did not go, or an empty text.

        One that ``earns`` gives its receiver the right to one message more.

        Parts that were received go out as they came, without a copy.

        Args:
            route: Routing id of the receiver.
            header: The encoded message.
            parts: What follows it.
            earns: Whether the receiver may answer it.

        Returns:
            Why it did not go; empty where it did.
        """
        send = self._send
        try:
            send(route, _NOBLOCK_MORE)
            self.guard.sent(route, len(header) + sum(map(len, parts)), earns)
            if not parts:
                send(header, _NOBLOCK)
                return ""
            send(header, _NOBLOCK_MORE)
            for part in parts[:-1]:
                send(part, _NOBLOCK_MORE, False)
            send(parts[-1], _NOBLOCK, False)
        except zmq.ZMQError as error:
            if error.errno == zmq.EHOSTUNREACH:
                return self.guard.gone_words
            if error.errno == zmq.EAGAIN:
                return "it takes no messages"
            raise
        return ""

    def close(self) -> None:
        """Send what is queued, as far as `LINGER_MS` allow, and close."""
        self.guard.close()
        self.socket.close()
        self._context.term()


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
        self.observers = Observers(
            clock=self.clock,
            epoch=self.epoch,
            patience_ns=self._guard.limits.observer_ns,
            send=self.router.send,
            cut=lambda route, why: self._guard.cut(route, why, bar=False),
            note=self.note_rarely,
        )
        """Peers that are no services."""
        self._guard.start(self.loop, self._cut_off, self._gone, self._refused)

    # --- what comes ----------------------------------------------------------------------------------

    def from_stranger(self, route: bytes, message: m.Message) -> None:
        """A message on a connection that has not said who it is, or is an observer's."""
        if route in self.observers.known:
            self.observers.handle(route, message)
        elif not isinstance(message, m.Hello | m.Attach):
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
        if hello.role == "observer":
            refusal = self.observers.join(route, hello, self._guard.is_open)
            if refusal is None:
                self._guard.admit_service(route, hello.name)
            else:
                self._replying = route
                self.turn_away(ev.TurnAway("", refusal))
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
            if observer := self.observers.forget(route):
                self.note("", f"observer {observer!r} was disconnected: {why}", "note")
            return bool(observer)
        for other in [r for r, c in self.known.items() if c.service == connection.service]:
            self._guard.cut(other, why)
        self.feed(ev.Lost(connection.service, f"it was cut off: {why}"))
        return True

    def _gone(self, route: bytes) -> None:
        """A connection has ended: a remote service is lost; of a local one the operating system tells."""
        connection = self.known.get(route)
        if connection is None:
            self.observers.gone(route, self._guard.gone_words)
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
