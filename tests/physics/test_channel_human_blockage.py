"""People as screens: blockage model B of TR 38.901, section 7.6.4.2; its formulas, written here once more."""

from __future__ import annotations

import cmath
import math

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from caviar_protocol.topics import Carrier, Interaction
from caviar_services.channel.propagation.attenuation import HumanBlockage, HumanBlockageSettings
from caviar_services.channel.sionna.settings import SionnaSettings

C = 299792458.0
FREQUENCIES = (28e9, 60e9)
CARRIERS = tuple(Carrier(name=f"{f / 1e9:g}", frequency_hz=f) for f in FREQUENCIES)
TOLERANCE_DB = 0.1
NO_POINTS = np.zeros((1, 0, 3)), np.zeros((1, 0), np.uint8)


def one_view(a: complex, b: complex, edges: tuple[complex, complex], wavelength: float) -> float:
    """Sum of F over two edges; points of a view are complex numbers, and the screen is between its edges."""
    ways = [abs(e - a) + abs(e - b) - abs(b - a) for e in edges]
    f = [math.atan(math.pi / 2 * math.sqrt(math.pi / wavelength * max(w, 0.0))) / math.pi for w in ways]
    # In the way: seen from the line's beginning, the edges are on both sides of it.
    sides = [((e - a) / (b - a)).imag for e in edges]
    if sides[0] * sides[1] <= 0:
        return f[0] + f[1]
    return max(f) - min(f)


def loss_db(
    tx: tuple[float, float, float],
    rx: tuple[float, float, float],
    feet: tuple[float, float, float],
    size: tuple[float, float, float],
    yaw: float,
    frequency: float,
) -> float:
    """Of the straight path between two points by one person."""
    a, b, p = (complex(*point[:2]) for point in (tx, rx, feet))
    towards = (b - a) / abs(b - a)
    at = ((p - a) / towards).real
    if not 0 < at < abs(b - a):
        return 0.0
    # The outline's points, seen across the path: the widest of many.
    outline = [
        cmath.rect(1, yaw) * complex(size[0] / 2 * math.cos(t), size[1] / 2 * math.sin(t))
        for t in np.linspace(0, 2 * math.pi, 4001)
    ]
    half = max((q / towards).imag for q in outline)
    wavelength = C / frequency
    top = one_view(a, b, (p - 1j * half * towards, p + 1j * half * towards), wavelength)
    upright = one_view(
        complex(0, tx[2]),
        complex(abs(b - a), rx[2]),
        (complex(at, feet[2]), complex(at, feet[2] + size[2])),
        wavelength,
    )
    return -20 * math.log10(1 - upright * top)


def of_model(people: HumanBlockage, tx: object, rx: object) -> list[float]:
    """Loss of the straight path on each carrier [dB]."""
    start, end = np.array([tx], float), np.array([rx], float)
    factor = people.amplitude_factor(start, NO_POINTS[0], end, NO_POINTS[1])
    return [-20 * math.log10(f) for f in factor[:, 0]]


def people_at(*who: tuple[tuple[float, float, float], tuple[float, float, float], float]) -> HumanBlockage:
    found = HumanBlockage(HumanBlockageSettings(), CARRIERS)
    found.put(*(np.array(column, float) for column in zip(*who, strict=True)))
    return found


plane = st.floats(-8.0, 8.0)
sizes = st.tuples(st.floats(0.2, 0.5), st.floats(0.3, 0.8), st.floats(1.2, 2.1))


@given(
    st.tuples(st.just(-12.0), plane, st.floats(0.5, 12.0)),
    st.tuples(st.just(12.0), plane, st.floats(0.5, 3.0)),
    st.tuples(plane, plane, st.floats(-0.5, 0.5)),
    sizes,
    st.floats(-math.pi, math.pi),
)
def test_the_loss_is_that_of_the_report_within_a_tenth_of_a_decibel(
    tx: tuple[float, float, float],
    rx: tuple[float, float, float],
    feet: tuple[float, float, float],
    size: tuple[float, float, float],
    yaw: float,
) -> None:
    found = of_model(people_at((feet, size, yaw)), tx, rx)
    expected = [loss_db(tx, rx, feet, size, yaw, f) for f in FREQUENCIES]
    assert found == pytest.approx(expected, abs=TOLERANCE_DB)


def test_the_deep_shadow_by_hand() -> None:
    """Middle of 10 m, 0.5 m wide, higher than the path by 0.2 m, feet 1.5 m below: each F from its detour."""
    detours = {
        "w": 2 * math.hypot(5, 0.25) - 10,
        "h1": 2 * math.hypot(5, 0.2) - 10,
        "h2": 2 * math.hypot(5, 1.5) - 10,
    }
    for frequency, found in zip(
        FREQUENCIES,
        of_model(people_at(((5, 0, 0), (0.3, 0.5, 1.7), 0.0)), (0, 0, 1.5), (10, 0, 1.5)),
        strict=True,
    ):
        f = {
            edge: math.atan(math.pi / 2 * math.sqrt(math.pi * frequency / C * d)) / math.pi
            for edge, d in detours.items()
        }
        assert found == pytest.approx(-20 * math.log10(1 - (f["h1"] + f["h2"]) * 2 * f["w"]), abs=1e-9)
        assert found > 5.0


def test_losses_of_several_people_are_added_and_far_ones_take_nothing() -> None:
    first, second = ((4.0, 0.1, 0.0), (0.3, 0.5, 1.7), 0.4), ((7.0, -0.2, 0.0), (0.3, 0.5, 1.8), 2.0)
    ends = (0, 0, 1.5), (10, 0, 1.4)
    both = of_model(people_at(first, second), *ends)
    alone = [of_model(people_at(one), *ends) for one in (first, second)]
    assert both == pytest.approx(np.sum(alone, axis=0), abs=1e-9)
    for far in ((5.0, 60.0, 0.0), (-3.0, 0.0, 0.0), (11.0, 0.0, 0.0)):
        assert of_model(people_at((far, (0.3, 0.5, 1.7), 0.0)), *ends) == pytest.approx([0, 0], abs=0.01)


def test_a_reflected_path_is_unfolded() -> None:
    """Over a wall at y = 6: the same as the straight path to the image, for a person on either leg."""
    tx, rx, wall = np.array([0.0, 0.0, 3.0]), np.array([10.0, 2.0, 1.5]), 6.0
    image = rx * [1, -1, 1] + [0, 2 * wall, 0]
    share = (wall - tx[1]) / (image[1] - tx[1])
    point = tx + share * (image - tx)
    types = np.array([[Interaction.REFLECTION]], np.uint8)
    for x, y, mirrored in ((3.0, 3.0, False), (8.2, 4.4, True)):
        size, yaw = (0.3, 0.5, 1.7), 0.7
        people = people_at(((x, y, 0.0), size, yaw))
        factor = people.amplitude_factor(tx[None], point[None, None], rx[None], types)
        seen = ((x, 2 * wall - y, 0.0), size, -yaw) if mirrored else ((x, y, 0.0), size, yaw)
        for carrier, frequency in enumerate(FREQUENCIES):
            # The first leg, or the second one, is the only one beside which the person stands.
            expected = loss_db(tuple(tx), tuple(image), *seen, frequency)
            assert -20 * math.log10(factor[carrier, 0]) == pytest.approx(expected, abs=TOLERANCE_DB)


def test_a_size_of_its_own_is_that_of_each_screen() -> None:
    people = HumanBlockage(HumanBlockageSettings(width_m=0.3, height_m=1.7), CARRIERS)
    people.put(np.array([[5.0, 0.1, 0.0]]), np.array([[0.9, 0.9, 1.2]]), np.array([0.3]))
    tx, rx = (0.0, 0.0, 1.5), (10.0, 0.0, 1.5)
    expected = [loss_db(tx, rx, (5.0, 0.1, 0.0), (0.3, 0.3, 1.7), 0.0, f) for f in FREQUENCIES]
    assert of_model(people, tx, rx) == pytest.approx(expected, abs=1e-3)


@pytest.mark.parametrize(
    ("settings", "says"),
    [
        ({}, r"traced bodies would block the same paths again; write without_body = \['pedestrian'\]"),
        (
            {"without_body": ["pedestrian"], "foliage": {"pedestrian": {}}},
            "'pedestrian' is a screen of human_blockage and stands in foliage, too",
        ),
    ],
)
def test_people_who_would_block_twice_are_refused(settings: dict[str, object], says: str) -> None:
    with pytest.raises(msgspec.ValidationError, match=says):
        msgspec.convert({"human_blockage": {}, **settings}, SionnaSettings)
