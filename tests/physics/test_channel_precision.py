"""Carrier phase against closed form, to a thousandth of a radian, where float32 is far from that.

Over 2 km at 60 GHz and 1 km at 300 GHz a path is 400,000 and a million wavelengths long. Expected lengths
come from images of the numbers that the scene was written with; also where all of it lies 10 km out.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from caviar_labs.stability.formulas import C, mirrored, turn, unit
from caviar_labs.stability.lab import (
    Array,
    Plate,
    Thing,
    antenna,
    measure,
    scene,
    sionna,
    write_scenery,
)
from caviar_protocol.space.coordinates import quaternion_from_euler
from caviar_protocol.topics import Channel

pytestmark = pytest.mark.channel

LIMIT = 1e-3
"""[rad]"""

AT = [
    pytest.param(60e9, 2000.0, np.zeros(3), id="60 GHz, 2 km", marks=pytest.mark.exhaustive),
    pytest.param(300e9, 1000.0, np.zeros(3), id="300 GHz, 1 km", marks=pytest.mark.exhaustive),
    pytest.param(60e9, 2000.0, np.array([7931.37, -6112.83, 311.19]), id="60 GHz, 2 km, 10 km out"),
    pytest.param(300e9, 1000.0, np.array([-6207.91, 7846.23, 87.31]), id="300 GHz, 1 km, 10 km out"),
]


def phase_error(tau: float, length: float, frequency: float) -> float:
    """Of exp(−j2πfτ) [rad], where the path has this length [m]."""
    return float(2 * np.pi * frequency * abs(tau - length / C))


def phase_of(channel: Channel, path: int, length: float, frequency: float) -> float:
    """Angle of the amplitude without the phase of this length [rad]: that of the interaction alone."""
    return float(np.angle(channel.a[0, path] * np.exp(2j * np.pi * ((frequency * length / C) % 1.0))))


def slope(centre: Array, half: float) -> tuple[list[Any], Array]:
    """Corners of a tilted square, and its normal."""
    turned = turn(0.5, 0.35, -0.4)
    corners = [
        centre + turned @ np.array([x, y, 0.0]) * half for x, y in [(-1, -1), (1, -1), (1, 1), (-1, 1)]
    ]
    return corners, turned[:, 2]


@pytest.mark.parametrize(("frequency", "distance", "offset"), AT)
def test_two_rays(tmp_path: Path, frequency: float, distance: float, offset: Array) -> None:
    """The line of sight and the reflection by a tilted ground of metal, which hardly turns the field."""
    corners, normal = slope(offset, distance)
    assets = write_scenery(tmp_path, [Plate("ground", corners, "metal")])
    model = sionna(frequency, assets, max_depth=1, outside_itu_range="nearest")
    along = turn(0.5, 0.35, -0.4)
    tx = offset + along @ [-0.4931 * distance, 0.0213 * distance, 0.1571 * distance]
    rx = offset + along @ [0.5069 * distance, -0.0137 * distance, 0.1193 * distance]
    channel = measure(model, scene([antenna("t", "tx", tx), antenna("r", "rx", rx)]))
    assert channel.interactions[:, 0].tolist() == [0, 1]
    direct = float(np.linalg.norm(rx - tx))
    bounced = float(np.linalg.norm(rx - mirrored(tx, np.array(corners[0]), normal)))
    assert direct > 0.999 * distance
    assert phase_error(channel.tau[0], direct, frequency) < LIMIT
    assert phase_error(channel.tau[1], bounced, frequency) < LIMIT
    assert abs(phase_of(channel, 0, direct, frequency)) < LIMIT
    # at this conductivity the coefficient of the vertical field is turned a little beyond its sign
    assert abs(phase_of(channel, 1, bounced, frequency)) < 0.1


@pytest.mark.parametrize(("frequency", "distance", "offset"), AT)
def test_a_wall_that_moves(tmp_path: Path, frequency: float, distance: float, offset: Array) -> None:
    """Reflection at the side of a long turned body, frame after frame, where its pose says that it is."""
    model = sionna(frequency, {}, max_depth=1, bodies=1, outside_itu_range="nearest")
    yaw, pitch, roll = 0.371, 0.043, -0.027
    turned = turn(yaw, pitch, roll)
    size = np.array([0.6 * distance, 21.3, 90.7])
    tx = offset + turned @ [-0.4971 * distance, -71.3, 11.71]
    rx = offset + turned @ [0.5029 * distance, -60.9, -13.37]
    velocity = turned @ [3.1, -7.7, 0.3]
    for t in (0.0, 0.1, 3.7):
        middle = offset + np.array([11.37, 4.19, 2.23]) + velocity * t
        body = Thing(
            "train",
            middle.tolist(),
            size.tolist(),
            quaternion_from_euler(yaw, pitch, roll),
            velocity.tolist(),
        )
        channel = measure(model, scene([antenna("t", "tx", tx), antenna("r", "rx", rx)], [body]))
        assert [row for row in channel.interactions[:, 0].tolist() if row] == [1]
        (path,) = np.flatnonzero(channel.interactions[:, 0])
        face = middle + turned @ [0.0, -size[1] / 2, 0.0]
        image = mirrored(tx, face, turned[:, 1])
        length = float(np.linalg.norm(rx - image))
        assert channel.object_names == ("train",)
        assert phase_error(channel.tau[path], length, frequency) < LIMIT
        # The image moves by twice what the wall moves along its normal.
        rate = 2 * (velocity @ turned[:, 1]) * (turned[:, 1] @ unit(rx - image))
        expected = frequency * rate / C
        assert channel.doppler[0, path] == pytest.approx(expected, rel=1e-6)


@pytest.mark.parametrize(("frequency", "distance", "offset"), AT)
def test_over_a_knife_edge_that_moves(
    tmp_path: Path, frequency: float, distance: float, offset: Array
) -> None:
    """Diffraction over the upper edge of a turned body: Keller's point, by its distances from the edge."""
    model = sionna(
        frequency, {}, max_depth=1, reflection=False, diffraction=True, bodies=1, body_material="glass",
        outside_itu_range="nearest",
    )  # fmt: skip
    yaw, pitch, roll = 0.171, -0.023, 0.017
    turned, size = turn(yaw, pitch, roll), np.array([80.0, 700.0, 60.0])
    middle = offset + np.array([0.0131 * distance, 3.7, -11.3])
    body = Thing("house", middle.tolist(), size.tolist(), quaternion_from_euler(yaw, pitch, roll))
    tx = middle + turned @ [-0.4931 * distance, 41.3, 9.9]
    rx = middle + turned @ [40.0 + 0.5069 * distance, -27.1, 44.3]
    channel = measure(model, scene([antenna("t", "tx", tx), antenna("r", "rx", rx)], [body]))
    assert 2 in channel.interactions[:, :1]
    edges = [
        [middle + turned @ (size / 2 * [x, y, z]) for y in (-1, 1)] for x, z in ((1, 1), (-1, 1), (1, -1))
    ]
    lengths = [over_edge(tx, rx, *edge) for edge in edges]
    for path in np.flatnonzero(channel.interactions[:, 0] == 2):
        assert min(phase_error(channel.tau[path], length, frequency) for length in lengths) < LIMIT


def over_edge(tx: Array, rx: Array, one: Array, other: Array) -> float:
    """Length over a line, unfolded: the root of (a + b)² + c², with distances a, b and the part along it."""
    along = unit(other - one)
    a, b = (float(np.linalg.norm(np.cross(end - one, along))) for end in (tx, rx))
    return float(np.hypot(a + b, (rx - tx) @ along))


UTM = np.array([456_789.123, 5_412_345.678, 211.5])
"""[m]; a place in zone 32."""


@pytest.mark.parametrize("settings", [{"candidates": "enumerated"}, {"candidates": "launched"}])
def test_bodies_at_utm_coordinates_without_scenery_are_as_exact_as_at_the_origin(
    settings: dict[str, Any],
) -> None:
    """Two vehicles and a wall that drives, none of them scenery: paths, lengths and coefficients of the same
    world about the origin and 5,400 km from it, frame after frame. Counted in float32 from the origin of
    coordinates, a vehicle would be a staircase of 0.5 m."""
    model = sionna(28e9, bodies=4, samples=50_000, max_depth=2, **settings)

    def at(origin: Array, t: float) -> Channel:
        places = [(12.0 + 300.0 * t, 3.0, 0.9), (-9.0, 300.0 * t - 4.0, 1.6), (0.0, 11.0, 4.0)]
        a, b, wall = (np.array(place) for place in places)
        things = [
            Thing("a", origin + a, (4.5, 1.8, 1.5), quaternion_from_euler(0.4)),
            Thing("b", origin + b, (12.0, 2.5, 3.2), quaternion_from_euler(2.0)),
            Thing("wall", origin + wall, (40.0, 0.5, 8.0)),
        ]
        ends = [antenna("t", "tx", origin + np.array([-15.0, 0.5, 6.0]))]
        ends += [antenna(f"r{i}", "rx", origin + np.array([8 - 5.0 * i, i - 2, 2])) for i in range(3)]
        return measure(model, scene(ends, things))

    for t in (0.0, 0.01, 1.0):
        here, there = at(np.zeros(3), t), at(UTM, t)
        assert len(here.tau) >= 6
        np.testing.assert_array_equal(here.id, there.id)
        np.testing.assert_allclose(there.tau * C, here.tau * C, rtol=0, atol=5e-9)
        np.testing.assert_allclose(abs(there.a), abs(here.a), rtol=2e-4)
        points = [channel.points[channel.interactions > 0] for channel in (here, there)]
        np.testing.assert_allclose(points[1] - UTM, points[0], rtol=0, atol=5e-9)
