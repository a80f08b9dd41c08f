"""An agent that speaks ZeroMQ, over WebSockets: ``websocket_zmq.py AGENT.py ws://HOST:PORT/ws NAME [TOKEN]``.

What the agent takes for ``zmq`` is the few lines below, written from SPEC.md, section WebSocket, so that
the very same agent is a peer over either transport.
"""

from __future__ import annotations

import runpy
import struct
import sys
import types
from typing import Any

from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect

TOKEN = sys.argv[4:]


class Dealer:
    """The part of a DEALER socket that the agent uses."""

    def __init__(self) -> None:
        self.linger = 0
        self._next: bytes | None = None

    def __enter__(self) -> Dealer:
        return self

    def __exit__(self, *_: object) -> None:
        self._socket.close()

    def connect(self, url: str) -> None:
        offered = ["caviar.v1", *(f"bearer.{token}" for token in TOKEN)]
        self._socket = connect(url, subprotocols=offered, max_size=None).__enter__()  # type: ignore[arg-type]

    def send_multipart(self, parts: list[bytes]) -> None:
        lengths = [len(part) for part in parts]
        self._socket.send(struct.pack(f"<{len(parts) + 1}I", len(parts), *lengths) + b"".join(parts))

    def send(self, part: bytes) -> None:
        self.send_multipart([part])

    def poll(self, milliseconds: float) -> bool:
        try:
            self._next = self._socket.recv(timeout=milliseconds / 1000)  # type: ignore[assignment]
        except TimeoutError:
            return False
        except ConnectionClosed:
            return True  # `recv` says so
        return True

    def recv_multipart(self) -> list[bytes]:
        frame, self._next = self._next or self._socket.recv(), None
        assert isinstance(frame, bytes)
        (count,) = struct.unpack_from("<I", frame)
        place, parts = 4 * (1 + count), []
        for length in struct.unpack_from(f"<{count}I", frame, 4):
            parts.append(frame[place : place + length])
            place += length
        return parts

    def recv(self) -> bytes:
        return self.recv_multipart()[0]


class Context:
    def __enter__(self) -> Context:
        return self

    def __exit__(self, *_: object) -> None:
        return

    def socket(self, _: object) -> Dealer:
        return Dealer()


def main() -> None:
    module: Any = types.ModuleType("zmq")
    module.Context, module.DEALER = Context, None
    sys.modules["zmq"] = module
    agent, *sys.argv[1:] = sys.argv[1:4]
    runpy.run_path(agent, run_name="__main__")


main()
