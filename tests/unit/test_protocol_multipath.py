"""Figures of a channel's paths: OFDM responses and taps by their formulas, spreads, births and deaths."""

from __future__ import annotations

import cmath
import math
from collections.abc import Sequence

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from caviar_protocol.arrays import Complex128Array
from caviar_protocol.errors import ScenarioError
from caviar_protocol.multipath import (
    TAPS_BEFORE,
    changes,
    coherence,
    delay_spread,
    doppler_spread,
    first_tap,
    k_factor,
    slot_offsets,
    subcarrier_offsets,
    subcarrier_weights,
    tap_weights,
)
from caviar_protocol.scenario import parse_scenario, with_numerology
from caviar_protocol.scenario.conversion import Place
from caviar_protocol.topics import Carrier, Channel

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


def product(rx: Sequence[str], ids: Sequence[Sequence[int]]) -> Channel:
    """A product of one transmitter with these ids of paths to each receiver."""
    flat = [number for pair in ids for number in pair]
    count = len(flat)
    return Channel(
        rung="siso-rt",
        carriers=(Carrier(name="c", frequency_hz=28e9),),
        tx=("t",),
        rx=tuple(rx),
        los=np.zeros((1, len(rx)), np.bool_),
        offsets=np.cumsum([0, *(len(pair) for pair in ids)]).astype(np.int64),
        id=np.array(flat, np.uint64),
        a=np.zeros((1, count), np.complex128),
        tau=np.zeros(count),
        aod=np.zeros((count, 2)),
        aoa=np.zeros((count, 2)),
        doppler=np.zeros((1, count)),
        interactions=np.zeros((count, 0), np.uint8),
        points=np.zeros((count, 0, 3)),
        objects=np.zeros((count, 0), np.int32),
    )


def test_paths_are_born_and_die_within_their_pair() -> None:
    """An id that moves from one receiver to another is a death and a birth."""
    turnover = changes(product(["r", "s"], [[1, 2, 3], [4]]), product(["r", "s"], [[1, 3], [2, 4]]))
    assert turnover.born.tolist() == [False, False, True, False]
    assert turnover.died.tolist() == [False, True, False, False]
    assert (turnover.births, turnover.deaths) == (1, 1)


def test_a_pair_that_comes_or_leaves_takes_its_paths_along() -> None:
    turnover = changes(product(["a", "b"], [[7], [8, 9]]), product(["b", "c"], [[9, 8], [7]]))
    assert turnover.born.tolist() == [False, False, True]
    assert turnover.died.tolist() == [True, False, False]


def test_nothing_changes_between_equal_products() -> None:
    turnover = changes(product(["r"], [[5, 6]]), product(["r"], [[5, 6]]))
    assert (turnover.births, turnover.deaths) == (0, 0)


_IDS = st.lists(st.lists(st.integers(0, 2**64 - 1), unique=True, max_size=6), min_size=3, max_size=3)


@given(_IDS, _IDS)
def test_what_was_is_what_remains_with_what_died(before: list[list[int]], after: list[list[int]]) -> None:
    """Balance of each pair, and the two directions of time mirror each other."""
    names = ["r", "s", "u"]
    one, other = product(names, before), product(names, after)
    forth, back = changes(one, other), changes(other, one)
    assert len(one.id) - forth.deaths + forth.births == len(other.id)
    assert np.array_equal(forth.born, back.died)
    assert np.array_equal(forth.died, back.born)
