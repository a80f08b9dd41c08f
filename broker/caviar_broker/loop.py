"""Descriptors and sockets that a broker waits for, and whom to call about them."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import zmq

Source = int | zmq.Socket[Any]
"""A file descriptor or a ZeroMQ socket."""


class Loop:
    """Calls back when something can be read or written."""

    def __init__(self) -> None:
        self._poller = zmq.Poller()
        self._callbacks: dict[Source, Callable[[], None]] = {}

    def watch(self, source: Source, callback: Callable[[], None], events: int = zmq.POLLIN) -> None:
        """Call back when ``source`` is readable, or as ``events`` say."""
        if self._callbacks.get(source) != callback:
            self._callbacks[source] = callback
            self._poller.register(source, events)

    def unwatch(self, source: Source) -> None:
        """Undo `watch`; nothing where it was not watched."""
        if self._callbacks.pop(source, None) is not None:
            self._poller.unregister(source)

    def poll(self, wait_ns: int = 0) -> list[Source]:
        """What is ready, after at most that long [ns]."""
        return [source for source, _ in self._poller.poll(-(-max(0, wait_ns) // 1_000_000))]

    def call(self, ready: list[Source]) -> None:
        """Call back for what `poll` returned, unless it is not watched any more."""
        for source in ready:
            callback = self._callbacks.get(source)
            if callback is not None:
                callback()
