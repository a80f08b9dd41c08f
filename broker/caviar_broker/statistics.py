"""Latency record of a run: per service and per frame, in constant memory a figure."""

from __future__ import annotations

from array import array
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from caviar_protocol.arrays import Int64Array


class ServiceStatistics(msgspec.Struct, frozen=True, kw_only=True):
    """Statistics of how a service kept its budget."""

    p50_ms: float
    p99_ms: float
    misses: int
    frames: int
    budget_ms: float


class RecentStatistics(msgspec.Struct, frozen=True, kw_only=True):
    """Statistics of how a service keeps its budget now."""

    p50_ms: float | None
    """Of the newest `RECENT` latencies; None: there is none yet."""
    p99_ms: float | None
    total_ms: float
    """Of all latencies."""
    grants_answered: int
    """How many these are."""
    misses: int
    budget_ms: float


RECENT = 512
"""Latencies behind figures that are asked for while the run goes on; few, since frames wait meanwhile."""


class DeadlineStatistics(msgspec.Struct, frozen=True, kw_only=True):
    """Statistics of how long after its deadline each decision was taken (clause 9)."""

    decisions: int
    p99_ms: float
    worst_ms: float


class PaceStatistics(msgspec.Struct, frozen=True, kw_only=True):
    """Statistics of the pace of a run (clause 8); no slips where it is free."""

    slips: int
    """Frames that were released later than they were due."""
    worst_slip_ms: float
    lag_ms: float
    """Sum of all slips."""


class Statistics:
    """Collects latencies [ns] and frame times, and sums them up.

    A frame costs 40 bytes a service and 8 for itself. A latency counts from the GRANT that is sent
    to the DONE that is received, or to the deadline where the frame went on without it.
    """

    def __init__(self, budgets_ns: dict[str, int]) -> None:
        self._budgets = budgets_ns
        # Arrays of machine integers: a list would take 32 B more a figure, in runs of millions of frames.
        self._latencies = {name: array("q") for name in budgets_ns}
        self._answers = {name: array("q") for name in budgets_ns}
        self._misses = dict.fromkeys(budgets_ns, 0)
        self._totals = dict.fromkeys(budgets_ns, 0)
        self._finished_at = array("q")
        self.earlier = 0
        """Frames that were finished before, under another broker."""
        self._lateness = array("q")
        self._slips = self._worst_slip = self._lag = 0
        self._lag_of_episode = (0, 0)

    def latency(
        self, service: str, elapsed_ns: int, missed: bool, episode: int = 0, frame: int = 0, now: int = 0
    ) -> None:
        """A grant was answered, or its deadline passed.

        Args:
            service: Which was granted.
            elapsed_ns: From GRANT to answer or deadline [ns].
            missed: Whether its budget was up.
            episode, frame: Of the grant.
            now: The time [ns].
        """
        self._latencies[service].append(elapsed_ns)
        self._answers[service].extend((episode, frame, now, missed))
        self._misses[service] += missed
        self._totals[service] += elapsed_ns

    def decision(self, lateness_ns: int) -> None:
        """A deadline passed, and that long after it the decision was taken."""
        self._lateness.append(lateness_ns)

    def frame(self, now: int, episode: int = 0, lag_ns: int = 0) -> None:
        """A frame is finished, in an episode that has slipped so far by ``lag_ns``.

        Args:
            now: The time [ns].
            episode: Of the frame.
            lag_ns: Sum of the episode's slips so far [ns].
        """
        self._finished_at.append(now)
        known, before = self._lag_of_episode
        # The lag is a sum over the episode, and begins at 0 with each.
        slip = lag_ns - before if episode == known else lag_ns
        self._lag_of_episode = episode, lag_ns
        if slip:
            self._slips += 1
            self._worst_slip = max(self._worst_slip, slip)
            self._lag += slip

    @property
    def frames(self) -> int:
        """Frames finished, over all episodes."""
        return len(self._finished_at)

    @property
    def finished_ns(self) -> Sequence[int]:
        """Instants at which frames were finished [ns], on the clock of `frame`."""
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
        # The first frames compile, load and fill caches: with them a short run would look slow.
        first = self.warm_up_frames
        if self.frames - first < 2:
            return 0.0
        # Between frames that are finished: neither start-up nor the time until the last BYE counts.
        elapsed = self._finished_at[-1] - self._finished_at[first]
        return (self.frames - 1 - first) / (elapsed / 1e9) if elapsed else 0.0

    def recent_rate(self, now: int) -> float:
        """Frames a second [1/s] over the newest `RECENT`, up to ``now`` [ns]; 0 if unknown."""
        count = min(RECENT, self.frames) - 1
        if count < 1:
            return 0.0
        return count / max(1, now - self._finished_at[-1 - count]) * 1e9

    def recent_services(self) -> dict[str, RecentStatistics]:
        """By service, in a time that does not depend on how long the run is."""
        found = {}
        for name, values in self._latencies.items():
            newest = sorted(values[-RECENT:])  # all of them would hold up the frames of a long run
            found[name] = RecentStatistics(
                p50_ms=_rank(newest, 0.50),
                p99_ms=_rank(newest, 0.99),
                total_ms=self._totals[name] / 1e6,
                grants_answered=len(values),
                misses=self._misses[name],
                budget_ms=self._budgets[name] / 1e6,
            )
        return found

    def deadlines(self) -> DeadlineStatistics:
        """Statistics of the decisions at deadlines."""
        lateness = np.asarray(self._lateness, np.int64)
        return DeadlineStatistics(
            decisions=len(lateness),
            p99_ms=float(np.percentile(lateness, 99)) / 1e6 if len(lateness) else 0.0,
            worst_ms=float(lateness.max(initial=0)) / 1e6,
        )

    def pace(self) -> PaceStatistics:
        """By how much frames slipped behind real time."""
        return PaceStatistics(slips=self._slips, worst_slip_ms=self._worst_slip / 1e6, lag_ms=self._lag / 1e6)

    def save(self, path: Path) -> None:
        """Write every figure as a NumPy archive: ``finished_ns`` by frame, ``latency_ns/NAME`` by grant,
        ``decision_lateness_ns`` by deadline that was missed; `answers` of each service, ``answers/NAME``.

        A disk that is full costs the record, not the run's result.
        """
        figures: dict[str, Any] = {"finished_ns": np.asarray(self._finished_at, np.int64)}
        figures["decision_lateness_ns"] = np.asarray(self._lateness, np.int64)
        figures |= {f"latency_ns/{n}": np.asarray(v, np.int64) for n, v in self._latencies.items()}
        figures |= {f"answers/{name}": self.answers(name) for name in self._answers}
        try:
            np.savez_compressed(path, **figures)
        except OSError:
            path.unlink(missing_ok=True)

    def granted(self, service: str) -> int:
        """Number of a service's grants that were answered, or overdue."""
        return len(self._latencies[service])

    def answers(self, service: str, first: int = 0) -> Int64Array:
        """Grants of a service in the order of their answers, from the ``first``-th on.

        Returns:
            Episode, frame, when it was answered [ns], 1 for a miss, latency [ns], Shape ``[grants, 5]``.
        """
        known = np.asarray(self._answers[service][4 * first :], np.int64).reshape(-1, 4)
        return np.column_stack([known, np.asarray(self._latencies[service][first:], np.int64)])

    def figures(self) -> dict[str, Any]:
        """The figures of the event ``finished``, as plain values."""
        return {
            "frames": self.frames + self.earlier,
            "frames_per_second": self.frames_per_second(),
            "warm_up_frames": self.warm_up_frames,
            "deadlines": msgspec.structs.asdict(self.deadlines()),
            "pace": msgspec.structs.asdict(self.pace()),
            "services": {name: msgspec.structs.asdict(found) for name, found in self.services().items()},
        }

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


def _rank(ascending: Sequence[int], share: float) -> float | None:
    """The value [ms] that so many of the others do not exceed."""
    if not ascending:
        return None
    return ascending[min(len(ascending) - 1, int(share * len(ascending)))] / 1e6
