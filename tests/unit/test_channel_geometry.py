"""Delays, directions, Doppler shifts and specular points from corner points."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

from caviar_protocol.space.coordinates import SPEED_OF_LIGHT
from caviar_protocol.topics import Interaction
from caviar_services.channel.paths import path_geometry
from caviar_services.channel.propagation.image_method import distinct, image_points, refined_points

pytestmark = pytest.mark.slow

R, S, T = Interaction.REFLECTION, Interaction.SCATTERING, Interaction.TRANSMISSION
D = Interaction.DIFFRACTION


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


FLOOR_AND_WALL = np.array(
    [[[[7.0, 7, 0], [9, 8, 0], [7, 12, 0]], [[10, -3, 9], [10, -1, 9], [10, 30 / 7, 2 / 7]]]]
)
"""Triangles of odd places and senses in the planes z = 0 and x = 10."""


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
    sheets = np.array([[[[9.0, 1, 3], [9, 2, 3], [7, 1, 3]], [[5, 5, 0], [6, 5, 0], [5, 6, 0]]]])
    exact = np.array([[[1.0, 0, 3], [4.0, 0, 0]]])
    found = refined_points(start, exact + 1e-4, end, np.array([[T, R]], np.uint8), sheets)
    assert found == pytest.approx(exact, abs=1e-12)


def test_a_scattering_point_stays_in_its_plane_and_the_rest_is_specular() -> None:
    """The traced point is moved along the normal only; from there the wall is met by the image."""
    start, end = np.array([[0.0, 0, 4]]), np.array([[6.0, 6, 2]])
    drawn, wall = [3.0, 1.0, 0.0], [10.0, 46 / 11, 14 / 11]  # image of RX at (14, 6, 2): 7 of 11 m in x
    noisy = np.add([[drawn, wall]], [[[0, 0, 1e-3], [1e-3, -2e-3, 1e-3]]])
    found = refined_points(start, noisy, end, np.array([[S, R]], np.uint8), FLOOR_AND_WALL)
    assert found == pytest.approx(np.array([[drawn, wall]]), abs=1e-12)


@pytest.mark.parametrize("seed", range(4))
def test_a_diffracted_path_after_a_reflection_is_the_shortest(seed: int) -> None:
    """Floor, edge, wall: the point on the edge, either end of it first, makes the length stationary."""
    rng = np.random.default_rng(seed)
    start, end = np.add(rng.uniform(-3, 3, (2, 1, 3)), [[[0, 0, 6]], [[4, 1, 7]]])
    o, along = np.array([3.0, -2.0, 5.0]), np.array([0.6, 0.8, 0.0])
    floor, wall = FLOOR_AND_WALL[0]
    edge = np.array([o - 30 * along, o + 30 * along])[:: 1 if seed % 2 else -1]
    face = np.vstack([edge, o - [0, 0, 9]])

    def unfolded(t: float) -> float:
        point = o + t * along
        first = start[0] * [1, 1, -1] - point
        return float(np.linalg.norm(first) + np.linalg.norm(end[0] * [-1, 1, 1] + [20, 0, 0] - point))

    ts = np.linspace(-25, 25, 500_001)
    shortest = ts[np.argmin([unfolded(t) for t in ts[::100]]) * 100]
    fine = shortest + np.linspace(-0.02, 0.02, 40_001)
    best = float(min(fine, key=unfolded))
    point = o + best * along
    at_floor = point + (start[0] * [1, 1, -1] - point) * point[2] / (point[2] + start[0, 2])
    image = end[0] * [-1, 1, 1] + [20, 0, 0]
    at_wall = point + (image - point) * (10 - point[0]) / (image[0] - point[0])
    exact = np.array([[at_floor, point, at_wall]])
    noisy = exact + rng.uniform(-1e-3, 1e-3, exact.shape)
    found = refined_points(
        start, noisy, end, np.array([[R, D, R]], np.uint8), np.array([[floor, face, wall]]), edge[None]
    )
    assert found[0, 1] == pytest.approx(point, abs=2e-5)
    assert np.cross(found[0, 1] - o, along) == pytest.approx(0, abs=1e-12)
    assert found == pytest.approx(exact, abs=1e-4)
    corners = np.concatenate([start, found[0], end])
    lengths = np.linalg.norm(np.diff(corners, axis=0), axis=1)
    assert lengths.sum() == pytest.approx(unfolded(best), abs=1e-9)


def test_a_point_far_from_where_it_was_traced_stays() -> None:
    """A plane that the path does not really use cannot carry it away."""
    start, noisy, end, _ = corner(1e-3)
    types = np.array([[R, R]], np.uint8)
    assert np.array_equal(refined_points(start, noisy + 0.2, end, types, FLOOR_AND_WALL), noisy + 0.2)


def test_a_line_along_the_plane_stays() -> None:
    """No crossing, no warning, no NaN; nor by a triangle that has no plane."""
    start, end = np.array([[0.0, 0, 0]]), np.array([[8.0, 0, 0]])
    traced, flat = np.array([[[4.0, 0, 0]]]), np.array([[[[4.0, 0, 0], [5, 0, 0], [4, 1, 0]]]])
    found = refined_points(start, traced, end, np.array([[T]], np.uint8), flat)
    assert np.array_equal(found, traced)
    found = refined_points(start + 1, traced, end, np.array([[R]], np.uint8), flat[..., :1, :].repeat(3, -2))
    assert np.array_equal(found, traced)


def test_at_grazing_incidence_a_point_moves_far_where_the_length_does_not() -> None:
    """1.5 m above ground over 2 km: the ray tracer's rounding moves the point by decimetres."""
    start, end = np.array([[0.0, 0, 1.5]]), np.array([[2000.0, 0, 1.5]])
    floor = np.array([[[[-9.0, -9, 0], [3000, -9, 0], [-9, 3000, 0]]]])
    traced = np.array([[[1000.4, 0, 1e-5]]])
    found = refined_points(start, traced, end, np.array([[R]], np.uint8), floor)
    assert found == pytest.approx(np.array([[[1000.0, 0, 0]]]), abs=1e-9)


def test_a_path_found_twice_is_one() -> None:
    """Same pair, types and points but for rounding; scattered samples and other pairs are left alone."""
    points = np.array([[[1.0, 2, 3], [4, 5, 6]]] * 6)
    points[1] += 1e-9
    points[2, 0, 1] += 1e-3
    points[3:5, 1] = [7.0, 8, 9]  # past the last interaction anything may stand
    types = np.array([[R, R], [R, R], [R, R], [R, 0], [R, 0], [R, S]], np.uint8)
    points[4, 1] = 0.0
    pair = np.array([3, 3, 3, 3, 3, 3])
    assert distinct(pair, types, points).tolist() == [True, False, True, True, False, True]
    again = distinct(np.array([3, 4]), types[:2], points[:2])
    assert again.tolist() == [True, True]
    assert distinct(pair[:2], types[[5, 5]], points[[5, 5]]).tolist() == [True, True]


def test_points_from_planes_alone_are_those_of_the_image_method() -> None:
    """Over the floor and by the wall, as a trace near the exact path gives them; nothing for a path without
    interactions, and no number where the line runs within the plane."""
    start, end = np.array([[1.0, 2.0, 3.0]]), np.array([[4.0, 5.0, 2.0]])
    planes = (
        FLOOR_AND_WALL[..., 0, :],
        np.cross(
            FLOOR_AND_WALL[..., 1, :] - FLOOR_AND_WALL[..., 0, :],
            FLOOR_AND_WALL[..., 2, :] - FLOOR_AND_WALL[..., 0, :],
        ),
    )
    types = np.array([[R, R]], np.uint8)
    found = image_points(start, end, types, *planes)
    again = refined_points(start, found + 1e-3, end, types, FLOOR_AND_WALL)
    assert np.abs(found - again).max() < 1e-12
    assert image_points(start, end, np.zeros((1, 2), np.uint8), *planes).tolist() == [[[0.0] * 3] * 2]
    along = planes[0][:, :1] * 0, np.array([[[0.0, 0.0, 1.0]]])
    level = image_points(start, np.array([[4.0, 5.0, 3.0]]), np.array([[T]], np.uint8), *along)
    assert not np.isfinite(level).all()
