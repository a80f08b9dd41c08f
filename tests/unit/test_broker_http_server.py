"""Slow, silent and oversized connections at the HTTP process keep no peer out, and leave no memory behind."""

from __future__ import annotations

import base64
import contextlib
import os
import select
import socket
import struct
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path

import psutil
import pytest
import zmq
from broker_harness import MS, PATIENCE_S
from http_harness import Peer, Site, site
from websockets.exceptions import ConnectionClosed
from websockets.frames import Close
from websockets.sync.client import ClientConnection, connect

from caviar_broker.http import server as strangers
from caviar_broker.http.gateway import MESSAGES_BEFORE_HELLO
from caviar_broker.http.process import gateway_in_front
from caviar_protocol import messages as m
from caviar_protocol.codec import encode_message, join_parts

pytestmark = pytest.mark.slow

MIB = 1 << 20
UPGRADE = (
    "GET /ws HTTP/1.1\r\nHost: 127.0.0.1\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
    f"Sec-WebSocket-Key: {base64.b64encode(bytes(16)).decode()}\r\nSec-WebSocket-Version: 13\r\n\r\n"
).encode()
SWITCHED = b"HTTP/1.1 101"
HEALTHY_S = 0.1
"""[s] within which a probe is answered."""
MEMORY = 64 * MIB
"""[B] above idle, at most."""
PATIENT = {"connect": 300_000 * MS, "ready": 300_000 * MS}


def slow(connection: socket.socket) -> None:
    """Half of a request."""
    connection.sendall(b"GET /status HTTP/1.1\r\nHost: 127.0.0.1\r\nX-Slow: ")


def silent(connection: socket.socket) -> None:
    """A WebSocket on which nothing is said."""
    connection.sendall(UPGRADE)
    assert connection.recv(4096).startswith(SWITCHED)


def oversized(connection: socket.socket) -> None:
    """A WebSocket whose first frame announces 250 MiB, with 4 MiB of it."""
    silent(connection)
    connection.setblocking(False)
    frame = b"\x82\xff" + struct.pack(">Q", 250 * MIB) + bytes(4) + bytes(4 * MIB)
    until = time.monotonic() + 0.05
    try:
        while frame and time.monotonic() < until:
            try:
                frame = frame[connection.send(frame) :]
            except BlockingIOError:
                os.sched_yield()
    except OSError:
        return  # cut off in the middle


KINDS: tuple[Callable[[socket.socket], None], ...] = (slow, silent, oversized)


def crowd(served: Site, number: int, stack: ExitStack) -> Iterator[int]:
    """So many connections, of all kinds in turn; yields how many there are after each thirty."""
    for count in range(1, number + 1):
        connection = stack.enter_context(socket.create_connection(("127.0.0.1", served.port), PATIENCE_S))
        KINDS[count % len(KINDS)](connection)
        if count % 30 == 0:
            yield count


def probed(served: Site) -> float:
    """How long a probe takes [s]; the better of two, since other tests use the processors too."""
    times = []
    for _ in range(2):
        began = time.monotonic()
        assert served.get("/healthz").json == {"ok": True}
        times.append(time.monotonic() - began)
    return min(times)


def memory(served: Site) -> int:
    return psutil.Process(served.process.pid).memory_info().rss


def closed(peer: ClientConnection) -> Close:
    """How a WebSocket is closed, whatever comes before."""
    try:
        while True:
            peer.recv(timeout=PATIENCE_S)
    except ConnectionClosed as end:
        return end.rcvd or Close(1006, "")


def joined(served: Site, name: str) -> Peer:
    peer = Peer(served.url, name)
    peer.join()
    return peer


@pytest.mark.parametrize("number", [330, pytest.param(600, marks=pytest.mark.exhaustive)])
def test_a_crowd_of_slow_silent_and_oversized_connections_keeps_nobody_out(
    tmp_path: Path, number: int, capsys: pytest.CaptureFixture[str]
) -> None:
    """More than the 256 of which the oldest make room."""
    with site(tmp_path, limits=PATIENT) as served, ExitStack() as stack:
        member = stack.enter_context(joined(served, "world"))
        probed(served)
        idle, times, most = memory(served), [], 0
        for _ in crowd(served, number, stack):
            times.append(probed(served))
            most = max(most, memory(served))
        stack.enter_context(joined(served, "sensors"))
        member.expect(m.Prepare)  # it was there before the crowd, and is still
        with capsys.disabled():
            told = f"/healthz within {max(times) * 1e3:.0f} ms, {(most - idle) / MIB:.1f} MiB above idle"
            sys.stdout.write(f"{number} connections: {told}\n")
        assert max(times) < HEALTHY_S
        assert most - idle < MEMORY


def test_the_memory_of_what_a_member_sent_is_given_back_when_it_has_gone(tmp_path: Path) -> None:
    with site(tmp_path, limits=PATIENT) as served:
        probed(served)
        idle = memory(served)
        with joined(served, "world") as peer:
            peer.socket.send(bytes(100 * MIB))  # a frame that is no message
            assert closed(peer.socket).code == 1007
        until = time.monotonic() + PATIENCE_S
        while memory(served) - idle > MEMORY // 4:
            assert time.monotonic() < until, f"{(memory(served) - idle) / MIB:.0f} MiB above idle are kept"
            os.sched_yield()


# --- a server in this process, with short times --------------------------------------------------------


@pytest.fixture
def told() -> list[str]:
    """What the gateway says to the run's user."""
    return []


@pytest.fixture
def port(told: list[str], monkeypatch: pytest.MonkeyPatch) -> Iterator[int]:
    """Of the gateway in front of a ROUTER that answers nothing."""
    monkeypatch.setattr(strangers, "REQUEST_S", 0.3)
    monkeypatch.setattr(strangers, "HELLO_S", 0.8)
    monkeypatch.setattr(strangers, "LOOK_S", 0.1)
    monkeypatch.setattr(strangers, "MAX_STRANGERS", 4)
    with zmq.Context() as context, context.socket(zmq.ROUTER) as router:
        endpoint = f"tcp://127.0.0.1:{router.bind_to_random_port('tcp://127.0.0.1')}"
        with gateway_in_front(endpoint, "127.0.0.1:0", told.append) as url:
            yield int(url.rpartition(":")[2].partition("/")[0])


def connected(port: int, source: str = "127.0.0.1") -> socket.socket:
    return socket.create_connection(("127.0.0.1", port), PATIENCE_S, (source, 0))


def ended(connection: socket.socket) -> bytes:
    """What comes until the connection is ended."""
    came = b""
    with contextlib.suppress(ConnectionResetError):
        while data := connection.recv(4096):
            came += data
    return came


def dribble(connection: socket.socket) -> None:
    """A byte now and then, until none is taken any more."""
    with contextlib.suppress(ConnectionError):
        while True:
            connection.sendall(b"x")
            select.select([connection], [], [], 0.01)


def test_half_a_request_ends_when_its_time_is_over_though_more_comes_again_and_again(port: int) -> None:
    with connected(port) as connection:
        slow(connection)
        began = time.monotonic()
        dribble(connection)
        assert 0.2 < time.monotonic() - began < PATIENCE_S / 2


def test_a_connection_that_asks_nothing_more_ends(port: int) -> None:
    with connected(port) as connection:
        connection.sendall(b"GET /nothing HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n")
        assert ended(connection).startswith(b"HTTP/1.1 404")


def test_a_websocket_that_never_says_hello_ends(port: int) -> None:
    with connected(port) as connection:
        began = time.monotonic()
        silent(connection)
        ended(connection)
        assert time.monotonic() - began > 0.6


def test_a_websocket_may_send_little_before_its_hello_is_accepted(port: int) -> None:
    with connected(port) as connection:
        silent(connection)
        connection.sendall(b"\x82\xff" + struct.pack(">Q", 250 * MIB) + bytes(strangers.HELLO_BYTES))
        kind, _, code = struct.unpack_from(">BBH", ended(connection))
    assert (kind, code) == (0x88, 1009)


def test_a_websocket_may_say_hello_a_few_times_until_it_is_accepted(port: int) -> None:
    hello = join_parts([encode_message(m.Hello(version=(1, 0), name="world", role="world"))])
    with connect(f"ws://127.0.0.1:{port}/ws") as peer:
        for _ in range(MESSAGES_BEFORE_HELLO + 1):
            peer.send(hello)
        end = closed(peer)
    assert end.code == 1008
    assert f"more than {MESSAGES_BEFORE_HELLO} messages" in end.reason


def test_the_oldest_of_the_address_that_has_most_makes_room(port: int, told: list[str]) -> None:
    with ExitStack() as stack:
        other = stack.enter_context(connected(port, "127.0.0.2"))
        crowd = [stack.enter_context(connected(port)) for _ in range(5)]
        assert ended(crowd[0]) == b""
        other.sendall(b"GET /nothing HTTP/1.1\r\nHost: 127.0.0.1\r\nConnection: close\r\n\r\n")
        assert ended(other).startswith(b"HTTP/1.1 404")
        assert [ended(connection) for connection in crowd] == [b""] * 5
    text = "connections from 127.0.0.1 that never said who they are were ended: there were more than 4"
    assert any(text in line for line in told)
