"""The traced channel against closed forms: free space, two rays over ground, one wall, polarisation."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from caviar_labs.stability.formulas import (
    C,
    horizontal,
    itu_permittivity,
    mirrored,
    reflected,
    spherical_wave,
    turn,
    unit,
    vertical,
)
from caviar_labs.stability.lab import (
    Array,
    Plate,
    antenna,
    free_space,
    measure,
    pair_sums,
    scene,
    sionna,
    write_scenery,
)
from caviar_protocol.space.coordinates import quaternion_from_euler
from caviar_protocol.topics import AntennaArray
from caviar_services.channel.base import ChannelModel

pytestmark = pytest.mark.channel

CONCRETE = (5.24, 0.0, 0.0462, 0.7822)
GLASS = (6.31, 0.0, 0.0036, 1.3394)
FIELD = {"V": vertical, "H": horizontal}

GROUND = Plate("ground", [(-900, -900, 0), (900, -900, 0), (900, 900, 0), (-900, 900, 0)])


@pytest.fixture(scope="module")
def over_ground(tmp_path_factory: pytest.TempPathFactory) -> ChannelModel[Any]:
    assets = write_scenery(tmp_path_factory.mktemp("ground"), [GROUND])
    return sionna(3.5e9, assets, receivers_at_once=60, max_depth=1)


def two_rays(tx: Array, rx: Array, origin: Array, normal: Array, eta: complex, pol: str, f: float) -> complex:
    """Direct ray and the one reflected by a plane, of isotropic elements of one polarisation."""
    field = FIELD[pol]
    k = unit(rx - tx)
    h = spherical_wave(float(np.linalg.norm(rx - tx)), f) * (field(k) @ field(-k))
    image = mirrored(tx, origin, normal)
    k_out = unit(rx - image)
    k_in = k_out - 2 * np.dot(k_out, normal) * normal
    arrived = reflected(field(k_in), k_in, normal, eta)
    return complex(h + spherical_wave(float(np.linalg.norm(rx - image)), f) * (field(-k_out) @ arrived))


@pytest.mark.parametrize("polarization", ["V", "H"])
def test_two_ray_ground_over_distance(over_ground: ChannelModel[Any], polarization: str) -> None:
    """Sixty receivers from 15 to 640 m along a slanted line over ITU concrete: the complex sum of both
    rays equals the closed form within 1 % of the direct ray, at every distance, through all fades."""
    tx = np.array([-31.0, 12.0, 9.3])
    away = np.array([0.8, -0.6, 0.0])
    places = [tx * [1, 1, 0] + away * d + [0, 0, 1.7] for d in np.geomspace(15, 640, 60)]
    array = AntennaArray(polarization=polarization)  # type: ignore[arg-type]
    devices = [antenna(f"r{i:02d}", "rx", place, array) for i, place in enumerate(places)]
    channel = measure(over_ground, scene([antenna("t", "tx", tx, array), *devices]))
    assert np.diff(channel.offsets).tolist() == [2] * 60
    eta = itu_permittivity(*CONCRETE, 3.5e9)
    up = np.array([0.0, 0.0, 1.0])
    expected = np.array([two_rays(tx, p, np.zeros(3), up, eta, polarization, 3.5e9) for p in places])
    direct = np.array([abs(spherical_wave(float(np.linalg.norm(p - tx)), 3.5e9)) for p in places])
    assert (np.abs(pair_sums(channel) - expected) / direct).max() < 0.01
    fading = 20 * np.log10(np.abs(expected) / direct)
    assert fading.max() - fading.min() > 15


@pytest.mark.parametrize("polarization", ["V", "H"])
def test_single_wall_reflection_over_distance(tmp_path: Path, polarization: str) -> None:
    """A slanted glass wall, receivers that drive off at random heights: complex sum within 1 % of the direct
    ray, while reflection and direct ray run in and out of phase."""
    turned = turn(0.4, 0.3, 0.0)
    normal = turned @ np.array([1.0, 0.0, 0.0])
    origin = np.array([-7.0, 3.0, 5.0])
    corners = [
        origin + turned @ np.array([0.0, y, z]) for y, z in [(-400, -99), (400, -99), (400, 99), (-400, 99)]
    ]
    model = sionna(
        5.8e9, write_scenery(tmp_path, [Plate("wall", corners, "glass")]), receivers_at_once=40, max_depth=1
    )
    rng = np.random.default_rng(3)
    tx = origin + normal * 6 + [0.4, 1.2, 0.3]
    along = turned @ np.array([0.0, 1.0, 0.0])
    places = [
        tx + along * d + normal * rng.uniform(-2, 9) + [0, 0, rng.uniform(-3, 3)]
        for d in np.linspace(4, 90, 40)
    ]
    array = AntennaArray(polarization=polarization)  # type: ignore[arg-type]
    devices = [antenna(f"r{i:02d}", "rx", place, array) for i, place in enumerate(places)]
    channel = measure(model, scene([antenna("t", "tx", tx, array), *devices]))
    eta = itu_permittivity(*GLASS, 5.8e9)
    expected = np.array([two_rays(tx, p, origin, normal, eta, polarization, 5.8e9) for p in places])
    direct = np.array([abs(spherical_wave(float(np.linalg.norm(p - tx)), 5.8e9)) for p in places])
    assert np.diff(channel.offsets).tolist() == [2] * 40
    assert (np.abs(pair_sums(channel) - expected) / direct).max() < 0.01
    assert channel.object_names == ("wall",)
    assert np.ptp(20 * np.log10(np.abs(expected) / direct)) > 6


def test_far_from_the_origin_the_phase_of_a_reflection_is_exact(tmp_path: Path) -> None:
    """Three kilometres out, at 60 GHz, where float32 points are off by 1e-4 m: the delay of the ground
    reflection by way of a tilted plane equals that of the image within 1e-5 of a period."""
    centre = np.array([3100.0, -2750.0, 412.0])
    turned = turn(0.5, 0.2, -0.1)
    corners = [
        centre + turned @ np.array([x, y, 0.0]) for x, y in [(-70, -70), (70, -70), (70, 70), (-70, 70)]
    ]
    model = sionna(60e9, write_scenery(tmp_path, [Plate("slope", corners)]), max_depth=1)
    # The plane is that of the corners as they are written in the file.
    held = np.array(corners)
    normal = unit(np.cross(held[1] - held[0], held[2] - held[0]))
    tx, rx = centre + turned @ [-31.3, 4.2, 11.7], centre + turned @ [24.9, -17.4, 6.1]
    channel = measure(model, scene([antenna("t", "tx", tx), antenna("r", "rx", rx)]))
    assert channel.interactions.tolist() == [[0], [1]]
    for path, length in enumerate((rx - tx, rx - mirrored(tx, held[0], normal))):
        assert abs(channel.tau[path] * 60e9 - np.linalg.norm(length) / C * 60e9) < 1e-5


@pytest.fixture(scope="module")
def nothing_there() -> ChannelModel[Any]:
    return sionna(28e9, samples=1000, max_depth=1)


@pytest.mark.parametrize("seed", range(6))
def test_line_of_sight_equals_free_space(nothing_there: ChannelModel[Any], seed: int) -> None:
    """Amplitude within 1e-5, absolute phase within 1e-5 rad, arrays, patterns and polarisations at
    random: the delay of a straight path is exact."""
    rng = np.random.default_rng(seed)
    devices = []
    for i, role in enumerate(("tx", "tx", "rx", "rx", "rx")):
        array = AntennaArray(
            rows=int(rng.integers(1, 4)),
            columns=int(rng.integers(1, 5)),
            pattern=("iso", "dipole", "hw_dipole", "tr38901")[rng.integers(4)],
            polarization="VH"[rng.integers(2)],
        )
        pose = quaternion_from_euler(*rng.uniform(-np.pi, np.pi, 3) * [1, 0.5, 1])
        devices.append(antenna(f"{role}{i}", role, rng.uniform(-200, 200, 3), array, orientation=pose))
    traced, formula = measure(nothing_there, scene(devices)), measure(free_space(28e9), scene(devices))
    assert np.array_equal(traced.offsets, formula.offsets)
    assert np.array_equal(traced.tau, formula.tau)
    scale = np.abs(formula.a).max()
    assert np.abs(traced.a - formula.a).max() < 1e-5 * scale
    for one, other in zip(traced.h, formula.h, strict=True):
        assert np.abs(one.h - other.h).max() < 1e-5 * scale


@pytest.mark.parametrize("up", [1.0, -1.0])
def test_line_of_sight_straight_up_equals_free_space(nothing_there: ChannelModel[Any], up: float) -> None:
    """At the poles of the angles nothing jumps: a UAV exactly above or below."""
    tilt = quaternion_from_euler(0.3, 0.8, 0.2)
    array = AntennaArray(columns=3)
    devices = [
        antenna("t", "tx", (3, 4, 5), array, orientation=tilt),
        antenna("r", "rx", (3, 4, 5 + 40 * up), array, orientation=quaternion_from_euler(-1, -0.7, 0.1)),
    ]
    traced, formula = measure(nothing_there, scene(devices)), measure(free_space(28e9), scene(devices))
    assert np.abs(traced.h[0].h - formula.h[0].h).max() < 1e-5 * np.abs(formula.a).max()


def test_a_quarter_roll_is_a_polarisation_null(nothing_there: ChannelModel[Any]) -> None:
    """100 dB below the upright receiver, as float32 allows."""
    facing, rolled = quaternion_from_euler(np.pi), quaternion_from_euler(np.pi, 0, np.pi / 2)
    levels = []
    for pose in (facing, rolled):
        devices = [antenna("t", "tx", (0, 0, 5)), antenna("r", "rx", (90, 0, 5), orientation=pose)]
        levels.append(np.abs(pair_sums(measure(nothing_there, scene(devices)))[0]))
    assert levels[1] < 1e-5 * levels[0]


def test_reflected_path_of_turned_arrays(over_ground: ChannelModel[Any]) -> None:
    """H over ground of two randomly turned arrays has, element by element, the phase of the exact
    direct distance and of the exact image distance, within 0.02 rad over 700 m."""
    frequency = 3.5e9
    wavelength = C / frequency
    rng = np.random.default_rng(11)
    tx, rx = np.array([-300.0, -40.0, 60.0]), np.array([330.0, 210.0, 45.0])
    arrays = [AntennaArray(rows=2, columns=4), AntennaArray(rows=3, columns=2, horizontal_spacing=0.8)]
    angles = rng.uniform(-1.2, 1.2, (2, 3))
    devices = [
        antenna(name, role, place, array, orientation=quaternion_from_euler(*angle))
        for name, role, place, array, angle in zip("tr", ("tx", "rx"), (tx, rx), arrays, angles, strict=True)
    ]
    channel = measure(over_ground, scene(devices))
    assert channel.interactions.tolist() == [[0], [1]]
    both = channel.h[0].h
    places = []
    for array, centre, angle in zip(arrays, (tx, rx), angles, strict=True):
        grid = [
            [0.0, (c - (array.columns - 1) / 2) * array.horizontal_spacing, ((array.rows - 1) / 2 - r) / 2]
            for c in range(array.columns)
            for r in range(array.rows)
        ]
        places.append(centre + (np.array(grid) * wavelength) @ turn(*angle).T)

    def phases(transmit: Array) -> Array:
        distance = np.linalg.norm(places[1][:, None] - transmit[None], axis=-1)
        return np.exp(-2j * np.pi * (distance / wavelength))

    flip = np.array([1.0, 1.0, -1.0])
    direct, image = phases(places[0]), phases(places[0] * flip)
    # Two unknown amplitudes, 48 elements: the fit is exact only where every phase is right.
    model = np.stack([direct.ravel(), image.ravel()], axis=1)
    amplitudes, *_ = np.linalg.lstsq(model, both.ravel(), rcond=None)
    rest = np.abs(model @ amplitudes - both.ravel()).max()
    assert rest < 0.02 * np.abs(amplitudes).min()
    assert np.abs(amplitudes) == pytest.approx(np.abs(channel.a[0]), rel=0.02)
