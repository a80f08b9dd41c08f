"""Gusts against the Dryden formulas, and a hover in wind."""

from __future__ import annotations

import math

import numpy as np
import pytest

from caviar_services.world.flight_dynamics import Limits
from caviar_services.world.quadrotor.airframe import Airframe
from caviar_services.world.quadrotor.control import Battery, Controller
from caviar_services.world.quadrotor.flyer import Quadrotor
from caviar_services.world.quadrotor.surroundings import NOISES, Gusts, Wind, scales

pytestmark = pytest.mark.slow

LIMITS = Limits(speed=12.0, acceleration=4.0, clearance=1.0, low=(-99.0, -99.0, 0.125), high=(99.0,) * 3)
HEIGHT = 30.0
PLACE = (0.0, 0.0, HEIGHT)
STILL = (0.0, 0.0, 0.0)


def series(wind: Wind, count: int, step: float, seed: int = 5) -> np.ndarray:
    """Gusts at a place: along, across and up, Shape ``[count, 3]``."""
    rng = np.random.default_rng(seed)
    gusts = Gusts(wind)
    gusts.reset(rng.normal(size=NOISES).tolist())
    noises = rng.normal(size=(count, NOISES)).tolist()
    return np.array([gusts.step(PLACE, STILL, noise, step) for noise in noises])


def test_scales_are_those_of_the_specification() -> None:
    """At 1000 ft all lengths are 1000 ft and intensities 0.1·W₂₀, as 0.177 + 0.823 = 1; at 10 ft by hand."""
    long, tall, sigma, sigma_w = scales(304.8, 15.0)
    assert (long, tall) == pytest.approx((304.8, 304.8))
    assert (sigma, sigma_w) == pytest.approx((1.5, 1.5))
    long, tall, sigma, sigma_w = scales(3.048, 10.0)
    assert tall == pytest.approx(3.048)
    assert long == pytest.approx(3.048 / 0.18523**1.2)
    assert (sigma, sigma_w) == pytest.approx((0.1 * 10 / 0.18523**0.4, 1.0))
    assert scales(0.0, 10.0) == scales(3.048, 10.0)
    assert scales(5000.0, 10.0) == scales(304.8, 10.0)


@pytest.mark.parametrize("step", [0.01, 2.0])
def test_variances_do_not_depend_on_the_step(step: float) -> None:
    """σ² of the formulas within 6 standard errors, with the closed form of short and of long steps."""
    wind = Wind(velocity_m_s=(60.0, 0.0, 0.0), gusts="dryden", speed_6m_m_s=15.4)
    long, _, sigma, sigma_w = scales(HEIGHT, 15.4)
    # At 60 m/s a length passes in 1 to 2 s; variances of samples that far apart are independent.
    count = 60_000 if step < 0.1 else 20_000
    found = series(wind, count, step).var(axis=0)
    independent = count * step * 60.0 / (2 * long)
    tolerance = 6 * math.sqrt(2 / min(independent, count))
    assert found == pytest.approx((sigma**2, sigma**2, sigma_w**2), rel=tolerance)


def test_spectra_are_those_of_dryden() -> None:
    """Averaged periodograms against Φ_u, Φ_v, Φ_w over a decade and a half of frequencies."""
    speed, step, count, blocks = 20.0, 0.05, 2048, 48
    wind = Wind(velocity_m_s=(speed, 0.0, 0.0), gusts="dryden", speed_6m_m_s=10.0)
    values = series(wind, count * blocks, step).reshape(blocks, count, 3)
    window = np.hanning(count)
    spectrum = np.abs(np.fft.rfft(values * window[:, None], axis=1)) ** 2
    # One-sided density over ω [rad/s], so that its integral over ω > 0 is the variance.
    density = 2 * step / (2 * np.pi) * spectrum.mean(axis=0) / (window**2).sum()
    omega = 2 * np.pi * np.fft.rfftfreq(count, step)
    long, tall, sigma, sigma_w = scales(HEIGHT, 10.0)
    for axis, (length, intensity) in enumerate([(long, sigma), (long, sigma), (tall, sigma_w)]):
        x = (length * omega / speed) ** 2
        shape = 2 / (1 + x) if axis == 0 else (1 + 3 * x) / (1 + x) ** 2
        formula = intensity**2 * length / (np.pi * speed) * shape
        # Bands of a third of a decade below half the Nyquist frequency, where aliasing is small.
        for low in np.geomspace(0.2, 6.0, 7):
            band = (omega >= low) & (omega < low * 10 ** (1 / 3))
            assert density[band, axis].mean() == pytest.approx(formula[band].mean(), rel=0.25)


def test_gusts_lie_along_the_wind() -> None:
    """Turned by 90° the same numbers are turned; without wind there are none."""
    east = series(Wind(velocity_m_s=(9.0, 0.0, 0.0), gusts="dryden"), 50, 0.01)
    north = series(Wind(velocity_m_s=(0.0, 9.0, 0.0), gusts="dryden"), 50, 0.01)
    np.testing.assert_allclose(north, east[:, [1, 0, 2]] * (-1, 1, 1), atol=1e-12)
    assert not series(Wind(gusts="dryden"), 50, 0.01).any()


@pytest.mark.parametrize("gusts", ["none", "dryden"])
def test_a_wind_of_8_m_s_is_held_within_a_metre(gusts: str) -> None:
    """From level flight on, which the wind meets at once, for 30 s; then it leans against the wind."""
    uav = Quadrotor(
        Airframe(),
        Controller(),
        Battery(),
        LIMITS,
        Wind(velocity_m_s=(8.0, 0.0, 0.0), gusts=gusts),  # type: ignore[arg-type]
    )
    noises = np.random.default_rng(8).normal(size=(3001, NOISES)).tolist()
    uav.reset(PLACE, 0.0, lambda number: noises[number])
    farthest = 0.0
    for number in range(3000):
        uav.fly_slice(None, number)
        farthest = max(farthest, math.dist(uav.state.body.position, PLACE))
    assert 0.1 < farthest < 1.0
    if gusts == "none":
        # Along the body's x, where the rotors do not push: m·g·sin(tilt) = (d + ½·ρ·A·|u|)·|u|·cos(tilt).
        airframe = Airframe()
        tilt = -2 * math.asin(uav.state.body.orientation[2])
        drag = (airframe.linear_drag_n_s_m[0] + 0.5 * 1.225 * airframe.drag_area_m2[0] * 8.0) * 8.0
        assert math.tan(tilt) == pytest.approx(drag / (airframe.mass_kg * 9.80665), rel=1e-5)
        assert math.dist(uav.state.body.position, PLACE) < 0.01
