"""Link adaptation: effective SINR, choice of schemes, outer loop, on tables that are made up."""

from __future__ import annotations

import numpy as np
import pytest

from caviar_protocol.cell.link_adaptation import BlockTable, effective_sinr, outer_loop

BETA = np.array([1.5, 4.0, 12.0, 40.0])


def waterfall(thresholds_db: list[float], unknown: int = 0) -> BlockTable:
    """Schemes that fail with probability 0.5 at these SINRs, and ten times less often with each dB more."""
    grid = np.arange(-5.0, 30.0, 0.1)
    error = np.minimum(1.0, 0.5 * 10 ** -(grid[None] - np.array(thresholds_db)[:, None]))
    error[:unknown] = 2.0
    bits = 1000 * np.arange(1, len(thresholds_db) + 1)
    return BlockTable(bits=bits, error=error, least_db=-5.0, step_db=0.1, beta=BETA[: len(thresholds_db)])


def db(*values: float) -> np.ndarray:
    return np.array([[10 ** (value / 10)] for value in values])


def test_the_highest_scheme_that_fails_seldom_enough_is_chosen() -> None:
    """A failure in ten is 0.7 dB above the thresholds."""
    table = waterfall([0.0, 5.0, 10.0, 15.0])
    sinr = db(-4.0, 0.6, 0.8, 9.0, 10.8, 29.0)
    assert table.choose(sinr, np.zeros(6), 0.1).tolist() == [0, 0, 0, 1, 2, 3]
    # 0.005 of 0.5 is 2 dB above.
    assert table.choose(sinr, np.zeros(6), 0.005).tolist() == [0, 0, 0, 1, 1, 3]


def test_an_offset_lowers_the_scheme_and_unknown_schemes_are_never_chosen() -> None:
    table = waterfall([0.0, 5.0, 10.0, 15.0], unknown=1)
    sinr = db(16.0, 16.0, 16.0, -5.0)
    assert table.choose(sinr, np.array([0.0, 1.0, 8.0, 0.0]), 0.1).tolist() == [3, 2, 1, 1]
    assert table.lowest == 1
    assert table.error_of(np.array([0]), db(20.0)).tolist() == [1.0]


def test_blocks_fail_as_the_table_says_at_their_sinr() -> None:
    table = waterfall([0.0, 5.0])
    found = table.error_of(np.array([0, 1, 1, 1]), db(1.0, 6.0, 4.0, 99.0))
    np.testing.assert_allclose(found, [0.05, 0.05, 1.0, 0.5e-24], rtol=1e-6, atol=1e-20)


@pytest.mark.parametrize("beta", [1.6, 11.0, 132.0])
def test_the_effective_sinr_is_that_of_the_formula(beta: float) -> None:
    sinr = np.random.default_rng(3).uniform(0.1, 20.0, (5, 24))
    expected = [-beta * np.log(np.mean([np.exp(-x / beta) for x in row])) for row in sinr]
    np.testing.assert_allclose(effective_sinr(sinr, np.full(5, beta)), expected, rtol=1e-12)
    assert (expected < sinr.mean(1)).all()


def test_the_effective_sinr_of_a_flat_channel_is_its_sinr_within_bounds() -> None:
    flat = np.array([[3.0] * 7, [700.0] * 7, [1e9] * 7, [1e-9] * 7])
    np.testing.assert_allclose(effective_sinr(flat, BETA), [3.0, 700.0, 1e3, 1e-3], rtol=1e-12)
    np.testing.assert_allclose(effective_sinr(flat[:, :1], BETA), [3.0, 700.0, 1e3, 1e-3], rtol=1e-12)
    # Of all schemes at once, each by its own parameter: that of a high scheme lies nearer to the mean.
    of_all = effective_sinr(np.array([[1.0, 20.0]]), BETA[:, None])
    assert of_all.shape == (4, 1)
    assert (np.diff(of_all[:, 0]) > 0).all()


def test_the_outer_loop_settles_where_as_many_blocks_fail_as_it_is_told() -> None:
    """The SINR is 3 dB below what the transmitter believes, and 10 % are to fail."""
    table, random = waterfall([0.0, 5.0, 10.0, 15.0]), np.random.default_rng(1)
    offset, failures = np.zeros(200), 0
    for slot in range(2000):
        known = db(*random.uniform(5, 15, 200))
        scheme = table.choose(known, offset, 0.1)
        failed = (random.random(200) < table.error_of(scheme, known / 2)).astype(np.int64)
        offset = outer_loop(offset, 1 - failed, failed, 0.5, 0.1)
        failures += int(failed.sum()) if slot >= 500 else 0
    assert failures / (1500 * 200) == pytest.approx(0.1, abs=0.005)
    assert offset.mean() > 1.5


def test_the_offset_stays_within_bounds() -> None:
    assert outer_loop(np.array([19.5, -19.99]), np.array([0, 9]), np.array([3, 0]), 1.0, 0.1).tolist() == [
        20.0,
        -20.0,
    ]
