"""Schedulers and rates."""

from __future__ import annotations

import numpy as np
import pytest

from caviar_protocol.cell.buffers import (
    averaged,
    chosen,
    max_rate,
    note_turns,
    proportional_fair,
    round_robin,
)
from caviar_protocol.cell.link_adaptation import shannon, sinr, slot_bits


def test_round_robin_serves_each_in_turn_and_passes_over_who_waits_for_nothing() -> None:
    turns, turn, order = np.full(4, -1), 0, []
    for slot in range(8):
        eligible = np.array([True, True, slot < 4, True])
        served = chosen(round_robin(turns), eligible, 1)
        turn = note_turns(turns, served, turn)
        order += np.flatnonzero(served).tolist()
    assert (order, turn) == ([0, 1, 2, 3, 0, 1, 3, 0], 8)


@pytest.mark.parametrize(("users", "count"), [(3, 2), (5, 2), (5, 3), (4, 4)])
def test_round_robin_of_several_a_slot_serves_all_equally_often(users: int, count: int) -> None:
    turns, turn, slots = np.full(users, -1), 0, np.zeros(users)
    for _ in range(users * 4):
        served = chosen(round_robin(turns), np.ones(users, bool), count)
        turn = note_turns(turns, served, turn)
        slots += served
    assert slots.tolist() == [4 * count] * users


@pytest.mark.parametrize("count", [1, 2, 3, 9])
def test_no_more_than_asked_are_chosen_and_none_that_is_not_eligible(count: int) -> None:
    rng = np.random.default_rng(4)
    priority, eligible = rng.integers(0, 4, (50, 6)).astype(float), rng.random((50, 6)) < 0.6
    found = chosen(priority, eligible, count)
    for row, may, got in zip(priority, eligible, found, strict=True):
        ranked = sorted(np.flatnonzero(may), key=lambda user: (-row[user], user))
        assert sorted(ranked[:count]) == np.flatnonzero(got).tolist()
        # One cell as many at once are.
        assert (chosen(row, may, count) == got).all()


def test_without_users_none_is_chosen() -> None:
    assert chosen(np.zeros(0), np.zeros(0, bool), 1).shape == (0,)


def test_the_greatest_rate_is_served_whatever_others_get() -> None:
    assert chosen(max_rate(np.array([3.0, 8.0, 5.0])), np.ones(3, bool), 1).tolist() == [False, True, False]


def test_proportional_fair_shares_slots_evenly_between_steady_users() -> None:
    """Users of constant rates get equal shares of the slots, whatever their rates (Viswanath, 2002)."""
    rate, average = np.array([100.0, 400.0, 1000.0]), np.zeros(3)
    slots = np.zeros(3)
    for _ in range(6000):
        served = chosen(proportional_fair(rate, average), np.ones(3, bool), 1)
        slots += served
        average = averaged(average, np.where(served, rate, 0).astype(np.int64), 50.0)
    np.testing.assert_allclose(slots / 6000, 1 / 3, atol=0.01)


def test_proportional_fair_serves_users_at_the_peaks_of_their_fading() -> None:
    """More than round robin carries, of equal and independent Rayleigh fading."""
    rng = np.random.default_rng(5)
    rates = np.log2(1 + 10 * rng.exponential(size=(4000, 5)))
    average, carried = np.zeros(5), 0.0
    for rate in 1e5 * rates:
        served = chosen(proportional_fair(rate, average), np.ones(5, bool), 1)
        carried += rate[served].sum()
        average = averaged(average, np.where(served, rate, 0).astype(np.int64), 100.0)
    assert carried / 4000 > 1.3 * 1e5 * rates.mean()


def test_rates_are_those_of_their_formulas() -> None:
    assert sinr(np.array([2.0]), np.array([0.5]), 0.5).tolist() == [2.0]
    assert shannon(np.array([0.0, 1.0, 7.0])).tolist() == [0.0, 1.0, 3.0]
    assert shannon(np.array([1e9]), 5.5547).tolist() == [5.5547]
    # 0.1 + 0.2 and the like: a product that is whole but for rounding keeps its last bit.
    assert slot_bits(np.array([3e8 * 1.1]), 1e-3).tolist() == [330_000]
