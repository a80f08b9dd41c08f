"""The kit's socket: one ROUTER, messages as plain MessagePack maps, and a count of connections."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import msgpack  # type: ignore[import-untyped]
import zmq
from zmq.utils.monitor import recv_monitor_message

from caviar_protocol.errors import RunError

BROKEN = (ValueError, TypeError, RecursionError, msgpack.exceptions.UnpackException)
"""What `unpack` raises for bytes that are no MessagePack."""


def pack(value: Any) -> bytes:
    """The bytes of a value, everything in its shortest form, floats in nine bytes."""
    packed: bytes = msgpack.packb(value)
    return packed


def unpack(data: bytes) -> Any:
    """The value of all these bytes; raises one of `BROKEN`."""
    return msgpack.unpackb(data, raw=False)


def in_order(value: Any) -> Any:
    """A plain value whose maps have their keys in the order of the canonical form."""
    if isinstance(value, dict):
        return {key: in_order(value[key]) for key in sorted(value, key=str.encode)}
    return [in_order(item) for item in value] if isinstance(value, list) else value


MAX_PART = 1 << 30
"""[B] of a part; a client that sends more is disconnected."""

Fields = dict[str, Any]


@dataclass(frozen=True)
class Received:
    """One multipart message, with the routing id of the connection that it came over."""

    route: bytes
    parts: list[bytes]

    @property
    def fields(self) -> Fields:
        """The header, or an empty map where it is none."""
        try:
            header = unpack(self.parts[0])
        except (*BROKEN, IndexError):
            return {}
        return header if isinstance(header, dict) else {}

    @property
    def kind(self) -> str:
        """The field ``type``; empty where there is none."""
        kind = self.fields.get("type", "")
        return kind if isinstance(kind, str) else ""


class Wire:
    """Listens at ``endpoint``; port 0 takes any.

    Raises `RunError` where it cannot.
    """

    def __init__(self, endpoint: str) -> None:
        self._context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
        self._socket = self._context.socket(zmq.ROUTER)
        self._socket.linger = 0
        self._socket.setsockopt(zmq.MAXMSGSIZE, MAX_PART)
        self._monitor = self._socket.get_monitor_socket(zmq.EVENT_ACCEPTED | zmq.EVENT_DISCONNECTED)
        self._open: set[int] = set()
        try:
            self._socket.bind(endpoint.removesuffix(":0") + ":*" if endpoint.endswith(":0") else endpoint)
        except zmq.ZMQError as error:
            self.close()
            raise RunError(
                f"cannot listen at {endpoint!r}: {error.strerror}; an address is like tcp://127.0.0.1:5590"
            ) from error
        self.endpoint = self._socket.getsockopt_string(zmq.LAST_ENDPOINT)

    @property
    def connections(self) -> int:
        """How many are open now."""
        while self._monitor.poll(0):
            event = recv_monitor_message(self._monitor, zmq.NOBLOCK)
            change = self._open.add if event["event"] == zmq.EVENT_ACCEPTED else self._open.discard
            change(event["value"])
        return len(self._open)

    def send(self, route: bytes, header: Fields | bytes, *parts: bytes) -> None:
        """Send a message; one to a connection that is gone is lost."""
        packed = header if isinstance(header, bytes) else pack(header)
        self._socket.send_multipart([route, packed, *parts])

    def send_parts(self, route: bytes, parts: list[bytes]) -> None:
        """Send parts as they are, also none that is a header."""
        self._socket.send_multipart([route, *parts])

    def poll(self, seconds: float) -> Received | None:
        """What comes within this time."""
        if not self._socket.poll(max(0, round(seconds * 1000))):
            return None
        route, *parts = self._socket.recv_multipart()
        return Received(route, parts)

    def close(self) -> None:
        """Close everything; what is not sent is lost."""
        self._socket.disable_monitor()
        self._monitor.close(0)
        self._socket.close()
        self._context.term()
