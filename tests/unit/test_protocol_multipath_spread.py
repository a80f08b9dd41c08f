"""Delay and Doppler spread, K-factor and coherence of paths, against closed forms."""

from __future__ import annotations

import math

import numpy as np
import pytest

from caviar_protocol.multipath import coherence, delay_spread, doppler_spread, k_factor

NAN = float("nan")


def test_two_paths_have_the_spread_of_their_distance() -> None:
    """σ = √(p₁·p₂)/(p₁ + p₂)·|τ₁ − τ₂|."""
    a = np.array([3e-6, 1e-6j, 0.0])
    tau = np.array([200e-9, 290e-9, 900e-9])
    assert delay_spread(a, tau) == pytest.approx(math.sqrt(9 * 1) / 10 * 90e-9)
    assert doppler_spread(a, np.array([100.0, -60.0, 5000.0])) == pytest.approx(0.3 * 160.0)


def test_users_without_paths_have_no_figures_and_padding_does_not_count() -> None:
    a = np.array([[1e-6, complex(NAN, NAN)], [complex(NAN, NAN)] * 2])
    tau = np.array([[1e-7, NAN], [NAN, NAN]])
    assert delay_spread(a, tau)[0] == 0.0
    assert math.isnan(delay_spread(a, tau)[1])
    k = k_factor(a, tau, np.array([True, True]))
    assert k[0] == math.inf
    assert math.isnan(k[1])
    assert np.isnan(k_factor(a[:, :0], tau[:, :0], np.array([True, True]))).all()


def test_the_k_factor_is_the_earliest_path_over_the_others_with_line_of_sight_alone() -> None:
    a = np.array([1e-6, 4e-6, 2e-6j])
    tau = np.array([3e-7, 1e-7, 2e-7])
    assert k_factor(a, tau, np.array(True)) == pytest.approx(16 / 5)
    assert np.isnan(k_factor(a, tau, np.array(False)))


@pytest.mark.parametrize("powers", [(1.0, 1.0), (9.0, 1.0), (5.0, 3.0, 1.0, 1.0)])
def test_correlation_stays_above_a_half_within_the_coherence_bandwidth(powers: tuple[float, ...]) -> None:
    """|R(Δf)| = |Σ p·exp(−j2πΔfτ)|/Σ p of uncorrelated paths; two equal ones meet the bound exactly."""
    p, tau = np.array(powers), np.array([0.0, 70e-9, 30e-9, 200e-9])[: len(powers)]
    bandwidth = float(coherence(delay_spread(np.sqrt(p).astype(complex), tau)))
    offsets = np.linspace(0.0, bandwidth, 101)
    correlation = np.abs(np.exp(-2j * np.pi * offsets[:, None] * tau) @ p) / p.sum()
    assert correlation.min() >= 0.5 - 1e-12
    if powers == (1.0, 1.0):
        assert correlation[-1] == pytest.approx(0.5)


def test_a_single_path_is_coherent_everywhere() -> None:
    assert coherence(delay_spread(np.array([1j]), np.array([1e-7]))) == math.inf
