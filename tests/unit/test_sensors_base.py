"""What of the sensors' geometry needs no ray tracer."""

from __future__ import annotations

import numpy as np
import pytest

from caviar_services.sensors.lidar import ray_directions
from caviar_space.meshes import SHAPES, box, contains


@pytest.mark.parametrize("seed", range(3))
def test_a_point_is_inside_a_box_where_its_coordinates_say_so(seed: int) -> None:
    rng = np.random.default_rng(seed)
    low, high = rng.uniform(-3, -1, 3), rng.uniform(1, 4, 3)
    mesh = box(*zip(low.tolist(), high.tolist(), strict=True))
    for point in rng.uniform(-5, 5, (200, 3)):
        assert contains(mesh, point) == bool(((point > low) & (point < high)).all())


def test_above_the_bonnet_is_outside_though_in_the_bounding_box() -> None:
    mesh = SHAPES["car"]()
    assert not contains(mesh, np.array([0.4, 0.0, 0.3]))
    assert contains(mesh, np.array([-0.1, 0.0, 0.3]))


def test_rays_stand_in_order_lowest_beam_first_counter_clockwise() -> None:
    directions = ray_directions(3, 4, -0.2, 0.4)
    elevation = np.arcsin(directions[2]).reshape(3, 4)
    np.testing.assert_allclose(elevation, [[-0.2] * 4, [0.1] * 4, [0.4] * 4], atol=1e-15)
    np.testing.assert_allclose(directions[:, 5], [0, np.cos(0.1), np.sin(0.1)], atol=1e-15)
    np.testing.assert_allclose(np.linalg.norm(directions, axis=0), 1)


def test_one_beam_alone_is_the_lowest() -> None:
    np.testing.assert_allclose(ray_directions(1, 8, -0.3, 0.5)[2], np.sin(-0.3))
