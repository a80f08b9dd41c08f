"""A relay of TCP connections that behaves like a long way: delay, and segments that are lost now and then.

TCP sends a lost segment again after its retransmission timeout, and holds back what follows it. So a loss is
a pause of a whole direction, which the relay makes without privileges, where the kernel has no ``netem``.
"""

from __future__ import annotations

import socket
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from queue import SimpleQueue
from random import Random

RETRANSMISSION_S = 0.2
"""Least retransmission timeout of Linux."""
SEGMENT_BYTES = 1448


class Relay:
    """Relays connections from a port of this machine to another address, until `close`.

    Args:
        host, port: Where to.
        delay_s: Of each direction [s].
        loss: Probability that a segment is lost.
        seed: Of the losses.
    """

    def __init__(self, host: str, port: int, delay_s: float, loss: float, seed: int = 1) -> None:
        self._to, self._delay, self._loss, self._random = (host, port), delay_s, loss, Random(seed)
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.port = int(self._listener.getsockname()[1])
        """Where it listens, of this machine."""
        self.lost = 0
        """Segments so far."""
        self._sockets, self._threads = [self._listener], list[threading.Thread]()
        self._start(self._accept)

    def _start(self, target: object, *arguments: object) -> None:
        self._threads.append(threading.Thread(target=target, args=arguments, daemon=True))  # type: ignore[arg-type]
        self._threads[-1].start()

    def _accept(self) -> None:
        with suppress(OSError):  # it is closed
            while True:
                here, _ = self._listener.accept()
                there = socket.create_connection(self._to)
                self._sockets += [here, there]
                for source, target in ((here, there), (there, here)):
                    source.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
                    under_way: SimpleQueue[tuple[float, bytes]] = SimpleQueue()
                    self._start(self._receive, source, under_way)
                    self._start(self._deliver, under_way, target)

    def _receive(self, source: socket.socket, under_way: SimpleQueue[tuple[float, bytes]]) -> None:
        free, data = 0.0, b"-"
        while data:
            try:
                data = source.recv(SEGMENT_BYTES)
            except OSError:
                data = b""
            free = max(free, time.monotonic())  # in order: what follows a lost segment waits for it
            if self._random.random() < self._loss:
                self.lost += 1
                free += RETRANSMISSION_S
            under_way.put((free + self._delay, data))

    def _deliver(self, under_way: SimpleQueue[tuple[float, bytes]], target: socket.socket) -> None:
        with suppress(OSError):
            while True:
                due, data = under_way.get()
                time.sleep(max(0.0, due - time.monotonic()))
                if not data:
                    target.shutdown(socket.SHUT_RDWR)
                    return
                target.sendall(data)

    def close(self) -> None:
        """End all connections."""
        for known in self._sockets:
            with suppress(OSError):
                known.shutdown(socket.SHUT_RDWR)
        for thread in self._threads:
            thread.join(10)
        for known in self._sockets:
            known.close()


@contextmanager
def relayed(host: str, port: int, delay_s: float, loss: float) -> Iterator[Relay]:
    """A relay for a block."""
    relay = Relay(host, port, delay_s, loss)
    try:
        yield relay
    finally:
        relay.close()
