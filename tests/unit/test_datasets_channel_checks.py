"""Checks of paths by ``caviar dataset verify``: a right channel passes, each wrong quantity is found."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from msgspec.structs import replace

from caviar_clients.datasets.verification import Finding
from caviar_clients.datasets.verification.channel_checks import (
    Pair,
    check_gains,
    check_geometry,
    check_matrix,
    pair_of,
)
from caviar_protocol.space.coordinates import SPEED_OF_LIGHT
from caviar_protocol.topics import AntennaArray, AntennaDevice, Carrier, Channel, ChannelOptions, Scene
from caviar_protocol.topics.channel import Interaction
from caviar_services.channel.assemble import Product, assemble
from caviar_services.channel.paths import Antenna, PathTable, Turning
from caviar_services.channel.propagation.patterns import Patterns

CARRIERS = Carrier(name="low", frequency_hz=3.5e9), Carrier(name="high", frequency_hz=28e9)
LOSS = 0.7
"""Reflected share of the amplitude."""
TURNING = np.array([[0.0, 0.0, 0.02], [0.0, 0.0, 0.0]])
"""Of bus and car [rad/s]."""


def scene() -> Scene:
    """A car, and a bus whose side y = 12 m is a mirror, both moving; a base station over them."""
    return Scene(
        names=("bus", "car"),
        classes=("bus", "car"),
        assets=("", ""),
        position=np.array([[0.0, 13.25, 1.5], [20.0, 3.0, 0.75]]),
        orientation=np.tile([1.0, 0.0, 0.0, 0.0], (2, 1)),
        velocity=np.array([[3.0, -1.0, 0.0], [-14.0, 0.5, 0.0]]),
        dimensions=np.array([[200.0, 2.5, 30.0], [4.5, 1.8, 1.5]]),
        devices=(
            AntennaDevice(
                name="bs",
                role="tx",
                position=(0.0, 0.0, 10.0),
                array=AntennaArray(columns=8, pattern="tr38901"),
            ),
            AntennaDevice(
                name="car/rx",
                role="rx",
                parent="car",
                position=(0.0, 0.0, 0.85),
                array=AntennaArray(columns=2),
            ),
        ),
        angular_velocity=TURNING,
    )


def ends(where: Scene) -> tuple[Antenna, Antenna]:
    tx, rx = (Antenna.of(where, device, Patterns()) for device in where.devices)
    return tx, rx


def channel(kind: Interaction = Interaction.REFLECTION, rung: str = "siso-rt") -> Channel:
    """The line of sight, and a path by way of the bus."""
    where = scene()
    tx, rx = ends(where)
    image = rx.position * [1, -1, 1] + [0, 24, 0]
    share = (12.0 - tx.position[1]) / (image[1] - tx.position[1])
    lengths = np.array([np.linalg.norm(rx.position - tx.position), np.linalg.norm(image - tx.position)])
    wavelengths = SPEED_OF_LIGHT / np.array([carrier.frequency_hz for carrier in CARRIERS])
    spreading = wavelengths[:, None] / (4 * math.pi * lengths) * [1.0, LOSS]
    points = np.zeros((2, 1, 3))
    points[1, 0] = tx.position + share * (image - tx.position)
    table = PathTable(
        pair=np.zeros(2, np.int64),
        transfer=spreading[:, :, None, None] * np.eye(3, dtype=np.complex128),
        types=np.array([[0], [kind]], np.uint8),
        objects=np.array([[-1], [0]], np.int32),
        points=points,
        object_names=("bus",),
        object_velocity=where.velocity[:1],
        object_turning=Turning(where.position[:1], TURNING[:1]),
    )
    product = Product(rung=rung, options=ChannelOptions(reflection=True), carriers=CARRIERS, with_h=True)
    made, _ = assemble(product, [tx], [rx], table, np.array([[True]]))
    return made


def pair(of: Channel) -> Pair:
    where = scene()
    return pair_of((3, 5), where, of, (0, 0), ends(where))


def findings(of: Channel) -> list[Finding]:
    made = pair(of)
    found = [*check_geometry(made), *check_gains(made)]
    for one in of.h:
        found += check_matrix(made, one.carrier, one.h)
    return found


def whats(of: Channel) -> list[str]:
    return [finding.what for finding in findings(of)]


def test_a_right_channel_has_no_finding() -> None:
    made = channel()
    assert made.interactions.tolist() == [[0], [Interaction.REFLECTION]]
    assert abs(made.doppler[1, 1]) > 100  # both move, and the mirror turns
    assert findings(made) == []


REFLECTED = "path 1 (reflection at bus)"


def scaled(name: str, index: Any, factor: float) -> Callable[[Channel], Channel]:
    def change(made: Channel) -> Channel:
        values = getattr(made, name).copy()
        values[index] *= factor
        return replace(made, **{name: values})

    return change


def without_h(change: Callable[[Channel], Channel]) -> Callable[[Channel], Channel]:
    return lambda made: replace(change(made), h=())


WRONG: dict[str, tuple[Callable[[Channel], Channel], list[str]]] = {
    "delay": (scaled("tau", 1, 0.999), [f"delay of {REFLECTED}"]),
    "departure": (scaled("aod", (1, 1), -1), [f"aod of {REFLECTED}"]),
    "arrival": (scaled("aoa", (1, 0), 1.01), [f"aoa of {REFLECTED}"]),
    "Doppler shift of a carrier": (scaled("doppler", (1, 1), -1), [f"Doppler shift of {REFLECTED}, high"]),
    "Doppler shifts, a little": (
        scaled("doppler", (slice(None), 1), 1.001),
        [f"Doppler shift of {REFLECTED}, low", f"Doppler shift of {REFLECTED}, high"],
    ),
    "gain above free space": (scaled("a", (0, 1), 2.0), [f"gain of {REFLECTED}, low"]),
    "point": (scaled("points", (1, 0, 0), 1.1), [f"delay of {REFLECTED}"]),
}


@pytest.mark.parametrize("quantity", WRONG)
def test_a_wrong_quantity_of_a_reflected_path_is_found(quantity: str) -> None:
    change, expected = WRONG[quantity]
    found = findings(without_h(change)(channel()))
    assert [one.what for one in found][: len(expected)] == expected
    assert {(one.episode, one.scene, one.user) for one in found} == {(3, 5, "car/rx")}
    assert all(one.expected != one.found for one in found)


def test_gains_are_bounded_towards_the_path_and_not_by_the_strongest_direction() -> None:
    """A path that leaves beside the boresight of an element of 8 dBi has less than 8 dB above free space."""
    made = channel()
    towards = pair(made).ends[0].radiated(pair(made).geometry.departure)
    assert 20 * math.log10(np.linalg.norm(towards[1])) < 5.0
    change = scaled("a", (slice(None), 1), 10 ** (2.0 / 20) / LOSS)
    assert whats(without_h(change)(made)) == [f"gain of {REFLECTED}, low", f"gain of {REFLECTED}, high"]


@pytest.mark.parametrize(("kind", "factor"), [(Interaction.DIFFRACTION, 1.9), (Interaction.SCATTERING, 30.0)])
def test_what_bends_or_scatters_may_bring_more_than_its_length_says(kind: Interaction, factor: float) -> None:
    change = scaled("a", (slice(None), 1), factor / LOSS)
    assert whats(without_h(change)(channel(kind))) == []


@pytest.mark.parametrize("rung", ["siso-rt", "spherical"])
@pytest.mark.parametrize("factor", [2.0, 0.5])
def test_an_h_of_another_magnitude_is_found(rung: str, factor: float) -> None:
    made = channel(rung=rung)
    assert whats(made) == []
    wrong = replace(made, h=(made.h[0], replace(made.h[1], h=factor * made.h[1].h)))
    assert whats(wrong) == ["H, high"]


def test_an_h_of_spherical_waves_need_not_be_the_sum_of_plane_ones() -> None:
    made = channel(rung="spherical")
    bent = np.exp(0.3j * np.arange(8) ** 2)
    assert whats(replace(made, h=tuple(replace(one, h=one.h * bent) for one in made.h))) == []
    plane = replace(made, rung="siso-rt")
    assert whats(replace(plane, h=tuple(replace(one, h=one.h * bent) for one in made.h))) == [
        "H, low",
        "H, high",
    ]


def test_an_h_of_other_elements_is_found() -> None:
    made = channel()
    (finding,) = findings(replace(made, h=(replace(made.h[0], h=made.h[0].h[:, :4]), made.h[1])))
    assert (finding.expected, finding.found) == ("2 × 8 elements", "2 × 4")


def test_amplitudes_that_do_not_add_up_to_h_are_found() -> None:
    made = channel()
    assert whats(scaled("a", (1, 1), 0.5)(made)) == ["H, high"]
