"""Rotations and poses against matrices that are written down by hand."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from caviar_protocol.space.coordinates import (
    Pose,
    angles,
    compose,
    direction,
    euler_from_quaternion,
    multiply,
    quaternion_from_euler,
    rotation_matrix,
)

ANGLE = st.floats(-3.1, 3.1)
PITCH = st.floats(-1.5, 1.5)
LENGTH = st.floats(-1e3, 1e3)
TURN = st.builds(quaternion_from_euler, ANGLE, PITCH, ANGLE)
POSE = st.builds(Pose, st.tuples(LENGTH, LENGTH, LENGTH), TURN)
Turn = tuple[float, float, float, float]


def about_z(t: float) -> np.ndarray:
    """Counter-clockwise turn seen from above."""
    return np.array([[math.cos(t), -math.sin(t), 0], [math.sin(t), math.cos(t), 0], [0, 0, 1]])


def about_y(t: float) -> np.ndarray:
    """Turn from +z to +x."""
    return np.array([[math.cos(t), 0, math.sin(t)], [0, 1, 0], [-math.sin(t), 0, math.cos(t)]])


def about_x(t: float) -> np.ndarray:
    """Turn from +y to +z."""
    return np.array([[1, 0, 0], [0, math.cos(t), -math.sin(t)], [0, math.sin(t), math.cos(t)]])


@given(ANGLE, PITCH, ANGLE)
def test_euler_angles_are_turns_about_z_then_y_then_x_of_the_body(
    yaw: float, pitch: float, roll: float
) -> None:
    expected = about_z(yaw) @ about_y(pitch) @ about_x(roll)
    np.testing.assert_allclose(
        rotation_matrix(quaternion_from_euler(yaw, pitch, roll)), expected, rtol=0, atol=1e-12
    )


def test_yaw_turns_the_nose_from_east_to_north_and_pitch_lowers_it() -> None:
    east = np.array([1.0, 0.0, 0.0])
    np.testing.assert_allclose(
        rotation_matrix(quaternion_from_euler(math.pi / 2)) @ east, [0, 1, 0], atol=1e-15
    )
    assert (rotation_matrix(quaternion_from_euler(0.0, 0.3)) @ east)[2] == pytest.approx(-math.sin(0.3))
    left = np.array([0.0, 1.0, 0.0])
    assert (rotation_matrix(quaternion_from_euler(0.0, 0.0, 0.3)) @ left)[2] == pytest.approx(math.sin(0.3))


@given(ANGLE, PITCH, ANGLE)
def test_euler_angles_come_back(yaw: float, pitch: float, roll: float) -> None:
    """Away from the poles; asin loses half the digits as the pitch nears ±π/2."""
    back = euler_from_quaternion(quaternion_from_euler(yaw, pitch, roll))
    np.testing.assert_allclose(back, (yaw, pitch, roll), rtol=0, atol=1e-9)


def test_straight_down_is_a_pitch_and_no_error() -> None:
    assert euler_from_quaternion(quaternion_from_euler(0.0, math.pi / 2))[1] == pytest.approx(math.pi / 2)


@given(TURN, TURN)
def test_a_product_of_quaternions_is_the_product_of_their_matrices(p: Turn, q: Turn) -> None:
    np.testing.assert_allclose(
        rotation_matrix(multiply(p, q)), rotation_matrix(p) @ rotation_matrix(q), rtol=0, atol=1e-12
    )


@given(POSE, POSE)
def test_composed_poses_are_products_of_homogeneous_matrices(parent: Pose, mount: Pose) -> None:
    np.testing.assert_allclose(
        homogeneous(compose(parent, mount)), homogeneous(parent) @ homogeneous(mount), rtol=0, atol=1e-9
    )


def homogeneous(pose: Pose) -> np.ndarray:
    """4×4 matrix of a pose."""
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = rotation_matrix(pose.orientation), pose.position
    return matrix


def test_an_antenna_on_the_roof_turns_with_its_car() -> None:
    """A car at (10, 5) heading north; an antenna 1 m ahead of its centre stands 1 m north of it."""
    car = Pose((10.0, 5.0, 0.75), quaternion_from_euler(math.pi / 2))
    antenna = compose(car, Pose((1.0, 0.0, 1.0), (1.0, 0.0, 0.0, 0.0)))
    assert antenna.position == pytest.approx((10.0, 6.0, 1.75))


@given(st.floats(0.001, math.pi - 0.001), ANGLE)
def test_angles_are_the_inverse_of_direction(zenith: float, azimuth: float) -> None:
    np.testing.assert_allclose(angles(direction(zenith, azimuth)), (zenith, azimuth), rtol=0, atol=1e-12)


def test_zenith_is_from_up_and_azimuth_from_east() -> None:
    known = np.array([[0.0, 0.0, 2.0], [3.0, 0.0, 0.0], [0.0, 5.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
    half = math.pi / 2
    expected = [[0.0, 0.0], [half, 0.0], [half, half], [half, math.pi], [math.pi, 0.0]]
    np.testing.assert_allclose(angles(known), expected, atol=1e-15)
    assert angles(known[None]).shape == (1, 5, 2)


def test_angles_near_the_pole_keep_their_digits() -> None:
    """acos(z/r) would give 0 here."""
    assert angles(np.array([1e-9, 0.0, 1.0]))[0] == pytest.approx(1e-9, rel=1e-12)
