"""How a broker process talks with whoever launched it, and with signals."""

from __future__ import annotations

import json
import os
import signal
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import zmq

from caviar_broker.core import events as ev
from caviar_broker.outbox import Line, Outbox
from caviar_broker.server import BrokerServer
from caviar_broker.statistics import Statistics
from caviar_protocol.messages import STOPPED_BY

FRAME_REPORT_S = 0.1
"""[s] between ``frame`` events at least."""
FINISH_S = 5.0
"""[s] that a slow reader gets for the last lines."""
MAX_ORDER = 1 << 16
"""[B] of an order."""


class Reporter:
    """Reports what happens: JSON lines to a launcher, words to a person, and notices to the log too."""

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
        """Report progress, not more often than somebody could read it."""
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
        """Report the outcome, behind everything else."""
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


class Control:
    """Orders of a launcher, from a descriptor; when that ends, so does the run."""

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
        self._rest = self._rest[-MAX_ORDER:]
        for line in lines:
            self._obey(line)

    def _obey(self, line: bytes) -> None:
        try:
            order = json.loads(line)
        except ValueError:
            order = None
        match order:
            case {"lost": str(service), "verdict": str(verdict)} if self._server.clock.peer(service):
                self._server.feed(ev.Lost(service, verdict))
            case {"restarted": str(service), "text": str(text)}:
                self._server.note(service, text, "restarted")
            case {"stop": str(reason)}:
                self._server.feed(ev.StopRequested(reason))
            case _:
                self._server.note("", f"the launcher gave an order that is none: {line[:200]!r}")


def stop_on_signals(server: BrokerServer) -> Callable[[], bool]:
    """SIGTERM and SIGINT end the run in order; whether one came can be asked."""
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
