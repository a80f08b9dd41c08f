"""The one ROUTER port of a broker: parts in, parts out, and never a wait of more than a millisecond."""

from __future__ import annotations

import secrets
from collections.abc import Iterator, Sequence
from pathlib import Path

import zmq
from zmq.backend import zmq_poll

from caviar_broker.security.access import Access, check_bind
from caviar_broker.security.limits import FRAMING, PeerGuard, PeerLimits
from caviar_protocol.errors import RunError
from caviar_protocol.fields import MAX_PARTS

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
    """Whether a routing id is ROUTER's choice, and not the peer's: a zero byte and four others.

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
        """Whether a message is here; cheaper than `receive` where there is none."""
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
