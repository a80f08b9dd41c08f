"""The rungs above plane waves: antenna pairs of their own length and visibility, against closed forms."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from channel_lab import Array, C, Plate, antenna, measure, scene, sionna, turn, write_scenery

from caviar_protocol.coordinates import quaternion_from_euler
from caviar_protocol.topics import AntennaArray

pytestmark = pytest.mark.channel

GROUND = Plate("ground", [(-90, -90, 0), (90, -90, 0), (90, 90, 0), (-90, 90, 0)])


def places(array: AntennaArray, centre: Array, angle: Array, frequency: float) -> Array:
    """Where the elements stand [m], written out."""
    grid = [
        [
            0.0,
            (c - (array.columns - 1) / 2) * array.horizontal_spacing,
            ((array.rows - 1) / 2 - r) * array.vertical_spacing,
        ]
        for c in range(array.columns)
        for r in range(array.rows)
    ]
    return centre + (np.array(grid) * C / frequency) @ turn(*angle).T


def distances(receive: Array, transmit: Array) -> Array:
    return np.linalg.norm(receive[:, None] - transmit[None], axis=-1)


def wave(length: Array, at_centre: float, frequency: float) -> Array:
    """Spherical wave relative to that over the centres' length."""
    return at_centre / length * np.exp(-2j * np.pi * (length - at_centre) * frequency / C)


@pytest.mark.parametrize("seed", range(3))
def test_line_of_sight_in_the_near_field_is_exact(seed: int) -> None:
    """Two turned planar arrays one metre apart at 28 GHz, where a plane wave is wrong by radians: every pair
    has the phase and amplitude of its own distance within 1e-6, and the plane wave has not."""
    rng = np.random.default_rng(seed)
    centres = [np.array([3.0, -2.0, 5.0]), np.array([3.0, -2.0, 5.0]) + turn(*rng.uniform(-1, 1, 3))[0]]
    arrays = [AntennaArray(rows=8, columns=4), AntennaArray(rows=3, columns=11, horizontal_spacing=0.9)]
    angles = rng.uniform(-1.2, 1.2, (2, 3))
    devices = [
        antenna(name, role, centre, array, orientation=quaternion_from_euler(*angle))
        for name, role, centre, array, angle in zip("tr", ("tx", "rx"), centres, arrays, angles, strict=True)
    ]
    transmit, receive = (places(a, c, g, 28e9) for a, c, g in zip(arrays, centres, angles, strict=True))
    shapes = {}
    for rung in ("siso-rt", "spherical"):
        channel = measure(sionna(28e9, samples=1000, reflection=False, rung=rung), scene(devices))
        assert channel.rung == rung
        shapes[rung] = channel.h[0].h / channel.a[0, 0]
    expected = wave(distances(receive, transmit), 1.0, 28e9)
    assert np.abs(shapes["spherical"] - expected).max() < 1e-6
    assert np.abs(shapes["siso-rt"] - expected).max() > 0.1


def test_two_rays_over_ground_in_the_near_field(tmp_path: Path) -> None:
    """A metre apart and half a metre above the ground: H less the exact direct wave is the exact wave from
    the image, of one complex amplitude for all pairs, within 1e-6 of it."""
    frequency = 28e9
    model = sionna(frequency, write_scenery(tmp_path, [GROUND]), max_depth=1, rung="spherical")
    tx, rx = np.array([0.3, -0.2, 0.61]), np.array([1.15, 0.33, 0.47])
    arrays = [AntennaArray(rows=4, columns=4), AntennaArray(rows=2, columns=8)]
    angles = np.array([[0.3, 0.2, 0.1], [2.7, -0.3, 0.4]])
    devices = [
        antenna(name, role, centre, array, orientation=quaternion_from_euler(*angle))
        for name, role, centre, array, angle in zip("tr", ("tx", "rx"), (tx, rx), arrays, angles, strict=True)
    ]
    channel = measure(model, scene(devices))
    assert channel.interactions.tolist() == [[0], [1]]
    transmit, receive = (
        places(a, c, g, frequency) for a, c, g in zip(arrays, (tx, rx), angles, strict=True)
    )
    flip = np.array([1.0, 1.0, -1.0])
    direct, bounced = (
        wave(distances(receive, source), float(np.linalg.norm(rx - centre)), frequency)
        for source, centre in ((transmit, tx), (transmit * flip, tx * flip))
    )
    expected = channel.a[0, 0] * direct + channel.a[0, 1] * bounced
    assert np.abs(channel.h[0].h - expected).max() < 1e-6 * np.abs(channel.a[0, 1])
