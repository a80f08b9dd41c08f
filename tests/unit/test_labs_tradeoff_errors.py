"""What channels are summed up to, against values computed by hand."""

from __future__ import annotations

import math

import numpy as np
import pytest

from caviar_labs.tradeoff import errors
from caviar_protocol.multipath import power_spread

RNG = np.random.default_rng(7)


def random_matrix(rows: int, columns: int) -> np.ndarray:
    return RNG.normal(size=(rows, columns)) + 1j * RNG.normal(size=(rows, columns))


def test_powers_of_paths_add_whatever_their_phases() -> None:
    a = np.array([0.3 * np.exp(2.1j), 0.4 * np.exp(-0.4j)])
    assert errors.path_gain_db(a) == pytest.approx(10 * math.log10(0.25))


def test_no_path_has_no_gain() -> None:
    assert errors.path_gain_db(np.zeros(0, np.complex128)) == -math.inf


def test_delay_spread_of_two_paths() -> None:
    """Powers 3 and 1 at 100 and 180 ns: mean 120 ns, variance (3·20² + 60²)/4 = 1200 ns²."""
    spread = power_spread(np.array([3.0, 1.0]), np.array([100e-9, 180e-9]))
    assert spread == pytest.approx(math.sqrt(1200) * 1e-9)


def test_delay_spread_does_not_depend_on_the_first_delay() -> None:
    """A path of 300 km is 1 ms long; picoseconds survive it."""
    tau, power = np.array([0.0, 5e-12, 9e-12]), np.array([1.0, 0.5, 0.1])
    near, far = power_spread(power, tau), power_spread(power, 1e-3 + tau)
    assert far == pytest.approx(near, rel=1e-6)


def test_angular_spread_of_two_equal_waves() -> None:
    """±30°: the resultant is cos 30°, so AS = sqrt(−2·ln(√3/2))."""
    angle = np.radians([-30.0, 30.0])
    expected = math.sqrt(-2 * math.log(math.sqrt(3) / 2))
    assert errors.angular_spread_rad(angle, np.array([1.0, 1.0])) == pytest.approx(expected)


def test_small_angular_spread_is_the_standard_deviation() -> None:
    angle = np.radians([10.0, 10.4, 11.0])
    power = np.array([1.0, 2.0, 1.0])
    mean = (angle * power).sum() / 4
    assert errors.angular_spread_rad(angle, power) == pytest.approx(
        math.sqrt((power * (angle - mean) ** 2).sum() / 4), rel=1e-3
    )


def test_angular_spread_does_not_see_where_angles_wrap() -> None:
    power = np.array([0.7, 0.2, 0.1])
    angle = np.array([3.1, -3.1, 2.9])
    moved = np.angle(np.exp(1j * (angle + 1.9)))
    assert errors.angular_spread_rad(angle, power) == pytest.approx(errors.angular_spread_rad(moved, power))


def test_one_wave_has_no_spread() -> None:
    power = np.array([1e-13])
    assert errors.angular_spread_rad(np.array([0.1]), power) == pytest.approx(0, abs=1e-7)
    assert power_spread(power, np.array([3e-7])) < 1e-20


@pytest.mark.parametrize("scale", [0.9, 1.25, 1j, -1.0])
def test_nmse_of_a_scaled_matrix(scale: complex) -> None:
    """‖cH − H‖²/‖H‖² = |c − 1|²."""
    h = random_matrix(3, 5)
    assert errors.nmse(scale * h, h) == pytest.approx(abs(scale - 1) ** 2)


def test_nmse_of_nothing_is_one() -> None:
    h = random_matrix(2, 4)
    assert errors.nmse(np.zeros_like(h), h) == pytest.approx(1.0)


def test_equal_channels_differ_by_the_floor() -> None:
    assert errors.decibel(0.0) == errors.FLOOR_DB
    assert errors.decibel(1e-30) == errors.FLOOR_DB
    assert errors.decibel(1e-3) == pytest.approx(-30.0)


def test_capacity_of_a_diagonal_channel() -> None:
    """Two parallel channels of gains 2 and 1, each with half of the power 6: log2(13) + log2(4)."""
    h = np.diag([2.0, 1.0]).astype(np.complex128)
    assert errors.capacity_bps_hz(h, 6.0) == pytest.approx(math.log2(13) + math.log2(4))


def test_capacity_is_that_of_the_determinant() -> None:
    h, snr = random_matrix(2, 5), 3.7
    expected = math.log2(np.linalg.det(np.eye(2) + snr / 5 * h @ h.conj().T).real)
    assert errors.capacity_bps_hz(h, snr) == pytest.approx(expected)


def test_best_pairs_come_first_and_of_equal_ones_the_lowest() -> None:
    abs_y = np.array([[0.1, 0.7, 0.3], [0.7, 0.2, 0.5]])
    assert errors.top_k(abs_y, 4) == [1, 3, 5, 2]


def test_a_hit_is_the_references_best_among_the_first_k() -> None:
    ranked, reference = [4, 2, 9, 1, 7], [1, 4, 2, 9, 7]
    assert not errors.hit(ranked, reference, 1)
    assert not errors.hit(ranked, reference, 3)
    assert errors.hit(ranked, reference, 5)
    assert not errors.hit([], reference, 5)


def test_a_pair_half_as_good_loses_six_decibels() -> None:
    reference = np.array([[0.2, 0.8], [0.4, 0.0]])
    assert errors.pair_loss_db(reference, 1) == 0
    assert errors.pair_loss_db(reference, 2) == pytest.approx(20 * math.log10(2))
    assert errors.pair_loss_db(reference, 3) == -errors.FLOOR_DB
