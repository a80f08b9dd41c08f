"""World ``flight`` with quadrotors: commands, bounds, contacts, battery, and the same flight again."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from caviar_protocol.codec import encode_payload
from caviar_protocol.errors import PayloadError, ScenarioError
from caviar_protocol.messages import GrantInput, Status
from caviar_protocol.scenario.conversion import Place
from caviar_protocol.space.coordinates import Pose, Vector, euler_from_quaternion, quaternion_from_euler
from caviar_protocol.topics import (
    Action,
    AttitudeCommand,
    PathCommand,
    Scene,
    VelocityCommand,
    WaypointCommand,
)
from caviar_protocol.topics.link import Command
from caviar_services.service import Frame, FrameInput, Preparation, RunInfo, StepResult
from caviar_services.world.flight import FlightSettings, FlightWorld, FlownObject
from caviar_services.world.quadrotor.airframe import Airframe
from caviar_services.world.quadrotor.control import Battery, Controller
from caviar_services.world.quadrotor.surroundings import Wind, box_contact
from caviar_services.world.trajectory import MovingObject

pytestmark = pytest.mark.slow

PERIOD_NS = 100_000_000
START = (0.0, 0.0, 30.0)
RADIUS = math.hypot(0.6, 0.6, 0.25) / 2
GUSTY = Wind(velocity_m_s=(5.0, 2.0, 0.0), gusts="dryden")


def flown(**changes: object) -> FlownObject:
    plain: dict[str, object] = {
        "name": "uav",
        "start_m": START,
        "max_speed_m_s": 12.0,
        "max_acceleration_m_s2": 4.0,
        "dynamics": "quadrotor",
    }
    return FlownObject(**{**plain, **changes})  # type: ignore[arg-type]


def world(
    *objects: FlownObject, wind: Wind | None = None, scripted: Sequence[MovingObject] = (), scenery: str = ""
) -> FlightWorld:
    settings = FlightSettings(
        flown=objects or (flown(),), objects=tuple(scripted), wind=wind or Wind(), scenery=scenery
    )
    made = FlightWorld(settings, RunInfo(name="world"))
    made.prepare(Preparation(demand={}))
    made.reset(0, 1, 0)
    made.step(Frame(episode=0, number=0, t_ns=0))
    return made


def frame(number: int, command: Command | None, t_ns: int = -1, previous: int = -1) -> Frame:
    """Frame with the action of the frame before."""
    provenance = GrantInput(topic="action", source="a", status=Status.FRESH, frame=number - 1)
    inputs = (FrameInput(provenance, payload=Action(commands=(command,))),) if command else ()
    return Frame(
        episode=0,
        number=number,
        t_ns=number * PERIOD_NS if t_ns < 0 else t_ns,
        previous=number - 1 if previous < 0 else previous,
        inputs=inputs,
    )


def fly(made: FlightWorld, command: Command | None, frames: int, first: int = 1) -> list[StepResult]:
    return [made.step(frame(first + k, command)) for k in range(frames)]


def scene_of(result: StepResult) -> Scene:
    scene = result.products["scene"]
    assert isinstance(scene, Scene)
    return scene


def position(result: StepResult, name: str = "uav") -> np.ndarray:
    scene = scene_of(result)
    place: np.ndarray = scene.position[scene.names.index(name)]
    return place


def counted(results: Sequence[StepResult]) -> Counter[str]:
    found: Counter[str] = Counter()
    for result in results:
        found.update(result.counts)
    return found


def wall(directory: Path) -> str:
    """A wall of 40 m × 60 m at x = 10, as scenery."""
    (directory / "wall.ply").write_text(
        "ply\nformat ascii 1.0\nelement vertex 4\nproperty float x\nproperty float y\nproperty float z\n"
        "element face 2\nproperty list uchar int vertex_indices\nend_header\n"
        "10 -20 0\n10 20 0\n10 20 60\n10 -20 60\n3 0 1 2\n3 0 2 3\n"
    )
    xml = directory / "wall.xml"
    xml.write_text(
        '<scene version="2.1.0"><shape type="ply" id="mesh-wall"><string name="filename" value="wall.ply"/>'
        '<bsdf type="itu-radio-material"><string name="type" value="concrete"/></bsdf></shape></scene>'
    )
    return str(xml)


def test_a_waypoint_is_reached_with_a_tilt_and_turning_on_the_way() -> None:
    made = world()
    target = (40.0, -20.0, 35.0)
    results = fly(made, WaypointCommand(object="uav", position=target, speed=8.0), 120)
    tilts = [np.abs(euler_from_quaternion(scene_of(r).orientation[0].tolist())[1:]).max() for r in results]
    turning = [scene_of(r).angular_velocity for r in results]
    assert 0.2 < max(tilts) < math.radians(40)
    assert any(rates is not None and np.abs(rates[0, :2]).max() > 0.1 for rates in turning)
    np.testing.assert_allclose(position(results[-1]), target, atol=0.15)
    assert max(np.linalg.norm(scene_of(r).velocity[0]) for r in results) < 8.5
    yaw = euler_from_quaternion(scene_of(results[60]).orientation[0].tolist())[0]
    assert yaw == pytest.approx(math.atan2(-20, 40), abs=0.05)


def test_the_angular_velocity_is_what_the_orientation_does() -> None:
    """In world axes: q(t + h) ⊗ q(t)⁻¹ over h, with frames of 1 ms."""
    made = world()
    command = VelocityCommand(object="uav", velocity=(6.0, 5.0, -2.0))
    results = [made.step(frame(k, command, t_ns=k * 1_000_000)) for k in range(1, 400)]
    for before, now, after in zip(results[100::50], results[101::50], results[102::50], strict=False):
        p, q = (scene_of(r).orientation[0] for r in (before, after))
        spin = 2 * (p[0] * q[1:] - q[0] * p[1:] - np.cross(q[1:], p[1:])) / 0.002
        rates = scene_of(now).angular_velocity
        assert rates is not None
        np.testing.assert_allclose(rates[0], spin, atol=0.02)


def test_a_velocity_is_taken_up_and_without_a_command_it_holds_its_place() -> None:
    made = world()
    moving = fly(made, VelocityCommand(object="uav", velocity=(0.0, 5.0, 1.0)), 80)[-1]
    np.testing.assert_allclose(scene_of(moving).velocity[0], (0.0, 5.0, 1.0), atol=0.05)
    rest = fly(made, None, 150, first=81)
    np.testing.assert_allclose(position(rest[-1]), position(rest[-50]), atol=0.05)
    assert np.linalg.norm(position(rest[-1]) - position(moving)) < 6.0


def test_a_path_is_followed_around_its_corners_without_a_stop() -> None:
    made = world()
    points = ((0.0, 0.0, 30.0), (30.0, 0.0, 30.0), (30.0, 30.0, 30.0), (0.0, 30.0, 30.0))
    results = fly(made, PathCommand(object="uav", points=points, speed=4.0), 300)
    places = np.array([position(r) for r in results])
    segments = [(np.array(a), np.array(b)) for a, b in pairwise(points)]

    def off(place: np.ndarray) -> float:
        gaps = []
        for a, b in segments:
            t = np.clip((place - a) @ (b - a) / ((b - a) @ (b - a)), 0, 1)
            gaps.append(float(np.linalg.norm(place - a - t * (b - a))))
        return min(gaps)

    # A corner of 90° taken with v and the acceleration a is missed by v²/2a at least: 2 m.
    assert max(map(off, places)) < 3.0
    np.testing.assert_allclose(places[-1], points[-1], atol=0.1)
    # 90 m with 4 m/s: a stop at each corner would take some seconds more.
    arrived = next(k for k, place in enumerate(places) if np.linalg.norm(place - points[-1]) < 1.0)
    assert arrived / 10 < 90 / 4 + 3.5


def test_an_attitude_is_taken_up_and_accelerates() -> None:
    made = world(flown(airframe=Airframe(linear_drag_n_s_m=(0, 0, 0), drag_area_m2=(0, 0, 0))))
    tilt = 0.3
    command = AttitudeCommand(
        object="uav", orientation=quaternion_from_euler(0.0, tilt), thrust=9.80665 / math.cos(tilt)
    )
    results = fly(made, command, 20)
    assert euler_from_quaternion(scene_of(results[-1]).orientation[0].tolist())[1] == pytest.approx(
        tilt, abs=1e-3
    )
    gained = (scene_of(results[-1]).velocity[0] - scene_of(results[-6]).velocity[0]) / 0.5
    np.testing.assert_allclose(gained, (9.80665 * math.tan(tilt), 0.0, 0.0), atol=0.02)


@pytest.mark.parametrize(
    ("command", "message"),
    [
        (AttitudeCommand(object="uav", orientation=(1.0, 1.0, 0.0, 0.0), thrust=9.8), "norm 1.41421"),
        (AttitudeCommand(object="uav", orientation=(math.nan, 0.0, 0.0, 0.0), thrust=9.8), "not finite"),
        (PathCommand(object="uav", points=((0.0, math.inf, 0.0),), speed=2.0), "not finite"),
    ],
)
def test_a_command_that_cannot_be_obeyed_is_refused(command: Command, message: str) -> None:
    with pytest.raises(PayloadError, match=message):
        fly(world(), command, 1)


def test_a_point_refuses_paths_and_attitudes_by_name() -> None:
    made = world(flown(dynamics="point"))
    with pytest.raises(PayloadError, match=r"PathCommand.*'uav'"):
        fly(made, PathCommand(object="uav", points=(START,), speed=2.0), 1)


def test_bounds_of_commands_hold_and_are_counted() -> None:
    made = world(flown(minimum_m=(-10.0, -20.0, 5.0), maximum_m=(10.0, 20.0, 40.0)))
    out = fly(made, VelocityCommand(object="uav", velocity=(9.0, 0.0, -3.0)), 200)
    np.testing.assert_allclose(position(out[-1]), (10.0, 0.0, 5.0), atol=0.1)
    assert max(position(r)[0] for r in out) < 10.3
    assert out[-1].counts["stopped-by-geofence"] == 1
    fast = fly(made, VelocityCommand(object="uav", velocity=(0.0, 40.0, 0.0)), 1, first=201)
    assert fast[0].counts["limited-speed"] == 1


def test_each_exit_from_the_geofence_is_counted_once_and_logged(caplog: pytest.LogCaptureFixture) -> None:
    """A tilt that is commanded takes it out, as a gale would; then it comes back, and goes out again."""
    made = world(flown(minimum_m=(-10.0, -20.0, 5.0), maximum_m=(10.0, 20.0, 40.0)))
    tilt = quaternion_from_euler(0.0, math.radians(20.0))
    out, number = list[StepResult](), 1
    for _ in range(2):
        away = AttitudeCommand(object="uav", orientation=tilt, thrust=9.81 / math.cos(math.radians(20.0)))
        out += fly(made, away, 40, first=number)
        out += fly(made, WaypointCommand(object="uav", position=START, speed=10.0), 120, first=number + 40)
        number += 160
    exits = [n for n, result in enumerate(out, 1) if result.counts.get("left-geofence/uav")]
    assert len(exits) == 2
    for left in exits:
        assert position(out[left - 2])[0] < 10.0 + RADIUS < position(out[left - 1])[0]
    told = [record.getMessage() for record in caplog.records if "left its geofence" in record.getMessage()]
    assert len(told) == 2
    assert told[0].startswith(f"episode 0, frame {exits[0]}: 'uav' left its geofence from [-10.0, ")


def test_gusts_that_it_withstands_at_its_bound_are_no_exit() -> None:
    made = world(flown(maximum_m=(10.0, 20.0, 40.0)), wind=GUSTY)
    out = fly(made, WaypointCommand(object="uav", position=(10.0, 0.0, 30.0), speed=8.0), 200)
    assert max(position(result)[0] for result in out) > 10.0
    assert counted(out)["left-geofence/uav"] == 0


def test_a_path_out_of_the_geofence_is_clipped_counted_and_warned_of(
    caplog: pytest.LogCaptureFixture,
) -> None:
    made = world(flown(maximum_m=(10.0, 20.0, 40.0)))
    out = fly(made, PathCommand(object="uav", points=(START, (90.0, 0.0, 30.0)), speed=5.0), 80)
    assert max(position(result)[0] for result in out) < 10.3
    assert counted(out)["commanded-outside-geofence/uav"] == 80
    (told,) = [record.getMessage() for record in caplog.records]
    assert told.startswith("episode 0, frame 1: agent 'a' commands 'uav' to [90.0, 0.0, 30.0] m, outside of")


@pytest.mark.parametrize("mode", ["stop", "bounce", "land", "fall", "ignore"])
def test_a_wall_is_touched_once_and_what_follows_is_as_configured(tmp_path: Path, mode: str) -> None:
    made = world(flown(on_collision=mode), scenery=wall(tmp_path))
    results = fly(made, VelocityCommand(object="uav", velocity=(6.0, 1.0, 0.0)), 60)
    places = np.array([position(r) for r in results])
    speeds = np.array([scene_of(r).velocity[0] for r in results])
    counts = counted(results)
    deepest = places[:, 0].max()
    if mode == "ignore":
        assert deepest > 15.0
        assert counts["collided/uav/scenery"] == 1
        return
    assert deepest <= 10.0 - RADIUS + 0.07
    hit = int(np.argmax(places[:, 0] > 10.0 - RADIUS - 0.3))
    if mode == "stop":  # it slides on along the wall
        assert counts["collided/uav/scenery"] >= 1
        assert np.abs(speeds[-1, 0]) < 0.5
        assert places[-1, 1] > places[hit, 1] + 1.0
    elif mode == "bounce":
        assert speeds[hit + 1 : hit + 4, 0].min() < -2.0
    else:
        assert counts["collided/uav/scenery"] == 1
        down = fly(made, VelocityCommand(object="uav", velocity=(6.0, 1.0, 0.0)), 350, first=61)
        assert position(down[-1])[2] == pytest.approx(0.125, abs=1e-9)
        assert position(down[-1]).tolist() == position(down[-9]).tolist()  # and stays
        lowest = min(scene_of(r).velocity[0, 2] for r in (*results, *down))
        assert lowest < -10.0 if mode == "fall" else lowest > -2.0
        assert counted([*results, *down])["collided/uav/ground"] == (1 if mode == "fall" else 0)


def test_a_van_that_drives_into_it_is_a_collision() -> None:
    script = MovingObject(
        name="van",
        kind="car",
        dimensions_m=(6.0, 2.0, 2.5),
        waypoints=((0.0, -20.0, 0.0, 1.25), (4.0, 20.0, 0.0, 1.25)),
    )
    made = world(flown(start_m=(0.0, 0.0, 1.5), minimum_m=(-50, -50, 1)), scripted=[script])
    results = fly(made, None, 30)
    counts = counted(results)
    assert counts["collided/uav/van"] >= 1
    assert position(results[-1])[0] > 2.0  # it was pushed


def test_two_quadrotors_collide() -> None:
    made = world(flown(name="a"), flown(name="b", start_m=(8.0, 0.0, 30.0)))
    results = fly(made, VelocityCommand(object="a", velocity=(6.0, 0.0, 0.0)), 30)
    counts = counted(results)
    assert counts["collided/a/b"] >= 1
    assert counts["collided/b/a"] >= 1
    for result in results:
        assert position(result, "b")[0] - position(result, "a")[0] > 2 * RADIUS - 0.15


def test_a_slow_descent_ends_on_the_ground_without_a_collision() -> None:
    made = world(flown(start_m=(0.0, 0.0, 3.0)))
    results = fly(made, VelocityCommand(object="uav", velocity=(0.0, 0.0, -1.5)), 80)
    assert position(results[-1])[2] == pytest.approx(0.125, abs=0.03)
    assert not [name for name in counted(results) if name.startswith("collided")]
    again = fly(made, VelocityCommand(object="uav", velocity=(0.0, 0.0, 2.0)), 20, first=81)
    assert position(again[-1])[2] > 2.0


def test_a_box_is_touched_at_faces_and_edges_and_left_by_the_nearest_face() -> None:
    pose, size, still = Pose((1.0, 2.0, 3.0), quaternion_from_euler(math.pi / 2)), (4.0, 2.0, 1.0), (0.0,) * 3
    # Turned by 90° the box reaches 1 m in x and 2 m in y.
    edge = box_contact("box", pose, size, still, (2.3, 4.4, 3.0), 0.6)
    assert edge is not None
    assert edge.normal == pytest.approx((0.6, 0.8, 0.0))
    assert edge.depth == pytest.approx(0.1)
    inside = box_contact("box", pose, size, still, (1.9, 2.0, 3.0), 0.6)
    assert inside is not None
    assert inside.normal == pytest.approx((1.0, 0.0, 0.0), abs=1e-12)
    assert inside.depth == pytest.approx(0.7)
    assert box_contact("box", pose, size, still, (2.5, 4.5, 3.0), 0.6) is None


def test_an_empty_battery_ends_the_flight_and_the_energy_is_counted() -> None:
    """Hover takes 168.6 W/0.8 + 10 W = 220.8 W: of 0.5 Wh, 1,800 J, nine tenths last 7.3 s."""
    made = world(flown(start_m=(0.0, 0.0, 40.0), battery=Battery(capacity_wh=0.5)))
    results = fly(made, None, 73)
    hovering = counted(results[:70])
    assert hovering["energy-j/uav"] == pytest.approx(220.8 * 7.0, rel=2e-3)
    assert not hovering["battery-low/uav"]
    rest = fly(made, None, 60, first=74)
    counts = counted([*results, *rest])
    assert counts["battery-low/uav"] == 1
    assert counts["battery-empty/uav"] == 1
    assert counts["collided/uav/ground"] == 1
    assert counts["energy-j/uav"] == 1800
    assert position(rest[-1])[2] == pytest.approx(0.125)


def test_frames_of_any_length_lead_to_the_same_flight() -> None:
    """Bit by bit, with gusts: 100 ms against 30 ms, 7 ms and one leap, under one command."""
    command = WaypointCommand(object="uav", position=(20.0, 10.0, 25.0), speed=6.0)
    scenes = []
    for period in (100, 30, 7, 2100):
        made = world(wind=GUSTY)
        for number in range(1, 2100 // period + 1):
            result = made.step(frame(number, command, t_ns=number * period * 1_000_000))
        scenes.append(encode_payload(scene_of(result)))
    assert scenes[1:] == scenes[:-1]


@pytest.mark.parametrize("period_ms", [100, 33])
def test_another_process_flies_on_bit_by_bit(tmp_path: Path, period_ms: int) -> None:
    """Saved in each frame of a flight with gusts, two commands and a wall."""
    file = wall(tmp_path)

    def at(number: int) -> Frame:
        if number < 20:
            command: Command = PathCommand(
                object="uav", points=(START, (5.0, 0.0, 30.0), (9.0, 5.0, 30.0)), speed=5.0
            )
        else:
            command = VelocityCommand(object="uav", velocity=(6.0, 0.0, 0.0))
        return frame(number, command, t_ns=number * period_ms * 1_000_000)

    def made() -> FlightWorld:
        return world(flown(battery=Battery(capacity_wh=10.0)), wind=GUSTY, scenery=file)

    original = made()
    results, kept = [], []
    for number in range(1, 50):
        results.append(original.step(at(number)))
        kept.append(original.checkpoint())
    for split in (1, 13, 21, 40):
        other = made()
        other.reset(0, 1, 0)
        other.restore(kept[split - 1])
        assert other.checkpoint() == kept[split - 1]
        for number in range(split + 1, 50):
            again = other.step(at(number))
            assert encode_payload(scene_of(again)) == encode_payload(scene_of(results[number - 1]))
            assert again.counts == results[number - 1].counts


def test_gusts_depend_on_seed_episode_and_name() -> None:
    def places(seed: int, episode: int) -> np.ndarray:
        made = world(flown(), flown(name="b", start_m=(40.0, 0.0, 30.0)), wind=GUSTY)
        made.reset(episode, seed, 0)
        for number in range(30):
            result = made.step(frame(number, None))
        return scene_of(result).position - scene_of(result).position.round(-1)

    first = places(1, 0)
    np.testing.assert_array_equal(first, places(1, 0))
    assert not np.allclose(first, places(2, 0))
    assert not np.allclose(first, places(1, 1))
    assert not np.allclose(first[0], first[1])


def test_it_can_be_put_elsewhere_at_once() -> None:
    made = world(wind=GUSTY)
    fly(made, VelocityCommand(object="uav", velocity=(6.0, 0.0, 0.0)), 15)
    there: Vector = (50.0, -40.0, 12.0)
    put = fly(made, WaypointCommand(object="uav", position=there, speed=3.0, at_once=True), 1, first=16)[0]
    assert np.linalg.norm(position(put) - there) < 0.05
    end = fly(made, None, 60, first=17)[-1]
    assert np.linalg.norm(position(end) - there) < 1.0


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"airframe": Airframe(mass_kg=5.0)}, "lift 0.82 of the weight"),
        ({"controller": Controller(max_tilt_deg=20.0)}, "write at most 3.56"),
        ({"max_speed_m_s": 50.0}, "pass through a wall"),
        ({"clearance_m": 0.3}, "half the diagonal"),
    ],
)
def test_a_quadrotor_that_cannot_fly_so_is_refused(changes: dict[str, object], message: str) -> None:
    with pytest.raises(ScenarioError, match=message):
        world(flown(**changes))


def test_what_a_point_does_not_have_is_refused_by_its_key() -> None:
    place = Place("services").at("world").at("settings")
    point = flown(dynamics="point", battery=Battery())
    with pytest.raises(ScenarioError, match='dynamics = "quadrotor"') as error:
        FlightWorld.check_settings(FlightSettings(flown=(point,)), place)
    assert error.value.key == "services.world.settings.flown[0].battery"
    with pytest.raises(ScenarioError, match="moves quadrotors alone"):
        FlightWorld.check_settings(FlightSettings(flown=(flown(dynamics="point"),), wind=GUSTY), place)
