"""A broker process and its launcher: the pipe between them, the console, the log of notices, signals."""

from __future__ import annotations

import json
import os
import queue
import select
import signal
import threading
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import zmq

from caviar_broker.core import events as ev
from caviar_broker.server import BrokerServer
from caviar_broker.statistics import Statistics
from caviar_protocol.files import open_to_append
from caviar_protocol.messages import STOPPED_BY

MAX_PENDING = 1 << 18
"""[B] of lines kept in memory; what comes after them is read back from the log."""
LOG_S = 0.1
"""[s] that is waited for the disk to take lines of the log."""
CHUNK = select.PIPE_BUF
"""[B] a pipe that polls as writable takes without blocking."""

Line = Mapping[str, Any]


class LogFile:
    """A file that a thread appends to, so that a disk that does not answer holds up no caller.

    Once lines could not be written, it takes no more: offsets of later ones would be wrong.

    Args:
        path: The file; it is made where it does not exist.

    Raises:
        RunError: The file cannot be opened.
    """

    def __init__(self, path: Path) -> None:
        self._file = open_to_append(path)
        self.size = self._file.seek(0, os.SEEK_END)
        """[B] of the file, with what is on its way."""
        # What has reached the file: between the two are the lines that the thread still has.
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
        """Reason why lines are missing; empty where none is. Waits `LOG_S` for those on their way."""
        self._wait_for(0)
        return self._error

    def put(self, data: bytes) -> bool:
        """Append lines. Waits `LOG_S` where too much is on its way.

        Args:
            data: Whole lines.

        Returns:
            Whether the file takes them.
        """
        if self.size - self._written > MAX_PENDING and not self._wait_for(MAX_PENDING):
            self._error = self._error or "the disk did not answer"
        if self._error:
            return False
        self.size += len(data)
        self._queue.put(data)
        return True

    def read(self, start: int) -> bytes:
        """Read whole lines from an offset on, as far as they are written."""
        # `pread` moves no offset, which the thread that appends would have to share.
        data = os.pread(self._file.fileno(), min(MAX_PENDING, self._written - start), start)
        return data[: data.rfind(b"\n") + 1]

    def wait(self, seconds: float) -> None:
        """Wait until more is written, but not longer than that [s]."""
        with self._progress:
            self._progress.wait(seconds)

    def close(self) -> None:
        """Close the file, once all is written or the disk has had `LOG_S` for it."""
        self._wait_for(0)
        self._queue.put(b"")
        # A thread in a write to a disk that hangs cannot be ended; it is a daemon and dies with the process.
        self._thread.join(LOG_S)
        if not self._thread.is_alive():
            self._file.close()

    def _wait_for(self, backlog: int) -> bool:
        with self._progress:
            return self._progress.wait_for(lambda: self.failed or self.size - self._written <= backlog, LOG_S)

    def _write_all(self) -> None:
        # No lock around the write: the lines are in the queue, and only this thread touches the file's end.
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

    Args:
        fd: Where lines go: a pipe, a terminal, a file.
        log: The file for notices.
        render: What a line looks like on ``fd``.
    """

    def __init__(self, fd: int, log: Path, render: Callable[[Line], str]) -> None:
        self._fd, self._render = fd, render
        self._log = LogFile(log)
        # Where in the log the notices begin that did not fit into memory; None: all did.
        self._behind: int | None = None
        self._pending = bytearray()
        self._poll = select.poll()
        self._poll.register(fd, select.POLLOUT)
        self.gone = False
        """Whether the reader has gone."""

    @property
    def log_error(self) -> str:
        """Reason why the log is incomplete; empty where it is not."""
        return self._log.error

    @property
    def waiting(self) -> bool:
        """Whether something has not been taken yet."""
        return bool(self._pending) or self._behind is not None

    def notice(self, line: Line) -> None:
        """Log a line, and pass it on."""
        # In the log first: from `start` on it can be read back, should the descriptor have no room.
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
        """Write what the descriptor takes now, without blocking."""
        while self.waiting and not self.gone:
            if not self._pending and not self._read_back():
                return
            # At most `CHUNK` after each poll: POSIX promises room for PIPE_BUF bytes and not for more.
            if self._poll.poll(0):
                try:
                    taken = os.write(self._fd, self._pending[:CHUNK])
                except OSError:  # the reader is gone: the log remains
                    self.gone = True
                    self._pending.clear()
                    self._behind = None
                else:
                    del self._pending[:taken]
            else:
                return

    def finish(self, last: Line, within_s: float) -> None:
        """Write all that waits and then a last line.

        Args:
            last: The last line.
            within_s: Time for that [s]; what is not taken then is lost here, and is in the log.
        """
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

    def _read_back(self) -> bool:
        """Take the next lines from the log into memory; False where the log does not have them yet."""
        start = self._behind or 0
        data = self._log.read(start)
        for line in data.splitlines():
            self._pending += self._encode(json.loads(line))
        start += len(data)
        self._behind = start if start < self._log.size and not self._log.failed else None
        return bool(self._pending)


FRAME_REPORT_S = 0.1
"""[s] between ``frame`` events at least."""
FINISH_S = 5.0
"""[s] that a slow reader gets for the last lines."""
MAX_ORDER = 1 << 16
"""[B] of an order."""


class Reporter:
    """Reports what happens: JSON lines to a launcher, words to a person, and notices to the log too.

    Args:
        fd: Where lines go.
        log: File for notices.
        control: Whether a launcher reads them.
    """

    def __init__(self, fd: int, log: Path, control: bool) -> None:
        self._control = control
        self._outbox = Outbox(fd, log, _json if control else _words)
        self._fd = fd
        self._server: BrokerServer | None = None
        self._last_frame = 0.0

    def attach(self, server: BrokerServer) -> None:
        """Let the server's loop see to lines that could not be written at once."""
        self._server = server

    def notice(self, notice: ev.Notice) -> None:
        """Report a notice; nothing late, dropped or overwritten goes unsaid."""
        fields = ("kind", "service", "episode", "frame", "text")
        self._outbox.notice({"event": "notice", **{field: getattr(notice, field) for field in fields}})
        self._see_to_the_rest()

    def frame(self, frame: ev.FrameFinished, statistics: Statistics) -> None:
        """Report progress, not more often than a person could read it."""
        now = time.monotonic()
        if self._control and now - self._last_frame >= FRAME_REPORT_S:
            self._last_frame = now
            frames = statistics.frames + statistics.earlier
            line = {"episode": frame.episode, "frames": frames, "misses": statistics.misses}
            self._outbox.passing({"event": "frame", **line})
            self._see_to_the_rest()

    def listening(self, endpoint: str) -> None:
        """Report the address."""
        self._outbox.event({"event": "listening", "endpoint": endpoint})
        self._see_to_the_rest()

    def finished(self, **values: Any) -> None:
        """Report the outcome, after everything else."""
        if self._outbox.log_error:
            text = f"the log of notices is incomplete: {self._outbox.log_error}"
            self._outbox.event({"event": "notice", "kind": "note", "service": "", "frame": -1, "text": text})
        self._outbox.finish({"event": "finished", **values}, FINISH_S)

    def _see_to_the_rest(self) -> None:
        if self._outbox.waiting and self._server is not None:
            self._server.loop.watch(self._fd, self._writable, zmq.POLLOUT)

    def _writable(self) -> None:
        self._outbox.flush()
        if self._server is not None and not self._outbox.waiting:
            self._server.loop.unwatch(self._fd)


def _json(line: Line) -> str:
    return json.dumps(line, ensure_ascii=False)


def _words(line: Line) -> str:
    match line["event"]:
        case "notice":
            where = f" frame {line['frame']}" if line["frame"] >= 0 else ""
            who = f"{line['service']}{where}: " if line["service"] or where else ""
            return f"{line['kind']}: {who}{line['text']}"
        case "listening":
            return f"listening on {line['endpoint']}"
        case _:
            return (
                f"{line['frames']} frames, digest {line['digest']}" if line["frames"] else "no frame was run"
            )


class LauncherPipe:
    """Orders of a launcher, from a descriptor; when that ends, so does the run.

    Args:
        server: The broker.
        fd: Where requests come from.
    """

    def __init__(self, server: BrokerServer, fd: int = 0) -> None:
        self._server, self._fd, self._rest = server, fd, b""
        server.loop.watch(fd, self._read)

    def _read(self) -> None:
        data = os.read(self._fd, MAX_ORDER)
        if not data:
            self._server.loop.unwatch(self._fd)
            self._server.feed(ev.StopRequested("the launcher of the run ended"))
            return
        *lines, self._rest = (self._rest + data).split(b"\n")
        # A launcher that never ends a line must not fill the memory.
        self._rest = self._rest[-MAX_ORDER:]
        for line in lines:
            try:
                order = json.loads(line)
            except ValueError:
                order = None
            match order:
                case {"lost": str(service), "verdict": str(verdict)} if self._server.clock.member(service):
                    self._server.feed(ev.Lost(service, verdict))
                case {"restarted": str(service), "text": str(text)}:
                    self._server.note(service, text, "restarted")
                case {"stop": str(reason)}:
                    self._server.feed(ev.StopRequested(reason))
                case _:
                    self._server.note("", f"the launcher gave an order that is none: {line[:200]!r}")


def stop_on_signals(server: BrokerServer) -> Callable[[], bool]:
    """Have SIGTERM and SIGINT end the run in order; the function that is returned says whether one came."""
    # A handler of Python runs between two bytecodes of any call: instead the signal's number is written to a
    # pipe, which the loop reads in its turn.
    came: list[int] = []
    read, write = os.pipe2(os.O_NONBLOCK | os.O_CLOEXEC)
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda *_: None)
    signal.set_wakeup_fd(write, warn_on_full_buffer=False)

    def stop() -> None:
        for number in os.read(read, 64):
            came.append(number)
            server.feed(ev.StopRequested(f"{STOPPED_BY} {signal.Signals(number).name}"))

    server.loop.watch(read, stop)
    return lambda: bool(came)
