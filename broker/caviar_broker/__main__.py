"""The broker as a process: ``python -m caviar_broker SCENARIO --bind URL --directory DIR``.

With ``--control`` a launcher talks to it in JSON lines. On standard output come ``listening``,
``notice``, ``frame`` and ``finished`` events; on standard input it takes
``{"lost": SERVICE, "verdict": TEXT}`` and ``{"stop": REASON}``. When the input ends, the run does.
"""

from __future__ import annotations

import argparse
import json
import os
import signal
import sys
import time
from pathlib import Path
from typing import Any, TextIO

import msgspec

from caviar_broker.briefing import briefings, with_ownership
from caviar_broker.core import events as ev
from caviar_broker.core.plan import plan_run
from caviar_broker.journal import JournalFile
from caviar_broker.server import BrokerServer
from caviar_broker.statistics import Statistics
from caviar_protocol.errors import CaviarError
from caviar_protocol.scenario_checks import with_overrides
from caviar_protocol.scenario_loader import load_scenario

FRAME_REPORT_S = 0.1
"""[s] between ``frame`` events at least."""


class Reporter:
    """Writes what happens as JSON lines, to the run's log and to whoever launched the broker."""

    def __init__(self, log: TextIO, out: TextIO, control: bool) -> None:
        self._log, self._out, self._control = log, out, control
        self._last_frame = 0.0

    def notice(self, notice: ev.Notice) -> None:
        """Log a notice; nothing late, dropped or overwritten goes unsaid."""
        line = json.dumps(
            {
                "event": "notice",
                "kind": notice.kind,
                "service": notice.service,
                "episode": notice.episode,
                "frame": notice.frame,
                "text": notice.text,
            },
            ensure_ascii=False,
        )
        self._log.write(line + "\n")
        self._log.flush()
        if self._control:
            self.tell(line)
        else:
            where = f" frame {notice.frame}" if notice.frame >= 0 else ""
            self.tell(f"{notice.kind}: {notice.service}{where}: {notice.text}")

    def frame(self, frame: ev.FrameFinished, statistics: Statistics) -> None:
        """Report progress, not more often than somebody could read it."""
        now = time.monotonic()
        if self._control and now - self._last_frame >= FRAME_REPORT_S:
            self._last_frame = now
            self.event("frame", episode=frame.episode, frames=statistics.frames, misses=statistics.misses)

    def event(self, event: str, **values: Any) -> None:
        """Report something to a launcher, or in words to a person."""
        if self._control:
            self.tell(json.dumps({"event": event, **values}, ensure_ascii=False))
        elif event == "listening":
            self.tell(f"listening on {values['endpoint']}")
        elif event == "finished":
            self.tell(f"run digest {values['digest']}, {values['frames']} frames")

    def tell(self, line: str) -> None:
        """Write one line; a launcher that is gone does not stop the broker from ending in order."""
        try:
            self._out.write(line + "\n")
            self._out.flush()
        except BrokenPipeError:
            self._out = self._log


class Control:
    """Orders of a launcher, from standard input."""

    def __init__(self, server: BrokerServer) -> None:
        self._server, self._rest = server, b""
        server.watch_fd(0, self._read)

    def _read(self) -> None:
        data = os.read(0, 65536)
        if not data:
            self._server.unwatch_fd(0)
            self._server.feed(ev.StopRequested("the launcher of the run ended"))
            return
        *lines, self._rest = (self._rest + data).split(b"\n")
        for line in lines:
            order = json.loads(line)
            if "lost" in order:
                self._server.feed(ev.Lost(order["lost"], order["verdict"]))
            else:
                self._server.feed(ev.StopRequested(order["stop"]))


def serve(arguments: argparse.Namespace) -> int:
    """Run the broker; the exit status: 0 exactly if the run came to its end."""
    scenario = load_scenario(arguments.scenario)
    scenario = with_ownership(with_overrides(scenario, arguments.frames, arguments.seed))
    directory = arguments.directory.resolve()
    directory.mkdir(parents=True, exist_ok=True)
    run = arguments.run or directory.name
    plan = plan_run(scenario, run, briefings(scenario, directory))
    journal = JournalFile(directory / "journal.msgpack", plan.epoch)
    with (directory / "events.jsonl").open("a") as log:
        reporter = Reporter(log, sys.stdout, arguments.control)
        server = BrokerServer(plan, arguments.bind, journal, reporter)
        if arguments.control:
            server.unwatched.update(arguments.supervised)
            Control(server)
        _stop_on_signals(server)
        reporter.event("listening", endpoint=server.endpoint)
        outcome = server.run()
        journal.close()
        statistics = server.statistics
        reporter.event(
            "finished",
            error=outcome.error,
            culprit=outcome.culprit,
            digest=outcome.digest,
            frames=statistics.frames,
            frames_per_second=statistics.frames_per_second(),
            warm_up_frames=statistics.warm_up_frames,
            services={n: msgspec.structs.asdict(s) for n, s in statistics.services().items()},
        )
    if outcome.error and not arguments.control:
        sys.stderr.write(f"caviar broker: {outcome.error}\n")
    return 1 if outcome.error else 0


def _stop_on_signals(server: BrokerServer) -> None:
    read, write = os.pipe2(os.O_NONBLOCK | os.O_CLOEXEC)
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda *_: None)
    signal.set_wakeup_fd(write, warn_on_full_buffer=False)

    def stop() -> None:
        name = signal.Signals(os.read(read, 1)[0]).name
        server.feed(ev.StopRequested(f"stopped by {name}"))

    server.watch_fd(read, stop)


def parser() -> argparse.ArgumentParser:
    """Command line of the broker."""
    found = argparse.ArgumentParser(prog="python -m caviar_broker", description=__doc__)
    found.add_argument("scenario", type=Path)
    found.add_argument("--bind", default="tcp://127.0.0.1:5570", help="address to listen on")
    found.add_argument("--directory", type=Path, required=True, help="where the run is written")
    found.add_argument("--run", default="", help="id of the run; by default the directory's name")
    found.add_argument("--frames", type=int, default=None, help="instead of the scenario's")
    found.add_argument("--seed", type=int, default=None, help="instead of the scenario's")
    found.add_argument("--control", action="store_true", help="talk JSON lines with a launcher")
    found.add_argument("--supervised", nargs="*", default=[], help="services the launcher watches itself")
    return found


def main() -> int:
    """Parse the command line and serve; the exit status."""
    try:
        return serve(parser().parse_args())
    except CaviarError as error:
        sys.stderr.write(f"caviar broker: {error}\n")
        return 1


if __name__ == "__main__":
    sys.exit(main())
