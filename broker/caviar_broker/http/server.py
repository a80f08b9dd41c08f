"""The socket and the server behind every HTTP address of this package."""

from __future__ import annotations

import asyncio
import gc
import socket
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, ClassVar

import uvicorn
from uvicorn.protocols.http.h11_impl import H11Protocol
from uvicorn.protocols.websockets.websockets_sansio_impl import WebSocketsSansIOProtocol

from caviar_protocol.codec.messages import MAX_FRAME
from caviar_protocol.errors import RunError
from caviar_protocol.host import steady_memory, trim_memory

ADMIT = "admit"
"""Key of a WebSocket's ASGI state: what to call once the broker has accepted the peer."""
MAX_STRANGERS = 256
"""Connections that have not yet shown what they are: the oldest of the address with most makes room."""
REQUEST_S = 10.0
"""[s] from the beginning of a connection, or the last answer, to the end of the next answer."""
HELLO_S = 60.0
"""[s] from the beginning of a WebSocket until its HELLO is accepted."""
HELLO_BYTES = 1 << 16
"""[B] of a WebSocket until its HELLO is accepted; one with 256 inputs and outputs has less than half."""
LOOK_S = 0.5
"""[s] between looks at whose time is over."""
TOO_LARGE = 1009


@dataclass(slots=True)
class _Stranger:
    address: str
    # When its time is over, on the clock of the event loop [s].
    until: float


@dataclass
class Strangers:
    """The strangers of one server, oldest first.

    Args:
        tell: Called, once in `LOOK_S` at most, with a text about connections that had to make room.
        own_process: Whether the memory of connections that have ended goes back to the system, which takes a
            look at all objects of the process.
    """

    tell: Callable[[str], None]
    own_process: bool = False
    _known: dict[asyncio.Transport, _Stranger] = field(default_factory=dict)
    _turned_out: Counter[str] = field(default_factory=Counter)
    # Whether connections have ended since the last look.
    _freed: bool = False
    # Whether another look is due.
    _looks: bool = False

    def add(self, transport: asyncio.Transport) -> None:
        """Count a new connection; the oldest one of the address that has most makes room.

        An honest peer says at once what it wants, so the oldest of many is the least likely to be one.

        Args:
            transport: The connection.
        """
        name = transport.get_extra_info("peername")
        self._known[transport] = _Stranger(str(name[0]) if name else "", _now() + REQUEST_S)
        if len(self._known) > MAX_STRANGERS:
            (address, _), *_ = Counter(stranger.address for stranger in self._known.values()).most_common(1)
            oldest = next(other for other, found in self._known.items() if found.address == address)
            self._turned_out[address] += 1
            self._end(oldest)
        self._look_soon()

    def grant(self, transport: asyncio.Transport, seconds: float) -> None:
        """Give a stranger so much time from now [s]."""
        if transport in self._known:
            self._known[transport].until = _now() + seconds

    def remove(self, transport: asyncio.Transport) -> None:
        """Forget a connection that has ended, or is no stranger's any more."""
        self._known.pop(transport, None)
        self._freed = True
        self._look_soon()

    def _end(self, transport: asyncio.Transport) -> None:
        self.remove(transport)
        transport.abort()

    def _look_soon(self) -> None:
        if not self._looks:
            self._looks = True
            asyncio.get_running_loop().call_later(LOOK_S, self._look)

    def _look(self) -> None:
        """End the connections whose time is over, and give memory back that others left."""
        now = _now()
        for transport in [found for found, stranger in self._known.items() if stranger.until < now]:
            self._end(transport)
        for address, count in self._turned_out.items():
            self.tell(
                f"{count} connections from {address} that never said who they are were ended: "
                f"there were more than {MAX_STRANGERS}"
            )
        self._turned_out.clear()
        if self._freed and self.own_process:
            gc.collect()  # the parsers of a connection are cycles, with all that it sent
            trim_memory()
        self._looks = self._freed = False
        if self._known:
            self._look_soon()

    def protocols(self) -> tuple[type[asyncio.Protocol], type[asyncio.Protocol]]:
        """Make protocols of uvicorn, HTTP and WebSocket, whose connections are strangers here."""
        # Classes, since uvicorn makes a protocol for each connection itself, and passes nothing of ours on.
        here = {"strangers": self}
        return type("Http", (_Http,), here), type("WebSockets", (_WebSocket,), here)


def _now() -> float:
    return time.monotonic()


class _Http(H11Protocol):
    """HTTP with a limit on the time of a request and its answer."""

    strangers: ClassVar[Strangers]

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        super().connection_made(transport)
        self.strangers.add(transport)

    def connection_lost(self, exc: Exception | None) -> None:
        self.strangers.remove(self.transport)
        super().connection_lost(exc)

    def on_response_complete(self) -> None:
        self.strangers.grant(self.transport, REQUEST_S)
        super().on_response_complete()


class _WebSocket(WebSocketsSansIOProtocol):
    """A WebSocket with limits on time and bytes until `admit` is called."""

    strangers: ClassVar[Strangers]

    def __init__(self, *arguments: Any, **options: Any) -> None:
        super().__init__(*arguments, **options)
        # [B] that may come yet; None: any number.
        self._room: int | None = HELLO_BYTES

    def connection_made(self, transport: Any) -> None:
        super().connection_made(transport)
        self.strangers.grant(transport, HELLO_S)

    def connection_lost(self, exc: Exception | None) -> None:
        self.strangers.remove(self.transport)
        super().connection_lost(exc)

    def handle_connect(self, event: Any) -> None:
        super().handle_connect(event)
        if not self.close_sent:
            self.scope["state"][ADMIT] = self._admit

    def data_received(self, data: bytes) -> None:
        if self._room is not None:
            self._room -= len(data)
            if self._room < 0:
                self._refuse()
                return
        super().data_received(data)

    def _admit(self) -> None:
        self._room = None
        self.strangers.remove(self.transport)

    def _refuse(self) -> None:
        if self.transport.is_closing():
            return
        reason = f"more than {HELLO_BYTES} B before its HELLO was accepted"
        self.queue.put_nowait({"type": "websocket.disconnect", "code": TOO_LARGE, "reason": reason})
        if self.handshake_complete and not self.close_sent:
            self.conn.fail(TOO_LARGE, reason)
            self.transport.write(b"".join(self.conn.data_to_send()))
        self.close_sent = True
        self.transport.close()


UNREACHABLE_MS = 8000
"""[ms] for which a peer's machine may acknowledge nothing, or have no room, until its connection is gone."""
SEND_BUFFER = 1 << 18
"""[B] that the system keeps for a peer at most, so that one that does not read is noticed soon."""
BACKLOG = 128
"""Connections that are accepted at once, before any of them is looked at."""


def http_server(app: Any, tell: Callable[[str], None], *, own_process: bool = False) -> uvicorn.Server:
    """A server of an ASGI application, WebSockets included, that has not begun to serve.

    Args:
        app: The application; ``scope["state"]["admit"]`` of a WebSocket is to be called once its peer is
            accepted.
        tell: Called with a text about connections that were ended because there were too many.
        own_process: Whether the process is this server's own, so that its memory may be tuned for it.
    """
    if own_process:
        steady_memory()
        gc.collect()
        gc.freeze()  # what is loaded stays, and need not be looked at whenever a connection has ended
    http, websockets = Strangers(tell, own_process).protocols()
    config = uvicorn.Config(
        app,
        loop="asyncio",
        http=http,
        ws=websockets,
        ws_max_size=MAX_FRAME,
        ws_ping_interval=None,  # a busy peer answers no pings, and is not gone
        ws_per_message_deflate=False,
        lifespan="off",
        log_level="warning",
        access_log=False,
        server_header=False,
        backlog=BACKLOG,
        timeout_graceful_shutdown=1,
    )
    return uvicorn.Server(config)


def listening_socket(host: str, port: int) -> socket.socket:
    """Make a listening socket; what is accepted from it has its options.

    Args:
        host: Address or name of this machine.
        port: Port; 0: any free one.

    Raises:
        RunError: The address is taken, or not this machine's.
    """
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    found = socket.socket(family, socket.SOCK_STREAM)
    found.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    # The peer's kernel answers for a peer that is busy or stopped, so this tells only of what is unreachable.
    found.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, SEND_BUFFER)
    found.setsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, UNREACHABLE_MS)
    found.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
    found.setsockopt(socket.IPPROTO_TCP, socket.TCP_KEEPIDLE, 1)
    found.setsockopt(socket.IPPROTO_TCP, socket.TCP_KEEPINTVL, 1)
    found.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    try:
        found.bind((host, port))
        found.listen(BACKLOG)
    except OSError as error:
        found.close()
        raise RunError(
            f"cannot serve HTTP at {host}:{port}: {error.strerror}; choose another --http HOST:PORT (0: any)"
        ) from error
    return found


def place_of(host: str, listening: socket.socket) -> str:
    """``HOST:PORT`` of a listening socket, as it stands in a URL.

    Args:
        host: As it was given to `listening_socket`.
        listening: The socket.
    """
    shown = f"[{host}]" if ":" in host else host
    return f"{shown}:{listening.getsockname()[1]}"
