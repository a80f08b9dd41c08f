"""AirSim's RPC on the wire: requests and answers, and what is done about those that are none."""

from __future__ import annotations

import asyncio
import socket
from collections.abc import Callable
from typing import Any

import msgpack
import pytest

from caviar_bridges.airsim import rpc
from caviar_bridges.airsim.rpc import CallError, Compact, Params, RpcClient, RpcServer, address_of, response
from caviar_protocol.errors import RunError, SetupError


async def echo(method: str, params: Params) -> object:
    if method == "fail":
        raise CallError("there is no such place")
    if method == "crash":
        raise KeyError("a bug")
    return [method, *params]


def served(client: Callable[[int], Any], handler: rpc.Handler = echo) -> Any:
    """What a client in a thread returns, with the port of a server beside it."""

    async def both() -> Any:
        server = RpcServer(handler, port=0)
        await server.start()
        try:
            return await asyncio.wait_for(asyncio.to_thread(client, server.port), 20)
        finally:
            await server.close("enough")

    return asyncio.run(both())


def raw(port: int, data: bytes) -> bytes:
    """What comes after these bytes, until the server hangs up."""
    with socket.create_connection(("127.0.0.1", port), 10) as connection:
        connection.sendall(data)
        found = b""
        while part := connection.recv(1 << 16):
            found += part
        return found


def test_a_call_gets_its_result_and_a_refusal_its_text() -> None:
    def client(port: int) -> list[Any]:
        with RpcClient(port=port) as connection:
            found = [connection.call("ping"), connection.call("add", 1, {"x_val": 2.5}, b"\x00\xff")]
            for method in ("fail", "crash"):
                with pytest.raises(RunError) as error:
                    connection.call(method)
                found.append(str(error.value).partition("refuses ")[2])
            return found

    assert served(client) == [
        ["ping"],
        ["add", 1, {"x_val": 2.5}, b"\x00\xff"],
        "fail: there is no such place",
        "crash: crash failed: KeyError: 'a bug'",
    ]


def test_texts_of_the_clients_old_packer_are_texts() -> None:
    """It knows no difference between texts and bytes: its texts are raw."""
    request = msgpack.packb([0, 7, "moveToZ", ["Drone1"]], use_bin_type=False)

    def client(port: int) -> Any:
        with socket.create_connection(("127.0.0.1", port), 10) as connection:
            connection.sendall(request)
            return msgpack.unpackb(connection.recv(1 << 16))

    assert served(client) == [1, 7, None, ["moveToZ", "Drone1"]]


def test_a_slow_call_does_not_hold_up_the_calls_after_it() -> None:
    """On one connection, as of a client that waits for a motion and asks for the state meanwhile."""
    gate = asyncio.Event()

    async def handler(method: str, params: Params) -> object:
        if method == "slow":
            await gate.wait()
        else:
            gate.set()
        return method

    def client(port: int) -> list[Any]:
        unpacker, found = msgpack.Unpacker(), []
        with socket.create_connection(("127.0.0.1", port), 10) as connection:
            connection.sendall(msgpack.packb([0, 1, "slow", []]) + msgpack.packb([0, 2, "quick", []]))
            while len(found) < 2:
                unpacker.feed(connection.recv(1 << 16))
                found += [(message[1], message[3]) for message in unpacker]
        return sorted(found)

    assert served(client, handler) == [(1, "slow"), (2, "quick")]


def test_a_notification_is_obeyed_and_not_answered() -> None:
    noted: list[str] = []

    async def handler(method: str, params: Params) -> object:
        noted.append(method)
        return method

    def client(port: int) -> Any:
        with socket.create_connection(("127.0.0.1", port), 10) as connection:
            connection.sendall(msgpack.packb([2, "hover", []]) + msgpack.packb([0, 5, "ping", []]))
            return msgpack.unpackb(connection.recv(1 << 16))

    assert served(client, handler) == [1, 5, None, "ping"]
    assert noted == ["hover", "ping"]


@pytest.mark.parametrize(
    "nonsense",
    [
        b"GET / HTTP/1.1\r\n\r\n",
        msgpack.packb([0, 1, "ping"]),
        msgpack.packb([0, "one", "ping", []]),
        msgpack.packb({"method": "ping"}),
        msgpack.packb([1, 1, None, True]),
        b"\xc1",
        b"\x91" * 5000,
    ],
)
def test_what_is_no_request_ends_its_connection_and_no_other(nonsense: bytes) -> None:
    def client(port: int) -> tuple[bytes, Any]:
        with RpcClient(port=port) as other:
            return raw(port, nonsense), other.call("ping")

    assert served(client) == (b"", ["ping"])


def test_a_message_that_is_too_long_is_cut_before_it_is_in_memory() -> None:
    head = b"\xc6" + (1 << 30).to_bytes(4, "big")  # a text of a gigabyte is announced

    def client(port: int) -> bytes:
        with socket.create_connection(("127.0.0.1", port), 10) as connection:
            connection.sendall(head)
            try:
                for _ in range(64):
                    connection.sendall(bytes(1 << 16))
                return connection.recv(1)
            except ConnectionError:
                return b""

    assert served(client) == b""


def test_connections_and_calls_in_progress_are_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(rpc, "MAX_CONNECTIONS", 2)
    monkeypatch.setattr(rpc, "MAX_CALLS", 3)

    async def handler(method: str, params: Params) -> object:
        if method == "wait":
            await asyncio.Event().wait()
        return method

    def client(port: int) -> tuple[Any, bytes, Any]:
        with (
            socket.create_connection(("127.0.0.1", port), 10) as connection,
            RpcClient(port=port) as second,
        ):
            second.call("ping")
            connection.sendall(b"".join(msgpack.packb([0, i, "wait", []]) for i in range(4)))
            return msgpack.unpackb(connection.recv(1 << 16)), raw(port, b""), second.call("ping")

    refused, third, pong = served(client, handler)
    assert refused == [1, 3, "3 calls are in progress on this connection; wait for some", None]
    assert (third, pong) == (b"", "ping")


def test_the_end_of_the_server_answers_what_waits() -> None:
    """A client of AirSim would wait for an hour otherwise."""

    async def both() -> str:
        began = asyncio.Event()

        async def handler(method: str, params: Params) -> object:
            began.set()
            return await asyncio.Event().wait()

        server = RpcServer(handler, port=0)
        await server.start()
        waiting = asyncio.create_task(asyncio.to_thread(called, server.port))
        await began.wait()
        await server.close("the run is over")
        return await asyncio.wait_for(waiting, 10)

    def called(port: int) -> str:
        with RpcClient(port=port) as client, pytest.raises(RunError) as error:
            client.call("moveToPosition")
        return str(error.value)

    assert asyncio.run(both()).endswith("refuses moveToPosition: the run is over")


def test_an_address_in_use_is_named_with_the_remedy() -> None:
    def client(port: int) -> str:
        with pytest.raises(SetupError) as error:
            asyncio.run(RpcServer(echo, port=port).start())
        return str(error.value)

    assert "choose another address" in served(client)


def test_a_server_that_is_not_there_is_named() -> None:
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    with pytest.raises(RunError, match=f"no AirSim answers at 127.0.0.1:{port}"):
        RpcClient(port=port)


def test_many_numbers_travel_in_single_precision_and_others_in_double() -> None:
    numbers = [0.1] * 100
    assert msgpack.unpackb(response(1, None, numbers))[3][0] == 0.1
    assert msgpack.unpackb(response(1, None, Compact(numbers)))[3][0] == pytest.approx(0.1, abs=1e-8)
    assert len(response(1, None, Compact(numbers))) < 0.6 * len(response(1, None, numbers))


@pytest.mark.parametrize("text", ["nowhere:port", "127.0.0.1:70000", "http://x:1", "a b:1", "x:-1"])
def test_an_address_that_is_none_is_refused(text: str) -> None:
    with pytest.raises(ValueError, match="write HOST:PORT"):
        address_of(text)


def test_parts_of_an_address_have_defaults() -> None:
    assert address_of("192.0.2.1:5") == ("192.0.2.1", 5)
    assert address_of("[::1]:5") == ("::1", 5)
    assert address_of("") == ("127.0.0.1", 41451)
