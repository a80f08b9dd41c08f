"""Serving HTTP in a process of its own: started by a broker, by hand beside one, or in front of any ROUTER.

``python -m caviar_broker.http RUN --http HOST:PORT`` serves beside the broker that runs in a directory, and
ends when that broker does. Libraries of HTTP are imported by the functions that serve: the broker's own
process, which imports this module to start the other one, does without them.
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import functools
import os
import socket
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from caviar_broker.control.socket import Ask, ask_in_thread, call_at_end, connect
from caviar_broker.http.auth import Tokens, http_address
from caviar_broker.supervision import describe_exit
from caviar_protocol.errors import CaviarError, RunError, SetupError
from caviar_protocol.host import PYTHON
from caviar_protocol.keys import Credentials, Pair
from caviar_protocol.run_directory import RunDirectory

if TYPE_CHECKING:
    from caviar_broker.server import BrokerServer

END_S = 3.0
"""[s] that the process gets to end after the broker's last frame, which it sees by itself."""


class HttpProcess:
    """The process that serves HTTP for a broker; without an address, nothing.

    Args:
        directory: Of the run.
        address: ``HOST:PORT``; "" for none.
        keys: Keys directory with the tokens.
        again: Whether the run goes on: then the process of the broker before may hold the address a moment
            longer.

    Raises:
        SetupError: The address is none, taken, or open to others without tokens.
    """

    def __init__(self, directory: Path, address: str, keys: Path | None, again: bool = False) -> None:
        self._directory, self._address, self._keys = directory, address, keys
        self._process: subprocess.Popen[bytes] | None = None
        self._fd = -1
        if address:
            place = http_address(address, keys)
            if not again:
                _refuse_taken(*place)

    def start(self, server: BrokerServer) -> None:
        """Start the process; the server's loop notes when it ends."""
        # Of its own, so that no request takes time from the loop that serves frames.
        if not self._address:
            return
        command = [*PYTHON, "-m", "caviar_broker.http", str(self._directory), "--http", self._address]
        command += ["--keys", str(self._keys)] if self._keys is not None else []
        log = RunDirectory(self._directory).log("http")
        log.parent.mkdir(exist_ok=True)
        with log.open("wb") as file:
            self._process = subprocess.Popen(  # noqa: S603  # our own module with checked arguments
                command, stdin=subprocess.DEVNULL, stdout=file, stderr=file, start_new_session=True
            )
        # A descriptor that is readable when the process ends, for the loop; a signal would need a handler.
        self._fd = os.pidfd_open(self._process.pid)
        server.loop.watch(self._fd, lambda: self._ended(server))

    def _ended(self, server: BrokerServer) -> None:
        server.loop.unwatch(self._fd)
        if self._process is not None:
            lines = RunDirectory(self._directory).log("http").read_text(errors="replace").strip().splitlines()
            said = f": {lines[-1]}" if lines else ""
            server.note("", f"HTTP is not served any more, {describe_exit(self._process.wait())}{said}")

    def close(self) -> None:
        """Wait for the end of the process, and kill it after `END_S`."""
        if self._process is None:
            return
        try:
            self._process.wait(END_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        os.close(self._fd)


def _refuse_taken(host: str, port: int) -> None:
    """`SetupError` where nothing can listen: the process itself would end beside a run that goes on."""
    try:
        family, kind, number, _, place = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
        with socket.socket(family, kind, number) as trial:
            trial.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            trial.bind(place)
            trial.listen()
    except OSError as error:
        raise SetupError(
            f"HTTP cannot be served at {host}:{port}: {error.strerror}; "
            "choose another address, or port 0 for any"
        ) from None


async def serve(
    run: Path, address: str, keys: Path | None, announce: Callable[[str], None] = lambda url: None
) -> None:
    """Serve until the broker ends. Raises `RunError` where none runs there, or the address is taken.

    Args:
        run: Directory of the run.
        address: ``HOST:PORT`` to serve at.
        keys: Keys directory; None: that of the broker, if any.
        announce: Called with the URL, once it is served.
    """
    from fastapi import Depends

    from caviar_broker.http.app import make_app, may
    from caviar_broker.http.gateway import NOTE, REMEDY, Gateway
    from caviar_broker.http.server import http_server, listening_socket, place_of
    from caviar_broker.http.view import LiveView, view_router
    from caviar_protocol.keys import VIEWER

    # Everything is asked over the control socket, which only the broker's user can reach.
    ask = functools.partial(ask_in_thread, run)
    keys, credentials = await _keys_of_broker(ask, keys)
    host, port = http_address(address, keys)
    tokens = Tokens(keys)
    status = (await ask(do="status"))["status"]
    known = {entry["name"] for entry in status["services"]}

    async def tell(service: str, text: str, kind: str) -> None:
        with contextlib.suppress(RunError):
            await ask(do="note", service=service if service in known else "", text=text[:1000], kind=kind)

    remedy = f"{REMEDY} --directory {keys}" if keys is not None else REMEDY
    gateway = Gateway(reachable(status["endpoint"]), tokens, tell, credentials, remedy)
    listening = listening_socket(host, port)
    notices: set[asyncio.Task[None]] = set()

    # The event loop keeps only weak references to tasks: without the set a notice might vanish unsent.
    def notify_soon(text: str) -> None:
        task = asyncio.create_task(tell("", text, NOTE))
        notices.add(task)
        task.add_done_callback(notices.discard)

    app = make_app(ask, run, tokens, gateway)
    live = LiveView(ask, run, reachable(status["endpoint"]), credentials)
    app.include_router(view_router({"": live.answers}, [Depends(may(VIEWER, tokens))], live))
    server = http_server(app, notify_soon, own_process=True)

    def end() -> None:
        server.should_exit = True

    # Before the address is announced: a broker that ends in between must not leave this process behind.
    call_at_end(connect(run), end)
    url = f"http://{place_of(host, listening)}"
    await ask(do="serving", http=url)
    announce(url)
    try:
        await server.serve(sockets=[listening])
    finally:
        gateway.close()


async def _keys_of_broker(ask: Ask, keys: Path | None) -> tuple[Path | None, Credentials | None]:
    """Keys directory, and the gateway's own key where the broker has keys, whose directory it then is.

    The key comes over the control socket, where only the broker's user can ask; it is written nowhere.
    """
    answer = await ask(do="gateway")
    if answer["keys"] is None:
        return keys, None
    directory = Path(answer["keys"])
    if keys is not None and keys.resolve() != directory:
        raise RunError(f"the broker has its keys and tokens in {directory}, not in {keys}; leave out --keys")
    pair = Pair(public=answer["public"], secret=answer["secret"])
    return directory, Credentials(pair, answer["broker"])


def reachable(endpoint: str) -> str:
    """Replace the address of a broker that listens at all of this machine's by that of the loopback."""
    return endpoint.replace("//0.0.0.0:", "//127.0.0.1:").replace("//[::]:", "//[::1]:")


@contextlib.contextmanager
def gateway_in_front(endpoint: str, address: str, notify: Callable[[str], None]) -> Iterator[str]:
    """Serve WebSockets for a ROUTER that is no broker's, such as that of the conformance kit, without tokens.

    Args:
        endpoint: Where the ROUTER listens.
        address: ``HOST:PORT`` of this machine to serve at; port 0: any.
        notify: Called in another thread with a text about each connection that is refused or cut off.

    Yields the URL, and serves until the context is left.
    Raises:
        SetupError: The address is none.
        RunError: The address is taken.
    """
    from starlette.applications import Starlette
    from starlette.routing import WebSocketRoute
    from uvicorn import Server

    from caviar_broker.http.gateway import Gateway
    from caviar_broker.http.server import http_server, listening_socket, place_of

    host, port = http_address(address, None)
    listening = listening_socket(host, port)
    servers: list[Server] = []

    async def serve() -> None:
        async def note(_service: str, text: str, _kind: str) -> None:
            notify(text)

        gateway = Gateway(endpoint, Tokens(None), note)
        servers.append(http_server(Starlette(routes=[WebSocketRoute("/ws", gateway.serve)]), notify))
        try:
            await servers[0].serve(sockets=[listening])
        finally:
            gateway.close()

    thread = threading.Thread(target=asyncio.run, args=(serve(),), name="gateway", daemon=True)
    thread.start()
    try:
        yield f"ws://{place_of(host, listening)}/ws"
    finally:
        for server in servers:
            server.should_exit = True
        thread.join()


def parser() -> argparse.ArgumentParser:
    """Command line."""
    found = argparse.ArgumentParser(prog="python -m caviar_broker.http", description=__doc__)
    found.add_argument("run", type=Path, help="directory of the run")
    found.add_argument("--http", default="127.0.0.1:8080", help="address to serve at; port 0: any free one")
    found.add_argument("--keys", type=Path, default=None, help="keys directory, with tokens.toml")
    return found


def main() -> int:
    """Parse the command line and serve; the exit status."""
    arguments = parser().parse_args()
    try:
        asyncio.run(serve(arguments.run, arguments.http, arguments.keys))
    except CaviarError as error:
        sys.stderr.write(f"caviar http: {error}\n")
        return 1
    except KeyboardInterrupt:
        return 130
    return 0
