"""``python -m caviar_broker.api RUN --http HOST:PORT``: HTTP and WebSocket beside a broker that runs.

Ends when the broker does.
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import sys
from pathlib import Path

from caviar_broker.api.link import DeskLink
from caviar_broker.api.tokens import Tokens, http_address
from caviar_protocol.errors import CaviarError, RunError
from caviar_protocol.keys import Credentials, Pair


async def serve(run: Path, address: str, keys: Path | None) -> None:
    """Serve until the broker ends. Raises `RunError` where none runs there, or the address is taken."""
    from caviar_broker.api.app import make_app
    from caviar_broker.api.gateway import NOTE, REMEDY, Gateway
    from caviar_broker.api.http_server import http_server, listening_socket

    desk = DeskLink(run)
    keys, credentials = await _of_the_broker(desk, keys)
    host, port = http_address(address, keys)
    tokens = Tokens(keys)
    status = (await desk.ask("status"))["status"]

    async def tell(service: str, text: str, kind: str) -> None:
        known = [entry["name"] for entry in status["services"]]
        with contextlib.suppress(RunError):
            await desk.ask("note", service=service if service in known else "", text=text[:1000], kind=kind)

    remedy = f"{REMEDY} --directory {keys}" if keys is not None else REMEDY
    gateway = Gateway(_reachable(status["endpoint"]), tokens, tell, credentials, remedy)
    listening = listening_socket(host, port)
    told: set[asyncio.Task[None]] = set()

    def tell_soon(text: str) -> None:
        task = asyncio.create_task(tell("", text, NOTE))
        told.add(task)
        task.add_done_callback(told.discard)

    server = http_server(make_app(desk, tokens, gateway), tell_soon, own_process=True)

    async def end_with_the_broker() -> None:
        async for _ in desk.events():
            continue
        server.should_exit = True

    follower = asyncio.create_task(end_with_the_broker())
    shown = f"[{host}]" if ":" in host else host
    await desk.ask("serving", http=f"http://{shown}:{listening.getsockname()[1]}")
    try:
        await server.serve(sockets=[listening])
    finally:
        follower.cancel()
        desk.close()
        gateway.close()


async def _of_the_broker(desk: DeskLink, keys: Path | None) -> tuple[Path | None, Credentials | None]:
    """Keys directory, and the gateway's own key where the broker has keys, whose directory it then is.

    The key comes by the broker's desk, where only the broker's user can ask, and is written nowhere.
    """
    told = await desk.ask("gateway")
    if told["keys"] is None:
        return keys, None
    directory = Path(told["keys"])
    if keys is not None and keys.resolve() != directory:
        raise RunError(f"the broker has its keys and tokens in {directory}, not in {keys}; leave out --keys")
    pair = Pair(public=told["public"], secret=told["secret"])
    return directory, Credentials(pair, told["broker"])


def _reachable(endpoint: str) -> str:
    """Where this machine reaches a broker that listens at all of its addresses."""
    return endpoint.replace("//0.0.0.0:", "//127.0.0.1:").replace("//[::]:", "//[::1]:")


def parser() -> argparse.ArgumentParser:
    """Command line."""
    found = argparse.ArgumentParser(prog="python -m caviar_broker.api", description=__doc__)
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


if __name__ == "__main__":
    sys.exit(main())
