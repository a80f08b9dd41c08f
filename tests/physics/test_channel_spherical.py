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
    transmit, receive = (places(a, c, g, frequency) for a, c, g in zip(arrays, (tx, rx), angles, strict=True))
    flip = np.array([1.0, 1.0, -1.0])
    direct, bounced = (
        wave(distances(receive, source), float(np.linalg.norm(rx - centre)), frequency)
        for source, centre in ((transmit, tx), (transmit * flip, tx * flip))
    )
    expected = channel.a[0, 0] * direct + channel.a[0, 1] * bounced
    assert np.abs(channel.h[0].h - expected).max() < 1e-6 * np.abs(channel.a[0, 1])


def test_diffraction_over_an_edge_has_the_shortest_way_of_each_pair(tmp_path: Path) -> None:
    """A block hides the receiver: the only paths go over its edge. Each pair's phase is that of the shortest
    way over the edge, found here by a search along it, within 1e-3 rad."""
    frequency = 10e9
    low, high = np.array([-6.0, 0.0, -4.0]), np.array([6.0, 9.0, 0.0])
    x0, y0, z0, x1, y1, z1 = *low, *high
    # One strip of two faces, folded at the edge: triangles of a fan around its first corner
    strip = [(x1, y0, z1), (x1, y1, z1), (x0, y1, z1), (x0, y0, z1), (x0, y0, z0), (x1, y0, z0)]
    model = sionna(
        frequency,
        write_scenery(tmp_path, [Plate("block", strip, "metal")]),
        max_depth=1,
        reflection=False,
        diffraction=True,
        rung="spherical",
        samples=100_000,
    )
    tx, rx = np.array([0.4, -3.0, -1.2]), np.array([-0.7, 2.5, 0.5])
    arrays = [AntennaArray(rows=3, columns=4), AntennaArray(rows=2, columns=3)]
    angles = np.array([[1.4, 0.1, 0.2], [-1.5, 0.3, -0.1]])
    devices = [
        antenna(name, role, centre, array, orientation=quaternion_from_euler(*angle))
        for name, role, centre, array, angle in zip("tr", ("tx", "rx"), (tx, rx), arrays, angles, strict=True)
    ]
    channel = measure(model, scene(devices))
    assert channel.interactions.tolist() == [[2]]
    transmit, receive = (places(a, c, g, frequency) for a, c, g in zip(arrays, (tx, rx), angles, strict=True))

    def shortest(a: Array, b: Array) -> float:
        left, right = -6.0, 6.0
        for _ in range(60):  # a third less each time, around the minimum of a convex function
            third = (right - left) / 3
            one, other = (
                np.linalg.norm(a - [x, 0, 0]) + np.linalg.norm(b - [x, 0, 0])
                for x in (left + third, right - third)
            )
            left, right = (left, right - third) if one < other else (left + third, right)
        return float(np.linalg.norm(a - [left, 0, 0]) + np.linalg.norm(b - [left, 0, 0]))

    lengths = np.array([[shortest(t, r) for t in transmit] for r in receive])
    turns = (lengths - shortest(tx, rx)) * frequency / C
    got = channel.h[0].h / channel.a[0, 0]
    assert np.abs(np.angle(got * np.exp(2j * np.pi * turns))).max() < 1e-3
    assert np.abs(np.abs(got) - 1).max() < 0.1


def test_scattering_keeps_its_points(tmp_path: Path) -> None:
    """Over rough ground, each pair's wave goes by way of the points where the paths were scattered: H from
    the product's own points and amplitudes, by 1/(d·d') and the way of each pair, within 1e-6."""
    frequency = 28e9
    model = sionna(
        frequency,
        write_scenery(tmp_path, [GROUND]),
        max_depth=1,
        los=False,
        reflection=False,
        scattering=True,
        rung="spherical",
        samples=300,
        materials={"skin-ground": {"scattering_coefficient": 0.7}},
    )
    tx, rx = np.array([0.3, -0.2, 1.6]), np.array([2.1, 0.7, 1.1])
    array = AntennaArray(rows=3, columns=3)
    angles = np.array([[0.3, 0.2, 0.1], [2.7, -0.3, 0.4]])
    devices = [
        antenna(name, role, centre, array, orientation=quaternion_from_euler(*angle))
        for name, role, centre, angle in zip("tr", ("tx", "rx"), (tx, rx), angles, strict=True)
    ]
    channel = measure(model, scene(devices))
    assert len(channel.tau) > 20
    assert (channel.interactions == 3).all()
    transmit, receive = (places(array, c, g, frequency) for c, g in zip((tx, rx), angles, strict=True))
    expected = np.zeros((9, 9), complex)
    for a, (point,) in zip(channel.a[0], channel.points, strict=True):
        sent, taken = (np.linalg.norm(x - point, axis=-1) for x in (transmit, receive))
        centres = np.linalg.norm(tx - point), np.linalg.norm(rx - point)
        turns = (taken[:, None] + sent - sum(centres)) * frequency / C
        loss = centres[0] * centres[1] / (taken[:, None] * sent)
        expected += a * loss * np.exp(-2j * np.pi * turns)
    assert np.abs(channel.h[0].h - expected).max() < 1e-6 * np.abs(expected).max()


def test_elements_behind_a_screen_receive_nothing(tmp_path: Path) -> None:
    """The edge of a screen stands between the arrays: of 24×20 pairs, those whose straight line passes
    beside it have their wave, the others have none. The lines are tested here by hand."""
    frequency = 6e9
    edge = 0.263
    screen = Plate("screen", [(2, edge, -3), (2, 6, -3), (2, 6, 9), (2, edge, 9)], "metal")
    tx, rx = np.array([0.0, 0.2, 1.0]), np.array([4.0, 0.3, 1.1])
    arrays = [AntennaArray(columns=20), AntennaArray(rows=2, columns=12)]
    angles = np.array([[0.0, 0.0, 0.0], [np.pi, 0.0, 0.0]])
    devices = [
        antenna(name, role, centre, array, orientation=quaternion_from_euler(*angle))
        for name, role, centre, array, angle in zip("tr", ("tx", "rx"), (tx, rx), arrays, angles, strict=True)
    ]
    model = sionna(frequency, write_scenery(tmp_path, [screen]), reflection=False, rung="spherical")
    transmit, receive = (places(a, c, g, frequency) for a, c, g in zip(arrays, (tx, rx), angles, strict=True))
    passes = (receive[:, None, 1] + transmit[None, :, 1]) / 2 < edge
    assert passes.any()
    assert not passes.all()
    h = measure(model, scene(devices)).h[0].h
    centre = float(np.linalg.norm(rx - tx))
    expected = (
        wave(distances(receive, transmit), centre, frequency) * passes * C / frequency / (4 * np.pi * centre)
    )
    expected = expected * np.exp(-2j * np.pi * centre * frequency / C)
    assert np.array_equal(h != 0, passes)
    assert np.abs(np.abs(h) - np.abs(expected)).max() < 1e-5 * np.abs(expected).max()
