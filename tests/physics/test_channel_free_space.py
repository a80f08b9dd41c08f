"""Free space against Friis, the Doppler formula and exact element distances."""

from __future__ import annotations

import numpy as np
import pytest

from caviar_labs.stability.formulas import C, spherical_wave, turn, vertical
from caviar_labs.stability.lab import Thing, antenna, free_space, measure, scene
from caviar_protocol.space.coordinates import quaternion_from_euler
from caviar_protocol.topics import AntennaArray


@pytest.mark.parametrize("seed", range(4))
def test_friis_with_absolute_phase(seed: int) -> None:
    """a equals λ/(4πd)·exp(−j2πd/λ)·(mismatch) to 1e-7, at two carriers and any distance."""
    rng = np.random.default_rng(seed)
    tx, rx = rng.uniform(-300, 300, (2, 3))
    channel = measure(free_space(3.5e9, 140e9), scene([antenna("t", "tx", tx), antenna("r", "rx", rx)]))
    k = (rx - tx) / np.linalg.norm(rx - tx)
    mismatch = vertical(k) @ vertical(-k)
    for carrier, frequency in enumerate((3.5e9, 140e9)):
        expected = spherical_wave(float(np.linalg.norm(rx - tx)), frequency) * mismatch
        assert abs(channel.a[carrier, 0] - expected) < 1e-7 * abs(expected)
    assert channel.tau[0] == pytest.approx(np.linalg.norm(rx - tx) / C, rel=1e-14)


def test_path_loss_in_decibels() -> None:
    """Friis at 100 m and 28 GHz: 32.45 + 20·log10(0.1 km) + 20·log10(28,000 MHz) = 101.39 dB."""
    ends = [antenna("t", "tx", (0, 0, 10)), antenna("r", "rx", (60, 80, 10))]
    assert -20 * np.log10(abs(measure(free_space(28e9), scene(ends)).a[0, 0])) == pytest.approx(
        101.39, abs=5e-3
    )


def test_gain_of_directive_elements_adds() -> None:
    """Two sector antennas that face each other: 8 + 8 dB more than isotropic ones."""
    sector = AntennaArray(pattern="tr38901")
    back = quaternion_from_euler(np.pi)
    iso = [antenna("t", "tx", (0, 0, 5)), antenna("r", "rx", (90, 0, 5))]
    facing = [
        antenna("t", "tx", (0, 0, 5), sector),
        antenna("r", "rx", (90, 0, 5), sector, orientation=back),
    ]
    gain = abs(
        measure(free_space(28e9), scene(facing)).a[0, 0] / measure(free_space(28e9), scene(iso)).a[0, 0]
    )
    assert 20 * np.log10(gain) == pytest.approx(16.0, abs=1e-9)


@pytest.mark.parametrize("seed", range(4))
def test_doppler_of_both_ends(seed: int) -> None:
    """f_D = −f·dτ/dt of the moving ends, by differences over ±1 ms; to 1e-6 of the largest possible."""
    rng = np.random.default_rng(seed)
    ends, speeds = rng.uniform(-80, 80, (2, 3)), rng.uniform(-30, 30, (2, 3))

    def at(t: float) -> tuple[float, float]:
        things = [
            Thing(name, ends[i] + speeds[i] * t, velocity=speeds[i]) for i, name in enumerate(("car", "uav"))
        ]
        devices = [
            antenna("t", "tx", (0, 0, 1), parent="car"),
            antenna("r", "rx", (0, 0, -1), parent="uav"),
        ]
        channel = measure(free_space(28e9), scene(devices, things))
        return float(channel.tau[0]), float(channel.doppler[0, 0])

    rate = (at(1e-3)[0] - at(-1e-3)[0]) / 2e-3
    assert at(0.0)[1] == pytest.approx(-28e9 * rate, abs=1e-6 * 28e9 * 60 / C + 2e-3)


def test_approaching_raises_the_frequency() -> None:
    for name, velocity in (("t", (20.0, 0, 0)), ("r", (-20.0, 0, 0))):
        things = [Thing("t", (0, 0, 0), velocity=velocity if name == "t" else (0, 0, 0))]
        things.append(Thing("r", (100, 0, 0), velocity=velocity if name == "r" else (0, 0, 0)))
        devices = [antenna("t/a", "tx", (0, 0, 1), parent="t"), antenna("r/a", "rx", (0, 0, 1), parent="r")]
        doppler = measure(free_space(28e9), scene(devices, things)).doppler[0, 0]
        assert doppler == pytest.approx(28e9 * 20 / C, rel=1e-9)


def elements(rows: int, columns: int, vertical_spacing: float, horizontal_spacing: float) -> np.ndarray:  # type: ignore[type-arg]
    """Element positions [wavelengths] as the topic describes them: down each column, columns to +y."""
    places = []
    for column in range(columns):
        for row in range(rows):
            y = (column - (columns - 1) / 2) * horizontal_spacing
            z = ((rows - 1) / 2 - row) * vertical_spacing
            places.append([0.0, y, z])
    return np.array(places)


@pytest.mark.parametrize("seed", range(4))
def test_arrays_turn_with_their_vehicles(seed: int) -> None:
    """H between turned arrays on turned vehicles equals exp(−j2πd/λ) over the exact distance of every two
    elements, to 2e-3: at 4 km the wave is as good as plane. Poses are random, so a mirrored axis
    or a wrong element order shows."""
    rng = np.random.default_rng(seed)
    frequency = 28e9
    wavelength = C / frequency
    poses = rng.uniform(-np.pi, np.pi, (4, 3)) * np.array([1, 0.4, 0.9])
    far = rng.normal(size=3)
    centres = np.array([rng.uniform(-5, 5, 3), far / np.linalg.norm(far) * 4000])
    arrays = [
        AntennaArray(rows=3, columns=4, vertical_spacing=0.6, horizontal_spacing=0.45),
        AntennaArray(rows=2, columns=5, vertical_spacing=0.5, horizontal_spacing=0.7),
    ]
    mounts = [(0.3, -0.2, 1.1), (-0.5, 0.4, 0.9)]
    things, devices, places = [], [], []
    for i, name in enumerate(("a", "b")):
        body, mount = turn(*poses[i]), turn(*poses[2 + i])
        things.append(Thing(name, centres[i], quaternion=quaternion_from_euler(*poses[i])))
        role = ("tx", "rx")[i]
        orientation = quaternion_from_euler(*poses[2 + i])
        devices.append(antenna(f"{name}/x", role, mounts[i], arrays[i], parent=name, orientation=orientation))
        local = elements(
            arrays[i].rows, arrays[i].columns, arrays[i].vertical_spacing, arrays[i].horizontal_spacing
        )
        places.append(centres[i] + body @ np.array(mounts[i]) + (local * wavelength) @ (body @ mount).T)

    channel = measure(free_space(frequency), scene(devices, things))
    h = channel.h[0].h / channel.a[0, 0]
    middle = [place.mean(0) for place in places]
    distance = np.linalg.norm(places[1][:, None] - places[0][None], axis=-1)
    expected = np.exp(-2j * np.pi * (distance - np.linalg.norm(middle[1] - middle[0])) / wavelength)
    assert np.abs(h - expected).max() < 2e-3


def test_a_quarter_roll_is_a_polarisation_null() -> None:
    """A vertical element rolled by 90° about the line to a vertical one hears nothing."""
    ends = [
        antenna("t", "tx", (0, 0, 5)),
        antenna("r", "rx", (90, 0, 5), orientation=quaternion_from_euler(np.pi, 0, np.pi / 2)),
    ]
    assert abs(measure(free_space(28e9), scene(ends)).a[0, 0]) < 1e-15
