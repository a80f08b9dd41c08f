"""Absorption by air: the Recommendation's figures, every channel model, and what is refused."""

from __future__ import annotations

from typing import Any

import msgspec
import numpy as np
import pytest

from caviar_labs.stability.lab import antenna, carriers, free_space, geometric, measure, scene
from caviar_protocol.codec import encode_payload
from caviar_protocol.errors import ScenarioError
from caviar_protocol.topics import Channel
from caviar_services.channel.propagation.atmosphere import Atmosphere, amplitude_factor, specific_attenuation
from caviar_services.channel.statistical.free_space import FreeSpaceChannel, FreeSpaceSettings
from caviar_services.channel.statistical.waves import GeometricSettings
from caviar_services.service import Preparation, RunInfo

C = 299_792_458.0
AIR = Atmosphere()


# --- specific attenuation -----------------------------------------------------------------------


@pytest.mark.parametrize(
    ("ghz", "expected", "within"),
    [
        (22.235, 0.19, 0.01),
        (60.0, 14.8, 0.3),
        (118.75, 1.9, 0.15),
        (183.31, 28.5, 1.0),
        (325.15, 38.0, 1.0),
    ],
)
def test_peaks_of_the_recommendations_figure(ghz: float, expected: float, within: float) -> None:
    """Figure 1 of P.676 (1013.25 hPa, 15 °C, 7.5 g/m³), as well as it can be read."""
    assert specific_attenuation(AIR, ghz * 1e9) == pytest.approx(expected, abs=within)


@pytest.mark.parametrize(
    ("low", "high", "deepest", "lowest"),
    [(24.0, 50.0, 31.0, 0.093), (70.0, 115.0, 78.0, 0.35), (125.0, 175.0, 127.0, 0.79)],
)
def test_windows_between_the_peaks(low: float, high: float, deepest: float, lowest: float) -> None:
    """Where the windows near 30, 80 and 130 GHz are clearest, and how clear."""
    ghz = np.arange(low, high, 0.25)
    absorbed = np.array([specific_attenuation(AIR, f * 1e9) for f in ghz])
    assert absorbed.min() == pytest.approx(lowest, rel=0.03)
    assert ghz[absorbed.argmin()] == pytest.approx(deepest, abs=3.0)


@pytest.mark.parametrize(
    ("ghz", "hpa", "vapour", "kelvin", "expected"),
    [
        (1.0, 1013.25, 7.5, 288.15, 0.0054395628),
        (12.0, 1013.25, 7.5, 288.15, 0.0182336523),
        (20.0, 1013.25, 7.5, 288.15, 0.1089308553),
        (60.0, 1013.25, 7.5, 288.15, 14.7783166371),
        (90.0, 1013.25, 7.5, 288.15, 0.3808431055),
        (118.75, 1013.25, 0.0, 288.15, 1.3481825609),
        (130.0, 1013.25, 7.5, 288.15, 0.7933537872),
        (31.0, 700.0, 2.0, 260.0, 0.0302147899),
        (62.0, 500.0, 0.3, 240.0, 11.0112881723),
        (325.0, 1013.25, 7.5, 288.15, 37.8922094897),
        (557.0, 900.0, 15.0, 300.0, 34092.1259865844),
        (1000.0, 1013.25, 7.5, 288.15, 695.7721821972),
    ],
)
def test_values_of_another_implementation(
    ghz: float, hpa: float, vapour: float, kelvin: float, expected: float
) -> None:
    """ITU-Rpy 0.4.0, ``gamma_exact`` of P.676-12, whose Annex 1 has the same formulas and lines."""
    air = Atmosphere(temperature_k=kelvin, pressure_hpa=hpa, water_vapour_g_m3=vapour)
    assert specific_attenuation(air, ghz * 1e9) == pytest.approx(expected, rel=1e-8)


def test_without_air_nothing_is_absorbed() -> None:
    vacuum = Atmosphere(pressure_hpa=0.0, water_vapour_g_m3=0.0)
    assert specific_attenuation(vacuum, 60e9) == 0.0


@pytest.mark.parametrize("frequency", [0.999e9, 1000.1e9])
def test_a_frequency_outside_the_recommendation_is_refused(frequency: float) -> None:
    with pytest.raises(ScenarioError, match=rf"1–1000 GHz, a carrier is at {frequency / 1e9:g} GHz"):
        specific_attenuation(AIR, frequency)


@pytest.mark.parametrize(
    "settings",
    [
        {"temperature_k": 15.0},
        {"temperature_k": 400.0},
        {"pressure_hpa": 101325.0},
        {"pressure_hpa": -1.0},
        {"water_vapour_g_m3": 750.0},
        {"water_vapour_g_m3": -0.1},
        {"temperature_c": 15.0},
    ],
)
def test_values_that_are_of_another_unit_are_refused_by_name(settings: dict[str, float]) -> None:
    (name,) = settings
    with pytest.raises(msgspec.ValidationError, match=name):
        msgspec.convert({"atmosphere": settings}, FreeSpaceSettings)


def test_amplitudes_fall_by_half_the_decibels_of_power() -> None:
    factor = amplitude_factor(np.array([20.0, 0.0]), np.array([1000.0, 500.0, 0.0]) / C)
    np.testing.assert_allclose(factor, [[10**-1, 10**-0.5, 1.0], [1.0, 1.0, 1.0]], rtol=1e-12)


# --- in the channel models ----------------------------------------------------------------------


def lossy(*frequencies: float, name: str = "channel", **air: float) -> FreeSpaceChannel:
    settings = FreeSpaceSettings(atmosphere=Atmosphere(**air))
    return FreeSpaceChannel(settings, RunInfo(name=name, carriers=carriers(*frequencies)))


def pair_at(metres: float) -> Any:
    return scene([antenna("t", "tx", (0, 0, 10)), antenna("r", "rx", (metres, 0, 10))])


def test_free_space_loses_what_each_carrier_is_absorbed() -> None:
    """Over 1 km at 60 GHz the ≈ 15 dB of the Recommendation; the phase stays."""
    with_air, without = lossy(28e9, 60e9), free_space(28e9, 60e9)
    with_air.prepare(Preparation(demand={"channel": frozenset({"h"})}))
    air, vacuum = measure(with_air, pair_at(1000.0)), measure(without, pair_at(1000.0))
    loss_db = 20 * np.log10(np.abs(vacuum.a) / np.abs(air.a)).ravel()
    assert loss_db == pytest.approx([specific_attenuation(AIR, f) for f in (28e9, 60e9)], rel=1e-9)
    assert loss_db[1] == pytest.approx(15, abs=0.5)
    np.testing.assert_allclose(np.angle(air.a), np.angle(vacuum.a), atol=1e-9)
    assert abs(air.h[1].h[0, 0]) == pytest.approx(abs(air.a[1, 0]))


def test_drawn_components_lose_over_their_own_delay() -> None:
    """Each wave of the geometric model by its own length, not by that of the straight line."""
    settings = {"normalization": "path-loss", "delay_spread_ns": 900.0}
    air = measure(geometric(60e9, **settings, atmosphere={}), pair_at(400.0))
    vacuum = measure(geometric(60e9, **settings), pair_at(400.0))
    expected = 10 ** (-specific_attenuation(AIR, 60e9) * air.tau * C / 1000 / 20)
    assert np.ptp(air.tau) > 100e-9
    np.testing.assert_allclose(air.a[0] / vacuum.a[0], expected, rtol=1e-9)


def test_the_product_says_what_was_absorbed() -> None:
    absorbed = measure(lossy(28e9, 60e9), pair_at(50.0)).options.absorption_db_per_km
    assert absorbed == pytest.approx([specific_attenuation(AIR, f) for f in (28e9, 60e9)])
    geometry = geometric(60e9, normalization="path-loss", atmosphere={"pressure_hpa": 900.0})
    thin = Atmosphere(pressure_hpa=900.0)
    said = measure(geometry, pair_at(50.0)).options.absorption_db_per_km
    assert said == pytest.approx([specific_attenuation(thin, 60e9)])


def test_without_an_atmosphere_products_keep_their_bytes() -> None:
    channel: Channel = measure(free_space(28e9), pair_at(50.0))
    assert channel.options.absorption_db_per_km == ()
    assert b"absorption" not in encode_payload(channel)[0]


def test_the_notes_say_state_and_attenuation() -> None:
    (note,) = lossy(60e9).prepare(Preparation(demand={})).notes
    for part in ("P.676", "288.15 K", "1013.25 hPa", "7.5 g/m³", "14.8 dB/km on 'c0'"):
        assert part in note


def test_a_carrier_outside_is_refused_with_the_key() -> None:
    with pytest.raises(ScenarioError, match=r"^services\.radio\.settings\.atmosphere.*0\.7.*GHz"):
        lossy(28e9, 0.7e9, name="radio")


def test_unit_power_and_absorption_exclude_each_other() -> None:
    with pytest.raises(msgspec.ValidationError, match=r'atmosphere.*normalization = "path-loss"'):
        msgspec.convert({"atmosphere": {}}, GeometricSettings)
