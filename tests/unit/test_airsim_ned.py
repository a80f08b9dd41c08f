"""AirSim's types and axes: NED at the edge, and back, of positions and of rotations."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from caviar_bridges.airsim.rpc import CallError
from caviar_bridges.airsim.wire import NedFrame, flag, ned_yaw, number, sensor_points, text, vector
from caviar_protocol.space.coordinates import Pose, Vector, quaternion_from_euler, rotated, rotation_matrix

NED = NedFrame((10.0, -20.0, 1.5), (47.641468, -122.140165, 122.0))
parts = st.floats(-1e4, 1e4)
angles = st.floats(-3.0, 3.0)


def values(of: dict[str, float]) -> tuple[float, ...]:
    return tuple(of.values())


def test_north_is_x_east_is_y_and_down_is_z_from_the_origin() -> None:
    pose = NED.pose(Pose((13.0, -16.0, 6.5), (1.0, 0.0, 0.0, 0.0)))
    assert values(pose["position"]) == (4.0, 3.0, -5.0)
    assert NED.point_to_enu((4.0, 3.0, -5.0)) == (13.0, -16.0, 6.5)
    assert NED.velocity((1.0, 2.0, 3.0)) == (2.0, 1.0, -3.0)
    assert NED.velocity_to_enu((2.0, 1.0, -3.0)) == (1.0, 2.0, 3.0)


def test_a_heading_counts_clockwise_from_north() -> None:
    """Nose to the north-east in ENU at 45°, then pitched up by 10°, rolled to the right by 20°."""
    up = quaternion_from_euler(math.radians(30), math.radians(-10), math.radians(20))
    orientation = NED.pose(Pose((0.0, 0.0, 0.0), up))["orientation"]
    w, x, y, z = values(orientation)
    heading = math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
    pitch = math.asin(2 * (w * y - z * x))
    roll = math.atan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
    # AirSim: the nose up is a positive pitch, the right wing down a positive roll.
    assert [math.degrees(angle) for angle in (heading, pitch, roll)] == pytest.approx([60.0, 10.0, 20.0])
    assert math.degrees(ned_yaw(math.radians(30))) == pytest.approx(60.0)


@given(position=st.tuples(parts, parts, parts), yaw=angles, pitch=st.floats(-1.5, 1.5), roll=angles)
def test_poses_survive_the_way_there_and_back(
    position: Vector, yaw: float, pitch: float, roll: float
) -> None:
    was = Pose(position, quaternion_from_euler(yaw, pitch, roll))
    back = NED.pose_to_enu(NED.pose(was))
    assert back.position == pytest.approx(was.position, abs=1e-9)
    assert rotation_matrix(back.orientation) == pytest.approx(rotation_matrix(was.orientation), abs=1e-12)


def test_the_nose_of_a_vehicle_points_the_same_way_in_both_axes() -> None:
    q = quaternion_from_euler(0.4, -0.2, 0.7)
    here = NED.velocity(rotated(q, (1.0, 0.0, 0.0)))
    there = rotated(values(NED.pose(Pose((0.0, 0.0, 0.0), q))["orientation"]), (1.0, 0.0, 0.0))
    assert there == pytest.approx(here)


def test_kinematics_have_turn_rates_clockwise() -> None:
    pose = Pose((10.0, -20.0, 1.5), (1.0, 0.0, 0.0, 0.0))
    found = NED.kinematics(pose, (1.0, 2.0, 3.0), (0.0, 0.0, 0.5), (4.0, 5.0, 6.0))
    assert values(found["linear_velocity"]) == (2.0, 1.0, -3.0)
    assert values(found["angular_velocity"]) == (0.0, 0.0, -0.5)
    assert values(found["linear_acceleration"]) == (5.0, 4.0, -6.0)


def test_points_are_ned_in_single_precision_and_the_sensors_own_axes_look_right_and_down() -> None:
    points = np.array([[13.0, -16.0, 6.5], [10.0, -20.0, 0.0]], np.float32)
    assert NED.points(points) == [4.0, 3.0, -5.0, 0.0, 0.0, 1.5]
    assert sensor_points(points) == [13.0, 16.0, -6.5, 10.0, 20.0, 0.0]


def test_a_geographic_point_is_a_hundred_metres_north_of_another() -> None:
    here = NED.geo_point((10.0, -20.0, 1.5))
    north = NED.geo_point((10.0, 80.0, 11.5))
    east = NED.geo_point((110.0, -20.0, 1.5))
    assert values(here) == (47.641468, -122.140165, 122.0)
    assert north["altitude"] == 132.0
    # A minute of latitude is a nautical mile of 1,852 m, within what a sphere differs from the Earth.
    assert (north["latitude"] - here["latitude"]) * 60 * 1852 == pytest.approx(100.0, rel=3e-3)
    shrink = math.cos(math.radians(here["latitude"]))
    assert (east["longitude"] - here["longitude"]) * 60 * 1852 * shrink == pytest.approx(100.0, rel=3e-3)


@pytest.mark.parametrize(
    ("check", "value", "words"),
    [
        (number, "3", "x is '3'; give a number"),
        (number, True, "x is True; give a number"),
        (number, math.nan, "x is nan; give a number"),
        (number, math.inf, "x is inf; give a number"),
        (number, None, "x is None; give a number"),
        (flag, 1, "x is 1; give True or False"),
        (text, ["a"], "x is ['a']; give a text"),
        (text, "a" * 300, "give a text of at most 256 characters"),
        (vector, [1, 2, 3], "x is [1, 2, 3]; give AirSim's type"),
        (vector, {"x_val": 1.0, "y_val": 2.0}, "x.z_val is None; give a number"),
    ],
)
def test_values_that_are_none_are_refused_by_name(check: Any, value: object, words: str) -> None:
    with pytest.raises(CallError) as error:
        check(value, "x")
    assert words in str(error.value)


def test_an_orientation_has_to_be_a_unit_quaternion() -> None:
    pose = NED.pose(Pose((0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0)))
    pose["orientation"] = {"w_val": 0.5, "x_val": 0.0, "y_val": 0.0, "z_val": 0.0}
    with pytest.raises(CallError, match=r"pose.orientation.*0.5"):
        NED.pose_to_enu(pose)


def test_cameras_may_have_numbers() -> None:
    assert text(0, "camera_name") == "0"
