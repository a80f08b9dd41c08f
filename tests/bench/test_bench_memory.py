"""A run of some thousand frames does not make the broker or a service grow."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from bench_memory import Growth, measure

from caviar_protocol.scenario import find_scenario


def test_the_slope_is_that_of_the_last_frames() -> None:
    """Growth at the start does not count, growth at the end does."""
    finished_ns = np.arange(1000, dtype=np.int64) * 1_000_000
    instants = [int(ns) + 1 for ns in finished_ns]
    steps = [frame if frame < 150 else 150 for frame in range(1000)]
    assert Growth("flat", instants, steps).slope(finished_ns) == pytest.approx(0.0)
    steps = [3 * frame for frame in range(1000)]
    assert Growth("steep", instants, steps).slope(finished_ns) == pytest.approx(3.0)


@pytest.mark.exhaustive
def test_smoke_grows_by_less_than_a_kilobyte_a_frame(tmp_path: Path) -> None:
    measured = measure(find_scenario("smoke"), 3000, ["channel"], tmp_path)
    assert len(measured.finished_ns) == 3000
    slopes = measured.slopes()
    assert slopes["broker"] < 1.0
    assert slopes["channel"] < 1.0
