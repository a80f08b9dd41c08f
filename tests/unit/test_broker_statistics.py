"""Figures of a run: percentiles, misses, and frames per second without the warm-up."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from caviar_broker.statistics import Statistics

MS = 1_000_000


def test_percentiles_and_misses_are_those_of_numpy() -> None:
    statistics = Statistics({"link": 20 * MS, "idle": MS})
    latencies = np.random.default_rng(1).integers(1, 50 * MS, 1000)
    for latency in latencies:
        statistics.latency("link", int(latency), bool(latency > 20 * MS))
    (name, figures), *others = statistics.services().items()
    assert (name, others) == ("link", [])
    assert figures.p50_ms == pytest.approx(float(np.percentile(latencies, 50)) / MS)
    assert figures.p99_ms == pytest.approx(float(np.percentile(latencies, 99)) / MS)
    assert figures.misses == statistics.misses == int((latencies > 20 * MS).sum())
    assert (figures.frames, figures.budget_ms) == (1000, 20.0)


def test_frames_per_second_leave_the_warm_up_out() -> None:
    statistics = Statistics({})
    assert statistics.frames_per_second() == 0.0
    now = 0
    for frame in range(101):
        now += 1000 * MS if frame < 10 else 10 * MS
        statistics.frame(now)
    assert statistics.warm_up_frames == 10
    assert statistics.frames_per_second() == pytest.approx(100.0)


def test_every_figure_is_saved(tmp_path: Path) -> None:
    statistics = Statistics({"file": MS, "idle": MS})
    statistics.latency("file", 5, False, 1, 2, 30)
    statistics.frame(7)
    statistics.decision(3)
    statistics.save(tmp_path / "latency.npz")
    with np.load(tmp_path / "latency.npz") as saved:
        assert {name: saved[name].tolist() for name in saved} == {
            "finished_ns": [7],
            "decision_lateness_ns": [3],
            "latency_ns/file": [5],
            "latency_ns/idle": [],
            "answers/file": [[1, 2, 30, 0, 5]],
            "answers/idle": [],
        }


def test_a_record_that_cannot_be_written_costs_nothing_else(tmp_path: Path) -> None:
    Statistics({}).save(tmp_path / "nowhere" / "latency.npz")
    assert not (tmp_path / "nowhere").exists()


def test_lateness_of_decisions_is_summed_up() -> None:
    statistics = Statistics({})
    assert statistics.deadlines().decisions == 0
    lateness = np.random.default_rng(2).integers(1, MS, 500)
    for value in lateness:
        statistics.decision(int(value))
    figures = statistics.deadlines()
    assert figures.decisions == 500
    assert figures.p99_ms == pytest.approx(float(np.percentile(lateness, 99)) / MS)
    assert figures.worst_ms == pytest.approx(int(lateness.max()) / MS)


def test_slips_are_counted_within_their_episode() -> None:
    """The lag that is reported with a frame is the sum of its episode."""
    statistics = Statistics({})
    for episode, lag in [(0, 0), (0, 3), (0, 3), (0, 10), (1, 12), (1, 12), (2, 0)]:
        statistics.frame(1, episode, lag * MS)
    pace = statistics.pace()
    assert (pace.slips, pace.worst_slip_ms, pace.lag_ms) == (3, 12.0, 22.0)
