"""Latency record of a run: per service and per frame, in constant memory a figure."""

from __future__ import annotations

from array import array
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import msgspec
import numpy as np


class ServiceStatistics(msgspec.Struct, frozen=True, kw_only=True):
    """How a service kept its budget."""

    p50_ms: float
    p99_ms: float
    misses: int
    frames: int
    budget_ms: float


class Statistics:
    """Collects latencies [ns] and frame times, and sums them up.

    A frame costs 8 bytes a service and 8 for itself. A latency counts from the GRANT that is sent
    to the DONE that is received, or to the deadline where the frame went on without it.
    """

    def __init__(self, budgets_ns: dict[str, int]) -> None:
        self._budgets = budgets_ns
        self._latencies = {name: array("q") for name in budgets_ns}
        self._misses = dict.fromkeys(budgets_ns, 0)
        self._finished_at = array("q")
        self.earlier = 0
        """Frames that were finished before, under another broker."""

    def latency(self, service: str, elapsed_ns: int, missed: bool) -> None:
        """A grant was answered, or its deadline passed."""
        self._latencies[service].append(elapsed_ns)
        self._misses[service] += missed

    def frame(self, now: int) -> None:
        """A frame is finished."""
        self._finished_at.append(now)

    @property
    def frames(self) -> int:
        """Frames finished, over all episodes."""
        return len(self._finished_at)

    @property
    def finished_ns(self) -> Sequence[int]:
        """When each frame was finished [ns], on the clock of `frame`."""
        return self._finished_at

    @property
    def misses(self) -> int:
        """Misses of all services."""
        return sum(self._misses.values())

    @property
    def warm_up_frames(self) -> int:
        """Frames left out of `frames_per_second`: a tenth of them, at most ten."""
        return min(10, self.frames // 10)

    def frames_per_second(self) -> float:
        """Finished frames a second of wall time, after the warm-up frames [1/s]; 0 if unknown."""
        first = self.warm_up_frames
        if self.frames - first < 2:
            return 0.0
        elapsed = self._finished_at[-1] - self._finished_at[first]
        return (self.frames - 1 - first) / (elapsed / 1e9) if elapsed else 0.0

    def save(self, path: Path) -> None:
        """Write every figure as a NumPy archive: ``finished_ns`` by frame, ``latency_ns/NAME`` by grant.

        A disk that is full costs the record, not the run's result.
        """
        figures: dict[str, Any] = {"finished_ns": np.asarray(self._finished_at, np.int64)}
        figures |= {f"latency_ns/{n}": np.asarray(v, np.int64) for n, v in self._latencies.items()}
        try:
            np.savez_compressed(path, **figures)
        except OSError:
            path.unlink(missing_ok=True)

    def services(self) -> dict[str, ServiceStatistics]:
        """Summary by service; a service that was never granted a frame has none."""
        return {
            name: ServiceStatistics(
                p50_ms=float(np.percentile(values, 50)) / 1e6,
                p99_ms=float(np.percentile(values, 99)) / 1e6,
                misses=self._misses[name],
                frames=len(values),
                budget_ms=self._budgets[name] / 1e6,
            )
            for name, values in self._latencies.items()
            if len(values)
        }
