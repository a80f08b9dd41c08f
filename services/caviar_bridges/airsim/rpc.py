"""MessagePack-RPC over TCP, as AirSim's clients speak it: the messages, a server, and a client.

A request is ``[0, id, method, params]``, its answer ``[1, id, error, result]``; answers come in any order. A
notification ``[2, method, params]`` gets none. Messages have no length in front: the first byte that is no
message ends a connection.
"""

from __future__ import annotations

import asyncio
import logging
import socket
from collections.abc import Awaitable, Callable, Sequence
from contextlib import suppress
from typing import Any, NamedTuple

import msgpack  # type: ignore[import-untyped]

from caviar_protocol.errors import RunError, SetupError

PORT = 41451
"""AirSim's."""
HOST = "127.0.0.1"
MAX_MESSAGE = 1 << 20
"""[B] of a request: a path of ten thousand points has a fifth of that."""
MAX_CONNECTIONS = 32
MAX_CALLS = 64
"""Calls in progress on a connection."""
SEND_S = 30.0
"""[s] that a client has to take an answer; then its connection is cut."""
MAX_TEXT = 2000
"""[characters] of an error."""
_REQUEST, _RESPONSE, _NOTIFICATION = 0, 1, 2
_CHUNK = 1 << 16
_NO_MESSAGE = (ValueError, TypeError, msgpack.exceptions.UnpackException, msgpack.exceptions.BufferFull)

Params = Sequence[Any]
Handler = Callable[[str, Params], Awaitable[object]]
"""``await handler(method, params)``: the result, or `CallError`."""

_log = logging.getLogger("caviar.airsim")


class CallError(Exception):
    """A call that cannot be done; the client raises an error with this text."""


class Compact(NamedTuple):
    """A result with thousands of numbers, which travel in single precision, as AirSim sends them."""

    result: object


def new_unpacker() -> msgpack.Unpacker:
    """Make an unpacker that holds a message of `MAX_MESSAGE` at most."""
    # Clients of that age pack texts as raw bytes, which is how they arrive as texts here.
    return msgpack.Unpacker(raw=False, strict_map_key=False, max_buffer_size=MAX_MESSAGE)


def response(call: int, error: str | None, result: object) -> bytes:
    """Pack an answer.

    Args:
        call: Number of the request.
        error: What is wrong; None: nothing.
        result: What the call returns.

    Example:
        >>> msgpack.unpackb(response(7, None, [1.5, "uav"]))
        [1, 7, None, [1.5, 'uav']]
    """
    single = isinstance(result, Compact)
    content = result.result if isinstance(result, Compact) else result
    packed: bytes = msgpack.packb([_RESPONSE, call, error, content], use_single_float=single)
    return packed


def address_of(text: str) -> tuple[str, int]:
    """Read ``HOST:PORT``, ``:PORT`` or ``HOST``; what is missing is AirSim's default.

    Raises:
        ValueError: It is no address.

    Example:
        >>> address_of(":0"), address_of("127.0.0.1")
        (('127.0.0.1', 0), ('127.0.0.1', 41451))
    """
    host, separator, port = text.rpartition(":")
    if not separator:
        host, port = text, ""
    number = int(port) if port.isdecimal() else PORT if not port else -1
    if not 0 <= number <= 65535 or "/" in host or " " in host:
        raise ValueError(f"{text!r} is no address; write HOST:PORT, for example {HOST}:{PORT}")
    return host.strip("[]") or HOST, number


class RpcServer:
    """Serves calls of many clients in the event loop that `start` is awaited in.

    Args:
        handler: Answers a call.
        host, port: Where it listens; port 0: any.

    Example:
        >>> async def handler(method, params):
        ...     return [method, *params]
        >>> async def demo():
        ...     server = RpcServer(handler, port=0)
        ...     await server.start()
        ...     answer = await asyncio.to_thread(called, server.port)
        ...     await server.close("enough")
        ...     return answer
        >>> def called(port):
        ...     with RpcClient("127.0.0.1", port) as client:
        ...         return client.call("ping", 1)
        >>> asyncio.run(demo())
        ['ping', 1]
    """

    def __init__(self, handler: Handler, host: str = HOST, port: int = PORT) -> None:
        self.host, self.port = host, port
        self.called = asyncio.Event()
        """Set once a client has called anything."""
        self._handler = handler
        self._server: asyncio.Server | None = None
        self._connections: set[_Connection] = set()

    async def start(self) -> None:
        """Listen.

        Raises:
            SetupError: The address cannot be listened on.
        """
        try:
            self._server = await asyncio.start_server(self._serve, self.host, self.port, limit=_CHUNK)
        except OSError as error:
            raise SetupError(
                f"AirSim's RPC cannot be served at {self.host}:{self.port}: {error.strerror or error}; end "
                "the program that listens there (AirSim itself?), or choose another address"
            ) from error
        self.port = self._server.sockets[0].getsockname()[1]

    async def close(self, reason: str) -> None:
        """Answer all calls in progress with an error, and hang up.

        Args:
            reason: The error's text.
        """
        if self._server is not None:
            self._server.close()
        for connection in tuple(self._connections):
            await connection.close(reason)

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        if len(self._connections) >= MAX_CONNECTIONS:
            _log.warning("a client is hung up on: there are %d connections", MAX_CONNECTIONS)
            writer.close()
            return
        connection = _Connection(reader, writer, self._handle)
        self._connections.add(connection)
        try:
            await connection.serve()
        finally:
            self._connections.discard(connection)

    async def _handle(self, method: str, params: Params) -> object:
        self.called.set()
        return await self._handler(method, params)


class _Connection:
    """One client."""

    def __init__(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter, handler: Handler) -> None:
        self._reader, self._writer, self._handler = reader, writer, handler
        # One answer at a time: the others wait here, and their results are bounded by the calls in progress.
        self._sending = asyncio.Lock()
        self._calls: dict[asyncio.Task[None], int | None] = {}

    async def serve(self) -> None:
        """Read requests until the client hangs up."""
        unpacker = new_unpacker()
        try:
            while data := await self._reader.read(_CHUNK):
                unpacker.feed(data)
                for message in unpacker:
                    self._take(message)
        except _NO_MESSAGE as error:
            _log.warning("a client sent what is no request, and is hung up on: %s", error)
        except ConnectionError:
            pass  # it is gone, which the end of this method says as well
        finally:
            for task in tuple(self._calls):
                task.cancel()
            self._writer.close()

    async def close(self, reason: str) -> None:
        """Answer calls in progress with an error, and hang up."""
        for task, call in tuple(self._calls.items()):
            task.cancel()
            if call is not None:
                with suppress(ConnectionError, TimeoutError):
                    await self._send(response(call, reason, None))
        self._writer.close()

    def _take(self, message: object) -> None:
        call, method, params = _request(message)
        if len(self._calls) >= MAX_CALLS:
            work = self._answer(call, f"{MAX_CALLS} calls are in progress on this connection; wait for some")
        else:
            work = self._call(call, method, params)
        task = asyncio.get_running_loop().create_task(work)
        self._calls[task] = call
        task.add_done_callback(lambda done: self._calls.pop(done, None))

    async def _call(self, call: int | None, method: str, params: Params) -> None:
        try:
            result = await self._handler(method, params)
        except CallError as error:
            await self._answer(call, str(error))
        except Exception as error:
            # A bug here, or values that no check foresaw: the client learns of it, and the run goes on.
            _log.exception("call %.80r failed", method)
            await self._answer(call, f"{method} failed: {type(error).__name__}: {error}")
        else:
            await self._answer(call, None, result)

    async def _answer(self, call: int | None, error: str | None, result: object = None) -> None:
        if call is None:  # a notification
            return
        try:
            await self._send(response(call, None if error is None else error[:MAX_TEXT], result))
        except (ConnectionError, TimeoutError):
            self._writer.transport.abort()

    async def _send(self, data: bytes) -> None:
        async with self._sending:
            self._writer.write(data)
            await asyncio.wait_for(self._writer.drain(), SEND_S)


def _request(message: object) -> tuple[int | None, str, Params]:
    """Number, method and parameters of a request; the number of a notification is None.

    Raises:
        ValueError: It is none.
    """
    match message:
        case [0, int() as call, str() as method, list() as params]:
            return call, method, params
        case [2, str() as method, list() as params]:
            return None, method, params
    raise ValueError(f"{message!r:.80} is not [0, id, method, params]")


class RpcClient:
    """Calls a server of AirSim's RPC, one call after the other.

    Args:
        host, port: Where it listens.
        timeout_s: Time in which it has to connect, and to answer [s].

    Raises:
        RunError: It does not listen there.
    """

    def __init__(self, host: str = HOST, port: int = PORT, timeout_s: float = 30.0) -> None:
        self._where, self._timeout_s = f"{host}:{port}", timeout_s
        self._unpacker = msgpack.Unpacker(raw=False, strict_map_key=False)
        self._number = 0
        try:
            self._socket = socket.create_connection((host, port), timeout_s)
        except OSError as error:
            raise RunError(
                f"no AirSim answers at {self._where}: {error.strerror or error}; start it"
            ) from error

    def __enter__(self) -> RpcClient:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def call(self, method: str, *params: object) -> Any:
        """Call a method, and wait for its result.

        Args:
            method: Its name.
            params: Numbers, texts, lists and maps of them.

        Raises:
            RunError: It answers with an error, not in time, or hangs up.
        """
        self.begin(method, *params)
        try:
            while True:
                for message in self._unpacker:
                    kind, number, error, result = message
                    if (kind, number) == (_RESPONSE, self._number):
                        if error is not None:
                            raise RunError(f"AirSim at {self._where} refuses {method}: {error}")
                        return result
                if not (data := self._socket.recv(_CHUNK)):
                    raise RunError(f"AirSim at {self._where} hung up during {method}")
                self._unpacker.feed(data)
        except TimeoutError as error:
            raise RunError(
                f"AirSim at {self._where} did not answer {method} within {self._timeout_s:g} s"
            ) from error
        except (OSError, *_NO_MESSAGE) as error:
            raise RunError(f"the connection to AirSim at {self._where} broke in {method}: {error}") from error

    def begin(self, method: str, *params: object) -> None:
        """Call a method without waiting for its result, which is dropped when it comes.

        Args:
            method: Its name.
            params: As for `call`.

        Raises:
            RunError: The server hung up.
        """
        self._number += 1
        try:
            self._socket.sendall(msgpack.packb([_REQUEST, self._number, method, list(params)]))
        except OSError as error:
            raise RunError(f"the connection to AirSim at {self._where} broke in {method}: {error}") from error

    def close(self) -> None:
        """Hang up."""
        self._socket.close()
