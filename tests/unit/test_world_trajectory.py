"""Trajectories through timed waypoints: their analytic properties, files and errors."""

from __future__ import annotations

import math
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from world_builders import scene_at, wire_bytes

from caviar_protocol.errors import ScenarioError
from caviar_protocol.scenario.conversion import convert_settings
from caviar_protocol.space.coordinates import euler_from_quaternion
from caviar_services.service import Preparation, RunInfo
from caviar_services.world.trajectory import (
    MovingObject,
    Track,
    TrajectorySettings,
    TrajectoryWorld,
    Waypoint,
    read_waypoints,
)

pytestmark = pytest.mark.slow

lengths = st.floats(-300.0, 300.0, allow_subnormal=False)
gaps = st.floats(0.25, 20.0)


@st.composite
def tracks(draw: st.DrawFn) -> list[Waypoint]:
    """Two to eight waypoints, some of them at the place of the one before."""
    count = draw(st.integers(2, 8))
    t = draw(st.floats(0.0, 5.0))
    found: list[Waypoint] = []
    for _ in range(count):
        stay = bool(found) and draw(st.booleans()) and draw(st.booleans())
        place = found[-1].position if stay else (draw(lengths), draw(lengths), draw(lengths))
        found.append(Waypoint(t, place))
        t += draw(gaps)
    return found


def instants(waypoints: list[Waypoint], per_segment: int = 7) -> list[float]:
    """Instants inside the segments, away from the waypoints."""
    return [
        a.t + (b.t - a.t) * (i + 0.5) / per_segment
        for a, b in pairwise(waypoints)
        for i in range(per_segment)
    ]


@given(tracks())
def test_it_passes_through_its_waypoints(waypoints: list[Waypoint]) -> None:
    track = Track(waypoints)
    for waypoint in waypoints:
        assert track.position(waypoint.t) == pytest.approx(waypoint.position, abs=1e-9)


@given(tracks())
def test_it_starts_and_ends_at_rest_and_stays_there(waypoints: list[Waypoint]) -> None:
    track = Track(waypoints)
    first, last = waypoints[0], waypoints[-1]
    for t, place in ((first.t - 10, first), (first.t, first), (last.t, last), (last.t + 10, last)):
        assert track.position(t) == pytest.approx(place.position, abs=1e-12)
        assert track.velocity(t) == pytest.approx((0.0, 0.0, 0.0), abs=1e-12)


@given(tracks())
def test_velocity_is_the_derivative_of_position(waypoints: list[Waypoint]) -> None:
    """Central differences of a cubic are off by h²/6 times its third derivative."""
    track = Track(waypoints)
    shortest = min(b.t - a.t for a, b in pairwise(waypoints))
    h = 1e-5 * shortest
    for t in instants(waypoints):
        difference = (np.array(track.position(t + h)) - track.position(t - h)) / (2 * h)
        scale = 600.0 / shortest
        assert track.velocity(t) == pytest.approx(difference, abs=1e-6 * scale)


@given(tracks())
def test_velocity_is_continuous(waypoints: list[Waypoint]) -> None:
    """Just before and just after a waypoint the velocities agree: no Doppler jumps."""
    track = Track(waypoints)
    for waypoint in waypoints:
        before, after = track.velocity(waypoint.t - 1e-9), track.velocity(waypoint.t + 1e-9)
        assert before == pytest.approx(after, abs=1e-3)


@given(tracks())
def test_it_never_overshoots_between_waypoints(waypoints: list[Waypoint]) -> None:
    """Each coordinate stays between its values at the two waypoints: a landing never goes below
    the ground."""
    track = Track(waypoints)
    for a, b in pairwise(waypoints):
        low, high = np.minimum(a.position, b.position) - 1e-9, np.maximum(a.position, b.position) + 1e-9
        for s in np.linspace(0.0, 1.0, 23):
            position = np.array(track.position(a.t + s * (b.t - a.t)))
            assert (position >= low).all()
            assert (position <= high).all()


def test_a_steady_flight_is_steady() -> None:
    """Equal secants give that slope: inside, the flight is a straight line at constant speed."""
    track = Track([Waypoint(2.0 * k, (6.0 * k, -8.0 * k, 5.0)) for k in range(6)])
    for t in np.linspace(2.0, 8.0, 31):
        assert track.velocity(float(t)) == pytest.approx((3.0, -4.0, 0.0), abs=1e-12)
        assert track.position(float(t)) == pytest.approx((3.0 * t, -4.0 * t, 5.0), abs=1e-9)


@given(tracks())
def test_the_yaw_rate_is_the_derivative_of_the_yaw(waypoints: list[Waypoint]) -> None:
    track = Track(waypoints)
    for a, b in pairwise(waypoints):
        for s in (0.2, 0.5, 0.8):
            t, h = a.t + s * (b.t - a.t), 1e-5 * (b.t - a.t)
            velocity = track.velocity(t)
            if 0 < math.hypot(*velocity[:2]) < 0.1:
                continue  # near a point of rest the course turns within no time
            if track.yaw_rate(t, velocity) == 0:
                continue  # the course is straight, or reverses
            turned = math.remainder(track.yaw(t + h) - track.yaw(t - h), 2 * math.pi)
            assert track.yaw_rate(t, velocity) == pytest.approx(turned / (2 * h), rel=1e-3, abs=1e-5)


@pytest.mark.parametrize("drift", [0.0, 1e-12, 1e-6, 1e-3, 0.01, 0.1])
@pytest.mark.parametrize("way", [5.0, 50.0])
def test_a_vehicle_that_backs_turns_no_faster_than_its_speed_allows(drift: float, way: float) -> None:
    """Its course reverses in a moment; no corner of it sweeps around at a multiple of the vehicle's speed."""
    track = Track(
        [Waypoint(0.0, (0, drift, 0)), Waypoint(0.5, (way, 2 * drift, 0)), Waypoint(1.0, (0, 3 * drift, 0))]
    )
    for t in np.concatenate([np.linspace(0, 1, 401), 0.5 + np.geomspace(1e-12, 1e-2, 200)]).tolist():
        velocity = track.velocity(t)
        assert abs(track.yaw_rate(t, velocity)) <= 10 * math.hypot(*velocity[:2])
    assert track.reversals() == [(1, 0.5)]


def test_a_turn_of_a_vehicle_has_its_rate() -> None:
    """On a circle of 8 m at 10 m/s: 1.25 rad/s."""
    angles = np.linspace(0.0, 2 * np.pi, 121)
    track = Track([Waypoint(0.8 * a, (8 * math.cos(a), 8 * math.sin(a), 0.0)) for a in angles.tolist()])
    t = 0.8 * math.radians(120.0 + 1.5)
    assert track.yaw_rate(t, track.velocity(t)) == pytest.approx(1.25, rel=0.05)
    assert track.reversals() == []


def test_noise_of_a_vehicle_that_stands_does_not_turn_it_fast() -> None:
    """Millimetres, ten times a second: they gave turns of hundreds of radians a second."""
    noise = np.random.default_rng(7).normal(0.0, 1e-3, (200, 2)).tolist()
    track = Track([Waypoint(0.1 * k, (x, y, 0.75)) for k, (x, y) in enumerate(noise)])
    rates = [track.yaw_rate(t, track.velocity(t)) for t in np.linspace(0, 19, 5000).tolist()]
    assert max(map(abs, rates)) < 1.0


def test_a_straight_flight_does_not_turn_not_even_by_rounding() -> None:
    track = Track([Waypoint(0.7 * k, (0.3 * k, 0.1 * k, 5.0)) for k in range(6)])
    assert {track.yaw_rate(t, track.velocity(t)) for t in np.linspace(-1.0, 4.0, 77).tolist()} == {0.0}


@given(tracks())
def test_it_looks_along_its_horizontal_course(waypoints: list[Waypoint]) -> None:
    track = Track(waypoints)
    for t in instants(waypoints):
        vx, vy, _ = track.velocity(t)
        if math.hypot(vx, vy) > 1e-3:
            assert math.remainder(track.yaw(t) - math.atan2(vy, vx), 2 * math.pi) == pytest.approx(
                0.0, abs=1e-9
            )


def test_it_turns_evenly_while_it_hovers_and_does_not_jump_at_rest() -> None:
    """North, a hover in two parts with a climb, then west: the yaw goes from 90° to 180° smoothly."""
    track = Track(
        [
            Waypoint(0.0, (0.0, 0.0, 0.0)),
            Waypoint(3.0, (0.0, 0.0, 20.0)),  # take-off: looks where it will go
            Waypoint(8.0, (0.0, 50.0, 20.0)),
            Waypoint(10.0, (0.0, 50.0, 20.0)),
            Waypoint(12.0, (0.0, 50.0, 30.0)),
            Waypoint(20.0, (-70.0, 50.0, 30.0)),
            Waypoint(25.0, (-70.0, 50.0, 0.0)),
        ]
    )
    yaws = [track.yaw(t) for t in np.linspace(-1.0, 26.0, 5401).tolist()]
    assert yaws[0] == pytest.approx(math.pi / 2)
    assert track.yaw(8.0) == pytest.approx(math.pi / 2)
    assert track.yaw(10.0) == pytest.approx(3 * math.pi / 4)
    assert track.yaw(12.0) == pytest.approx(math.pi)
    assert yaws[-1] == pytest.approx(math.pi)
    assert max(abs(math.remainder(b - a, 2 * math.pi)) for a, b in pairwise(yaws)) < 0.01


@given(tracks())
def test_the_course_at_rest_is_the_limit_of_the_course_beside_it(waypoints: list[Waypoint]) -> None:
    """At a waypoint where it rests, the yaw is that of a moment later or before."""
    track = Track(waypoints)
    for a, b in pairwise(waypoints):
        step = np.subtract(b.position, a.position)[:2]
        if np.abs(step).min() < 1.0:
            continue  # the limit is reached too slowly to be seen beside the point
        for t, inside in ((a.t, 1e-4), (b.t, -1e-4)):
            if math.hypot(*track.velocity(t)[:2]) < 1e-12:
                beside = track.yaw(t + inside * (b.t - a.t))
                edge = track.yaw(t + 1e-9 * math.copysign(b.t - a.t, inside))
                assert math.remainder(beside - edge, 2 * math.pi) == pytest.approx(0.0, abs=0.05)


def test_a_given_yaw_is_followed_the_short_way_round() -> None:
    track = Track(
        [
            Waypoint(0.0, (0.0, 0.0, 0.0), math.radians(170.0)),
            Waypoint(2.0, (5.0, 0.0, 0.0), math.radians(-170.0)),
        ]
    )
    assert track.yaw(0.0) == pytest.approx(math.radians(170.0))
    assert track.yaw(1.0) == pytest.approx(math.radians(180.0))
    assert track.yaw(2.0) == pytest.approx(math.radians(190.0))


def test_a_single_waypoint_is_a_thing_that_stands() -> None:
    track = Track([Waypoint(3.0, (1.0, 2.0, 3.0))])
    for t in (0.0, 3.0, 9.0):
        assert track.position(t) == (1.0, 2.0, 3.0)
        assert track.velocity(t) == (0.0, 0.0, 0.0)
        assert track.yaw(t) == 0.0


# --- files -----------------------------------------------------------------------------------


def test_a_file_with_comments_and_yaw_is_read(tmp_path: Path) -> None:
    file = tmp_path / "flight.csv"
    file.write_text("# a flight\n\nt_s, x_m, y_m, z_m, yaw_deg\n0, 1, 2, 3, 90\n2.5, 1, 2, 30, -90\n")
    assert read_waypoints(str(file)) == [
        Waypoint(0.0, (1.0, 2.0, 3.0), math.pi / 2),
        Waypoint(2.5, (1.0, 2.0, 30.0), -math.pi / 2),
    ]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("t_s,x_m,y_m,z_m\n0,0,0,0\n0,1,1,1\n", r"flight\.csv:3: t_s = 0\.0 does not come after 0\.0"),
        ("t_s,x_m,y_m,z_m\n0,0,0,0\n# turn\n2,1,1\n", r"flight\.csv:4: has 3 columns, write 4"),
        ("t_s,x_m,y_m,z_m\n0,0,0,nan\n", r"flight\.csv:2: .* is not finite"),
        ("t_s,x_m,y_m,z_m\n0,0,0,1e999\n", r"flight\.csv:2: .* is not finite"),
        ("t_s,x_m,y_m,z_m\n0,0,zero,0\n", r"flight\.csv:2: .* no number"),
        ("t,x,y,z\n0,0,0,0\n", r"flight\.csv:1: the first line is 't,x,y,z'; write t_s,x_m,y_m,z_m"),
        ("t_s,x_m,y_m,z_m\n", r"flight\.csv: .*holds no waypoint"),
    ],
)
def test_errors_name_file_line_and_remedy(tmp_path: Path, text: str, message: str) -> None:
    file = tmp_path / "flight.csv"
    file.write_text(text)
    with pytest.raises(ScenarioError, match=message):
        read_waypoints(str(file))


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(ScenarioError, match=r"none\.csv"):
        read_waypoints(str(tmp_path / "none.csv"))


@pytest.mark.parametrize("rows", [(), ((0.0, 1.0, 2.0),), ((0.0, 1.0, 2.0, 3.0), (1.0, 1.0, 2.0, 3.0, 90.0))])
def test_rows_of_a_wrong_length_are_refused(rows: tuple[tuple[float, ...], ...]) -> None:
    with pytest.raises(ScenarioError, match=r"rows of one length"):
        read_waypoints(rows, "objects[0].waypoints")


def test_rows_out_of_order_are_named_by_index() -> None:
    with pytest.raises(ScenarioError, match=r"waypoints\[1\]: t_s = 1\.0.*2\.0"):
        read_waypoints(((2.0, 0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0)), "waypoints")


# --- the world -------------------------------------------------------------------------------

UAV = MovingObject(
    name="uav", waypoints=((0.0, 0.0, 0.0, 0.125), (1.0, 0.0, 0.0, 9.0), (3.0, -8.0, 6.0, 9.0))
)


def world(*objects: MovingObject, prefix: str | None = None) -> TrajectoryWorld:
    return TrajectoryWorld(TrajectorySettings(objects=objects, prefix=prefix), RunInfo(name="flight"))


def test_objects_fly_in_the_scene_with_prefix_class_and_mesh() -> None:
    flight = world(
        UAV, MovingObject(name="balloon", kind="balloon", waypoints=((0.0, 1.0, 1.0, 1.0),)), prefix="air."
    )
    assert flight.prepare(Preparation(demand={})).prefixes == ("air.",)
    assert set(flight.scenery()) == {"objects/uav.ply"}
    flight.reset(0, 1, 0)
    scene = scene_at(flight, 20)
    assert scene.names == ("air.balloon", "air.uav")
    assert scene.assets == ("", "objects/uav.ply")
    vx, vy, _ = scene.velocity[1]
    assert euler_from_quaternion(scene.orientation[1].tolist())[0] == pytest.approx(math.atan2(vy, vx))


def test_a_frame_does_not_depend_on_the_ones_before() -> None:
    """A gap is stepped whole: frame 17 alone equals frame 17 after all the others."""
    steady, gap = world(UAV), world(UAV)
    for k in range(18):
        scene = scene_at(steady, k)
    assert wire_bytes(scene_at(gap, 17, previous=-1)) == wire_bytes(scene)


def test_a_note_names_the_waypoint_at_which_an_object_turns_round() -> None:
    back = ((0.0, 0.0, 12.0, 0.75), (0.5, 5.0, 12.01, 0.75), (1.0, 0.0, 12.02, 0.75))
    car = MovingObject(name="car", kind="car", waypoints=back)
    (note,) = [note for note in world(car).prepare(Preparation(demand={})).notes if "turns round" in note]
    assert "object 'car' turns round at once at waypoint 1 (t_s = 0.5)" in note
    assert "write yaw_deg" in note
    heading = MovingObject(name="car", waypoints=tuple((*waypoint, 0.0) for waypoint in back))
    assert not any("turns round" in note for note in world(heading).prepare(Preparation(demand={})).notes)


def test_whole_names_are_declared_without_a_prefix() -> None:
    assert world(UAV).prepare(Preparation(demand={})).prefixes == ("uav",)


def test_two_objects_of_one_name_are_refused() -> None:
    with pytest.raises(ScenarioError, match=r"objects\[1\].*'uav'"):
        world(UAV, UAV)


def test_an_object_without_size_is_refused() -> None:
    flat = {"name": "uav", "dimensions_m": [1.0, 0.0, 1.0], "waypoints": [[0.0, 0.0, 0.0, 0.0]]}
    with pytest.raises(ScenarioError, match=r"objects\[0\].dimensions_m\[1\]: is 0.0"):
        convert_settings(TrajectorySettings, {"objects": [flat]})


def test_control_characters_in_a_name_or_prefix_are_refused_and_other_signs_are_not() -> None:
    rows = [[0.0, 0.0, 0.0, 0.0]]
    for odd in ("uav\n", "u\0av", "\x1b[2Juav"):
        with pytest.raises(ScenarioError) as caught:
            convert_settings(TrajectorySettings, {"objects": [{"name": odd, "waypoints": rows}]})
        assert f"objects[0].name: is {odd!r}, write a string of 1 to 100 characters without" in str(
            caught.value
        )
        with pytest.raises(ScenarioError, match=r"prefix: is .*control characters"):
            convert_settings(TrajectorySettings, {"prefix": odd})
    for name in ("größe 1.a/b", "無人機", "a"):
        convert_settings(TrajectorySettings, {"prefix": "", "objects": [{"name": name, "waypoints": rows}]})


def test_a_waypoint_that_is_no_number_is_named_with_row_and_column() -> None:
    uav = {"name": "uav", "waypoints": [[0.0, 0.0, 0.0, 0.0], [1.0, "two", 0.0, 0.0]]}
    with pytest.raises(ScenarioError, match=r"waypoints\[1\]\[1\].*'two'"):
        convert_settings(TrajectorySettings, {"objects": [uav]})


def test_a_file_without_its_prefix_is_refused_with_the_remedy() -> None:
    with pytest.raises(ScenarioError, match=r'write "file:flight.csv"'):
        world(MovingObject(name="uav", waypoints="flight.csv"))
