"""What error is stated of a rung, and how often that holds."""

from __future__ import annotations

import numpy as np
import pytest

from caviar_protocol.topics import Carrier, Channel, ChannelMatrix
from caviar_services.channel.adaptive.errors_stated import FLOOR_DB, NEEDED, StatedError, nmse_db


def channel(*matrices: complex) -> Channel:
    """One pair for each 1×1 matrix."""
    count = len(matrices)
    return Channel(
        rung="siso-rt",
        carriers=(Carrier(name="c", frequency_hz=28e9),),
        tx=("t",),
        rx=tuple(f"r{i}" for i in range(count)),
        los=np.zeros((1, count), bool),
        offsets=np.zeros(count + 1, np.int64),
        id=np.zeros(0, np.uint64),
        a=np.zeros((1, 0), complex),
        tau=np.zeros(0),
        aod=np.zeros((0, 2)),
        aoa=np.zeros((0, 2)),
        doppler=np.zeros((1, 0)),
        interactions=np.zeros((0, 0), np.uint8),
        points=np.zeros((0, 0, 3)),
        objects=np.zeros((0, 0), np.int32),
        h=tuple(
            ChannelMatrix(carrier=0, tx=0, rx=i, h=np.array([[value]], complex))
            for i, value in enumerate(matrices)
        ),
    )


def test_nmse_is_over_all_pairs() -> None:
    """|0.1j|² / (|1|² + |3j|²) = 0.001."""
    assert nmse_db(channel(1 + 0.1j, 3j), channel(1, 3j)) == pytest.approx(-30)


def test_a_phase_counts_as_an_error_and_a_path_that_is_missing_too() -> None:
    assert nmse_db(channel(-1), channel(1)) == pytest.approx(10 * np.log10(4))
    assert nmse_db(channel(0), channel(1)) == pytest.approx(0)


def test_equal_matrices_have_the_floor_and_no_path_at_all_has_no_error() -> None:
    assert nmse_db(channel(1, 2), channel(1, 2)) == FLOOR_DB
    assert nmse_db(channel(1), channel(0)) is None


def test_nothing_is_stated_before_enough_is_known_but_what_is_declared() -> None:
    blank, declared = StatedError(), StatedError(-20.0)
    for error in (-31.0, -30.0, -29.0)[: NEEDED - 1]:
        assert blank.check(error) is None
        assert declared.check(error) is True
    assert (blank.stated_db, declared.stated_db) == (None, -20.0)
    blank.check(-29.0)
    assert blank.stated_db == -29.0
    assert (blank.checks, declared.checks) == (0, NEEDED - 1)


def test_a_declared_error_that_is_too_small_is_found_out() -> None:
    stated = StatedError(-60.0)
    assert [stated.check(-30.0) for _ in range(4)] == [False, False, False, True]
    assert (stated.checks, stated.covered) == (4, 1)


def test_the_order_statistic_is_that_of_split_conformal_prediction() -> None:
    """19 errors: the 18th; 9: the 9th, the largest."""
    stated = StatedError()
    for error in range(-19, 0):
        stated.check(float(error))
    assert stated.stated_db == -2.0
    stated.reset()
    assert stated.stated_db is None
    for error in range(-9, 0):
        stated.check(float(error))
    assert stated.stated_db == -1.0


def test_what_is_stated_is_rounded_up() -> None:
    stated = StatedError()
    for _ in range(3):
        stated.check(-30.17)
    assert stated.stated_db == -30.1


def test_coverage_of_exchangeable_errors_is_what_is_promised() -> None:
    """Over 3,000 normal errors nine of ten are covered, within 2 points."""
    stated = StatedError()
    for error in np.random.default_rng(4).normal(-30, 5, 3000):
        stated.check(float(error))
    assert stated.covered / stated.checks == pytest.approx(0.9, abs=0.02)
