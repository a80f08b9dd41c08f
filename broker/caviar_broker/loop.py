"""Descriptors and sockets that a broker waits for, and whom to call about them."""

from __future__ import annotations

import select
import time
from collections.abc import Callable
from typing import Any

import zmq

Source = int | zmq.Socket[Any]
"""A file descriptor or a ZeroMQ socket."""


COARSE_NS = 1_000_000
"""[ns] The poller counts whole milliseconds, and may take one more than it was told."""
_EVENTS = int(zmq.EVENTS)
_POLLIN = int(zmq.POLLIN)
SELECTABLE = 1024
"""Descriptors from here on are nothing for ``select``."""


class Loop:
    """Calls back when something can be read or written.

    Waits end on time to within some 0.1 ms: the poller, which knows whole milliseconds only, is left two of
    them early, and the rest is waited for on the sockets alone. Other descriptors are late by that at most.
    """

    def __init__(self) -> None:
        self._poller = zmq.Poller()
        self._sockets: dict[int, zmq.Socket[Any]] = {}
        self._callbacks: dict[Source, Callable[[], None]] = {}
        self._prompt: set[int] = set()
        self._polls = 0

    def watch(
        self,
        source: Source,
        callback: Callable[[], None],
        events: int = zmq.POLLIN,
        *,
        prompt: bool = False,
    ) -> None:
        """Call back when ``source`` is readable, or as ``events`` say.

        A descriptor that is ``prompt`` is waited for with the sockets.
        """
        if self._callbacks.get(source) != callback:
            self._callbacks[source] = callback
            self._poller.register(source, events)
            if isinstance(source, zmq.Socket) and events == zmq.POLLIN:
                fd = int(source.getsockopt(zmq.FD))
                self._sockets |= {fd: source} if fd < SELECTABLE else {}
            elif prompt and isinstance(source, int) and source < SELECTABLE:
                self._prompt.add(source)

    def unwatch(self, source: Source) -> None:
        """Undo `watch`; nothing where it was not watched."""
        if self._callbacks.pop(source, None) is not None:
            self._poller.unregister(source)
            self._sockets = {fd: socket for fd, socket in self._sockets.items() if socket is not source}
            self._prompt -= {fd for fd in self._prompt if fd == source}

    def poll(self, wait_ns: int = 0) -> list[Source]:
        """What is ready, after at most that long [ns]."""
        self._polls += 1
        until = time.monotonic_ns() + wait_ns
        ready = [source for source, _ in self._poller.poll(max(0, wait_ns // COARSE_NS - 1))]
        return ready if ready or wait_ns <= 0 else self.poll_sockets(until)

    def poll_sockets(self, until: int) -> list[Source]:
        """Which sockets and prompt descriptors can be read, until that instant [ns] at the latest."""
        while True:
            # Asked before it is waited for: only then does a socket's descriptor tell of what comes.
            ready: list[Source] = [s for s in self._sockets.values() if int(s.getsockopt(_EVENTS)) & _POLLIN]
            rest = until - time.monotonic_ns()
            if ready or rest <= 0:
                return ready
            readable, _, _ = select.select([*self._sockets, *self._prompt], (), (), rest / 1e9)
            if found := self._prompt.intersection(readable):
                return [*found]

    def call(self, ready: list[Source]) -> None:
        """Call back for what `poll` returned, unless it is not watched any more.

        Where another thread polls while one of the callbacks waits, the others are its to call.
        """
        polls = self._polls
        for source in ready:
            if self._polls != polls:
                return
            callback = self._callbacks.get(source)
            if callback is not None:
                callback()
