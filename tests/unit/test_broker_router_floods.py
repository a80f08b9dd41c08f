"""Peers that send more than is read and go: libzmq 4.3.5 aborts where its queue of a connection is full then.

Its timer for heartbeats writes to a connection whose end it has seen and does not tell before the queue is
read (libzmq issues 3937, 4767 and 4841). A queue without an end is never full.
"""

from __future__ import annotations

import subprocess
import sys

import pytest

pytestmark = pytest.mark.slow

FLOODS = r"""
import socket, struct, sys, time
import zmq
from caviar_broker.event_loop import EventLoop
from caviar_broker.connections import Router
GREETING = b"\xff" + bytes(8) + b"\x7f" + b"\x03\x00" + b"NULL" + bytes(16) + b"\0" + bytes(31)
READY = b"\x04\x1c\x05READY\x0bSocket-Type\0\0\0\x06DEALER"
port, loop = Router("tcp://127.0.0.1:0", 60_000_000), EventLoop()  # a heartbeat every 20 ms
endpoint = port.endpoint
if len(sys.argv) > 2:
    port.socket.setsockopt(zmq.RCVHWM, int(sys.argv[2]))
    port.socket.bind("tcp://127.0.0.1:*")
    endpoint = port.socket.getsockopt_string(zmq.LAST_ENDPOINT)
port.guard.start(loop, lambda *_: False, lambda *_: None, lambda *_: None)
def answer(seconds):
    until = time.monotonic() + seconds
    while time.monotonic() < until:
        loop.call(loop.poll(1_000_000))
for number in range(int(sys.argv[1])):
    with socket.create_connection(("127.0.0.1", int(endpoint.rpartition(":")[2]))) as peer:
        peer.sendall(GREETING + READY)
        answer(0.01)
        peer.sendall(b"\0\x01\xc1" * 5000)
        answer(0.01)
        if number % 2:  # its end is a reset
            peer.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
    answer(0.06)
    for _ in range(10_000 if number % 3 else 0):
        port.receive()
port.close()
print("alive")
"""


def floods(*arguments: str) -> subprocess.CompletedProcess[str]:
    """In a process of its own, which may abort."""
    command = [sys.executable, "-c", FLOODS, *arguments]
    return subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)


def test_peers_that_send_more_than_is_read_and_go_do_not_end_the_broker() -> None:
    finished = floods("60")
    assert finished.stdout == "alive\n", finished.stderr


@pytest.mark.parametrize("queue", ["1000"])
def test_the_floods_do_abort_a_process_whose_queue_has_an_end(queue: str) -> None:
    """So that the test above is known to be one."""
    finished = floods("60", queue)
    assert "_io_error" in finished.stderr
