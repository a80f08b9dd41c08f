"""The gateway in front of a ROUTER that is no broker's, such as that of the conformance kit."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from starlette.applications import Starlette
from starlette.routing import WebSocketRoute
from uvicorn import Server

from caviar_broker.api.gateway import Gateway
from caviar_broker.api.http_server import http_server, listening_socket
from caviar_broker.api.tokens import Tokens, http_address


@contextmanager
def gateway_in_front(endpoint: str, address: str, tell: Callable[[str], None]) -> Iterator[str]:
    """Serve WebSockets for a ROUTER, without tokens, until the context is left; yields the URL of it.

    Parameters
    ----------
    endpoint
        Where the ROUTER listens.
    address
        ``HOST:PORT`` of this machine to serve at; port 0: any.
    tell
        Is told of each connection that is refused or cut off, from another thread.

    Raises `SetupError` for an address that is none, `RunError` where it is taken.
    """
    host, port = http_address(address, None)
    listening = listening_socket(host, port)
    shown = f"[{host}]" if ":" in host else host
    url = f"ws://{shown}:{listening.getsockname()[1]}/ws"
    servers: list[Server] = []

    async def serve() -> None:
        async def note(_service: str, text: str, _kind: str) -> None:
            tell(text)

        gateway = Gateway(endpoint, Tokens(None), note)
        servers.append(http_server(Starlette(routes=[WebSocketRoute("/ws", gateway.serve)]), tell))
        try:
            await servers[0].serve(sockets=[listening])
        finally:
            gateway.close()

    thread = threading.Thread(target=asyncio.run, args=(serve(),), name="gateway", daemon=True)
    thread.start()
    try:
        yield url
    finally:
        for server in servers:
            server.should_exit = True
        thread.join()
