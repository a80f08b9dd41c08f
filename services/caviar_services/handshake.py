"""How a connection to a broker with keys comes about, and why it does not."""

from __future__ import annotations

import struct
from typing import Any

import zmq

from caviar_protocol.errors import RunError
from caviar_protocol.keys import BROKER_KEY_VARIABLE, KEY_VARIABLE, Credentials

_EVENT = struct.Struct("=HI")
_WATCHED = (
    int(zmq.EVENT_HANDSHAKE_SUCCEEDED)
    | int(zmq.EVENT_HANDSHAKE_FAILED_NO_DETAIL)
    | int(zmq.EVENT_HANDSHAKE_FAILED_PROTOCOL)
    | int(zmq.EVENT_HANDSHAKE_FAILED_AUTH)
)
CONNECT_TIMEOUT_MS = 1000
"""[ms] after which an attempt to connect that is not answered is followed by another one."""
REPEATED = 3
"""Handshakes in a row that fail without a reason being given, which a broker that is just starting or
ending may cause once."""


def dress(socket: zmq.Socket[Any], endpoint: str, credentials: Credentials | None) -> None:
    """Give a socket what it needs before it connects. Raises `zmq.ZMQError` for impossible keys."""
    socket.setsockopt(zmq.IPV6, int("[" in endpoint))
    # The system sends the packet that opens a connection again after 1, 3, 7 and 15 s: behind an outage of
    # 8 s it would be silent for 7 s more.
    socket.setsockopt(zmq.CONNECT_TIMEOUT, CONNECT_TIMEOUT_MS)
    if credentials is not None:
        credentials.give(socket)


class Handshake:
    """Watches whether a socket, not connected yet, comes to terms with its broker."""

    def __init__(
        self, context: zmq.Context[Any], socket: zmq.Socket[Any], endpoint: str, with_keys: bool
    ) -> None:
        address = f"inproc://handshake-{id(self)}"
        socket.monitor(address, _WATCHED)
        self._watched = socket
        self._monitor = context.socket(zmq.PAIR)
        self._monitor.rcvhwm = 0
        self._monitor.connect(address)
        self._endpoint, self._with_keys = endpoint, with_keys
        self._failures = 0

    def check(self) -> None:
        """Raises `RunError` with the remedy, where the two do not come to terms."""
        while (kind := self._next()) is not None:
            if kind == zmq.EVENT_HANDSHAKE_SUCCEEDED:
                self._failures = 0
                continue
            self._failures += 1
            if kind == zmq.EVENT_HANDSHAKE_FAILED_AUTH:
                raise RunError(
                    f"the broker at {self._endpoint} refused the key: it is not authorized there, or barred "
                    "for a while; on the broker's machine:  "
                    "caviar keys authorize NAME.pub --name NAME --role ROLE"
                )
            if kind == zmq.EVENT_HANDSHAKE_FAILED_PROTOCOL or self._failures >= REPEATED:
                raise RunError(self._disagreement())

    def close(self) -> None:
        """Stop watching."""
        if not self._monitor.closed:
            self._watched.disable_monitor()
            self._monitor.close(0)

    def _next(self) -> int | None:
        try:
            header, _ = self._monitor.recv_multipart(zmq.NOBLOCK)
        except zmq.Again:
            return None
        kind, _ = _EVENT.unpack(header)
        return int(kind)

    def _disagreement(self) -> str:
        if self._with_keys:
            return (
                f"there is no secure connection to {self._endpoint}: the broker's public key is not the one "
                f"given (--broker-key or {BROKER_KEY_VARIABLE}), or that broker has no keys"
            )
        return (
            f"{self._endpoint} does not let this service in: a broker there asks for keys "
            f"(--key and --broker-key, or {KEY_VARIABLE} and {BROKER_KEY_VARIABLE}), or it is no broker"
        )
