"""The response of two paths against its closed form, and the numerology that a scenario's keys make."""

from __future__ import annotations

import cmath
import math

import numpy as np
import pytest

from caviar_protocol.arrays import Complex128Array
from caviar_protocol.errors import ScenarioError
from caviar_protocol.multipath import (
    TAPS_BEFORE,
    first_tap,
    slot_offsets,
    subcarrier_offsets,
    subcarrier_weights,
    tap_weights,
)
from caviar_protocol.scenario import parse_scenario, with_numerology
from caviar_protocol.scenario.conversion import Place
from caviar_protocol.topics import Carrier

FREQUENCY = 28e9
TAU = np.array([211.37e-9, 268.91e-9])
"""[s] of a direct and a reflected path."""
AMPLITUDE = np.array([3.1e-6, 1.7e-6 * cmath.exp(0.4j)]) * np.exp(-2j * np.pi * FREQUENCY * TAU)
DOPPLER = np.array([1240.0, -655.0])
"""[Hz]."""
CARRIER = Carrier(
    name="n257",
    frequency_hz=FREQUENCY,
    bandwidth_hz=100e6,
    subcarriers=264,
    subcarrier_spacing_hz=120e3,
    taps=48,
    slots=3,
    slot_duration_s=125e-6,
)


def relative_error(found: Complex128Array, expected: Complex128Array) -> float:
    return float(np.abs(found - expected).max() / np.abs(expected).max())


def test_two_paths_interfere_over_frequency_and_time_as_the_formula_says() -> None:
    """|H|² = |a₁|² + |a₂|² + 2·Re(a₁·a₂*·exp(−j2π(f·Δτ − Δν·t))), and H itself term by term."""
    found = subcarrier_weights(CARRIER, TAU, DOPPLER) @ AMPLITUDE
    expected = np.zeros((3, 264), np.complex128)
    for s in range(3):
        for k in range(264):
            t, f = s * 125e-6, FREQUENCY + (k - 132) * 120e3
            for a, tau, shift in zip(AMPLITUDE, TAU, DOPPLER, strict=True):
                delay = tau - shift / FREQUENCY * t  # at the instant t
                base = a * cmath.exp(2j * math.pi * FREQUENCY * tau)
                expected[s, k] += base * cmath.exp(-2j * math.pi * math.fmod(f * delay, 1.0))
    assert relative_error(found, expected) <= 1e-6
    difference = subcarrier_offsets(CARRIER) * (TAU[0] - TAU[1])
    cross = 2 * (AMPLITUDE[0] * np.conj(AMPLITUDE[1]) * np.exp(-2j * np.pi * difference)).real
    power = (np.abs(AMPLITUDE) ** 2).sum() + cross
    assert np.abs(np.abs(found[0]) ** 2 - power).max() <= 1e-6 * power.max()


def test_the_subcarrier_at_the_centre_is_the_narrowband_channel() -> None:
    found = subcarrier_weights(CARRIER, TAU, DOPPLER) @ AMPLITUDE
    assert subcarrier_offsets(CARRIER)[132] == 0.0
    assert found[0, 132] == pytest.approx(AMPLITUDE.sum(), rel=1e-12)


def test_taps_of_two_paths_are_two_sincs() -> None:
    first = first_tap(CARRIER, TAU)
    assert first == math.floor(TAU[0] * 100e6) - TAPS_BEFORE
    found = tap_weights(CARRIER, TAU, DOPPLER, first) @ AMPLITUDE
    for s in range(3):
        for tap in range(48):
            value = 0j
            for a, tau, shift in zip(AMPLITUDE, TAU, DOPPLER, strict=True):
                t = s * 125e-6
                x = math.pi * (first + tap - 100e6 * (tau - shift / FREQUENCY * t))
                value += a * cmath.exp(2j * math.pi * shift * t) * (math.sin(x) / x)
            assert abs(found[s, tap] - value) <= 1e-6 * np.abs(found).max()


def test_taps_have_the_spectrum_of_the_response() -> None:
    """Their transform at a frequency inside the band; what is left is the truncation of sincs."""
    long = Carrier(name="x", frequency_hz=FREQUENCY, bandwidth_hz=100e6, taps=4096, subcarriers=1)
    still = np.zeros(2)
    first = first_tap(long, TAU) - 2000
    taps = tap_weights(long, TAU, still, first)[0] @ AMPLITUDE
    frequency = 7.3e6
    transform = (taps * np.exp(-2j * np.pi * frequency / 100e6 * (first + np.arange(4096)))).sum()
    response = (AMPLITUDE * np.exp(-2j * np.pi * frequency * TAU)).sum()
    assert abs(transform - response) <= 2e-3 * abs(response)


def test_a_path_without_delay_has_one_tap() -> None:
    carrier = Carrier(name="x", frequency_hz=1e9, bandwidth_hz=1e6, taps=13)
    weights = tap_weights(carrier, np.zeros(1), np.zeros(1), first_tap(carrier, np.zeros(1)))
    assert weights[0, :, 0] == pytest.approx(np.eye(13)[TAPS_BEFORE], abs=1e-15)


def test_no_path_has_no_first_tap() -> None:
    assert first_tap(CARRIER, np.zeros(0)) == 0


# --- keys of a scenario -----------------------------------------------------------------------------


def resolved(sampling_period_ns: int | None = 100_000_000, **keys: float) -> Carrier:
    carrier = Carrier(**{"name": "x", "frequency_hz": 28e9, "bandwidth_hz": 100e6, **keys})  # type: ignore[arg-type]
    return with_numerology(carrier, sampling_period_ns, Place("carriers").at(0))


def test_spacing_or_number_follows_from_the_bandwidth() -> None:
    assert resolved(subcarriers=500).subcarrier_spacing_hz == 200e3
    assert resolved(subcarrier_spacing_hz=120e3).subcarriers == 833
    both = resolved(subcarriers=264, subcarrier_spacing_hz=120e3)
    assert (both.subcarriers, both.subcarrier_spacing_hz) == (264, 120e3)
    assert resolved() == Carrier(name="x", frequency_hz=28e9, bandwidth_hz=100e6)


def test_slots_share_the_sampling_period() -> None:
    assert slot_offsets(resolved(slots=4)) == pytest.approx([0.0, 0.025, 0.05, 0.075])
    assert resolved(slots=4, slot_duration_s=125e-6).slot_duration_s == 125e-6


SCENARIO = """
[run]
name = "x"
{run}
record = ["{record}"]
[[carriers]]
name = "c"
frequency_hz = 28e9
bandwidth_hz = 20e6
{keys}
[services.world]
role = "world"
use = "trajectory"
budget_ms = 5
[services.recorder]
role = "recorder"
use = "mcap"
budget_ms = 5
"""


@pytest.mark.parametrize(
    ("keys", "record", "run", "line", "key", "remedy"),
    [
        (
            "subcarriers = 264\nsubcarrier_spacing_hz = 120e3",
            "scene",
            "frames = 3",
            10,
            "carriers[0].subcarriers",
            "bandwidth_hz = 3.168e+07",
        ),
        (
            "subcarrier_spacing_hz = 30e6",
            "scene",
            "frames = 3",
            10,
            "carriers[0].subcarrier_spacing_hz",
            "at most the bandwidth",
        ),
        ("slots = 2", "scene", "instants_s = [0.0, 0.1]", 10, "carriers[0].slots", "slot_duration_s"),
        (
            "subcarriers = 64\nsubcarrier_spacing_hz = 120e6",
            "scene",
            "frames = 3",
            11,
            "carriers[0].subcarrier_spacing_hz",
            "is 1.2e+08 Hz, wider than bandwidth_hz",
        ),
        ("taps = 4", "channel.hf", "frames = 3", 5, "run.record[0]", "subcarriers = 264"),
        ("subcarriers = 4", "channel.taps", "frames = 3", 5, "run.record[0]", "taps = 64"),
        ("subcarriers = -1", "scene", "frames = 3", 10, "carriers[0].subcarriers", "whole number"),
        ("subcarrier = 4", "scene", "frames = 3", 10, "carriers[0].subcarrier", "did you mean 'subcarriers'"),
    ],
)
def test_a_numerology_that_cannot_be_is_refused_with_its_line(
    keys: str, record: str, run: str, line: int, key: str, remedy: str
) -> None:
    text = SCENARIO.format(keys=keys, record=record, run=run)
    with pytest.raises(ScenarioError) as caught:
        parse_scenario(text, "x.toml")
    message = str(caught.value)
    assert f"x.toml:{line}" in message
    assert key in message
    assert remedy in message


def test_a_scenario_states_what_follows_from_its_keys() -> None:
    keys = "subcarrier_spacing_hz = 15e3\nslots = 10\ntaps = 16"
    (carrier,) = parse_scenario(
        SCENARIO.format(keys=keys, record="channel.hf", run="frames = 3\nsampling_period_ns = 1_000_000"), ""
    ).carriers
    assert (carrier.subcarriers, carrier.slot_duration_s) == (1333, 1e-4)
