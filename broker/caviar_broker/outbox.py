"""Lines for a reader that may be slow: the run never waits for whoever watches it."""

from __future__ import annotations

import json
import os
import queue
import select
import threading
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from caviar_protocol.files import open_to_append

MAX_PENDING = 1 << 18
"""[B] of lines kept in memory; what comes behind them is read back from the log."""
LOG_S = 0.1
"""[s] that is waited for the disk to take lines of the log."""
CHUNK = select.PIPE_BUF
"""[B] a pipe that polls as writable takes without blocking."""

Line = Mapping[str, Any]


class LogFile:
    """A file that a thread appends to, so that a disk that does not answer holds up no caller.

    Once lines could not be written, it takes no more: offsets of later ones would be wrong.
    Raises `RunError` naming the file where it cannot be opened.
    """

    def __init__(self, path: Path) -> None:
        self._file = open_to_append(path)
        self.size = self._file.seek(0, os.SEEK_END)
        """[B] of the file, with what is on its way."""
        self._written = self.size
        self._error = ""
        self._queue: queue.SimpleQueue[bytes] = queue.SimpleQueue()
        self._progress = threading.Condition()
        self._thread = threading.Thread(target=self._write_all, name="log", daemon=True)
        self._thread.start()

    @property
    def failed(self) -> bool:
        """Whether it takes no more lines."""
        return bool(self._error)

    @property
    def error(self) -> str:
        """Why lines are missing; empty where none is. Waits `LOG_S` for those on their way."""
        self._wait_for(0)
        return self._error

    def put(self, data: bytes) -> bool:
        """Append lines; whether the file takes them. Waits `LOG_S` where too much is on its way."""
        if self.size - self._written > MAX_PENDING and not self._wait_for(MAX_PENDING):
            self._error = self._error or "the disk did not answer"
        if self._error:
            return False
        self.size += len(data)
        self._queue.put(data)
        return True

    def read(self, start: int) -> bytes:
        """Whole lines from an offset on, as far as they are written."""
        data = os.pread(self._file.fileno(), min(MAX_PENDING, self._written - start), start)
        return data[: data.rfind(b"\n") + 1]

    def wait(self, seconds: float) -> None:
        """Until more is written, but not longer than that [s]."""
        with self._progress:
            self._progress.wait(seconds)

    def close(self) -> None:
        """Close the file, once all is written or the disk has had `LOG_S` for it."""
        self._wait_for(0)
        self._queue.put(b"")
        self._thread.join(LOG_S)
        if not self._thread.is_alive():
            self._file.close()

    def _wait_for(self, backlog: int) -> bool:
        with self._progress:
            return self._progress.wait_for(lambda: self.failed or self.size - self._written <= backlog, LOG_S)

    def _write_all(self) -> None:
        while data := self._queue.get():
            left = memoryview(data)
            try:
                while left:
                    left = left[os.write(self._file.fileno(), left) :]
            except OSError as error:
                self._error = error.strerror or str(error)
            with self._progress:
                self._written += len(data) - len(left)
                self._progress.notify_all()


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
        self._log = LogFile(log)
        self._behind: int | None = None
        """Where in the log the notices begin that did not fit into memory; None: all did."""
        self._pending = bytearray()
        self._poll = select.poll()
        self._poll.register(fd, select.POLLOUT)
        self.gone = False
        """Whether nobody reads any more."""

    @property
    def log_error(self) -> str:
        """Why the log is incomplete; empty where it is not."""
        return self._log.error

    @property
    def waiting(self) -> bool:
        """Whether something has not been taken yet."""
        return bool(self._pending) or self._behind is not None

    def notice(self, line: Line) -> None:
        """Log a line, and pass it on."""
        start = self._log.size
        logged = self._log.put(json.dumps(line, ensure_ascii=False).encode(errors="backslashreplace") + b"\n")
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
            if not self._pending and not self._read_back():
                return
            if self._poll.poll(0):
                self._write()
            else:
                return

    def finish(self, last: Line, within_s: float) -> None:
        """Write all that waits and then ``last``, but wait no longer than ``within_s``."""
        until = time.monotonic() + within_s
        while self.waiting and not self.gone and (left := until - time.monotonic()) > 0:
            if self._pending:
                self._poll.poll(left * 1000)
            else:
                self._log.wait(min(left, LOG_S))
            self.flush()
        self._behind = None
        self._pending += self._encode(last)
        while self._pending and not self.gone and (left := until - time.monotonic()) > 0:
            self._poll.poll(left * 1000)
            self.flush()
        self.close()

    def close(self) -> None:
        """Close the log; the descriptor is its owner's."""
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

    def _read_back(self) -> bool:
        """Take the next lines from the log into memory; False where the log does not have them yet."""
        start = self._behind or 0
        data = self._log.read(start)
        for line in data.splitlines():
            self._pending += self._encode(json.loads(line))
        start += len(data)
        self._behind = start if start < self._log.size and not self._log.failed else None
        return bool(self._pending)
