"""Lines for a reader that may be slow: the run never waits for whoever watches it."""

from __future__ import annotations

import json
import os
import select
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from caviar_broker.aside import Aside

MAX_PENDING = 1 << 18
"""[B] of lines kept in memory; what comes behind them is read back from the log."""
LOG_S = 0.1
"""[s] that is waited for the disk to take a line of the log."""
CHUNK = select.PIPE_BUF
"""[B] a pipe that polls as writable takes without blocking."""

Line = Mapping[str, Any]


class Outbox:
    """Writes events to a descriptor, as much as it takes, and all notices to a log file.

    The log holds every notice as one JSON line. When the descriptor is slow and more than
    `MAX_PENDING` are waiting, later notices go to the log alone and come from there, in their order,
    once there is room. So none is lost, and memory stays bounded.

    Parameters
    ----------
    fd
        Where lines go: a pipe, a terminal, a file.
    log
        The file for notices.
    render
        What a line looks like on ``fd``.
    """

    def __init__(self, fd: int, log: Path, render: Callable[[Line], str]) -> None:
        self._fd, self._render = fd, render
        self._log = log.open("a+b", buffering=0)
        self._size = self._log.seek(0, os.SEEK_END)
        self._aside = Aside()
        self._unlogged = bytearray()
        """Lines that wait for a disk that does not answer."""
        self._behind: int | None = None
        """Where in the log the notices begin that did not fit into memory; None: all did."""
        self._pending = bytearray()
        self._poll = select.poll()
        self._poll.register(fd, select.POLLOUT)
        self.gone = False
        """Whether nobody reads any more."""
        self.log_error = ""
        """Why the log cannot be written; empty while it can."""

    @property
    def waiting(self) -> bool:
        """Whether something has not been taken yet."""
        return bool(self._pending) or self._behind is not None

    def notice(self, line: Line) -> None:
        """Log a line, and pass it on."""
        start, logged = self._size, self._write_log(line)
        if self.gone:
            return
        if logged and (self._behind is not None or len(self._pending) > MAX_PENDING):
            self._behind = start if self._behind is None else self._behind
        else:
            self._pending += self._encode(line)
        self.flush()

    def event(self, line: Line) -> None:
        """Pass a line on that need not be logged; it may overtake notices that wait in the log."""
        self._pending += self._encode(line)
        self.flush()

    def passing(self, line: Line) -> None:
        """Pass a line on if there is room now; the next of its kind makes up for it."""
        if not self.waiting:
            self.event(line)

    def flush(self) -> None:
        """Write what the descriptor takes now."""
        while self.waiting and not self.gone:
            if not self._pending:
                self._read_back()
            elif self._poll.poll(0):
                self._write()
            else:
                return

    def finish(self, last: Line, within_s: float) -> None:
        """Write all that waits and then ``last``, but wait no longer than ``within_s``."""
        until = time.monotonic() + within_s
        while self.waiting and not self.gone and (left := until - time.monotonic()) > 0:
            self._poll.poll(left * 1000)
            self.flush()
        self._behind = None
        self._pending += self._encode(last)
        while self._pending and not self.gone and (left := until - time.monotonic()) > 0:
            self._poll.poll(left * 1000)
            self.flush()
        self.close()

    def close(self) -> None:
        """Close the log; the descriptor is its owner's."""
        if not self._aside.is_busy:
            self._log.close()

    def _encode(self, line: Line) -> bytes:
        return self._render(line).encode(errors="backslashreplace") + b"\n"

    def _write(self) -> None:
        try:
            taken = os.write(self._fd, self._pending[:CHUNK])
        except OSError:  # whoever read is gone: the log remains
            self.gone = True
            self._pending.clear()
            self._behind = None
        else:
            del self._pending[:taken]

    def _write_log(self, line: Line) -> bool:
        data = json.dumps(line, ensure_ascii=False).encode(errors="backslashreplace") + b"\n"
        if self._aside.is_busy:
            if len(self._unlogged) < MAX_PENDING:
                self._unlogged += data
            else:
                self.log_error = "the disk did not answer"
            return False
        data, self._unlogged = bytes(self._unlogged) + data, bytearray()
        try:
            in_time = self._aside.call(lambda: self._log.write(data), LOG_S)
        except OSError as error:
            self.log_error = error.strerror or str(error)
            return False
        self._size += len(data)
        return in_time

    def _read_back(self) -> None:
        """Take the next lines from the log into memory."""
        start = self._behind or 0
        data = os.pread(self._log.fileno(), MAX_PENDING, start)
        data = data[: data.rfind(b"\n") + 1]
        for line in data.splitlines():
            self._pending += self._encode(json.loads(line))
        start += len(data)
        self._behind = start if data and start < self._size else None
