"""The socket and the server behind every HTTP address of this package."""

from __future__ import annotations

import gc
import socket
from collections.abc import Callable
from typing import Any

import uvicorn

from caviar_broker.api.strangers import Strangers
from caviar_protocol.codec.messages import MAX_FRAME
from caviar_protocol.errors import RunError
from caviar_protocol.host import steady_memory

UNREACHABLE_MS = 8000
"""[ms] for which a peer's machine may acknowledge nothing, or have no room, until its connection is gone."""
SEND_BUFFER = 1 << 18
"""[B] that the system keeps for a peer at most, so that one that does not read is noticed soon."""
BACKLOG = 128
"""Connections that are accepted at once, before any of them is looked at."""


def http_server(app: Any, tell: Callable[[str], None], *, own_process: bool = False) -> uvicorn.Server:
    """A server of an ASGI application, WebSockets included, that has not begun to serve.

    Parameters
    ----------
    app
        The application; ``scope["state"]["admit"]`` of a WebSocket is to be called once its peer is accepted.
    tell
        Is told of connections that were ended because there were too many.
    own_process
        Whether the process is this server's own, so that its memory may be tuned for it.
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
    """A listening socket; what is accepted from it has its options."""
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
