"""The cost model learns from durations that it is given; nothing here is timed."""

from __future__ import annotations

import numpy as np
import pytest

from caviar_services.channel.adaptive.controller import CostModel, Workload

pytestmark = pytest.mark.slow

MS = 1_000_000
WORK = Workload(pairs=10, objects=0)


def model(*timings_ms: float, quantile: float = 0.95) -> CostModel:
    """Rungs that took so long with 10 pairs, with a little scatter."""
    timings = [[round(t * f * MS) for f in (0.98, 1.0, 1.02)] for t in timings_ms]
    return CostModel(timings, WORK, quantile=quantile)


def in_ms(costs: CostModel, work: Workload = WORK) -> list[float]:
    return [predicted / MS for predicted in costs.predict(work)]


def test_before_the_first_frame_predictions_are_the_timings_and_some_scatter() -> None:
    """A p95 of 15 % scatter is 28 % more than the median."""
    low, high = in_ms(model(10, 100))
    assert low == pytest.approx(12.8, rel=0.05)
    assert high / low == pytest.approx(10)


def test_one_slow_frame_moves_predictions_little_and_two_do() -> None:
    costs = model(10, 100)
    for _ in range(20):
        costs.observe(0, WORK, 10 * MS)
    before = in_ms(costs)[1]
    costs.observe(0, WORK, 50 * MS)
    assert in_ms(costs)[1] < 1.4 * before
    costs.observe(0, WORK, 50 * MS)
    assert in_ms(costs)[0] > 40
    assert in_ms(costs)[1] > 250


def test_persistent_load_shifts_all_rungs_and_goes_again() -> None:
    """Only the low rung runs; the high one is judged by how busy the machine is. Three frames suffice."""
    for times, frames in ((3, 40), (100, 10), (0.2, 40)):
        costs = model(10, 100)
        for _ in range(20):
            costs.observe(0, WORK, 10 * MS)
        for frame in range(frames):
            costs.observe(0, WORK, round(10 * times * MS))
            if frame >= 2:
                assert in_ms(costs) == pytest.approx([10 * times, 100 * times], rel=0.5)
        for frame in range(20):
            costs.observe(0, WORK, 10 * MS)
            if frame >= 2:
                assert in_ms(costs) == pytest.approx([10, 100], rel=0.6)


def test_the_stated_quantile_bounds_as_many_frames_as_it_says() -> None:
    """Log-normal scatter of 30 %: what is stated holds in so many of 2,000 frames, within 4 points."""
    for quantile in (0.95, 0.9):
        rng = np.random.default_rng(5)
        costs, held = model(10, quantile=quantile), 0
        for duration in 10 * np.exp(rng.normal(0, 0.3, 2000)):
            held += duration <= in_ms(costs)[0]
            costs.observe(0, WORK, round(duration * MS))
        assert held / 2000 == pytest.approx(quantile, abs=0.04)


def test_cost_grows_with_pairs_and_objects_as_it_was_seen_to() -> None:
    """True: 4 ms + 0.2 ms a pair + 0.5 ms an object, 4.7 to 19 ms; the scatter of p95 is the misfit."""
    rng = np.random.default_rng(6)
    costs = model(6)
    for _ in range(600):
        work = Workload(pairs=int(rng.integers(1, 30)), objects=int(rng.integers(0, 20)))
        costs.observe(0, work, round((4 + 0.2 * work.pairs + 0.5 * work.objects) * MS))
    for work in (
        Workload(pairs=28, objects=18),
        Workload(pairs=3, objects=15),
        Workload(pairs=25, objects=2),
    ):
        expected = costs.expect(work)[0] / MS
        assert expected == pytest.approx(4 + 0.2 * work.pairs + 0.5 * work.objects, rel=0.2)


def mistimed() -> CostModel:
    """The high rung takes four times what it did before the first frame; the low one as timed."""
    costs = model(10, 100)
    for rung, duration in ((0, 10), (1, 400)) * 2:
        for _ in range(8):
            costs.observe(rung, WORK, duration * MS)
    return costs


def test_what_comes_with_a_change_of_rung_is_told_from_load() -> None:
    """Few frames are enough; also for the low one, which does not run meanwhile."""
    low, high = mistimed().expect(WORK)
    assert high / low > 25
    assert low / MS < 15


def test_a_rung_that_was_slow_once_is_believed_in_again() -> None:
    costs = mistimed()
    for _ in range(60):
        costs.observe(0, WORK, 10 * MS)
    assert in_ms(costs)[1] > 200
    for _ in range(1000):
        costs.observe(0, WORK, 10 * MS)
    assert in_ms(costs)[1] == pytest.approx(100, rel=0.2)


def test_constant_work_for_long_leaves_the_model_finite_and_quick() -> None:
    """Features that never vary wind up a filter that forgets; ten thousand frames of them do no harm."""
    costs = model(10, 100)
    for _ in range(10_000):
        costs.observe(0, WORK, 10 * MS)
    assert in_ms(costs) == pytest.approx([10, 100], rel=0.05)
    for _ in range(60):
        costs.observe(0, Workload(pairs=20, objects=5), 15 * MS)
    assert in_ms(costs, Workload(pairs=20, objects=5))[0] == pytest.approx(15, rel=0.2)


def test_bursts_of_slow_frames_are_covered_as_well() -> None:
    """Five slow frames in every fifty: a quantile of what was lately would be short in all of them."""
    rng = np.random.default_rng(8)
    costs, held, frames = model(10), 0, 3000
    for frame in range(frames):
        duration = 10 * np.exp(rng.normal(0, 0.05)) * (1.5 if frame % 50 >= 45 else 1)
        held += duration <= in_ms(costs)[0]
        costs.observe(0, WORK, round(duration * MS))
    assert held / frames == pytest.approx(0.95, abs=0.03)


def test_equal_durations_give_equal_predictions() -> None:
    rng = np.random.default_rng(7)
    taken = (10 * MS * np.exp(rng.normal(0, 0.3, 50))).astype(int).tolist()
    first, second = model(10, 100), model(10, 100)
    for duration in taken:
        first.observe(0, WORK, duration)
        second.observe(0, WORK, duration)
    assert first.predict(WORK) == second.predict(WORK)
