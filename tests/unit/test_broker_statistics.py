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
        statistics.latency("link", int(latency), latency > 20 * MS)
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
    statistics.latency("file", 5, False)
    statistics.frame(7)
    statistics.save(tmp_path / "latency.npz")
    with np.load(tmp_path / "latency.npz") as saved:
        assert {name: saved[name].tolist() for name in saved} == {
            "finished_ns": [7],
            "latency_ns/file": [5],
            "latency_ns/idle": [],
        }


def test_a_record_that_cannot_be_written_costs_nothing_else(tmp_path: Path) -> None:
    Statistics({}).save(tmp_path / "nowhere" / "latency.npz")
    assert not (tmp_path / "nowhere").exists()
