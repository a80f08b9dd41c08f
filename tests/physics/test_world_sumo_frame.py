"""SUMO's conventions into ours: front bumper, clockwise from north, slope; and back again."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from caviar_protocol.space.coordinates import rotation_matrix
from caviar_services.world.sumo_conventions import Placement, body_pose, heading, object_class

compass = st.floats(0.0, 360.0, exclude_max=True)
slopes = st.floats(-30.0, 30.0)
metres = st.floats(-2000.0, 2000.0)


@pytest.mark.parametrize(
    ("angle_deg", "forward"),
    [(0.0, (0, 1)), (90.0, (1, 0)), (180.0, (0, -1)), (270.0, (-1, 0)), (30.0, (0.5, math.sqrt(0.75)))],
)
def test_headings_of_the_compass(angle_deg: float, forward: tuple[float, float]) -> None:
    """0° is north (+y), 90° is east (+x), 30° leans from north to east."""
    towards = heading(angle_deg, 0.0, Placement())
    assert towards.forward == pytest.approx((*forward, 0.0), abs=1e-12)
    nose = rotation_matrix(body_pose((0.0, 0.0, 0.0), towards, 4.0, 1.5, Placement()).orientation) @ [1, 0, 0]
    assert nose == pytest.approx((*forward, 0.0), abs=1e-12)


def test_an_eastbound_car_reaches_back_from_its_front_bumper() -> None:
    """By hand: bumper at (100, 50), 5 m long, 1.6 m high, ground at 3 m."""
    towards = heading(90.0, 0.0, Placement())
    pose = body_pose((100.0, 50.0, 3.0), towards, 5.0, 1.6, Placement())
    assert pose.position == pytest.approx((97.5, 50.0, 3.8))


def test_a_car_uphill_lifts_its_nose() -> None:
    """Northbound at 45° uphill: the nose points to (0, 1, 1), the roof to (0, −1, 1)."""
    towards = heading(0.0, 45.0, Placement())
    turn = rotation_matrix(body_pose((0.0, 0.0, 0.0), towards, 4.0, 2.0, Placement()).orientation)
    assert turn @ [1, 0, 0] == pytest.approx([0, math.sqrt(0.5), math.sqrt(0.5)], abs=1e-12)
    assert turn @ [0, 0, 1] == pytest.approx([0, -math.sqrt(0.5), math.sqrt(0.5)], abs=1e-12)
    assert turn @ [0, 1, 0] == pytest.approx([-1, 0, 0], abs=1e-12)


def test_a_turned_and_shifted_network() -> None:
    """Turned by 90° counter-clockwise, what went east goes north, and what lay east lies north."""
    placement = Placement(offset=(10.0, 20.0, -1.0), yaw=math.pi / 2)
    towards = heading(90.0, 0.0, placement)
    pose = body_pose((7.0, 2.0, 0.0), towards, 4.0, 2.0, placement)
    assert pose.position == pytest.approx((10.0 - 2.0, 20.0 + 7.0 - 2.0, 0.0))
    assert rotation_matrix(pose.orientation) @ [1, 0, 0] == pytest.approx([0, 1, 0], abs=1e-12)


@given(
    st.tuples(metres, metres, st.floats(-50.0, 50.0)),
    compass,
    slopes,
    st.floats(0.2, 25.0),
    st.floats(0.3, 4.5),
    st.tuples(metres, metres, st.floats(-50.0, 50.0)),
    st.floats(-math.pi, math.pi),
)
def test_there_and_back(
    bumper: tuple[float, float, float],
    angle_deg: float,
    slope_deg: float,
    length: float,
    height: float,
    offset: tuple[float, float, float],
    yaw: float,
) -> None:
    """From the pose alone, SUMO's position and rotation come back: the middle of the bottom edge of
    the body's front face, and the compass angle and slope of its axes."""
    placement = Placement(offset, yaw)
    pose = body_pose(bumper, heading(angle_deg, slope_deg, placement), length, height, placement)
    axes = rotation_matrix(pose.orientation)
    front = np.array(pose.position) + axes @ [length / 2, 0.0, -height / 2]
    back_turn = np.array([[math.cos(yaw), math.sin(yaw), 0], [-math.sin(yaw), math.cos(yaw), 0], [0, 0, 1]])
    assert back_turn @ (front - offset) == pytest.approx(bumper, abs=1e-8)
    nose = back_turn @ axes @ [1.0, 0.0, 0.0]
    compass_angle = math.degrees(math.atan2(nose[0], nose[1]))
    assert math.remainder(compass_angle - angle_deg, 360.0) == pytest.approx(0.0, abs=1e-7)
    assert math.degrees(math.asin(nose[2])) == pytest.approx(slope_deg, abs=1e-7)
    left = axes @ [0.0, 1.0, 0.0]
    assert left[2] == pytest.approx(0.0, abs=1e-12)  # no roll


@pytest.mark.parametrize(
    ("type_id", "vehicle_class", "expected"),
    [
        ("whatever", "passenger", "car"),
        ("whatever", "bus", "bus"),
        ("whatever", "delivery", "truck"),
        ("whatever", "something-new", "car"),
        ("Lorry", "passenger", "truck"),
        ("Lorry@veh.7", "passenger", "truck"),
        ("whatever", "tram", "bus"),
    ],
)
def test_classes_follow_the_settings_then_sumo(type_id: str, vehicle_class: str, expected: str) -> None:
    assert object_class(type_id, vehicle_class, {"Lorry": "truck", "tram": "bus"}) == expected
