"""Limits of what one peer may use of the broker: one that takes more is named and cut off.

Bounded are the memory that messages of a peer take while they wait, the size of a message, the rate of
messages that were not asked for, and what an unauthenticated connection, which has not said HELLO, may send.
`PeerGuard` also answers the handshakes (ZAP) by `access`.
"""

from __future__ import annotations

import resource
import time
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import zmq

from caviar_broker.event_loop import EventLoop
from caviar_broker.security.access import BAR_NS, Access, answer, is_local
from caviar_broker.security.tcp import TcpConnection, TcpConnections, plain
from caviar_protocol.fields import MAX_BODY
from caviar_protocol.scenario import Limits

PERIOD_NS = 10_000_000_000
"""[ns] between two notices of one kind."""


class NoticeThrottle:
    """Counts repetitions: the first of a kind passes at once, later ones together, every `PERIOD_NS`.

    What a peer sends must never decide how much the broker writes; what is held back is counted.

    Example:
        >>> throttle = NoticeThrottle()
        >>> [throttle.tell("key", "refused", s * 10**9) for s in (0, 1, 2, 10)]
        ['refused', '', '', 'refused (and 2 more of this kind)']
    """

    def __init__(self) -> None:
        self._told: dict[str, tuple[int, int]] = {}

    def tell(self, kind: str, text: str, now: int) -> str:
        """The text to tell now, with the number of those held back; empty: hold it back.

        Args:
            kind: What is counted together.
            text: Of the notice.
            now: The time [ns].
        """
        last, held = self._told.get(kind, (None, 0))
        if last is not None and now - last < PERIOD_NS:
            self._told[kind] = (last, held + 1)
            return ""
        self._told[kind] = (now, 0)
        return f"{text} (and {held} more of this kind)" if held else text


ZAP = "inproc://zeromq.zap.01"
SCAN_NS = 100_000_000
"""[ns] between two looks at how much waits in the connections."""
SCANNED = 128
"""Connections looked at in one scan, or answered for at once."""
KEPT_NS = 5_000_000_000
"""[ns] for which a peer is remembered whose connection has ended: messages of it may still come."""
LAST_WORDS_NS = 200_000_000
"""[ns] for which a connection that ended is not missed: its last messages, and BYE, may wait to be read."""
FRAMING = 48
"""[B] that ZMTP and CURVE may add to a part."""
CHATTER = 1024
"""[B/s] that ZMTP may send by itself: its heartbeats."""


@dataclass(frozen=True, kw_only=True)
class PeerLimits:
    """Limits of a peer: of its memory, messages and connections.

    A peer is any process that connects, also one that is no service of the run (`core.run.Member` is one
    is). The defaults are far more than a service needs, unless a scenario's ``[limits]`` differ;
    ``waiting_mib`` there is the memory limit `queued`.
    """

    connections: int = 4096
    """Open connections in all; at most half the descriptors that this process may have."""
    strangers: int = 256
    """Open connections of one address on which no HELLO or ATTACH was accepted yet."""
    stranger_messages: int = 16
    """Messages of such a connection."""
    stranger_bytes: int = 4 << 20
    """[B] that wait of such a connection, and of a heartbeat connection."""
    burst: float = 4000.0
    """Messages that a service may send at once, beyond one for each that it was sent."""
    rate: float = 500.0
    """[1/s] messages that a service may send on and on, beyond one for each that it was sent."""
    queued: int = (1 << 30) + (64 << 20)
    """[B] that wait of a service, or for it: the largest product and something."""
    part: int = MAX_BODY
    """[B] of one part of a message."""
    observer_ns: int = 10_000_000_000
    """[ns] that an observer may take to acknowledge a message."""

    @classmethod
    def from_scenario(cls, limits: Limits) -> PeerLimits:
        """Convert a scenario's ``[limits]``."""
        return cls(
            connections=limits.connections,
            strangers=limits.connections_before_hello,
            stranger_messages=limits.messages_before_hello,
            stranger_bytes=limits.waiting_before_hello_mib << 20,
            burst=float(limits.messages_at_once),
            rate=limits.messages_per_s,
            queued=limits.waiting_mib << 20,
            part=limits.part_mib << 20,
            observer_ns=round(limits.observer_s * 1e9),
        )


@dataclass(eq=False, slots=True)
class _Peer:
    """A peer as the guard knows it, by its routing id."""

    route: bytes
    # The connection that had the descriptor of its first message then: its own, or a later one.
    maybe: TcpConnection | None
    address: str
    key: str
    credit: float
    # When `credit` was counted [ns].
    at: int
    # [B] that may wait.
    limit: int
    # Its connection, once that is certain.
    wire: TcpConnection | None = None
    service: str = ""
    # [B] taken from it, and an allowance for framing.
    taken: int = 0
    # [B] handed to libzmq for it.
    sent: int = 0
    cut: bool = False
    # When its connection ended [ns]; 0: it has not.
    ended: int = 0
    missed: bool = False


class PeerGuard:
    """Watches over one ROUTER socket.

    Args:
        context, socket: The socket, not bound yet.
        access: The keys; None where every process of this machine may take part.
        limits: What each peer may use.
    """

    def __init__(
        self,
        context: zmq.Context[Any],
        socket: zmq.Socket[Any],
        access: Access | None = None,
        limits: PeerLimits | None = None,
    ) -> None:
        self.access, self.limits = access, limits or PeerLimits()
        self.gone_words = "its connection is gone"
        """What is said of a peer that has none. libzmq ends one over too large a part without saying so."""
        if self.limits.part < MAX_BODY:
            most = f"{self.limits.part >> 20} MiB"
            self.gone_words += f"; a part of more than {most}, part_mib in [limits], ends it too"
        files = resource.getrlimit(resource.RLIMIT_NOFILE)[0]
        self._connections = min(self.limits.connections, max(16, files // 2))
        self._wires = TcpConnections(context, socket)
        self._peers: dict[bytes, _Peer] = {}
        self._by_wire: dict[TcpConnection, _Peer] = {}
        # Address to the instant until which it is barred [ns].
        self._barred: dict[str, int] = {}
        self._scan_at = self._scan_from = 0
        self._lost: Callable[[bytes, str], bool] = lambda route, why: False
        self._gone: Callable[[bytes], None] = lambda route: None
        self._tell: Callable[[str, str], None] = lambda kind, text: None
        # Asked also where there are no keys: libzmq then takes no peer older than ZMTP 3, where any bytes
        # would do.
        self._zap = context.socket(zmq.REP)
        self._zap.linger = 0
        self._zap.bind(ZAP)
        socket.zap_domain = b"caviar"
        if access is not None:
            socket.curve_server = True
            socket.curve_secretkey = access.pair.secret.encode()

    def start(
        self,
        loop: EventLoop,
        lost: Callable[[bytes, str], bool],
        gone: Callable[[bytes], None],
        tell: Callable[[str, str], None],
    ) -> None:
        """Begin to watch.

        Args:
            loop: The broker's.
            lost: Called with routing id and reason of a peer that is cut off; whether that was a service.
            gone: Called with the routing id of a service whose connection has ended.
            tell: Called with kind and text of what others than services did.
        """
        self._lost, self._gone, self._tell = lost, gone, tell
        loop.watch(self._wires.monitor, self._connections_changed)
        loop.watch(self._zap, self._authenticate)

    def close(self) -> None:
        """Stop watching."""
        self._wires.close()
        self._zap.close()

    # --- messages ------------------------------------------------------------------------------------

    def admits(self, route: bytes, parts: Sequence[zmq.Frame], size: int) -> bool:
        """Decide whether a message is to be handled; else it is dropped.

        Args:
            route: Routing id of the sender.
            parts: The message.
            size: Size of all its parts [B].
        """
        # The frame path, once for each message: a dictionary, two additions, a comparison. What needs the
        # clock or the system is done when credit is used up, or in `check`.
        peer = self._peers.get(route)
        if peer is None:
            peer = self._meet(route, parts[0])
        elif peer.wire is None:
            self._claim(peer)
        peer.taken += size + FRAMING * len(parts)
        peer.credit -= 1.0
        return peer.credit >= 0.0 or self._has_more(peer)

    def sent(self, route: bytes, size: int, earns: bool) -> None:
        """Count a message that was handed to libzmq.

        Args:
            route: Routing id of the receiver.
            size: Size of the message [B].
            earns: Whether the receiver may answer it, which gives it credit for a message.
        """
        peer = self._peers.get(route)
        if peer is not None:
            peer.sent += size
            peer.credit += earns and peer.credit < self.limits.burst

    def admit_service(self, route: bytes, service: str, *, pulse: bool = False) -> None:
        """Give the connection of an accepted service its limits.

        Args:
            route: Routing id of the connection.
            service: Name of the service.
            pulse: Whether it is the heartbeat connection, over which no products come.
        """
        peer = self._peers.get(route)
        if peer is not None:
            peer.service, peer.credit, peer.at = service, self.limits.burst, time.monotonic_ns()
            peer.limit = self.limits.stranger_bytes if pulse else self.limits.queued

    def refusal(self, route: bytes, name: str, role: str = "", outputs: Sequence[str] = ()) -> str:
        """Say why the key of a connection may not appear as that service; empty where it may.

        Args:
            route: Routing id of the connection.
            name: Of the service.
            role: Of the service; empty: not asked about.
            outputs: Topics that it declares.
        """
        if self.access is None:
            return ""
        peer = self._peers.get(route)
        if peer is None:
            return "its connection is not known any more"
        return self.access.refusal(peer.key, name, role, outputs)

    def origin(self, route: bytes) -> str:
        """Say where a peer connects from: an address, or at a socket file a process; empty where its routing
        id is not remembered."""
        peer = self._peers.get(route)
        return self._origin(peer) if peer is not None else ""

    def is_open(self, route: bytes) -> bool:
        """Return whether the connection of a peer still stands, as far as is known."""
        peer = self._peers.get(route)
        return peer is not None and not peer.ended and not peer.cut

    def cut(self, route: bytes, why: str, *, bar: bool = True) -> None:
        """End the connection of a peer, and ``bar`` it for a while."""
        peer = self._peers.get(route)
        if peer is not None and not peer.cut:
            self._cut(peer, why, bar=bar)

    def _origin(self, peer: _Peer) -> str:
        wire = peer.wire or peer.maybe
        # The address that libzmq has of a peer at a socket file is made of numbers: localhost:0:0:4711.
        return wire.process if wire is not None and wire.process else peer.address

    def _meet(self, route: bytes, part: zmq.Frame) -> _Peer:
        """Remember a routing id at its first message."""
        # What began or ended since the last look comes first: the descriptor may be a new connection's.
        self._connections_changed()
        fd, address = int(_property(part, "__fd") or -1), plain(_property(part, "Peer-Address"))
        key = _property(part, "User-Id") if self.access is not None else ""
        messages, waiting = self.limits.stranger_messages, self.limits.stranger_bytes
        wire, now = self._wires.at(fd), time.monotonic_ns()
        peer = self._peers[route] = _Peer(route, wire, address, key, messages, now, waiting)
        if wire is None and fd >= 0:
            peer.ended = now  # these are its last words
        self._claim(peer)
        return peer

    def _claim(self, peer: _Peer) -> None:
        """Make certain which connection a peer's messages come through, if that can be."""
        wire = peer.maybe
        if wire is not None and not peer.ended and self._wires.claim(wire, peer.address):
            peer.wire, self._by_wire[wire] = wire, peer
            if peer.cut:
                wire.end()

    def _unsure(self) -> list[tuple[_Peer, TcpConnection]]:
        """Peers whose connection is not certain yet, each with the one that it may be."""
        peers = [peer for peer in self._peers.values() if peer.wire is None and not peer.ended]
        return [(peer, peer.maybe) for peer in peers if peer.maybe is not None]

    def _uncertain(self) -> dict[TcpConnection, _Peer]:
        """Connections of which it is not certain whose they are: each with the one of these that may use
        most."""
        found: dict[TcpConnection, _Peer] = {}
        for peer, wire in self._unsure():
            other = found.get(wire)
            if not peer.cut and (other is None or peer.taken + peer.limit > other.taken + other.limit):
                found[wire] = peer
        return found

    def _has_more(self, peer: _Peer) -> bool:
        """Return whether time has brought a peer new credit; otherwise it is cut off."""
        if peer.cut:
            return False
        if not peer.service:
            self._cut(peer, f"it sent more than {self.limits.stranger_messages} messages without HELLO")
            return False
        now = time.monotonic_ns()
        peer.credit = min(self.limits.burst, peer.credit + (now - peer.at) / 1e9 * self.limits.rate)
        peer.at = now
        if peer.credit < 0.0:
            self._cut(
                peer,
                f"it sends messages faster than {self.limits.rate:g} a second beyond those that answer one",
            )
        return peer.credit >= 0.0

    # --- connections -----------------------------------------------------------------------------------

    def check(self, now: int) -> None:
        """Look at what waits in the connections, and at whose keys were revoked."""
        if now < self._scan_at:
            return
        self._scan_at = now + SCAN_NS
        # Two calls of `stat` ten times a second: a revoked key is out without an order to the broker.
        if self.access is not None and (trouble := self.access.reload()) is not None:
            if trouble:
                self._tell("authorized", trouble)
            self._revoke()
        for peer, wire in self._unsure():
            if not wire.open or wire.claimed:
                peer.ended = now
        uncertain = self._uncertain()
        wires = list(self._wires)
        # A part of the connections at each look: TCP_INFO of thousands at once would hold up a frame.
        first = self._scan_from = self._scan_from if self._scan_from < len(wires) else 0
        self._scan_from += SCANNED
        for wire in wires[first : first + SCANNED]:
            self._measure(wire, uncertain.get(wire), now)
        self._barred = {address: until for address, until in self._barred.items() if until > now}
        self._miss([peer for peer in self._peers.values() if peer.ended], now)

    def _miss(self, ended: Sequence[_Peer], now: int) -> None:
        for peer in ended:
            if peer.service and not peer.cut and not peer.missed and now - peer.ended > LAST_WORDS_NS:
                peer.missed = True
                self._gone(peer.route)
            if now - peer.ended > KEPT_NS:
                self._peers.pop(peer.route, None)

    def _measure(self, wire: TcpConnection, maybe: _Peer | None, now: int) -> None:
        """Cut off a peer that has more waiting than it may; ``maybe``: whose connection it may be."""
        counted = wire.transferred()
        if counted is None:
            return  # a socket file, which only this user's processes can connect to: nothing counts its bytes
        acknowledged, received = counted
        peer = self._by_wire.get(wire)
        chatter = CHATTER * (1 + (now - wire.since) // 10**9)
        whose = peer or maybe
        taken, limit = (whose.taken, whose.limit) if whose else (0, self.limits.stranger_bytes)
        waiting = received - taken - chatter
        if waiting > limit:
            self._end(
                wire, peer, f"{waiting >> 20} MiB of it wait for being a message, more than it may send"
            )
        elif peer is not None and peer.sent - acknowledged > limit:
            unread = (peer.sent - acknowledged) >> 20
            self._end(wire, peer, f"it reads too slowly: {unread} MiB wait for it")

    def _revoke(self) -> None:
        for peer in list(self._peers.values()):
            if self.access is None or peer.cut or peer.ended:
                continue
            why = (
                self.access.refusal(peer.key, peer.service) if peer.service else self.access.admits(peer.key)
            )
            if why:
                self._cut(peer, f"it is not authorized any more: {why}", bar=False)

    def _connections_changed(self) -> None:
        fresh, failures = self._wires.update()
        now = time.monotonic_ns()
        for wire in [wire for wire in self._by_wire if not wire.open]:
            self._by_wire.pop(wire).ended = now
        spoke = {peer.maybe for peer in self._peers.values()} if failures else ()
        what = "no authorized key" if self.access else "no ZMTP 3"
        for wire in failures:
            # A service that ends before its first message is missed by whoever started it, and by the clock.
            if wire in spoke or wire.is_sibling:
                continue
            text = f"a connection from {wire.origin} ended before it sent a message, like one that has {what}"
            self._tell(f"handshake {wire.origin}", text)
        for wire in fresh:
            if self._barred.get(wire.address, 0) > now:
                wire.end()
        if fresh:
            self._make_room({wire.address for wire in fresh})

    def _make_room(self, addresses: set[str]) -> None:
        """End the oldest of those connections that have not said who they are, where there are too many:
        an honest one says so at once."""
        uncertain = {wire for wire, peer in self._uncertain().items() if peer.service}
        idle = [wire for wire in self._wires if wire not in uncertain and not self._is_service(wire)]
        beyond = set[TcpConnection]()
        for address in addresses:
            here = [wire for wire in idle if wire.address == address]
            beyond.update(here[: max(0, len(here) - self.limits.strangers)])
        beyond.update(idle[: max(0, len(self._wires) - self._connections)])
        for wire in beyond:
            wire.end()
        for address, count in Counter(wire.address for wire in beyond).items():
            whose = f" from {address}" if address else ""
            text = f"{count} connections{whose} that never said HELLO were ended: there were too many"
            self._tell(f"connections {address}", text)

    def _is_service(self, wire: TcpConnection) -> bool:
        peer = self._by_wire.get(wire)
        return peer is not None and bool(peer.service)

    # --- consequences ------------------------------------------------------------------------------------

    def _end(self, wire: TcpConnection, peer: _Peer | None, why: str) -> None:
        if peer is not None:
            if not peer.cut:
                self._cut(peer, why)
            return
        wire.end()
        self._bar(wire.address)
        self._tell(f"cut {wire.origin}", f"a connection from {wire.origin} was cut off: {why}")

    def _cut(self, peer: _Peer, why: str, *, bar: bool = True) -> None:
        peer.cut, peer.credit = True, float("-inf")
        if peer.wire is not None:
            peer.wire.end()
        if bar and self.access is not None:
            self.access.bar(peer.key, peer.service)
        elif bar:
            self._bar(peer.address)
        if not self._lost(peer.route, why):
            name = self.access.name(peer.key) if self.access is not None else ""
            who = f"a connection of {name!r}" if name else "a connection"
            who += f" from {origin}" if (origin := self._origin(peer)) else ""
            self._tell(f"cut {origin}", f"{who} was cut off: {why}")

    def _bar(self, address: str) -> None:
        """Bar an address, unless services in good standing are at home there, which may have to come back."""
        shared = any(p.service and not p.cut and p.address == address for p in self._peers.values())
        if address and not shared and not is_local(f"tcp://[{address}]:0"):
            self._barred[address] = time.monotonic_ns() + BAR_NS

    def _authenticate(self) -> None:
        """Answer libzmq, which asks about each new connection, so that many that come at once wait for one
        look at this socket."""
        for _ in range(SCANNED):
            try:
                request = self._zap.recv_multipart(zmq.NOBLOCK)
            except zmq.Again:
                return
            reply, why = answer(self.access, request)
            self._zap.send_multipart(reply, zmq.NOBLOCK)
            if why:
                address = request[3].decode(errors="replace") if len(request) > 3 else ""
                whose = f" from {address}" if address else ""
                self._tell(f"key {address}", f"a connection{whose} was refused: {why}")


def _property(part: zmq.Frame, name: str) -> str:
    try:
        return str(part.get(name))
    except zmq.ZMQError:
        return ""
