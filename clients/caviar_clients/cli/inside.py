"""`caviar run --embedded`: everything in this process, told like a run of many."""

from __future__ import annotations

import json
import time
from collections import deque
from collections.abc import Iterator, Mapping
from contextlib import closing
from pathlib import Path
from typing import Any

import msgspec

from caviar_broker.core import events as ev
from caviar_clients.embedded.run import EmbeddedRun
from caviar_protocol.errors import RunError
from caviar_protocol.run_directory import RunDirectory
from caviar_protocol.scenario import Scenario

REPORT_S = 0.1
"""[s] between ``frame`` events at least."""


class EmbeddedLauncher:
    """Has the interface of `caviar_clients.cli.launch.Launcher`, without processes."""

    def __init__(self, scenario: Scenario, directory: Path) -> None:
        self._directory = directory
        self._told: deque[dict[str, Any]] = deque()
        self._told_frame = 0.0
        self._log_error = ""
        self._run = EmbeddedRun(scenario, directory, self._notice, self._frame)

    def __enter__(self) -> EmbeddedLauncher:
        return self

    def __exit__(self, *_: object) -> None:
        """Nothing is left: whoever leaves the loop over `events` ends the run."""

    def events(self) -> Iterator[Mapping[str, Any]]:
        """What happens, until the run is over."""
        with closing(self._run.steps()) as steps:
            for _ in steps:
                while self._told:
                    event = self._told.popleft()
                    if event["event"] == "notice":
                        self._log(event)
                    yield event
        outcome, statistics = self._run.outcome, self._run.statistics
        if outcome is None:
            raise RunError("the run ended without an outcome")
        statistics.save(self._directory / "latency.npz")
        if self._log_error:
            text = f"the log of notices is incomplete: {self._log_error}"
            yield {"event": "notice", "kind": "note", "service": "", "frame": -1, "text": text}
        yield {
            "event": "finished",
            "error": outcome.error,
            "culprit": outcome.culprit,
            "digest": outcome.digest,
            "frames": statistics.frames,
            "frames_per_second": statistics.frames_per_second(),
            "warm_up_frames": statistics.warm_up_frames,
            "deadlines": msgspec.structs.asdict(statistics.deadlines()),
            "pace": msgspec.structs.asdict(statistics.pace()),
            "services": {n: msgspec.structs.asdict(s) for n, s in statistics.services().items()},
        }

    def stop(self, reason: str) -> None:
        """Ask for an orderly end."""
        self._run.stop(reason)

    def log_of(self, service: str) -> Path | None:
        """Services have no logs of their own here."""
        return None

    def _log(self, event: Mapping[str, Any]) -> None:
        """Keep a notice; a disk that is full costs the log, not the run."""
        try:
            with RunDirectory(self._directory).events.open("a", encoding="utf-8") as log:
                log.write(json.dumps(event, ensure_ascii=False) + "\n")
        except OSError as error:
            self._log_error = self._log_error or str(error)

    def _notice(self, notice: ev.Notice) -> None:
        fields = ("kind", "service", "episode", "frame", "text")
        self._told.append({"event": "notice", **{field: getattr(notice, field) for field in fields}})

    def _frame(self, frame: ev.FrameFinished) -> None:
        now = time.monotonic()
        if now - self._told_frame >= REPORT_S:
            self._told_frame = now
            frames = self._run.statistics.frames
            self._told.append({"event": "frame", "episode": frame.episode, "frames": frames, "misses": 0})
