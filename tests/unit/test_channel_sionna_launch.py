"""The order in which rays are launched: the same rays, neighbours side by side."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from caviar_services.channel.sionna.ray_launcher import morton_order


def test_the_curve_visits_the_quarters_of_a_square_one_after_the_other() -> None:
    x = np.array([0.75, 0.25, 0.75, 0.25])
    y = np.array([0.75, 0.75, 0.25, 0.25])
    assert morton_order(x, y).tolist() == [3, 2, 1, 0]


@given(st.integers(0, 2**32 - 1), st.integers(1, 500))
def test_every_point_is_visited_once(seed: int, count: int) -> None:
    x, y = np.random.default_rng(seed).random((2, count))
    assert sorted(morton_order(x, y).tolist()) == list(range(count))


def test_points_on_the_upper_edges_belong_to_the_last_cells() -> None:
    assert morton_order(np.array([1.0, 0.999]), np.array([1.0, 0.0])).tolist() == [1, 0]


def test_neighbours_on_the_curve_are_near_each_other() -> None:
    """A random order of 4,096 points in the unit square has a mean step of 0.52."""
    x, y = np.random.default_rng(1).random((2, 4096))
    order = morton_order(x, y)
    steps = np.hypot(np.diff(x[order]), np.diff(y[order]))
    assert steps.mean() < 0.03
