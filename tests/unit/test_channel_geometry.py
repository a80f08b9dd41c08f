"""Delays, directions, Doppler shifts and specular points from corner points."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

from caviar_protocol.coordinates import SPEED_OF_LIGHT
from caviar_protocol.topics import Interaction
from caviar_services.channel.geometry import path_geometry
from caviar_services.channel.specular import refined_points

R, S, T = Interaction.REFLECTION, Interaction.SCATTERING, Interaction.TRANSMISSION
UP = np.array([0.0, 0.0, 1.0])


@pytest.mark.parametrize("seed", range(3))
def test_geometry_of_random_polylines(seed: int) -> None:
    """Delay, end directions and −dτ/dt of polylines of zero to three corners, all of which move."""
    rng = np.random.default_rng(seed)
    count = np.array([0, 1, 2, 3, 3])
    start, end = rng.uniform(-50, 50, (2, 5, 3))
    points = rng.uniform(-50, 50, (5, 3, 3))
    v_start, v_end = rng.uniform(-20, 20, (2, 5, 3))
    v_points = rng.uniform(-20, 20, (5, 3, 3))

    def lengths(t: float) -> list[float]:
        found = []
        for p in range(5):
            line = [
                start[p] + v_start[p] * t,
                *(points[p] + v_points[p] * t)[: count[p]],
                end[p] + v_end[p] * t,
            ]
            found.append(sum(float(np.linalg.norm(b - a)) for a, b in pairwise(line)))
        return found

    geometry = path_geometry(start, points, end, count, v_start, v_points, v_end)
    assert geometry.tau * SPEED_OF_LIGHT == pytest.approx(lengths(0), rel=1e-14)
    rate = (np.array(lengths(1e-5)) - np.array(lengths(-1e-5))) / 2e-5
    assert geometry.doppler_ratio * SPEED_OF_LIGHT == pytest.approx(-rate, abs=1e-5)
    for p in range(5):
        first = points[p, 0] if count[p] else end[p]
        last = points[p, count[p] - 1] if count[p] else start[p]
        assert np.cross(geometry.departure[p], first - start[p]) == pytest.approx(0, abs=1e-12)
        assert np.cross(geometry.arrival[p], last - end[p]) == pytest.approx(0, abs=1e-12)
        assert geometry.departure[p] @ (first - start[p]) > 0
        assert geometry.arrival[p] @ (last - end[p]) > 0


FLOOR_AND_WALL = (np.array([[[7.0, 7, 0], [10, -3, 9]]]), np.array([[[0.0, 0, -3], [2, 0, 0]]]))
"""Planes z = 0 and x = 10, given by odd points and normals of odd lengths and senses."""


def corner(noise: float) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:  # type: ignore[type-arg]
    """From (0, 0, 4) by floor and wall to (6, 6, 2): the image of the image is at (20, 0, −4); the line to it
    meets the wall after 4 of 14 m in x, and from there the line to (0, 0, −4) the floor after 1 of 15."""
    exact = np.array([[[28 / 3, 4.0, 0.0], [10.0, 30 / 7, 2 / 7]]])
    noisy = exact + np.random.default_rng(0).uniform(-noise, noise, exact.shape)
    return np.array([[0.0, 0, 4]]), noisy, np.array([[6.0, 6, 2]]), exact


def test_a_corner_reflector_by_hand() -> None:
    start, noisy, end, exact = corner(1e-3)
    found = refined_points(start, noisy, end, np.array([[R, R]], np.uint8), FLOOR_AND_WALL)
    assert found == pytest.approx(exact, abs=1e-12)


def test_transmission_does_not_bend() -> None:
    """Through z = 3, then off the floor: the floor is met where it would be without the sheet."""
    start, end = np.array([[0.0, 0, 4]]), np.array([[8.0, 0, 4]])
    planes = (np.array([[[9.0, 1, 3], [5, 5, 0]]]), np.tile(UP, (1, 2, 1)))
    exact = np.array([[[1.0, 0, 3], [4.0, 0, 0]]])
    found = refined_points(start, exact + 1e-4, end, np.array([[T, R]], np.uint8), planes)
    assert found == pytest.approx(exact, abs=1e-12)


@pytest.mark.parametrize("types", [[S, R], [R, Interaction.DIFFRACTION]])
def test_what_is_not_specular_stays(types: list[int]) -> None:
    start, noisy, end, _ = corner(1e-3)
    assert np.array_equal(
        refined_points(start, noisy, end, np.array([types], np.uint8), FLOOR_AND_WALL), noisy
    )


def test_a_point_far_from_where_it_was_traced_stays() -> None:
    """A plane that the path does not really use cannot carry it away."""
    start, noisy, end, _ = corner(1e-3)
    types = np.array([[R, R]], np.uint8)
    assert np.array_equal(refined_points(start, noisy + 0.2, end, types, FLOOR_AND_WALL), noisy + 0.2)


def test_a_line_along_the_plane_stays() -> None:
    """No crossing, no warning, no NaN."""
    start, end = np.array([[0.0, 0, 0]]), np.array([[8.0, 0, 0]])
    traced = np.array([[[4.0, 0, 0]]])
    found = refined_points(start, traced, end, np.array([[T]], np.uint8), (traced, UP[None, None]))
    assert np.array_equal(found, traced)
