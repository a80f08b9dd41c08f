"""Flown objects: they obey commands within their limits, and reach where they are sent."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from caviar_protocol.codec import encode_payload
from caviar_protocol.errors import PayloadError, RunError, ScenarioError
from caviar_protocol.messages import GrantInput, Status
from caviar_protocol.space.coordinates import Vector, euler_from_quaternion
from caviar_protocol.topics import Action, BeamChoice, Scene, VelocityCommand, WaypointCommand
from caviar_protocol.topics.link import Command
from caviar_services.service import Frame, FrameInput, Preparation, RunInfo, StepResult
from caviar_services.world.flight import FlightSettings, FlightWorld, FlownObject
from caviar_services.world.trajectory import MovingObject

pytestmark = pytest.mark.slow

SPEED, ACCELERATION = 12.0, 4.0
PERIOD_NS = 100_000_000

coordinates = st.floats(-80.0, 80.0, allow_subnormal=False)
points = st.tuples(coordinates, coordinates, st.floats(1.0, 60.0))


def flown(**changes: object) -> FlownObject:
    plain: dict[str, object] = {
        "name": "uav",
        "start_m": (0.0, 0.0, 30.0),
        "max_speed_m_s": SPEED,
        "max_acceleration_m_s2": ACCELERATION,
    }
    return FlownObject(**{**plain, **changes})  # type: ignore[arg-type]


def world(*objects: FlownObject, scripted: Sequence[MovingObject] = ()) -> FlightWorld:
    made = FlightWorld(
        FlightSettings(flown=objects or (flown(),), objects=tuple(scripted)), RunInfo(name="world")
    )
    made.reset(0, 1, 0)
    made.step(Frame(episode=0, number=0, t_ns=0))
    return made


def commanded(number: int, agents: dict[str, tuple[Command, ...]], **changes: int) -> Frame:
    """Frame with the agents' actions of the frame before."""
    inputs = tuple(
        FrameInput(
            GrantInput(topic="action", source=name, status=Status.FRESH, frame=number - 1),
            payload=Action(commands=commands),
        )
        for name, commands in agents.items()
    )
    t_ns = changes.pop("t_ns", number * PERIOD_NS)
    return Frame(episode=0, number=number, t_ns=t_ns, previous=number - 1, inputs=inputs, **changes)


def state(result: StepResult, name: str = "uav") -> tuple[np.ndarray, np.ndarray, float]:
    """Position, velocity and yaw."""
    scene = result.products["scene"]
    assert isinstance(scene, Scene)
    i = scene.names.index(name)
    return scene.position[i], scene.velocity[i], euler_from_quaternion(scene.orientation[i].tolist())[0]


def fly(made: FlightWorld, command: Command | None, frames: int, first: int = 1) -> list[StepResult]:
    agents: dict[str, tuple[Command, ...]] = {"agent": (command,)} if command else {}
    return [made.step(commanded(first + k, agents)) for k in range(frames)]


@given(points, st.floats(0.5, 30.0))
@settings(max_examples=15, deadline=None)
def test_a_waypoint_is_reached_without_passing_it_or_any_limit(target: Vector, speed: float) -> None:
    """The way there is straight: no place is farther from the target than the one before."""
    made = world()
    distance = math.dist((0.0, 0.0, 30.0), target)
    allowed = min(speed, SPEED)
    duration = distance / allowed + 2 * allowed / ACCELERATION + 1.0
    results = fly(made, WaypointCommand(object="uav", position=target, speed=speed), int(duration * 10) + 1)
    before, slow = distance, np.zeros(3)
    for result in results:
        position, velocity, _ = state(result)
        left = float(np.linalg.norm(position - target))
        assert left <= before + 1e-9
        assert np.linalg.norm(velocity) <= allowed + 1e-9
        assert np.linalg.norm(velocity - slow) <= ACCELERATION * PERIOD_NS / 1e9 + 1e-9
        before, slow = left, velocity
    assert before < 1e-3
    assert np.linalg.norm(slow) < 1e-2


@pytest.mark.parametrize("dynamics", ["point", "quadrotor"])
@pytest.mark.parametrize("moving", [(0.0, 0.0, 0.0), (0.0, -3.0, 0.0)])
def test_a_heading_is_kept_turned_to_or_turned_as_commanded_wherever_it_flies(
    dynamics: str, moving: Vector
) -> None:
    made = world(flown(dynamics=dynamics))
    turns = fly(made, VelocityCommand(object="uav", velocity=moving, yaw_rate=0.5), 40)
    turned, scene = state(turns[-1])[2], turns[-1].products["scene"]
    assert turned == pytest.approx(2.0, abs=0.08)  # a body follows its set-point with a lag
    assert isinstance(scene, Scene)
    assert scene.angular_velocity is not None
    assert scene.angular_velocity[0, 2] == pytest.approx(0.5, abs=0.05)
    to = fly(made, VelocityCommand(object="uav", velocity=moving, yaw=-2.0), 40, 41)
    # The short way round, over ±π, and a point never faster than 120 °/s.
    course = np.unwrap([turned, *(state(result)[2] for result in to)])
    assert course[-1] == pytest.approx(2.0 * math.pi - 2.0, abs=0.02)
    if dynamics == "point":
        assert np.abs(np.diff(course)).max() <= math.radians(12.0) + 1e-9
    there = fly(made, WaypointCommand(object="uav", position=(9.0, 0.0, 30.0), speed=5.0, yaw=-2.0), 60, 81)
    assert state(there[-1])[2] == pytest.approx(-2.0, abs=0.02)
    put = WaypointCommand(object="uav", position=(5.0, 5.0, 9.0), speed=5.0, at_once=True, yaw=1.0)
    assert state(fly(made, put, 1, 141)[0])[2] == pytest.approx(1.0, abs=0.01)


@given(st.tuples(coordinates, coordinates, st.floats(0.0, 80.0)))
@settings(max_examples=40, deadline=None)
def test_a_velocity_is_taken_up_with_the_greatest_acceleration(asked: Vector) -> None:
    """x = a·t²/2 until the speed is reached, then x = v·t − v²/2a."""
    made = world()
    speed = min(math.hypot(*asked), SPEED)
    direction = np.array(asked) / max(math.hypot(*asked), 1e-12)
    for k, result in enumerate(fly(made, VelocityCommand(object="uav", velocity=asked), 40), 1):
        t = k * PERIOD_NS / 1e9
        rising = speed / ACCELERATION
        way = ACCELERATION * t * t / 2 if t < rising else speed * t - speed * speed / (2 * ACCELERATION)
        position, velocity, _ = state(result)
        # In the sub-step in which the speed is reached the acceleration is smaller.
        np.testing.assert_allclose(position, np.array([0, 0, 30]) + way * direction, atol=ACCELERATION * 1e-4)
        np.testing.assert_allclose(velocity, min(ACCELERATION * t, speed) * direction, atol=1e-9)


def test_a_bend_is_told_as_a_yaw_rate() -> None:
    """From east to north: the course turns, and its rate is the change of the yaw over 0.1 ms."""
    made = world()
    fly(made, VelocityCommand(object="uav", velocity=(6.0, 0.0, 0.0)), 30)
    north = VelocityCommand(object="uav", velocity=(0.0, 6.0, 0.0))
    bend = fly(made, north, 4, first=31)[-1].products["scene"]
    assert isinstance(bend, Scene)
    assert bend.angular_velocity is not None
    velocity, acceleration = bend.velocity[0], np.array([-1.0, 1.0, 0.0]) * ACCELERATION / math.sqrt(2)
    yaws = [math.atan2(*(velocity + acceleration * t)[1::-1]) for t in (-1e-4, 1e-4)]
    assert bend.angular_velocity[0] == pytest.approx((0.0, 0.0, (yaws[1] - yaws[0]) / 2e-4), rel=1e-6)
    straight = fly(made, north, 40, first=35)[-1].products["scene"]
    assert isinstance(straight, Scene)
    assert straight.angular_velocity is None


def test_without_a_command_it_brakes_and_hovers_and_keeps_its_yaw() -> None:
    made = world()
    fast = fly(made, VelocityCommand(object="uav", velocity=(6.0, -8.0, 0.0)), 30)[-1]
    start, velocity, yaw = state(fast)
    assert np.linalg.norm(velocity) == pytest.approx(10.0)
    assert yaw == pytest.approx(math.atan2(-8, 6))
    end, rest, kept = state(fly(made, None, 40, first=31)[-1])
    assert rest.tolist() == [0.0, 0.0, 0.0]
    assert np.linalg.norm(end - start) == pytest.approx(10.0**2 / (2 * ACCELERATION), abs=1e-2)
    assert kept == pytest.approx(yaw, abs=1e-9)


def test_a_skipped_frame_is_flown_with_the_command_that_comes() -> None:
    command = VelocityCommand(object="uav", velocity=(5.0, 1.0, 0.0))
    step_by_step = state(fly(world(), command, 7)[-1])
    at_once = state(world().step(commanded(7, {"agent": (command,)})))
    for one, other in zip(step_by_step, at_once, strict=True):
        np.testing.assert_array_equal(one, other)


def test_uneven_instants_are_flown_too() -> None:
    """Speed at an instant that is no multiple of the sub-step."""
    made = world()
    command = VelocityCommand(object="uav", velocity=(1.0, 0.0, 0.0))
    result = made.step(commanded(1, {"agent": (command,)}, t_ns=123_456_789))
    assert state(result)[1][0] == pytest.approx(ACCELERATION * 0.123456789)


def test_every_episode_starts_at_the_same_place() -> None:
    made = world(flown(start_yaw_deg=90.0))
    fly(made, VelocityCommand(object="uav", velocity=(5.0, 0.0, 0.0)), 5)
    made.reset(1, 2, 0)
    position, velocity, yaw = state(made.step(Frame(episode=1, number=0, t_ns=0)))
    assert position.tolist() == [0.0, 0.0, 30.0]
    assert velocity.tolist() == [0.0, 0.0, 0.0]
    assert yaw == pytest.approx(math.pi / 2)


def test_too_much_speed_is_counted_and_not_flown() -> None:
    made = world()
    result = fly(made, VelocityCommand(object="uav", velocity=(0.0, 100.0, 0.0)), 50)[-1]
    assert result.counts == {"limited-speed": 1}
    np.testing.assert_allclose(state(result)[1], (0.0, SPEED, 0.0))


@pytest.mark.parametrize("course", [(0.1, 0.7, 0.3), (1.0, 1.0, 1.0), (-0.6, 0.23, 0.11)])
def test_the_greatest_speed_but_for_rounding_is_not_too_much(course: Vector) -> None:
    size = math.hypot(*course)
    x, y, z = (c * (SPEED / size) * (1 + 4e-16) for c in course)
    result = fly(world(), VelocityCommand(object="uav", velocity=(x, y, z)), 50)[-1]
    assert result.counts == {}


def test_the_geofence_and_the_ground_are_limits() -> None:
    made = world(flown(maximum_m=(10.0, 20.0, 40.0), minimum_m=(-10.0, -20.0, 5.0)), flown(name="low"))
    out = fly(made, VelocityCommand(object="uav", velocity=(9.0, 0.0, -6.0)), 80)[-1]
    assert state(out)[0].tolist() == pytest.approx([10.0, 0.0, 5.0], abs=0.02)
    assert state(out)[0][0] <= 10.0
    assert state(out)[0][2] >= 5.0
    assert out.counts == {"stopped-by-geofence": 1}
    down = fly(made, VelocityCommand(object="low", velocity=(0.0, 0.0, -9.0)), 80, first=81)[-1]
    assert 0.125 <= state(down, "low")[0][2] < 0.145  # it stands on the ground
    assert state(down, "low")[1].tolist() == pytest.approx([0.0, 0.0, 0.0], abs=0.01)


def test_a_waypoint_out_of_the_geofence_is_warned_of_once_and_counted(
    caplog: pytest.LogCaptureFixture,
) -> None:
    made = world(flown(maximum_m=(10.0, 20.0, 40.0)))
    out = fly(made, WaypointCommand(object="uav", position=(1e8, 0.0, 30.0), speed=9.0), 30)
    assert state(out[-1])[0][0] <= 10.0
    assert all(result.counts["commanded-outside-geofence/uav"] == 1 for result in out)
    (told,) = [record.getMessage() for record in caplog.records]
    assert re.match(
        r"episode 0, frame 1: agent '\w+' commands 'uav' to \[100000000.0, 0.0, 30.0\] m, outside", told
    )


def test_a_waypoint_out_of_any_range_is_refused() -> None:
    with pytest.raises(PayloadError, match=r"'uav'.*\[1000000000000.0.*1e\+09"):
        fly(world(), WaypointCommand(object="uav", position=(1e12, 0.0, 30.0), speed=9.0), 1)


def test_scripted_objects_follow_their_script_beside_it() -> None:
    script = MovingObject(name="van", kind="car", waypoints=((0.0, 0.0, 0.0, 1.0), (1.0, 8.0, 0.0, 1.0)))
    made = world(scripted=[script])
    result = fly(made, WaypointCommand(object="uav", position=(0.0, 0.0, 35.0), speed=2.0), 10)[-1]
    assert state(result, "van")[0].tolist() == [8.0, 0.0, 1.0]
    assert state(result)[0][2] > 30.5


def test_beams_are_not_for_worlds() -> None:
    made = world()
    beam = BeamChoice(tx="bs", rx="rx", tx_beam=3)
    result = made.step(commanded(1, {"agent": (beam,)}))
    assert state(result)[0].tolist() == [0.0, 0.0, 30.0]


def test_an_unknown_object_is_refused_by_name() -> None:
    with pytest.raises(PayloadError, match=r"'pilot'.*'uva'.*flies 'uav', 'b'"):
        world(flown(), flown(name="b")).step(
            commanded(1, {"pilot": (VelocityCommand(object="uva", velocity=(1.0, 0.0, 0.0)),)})
        )


def test_what_another_world_flies_is_left_to_it() -> None:
    """But not what a prefix of this world's own claims."""
    made = world(flown(name="sky.uav"))
    made.prepare(Preparation(demand={}, producers={"scene": ("sea", "world")}))
    elsewhere = VelocityCommand(object="sea.boat", velocity=(1.0, 0.0, 0.0))
    position, velocity, _ = state(made.step(commanded(1, {"agent": (elsewhere,)})), "sky.uav")
    assert (position.tolist(), velocity.tolist()) == ([0.0, 0.0, 30.0], [0.0, 0.0, 0.0])
    mine = VelocityCommand(object="sky.uav2", velocity=(1.0, 0.0, 0.0))
    with pytest.raises(PayloadError, match=r"'sky\.uav2'.*'world'"):
        made.step(commanded(2, {"agent": (mine,)}))


def test_a_process_that_comes_back_in_the_middle_does_not_start_over() -> None:
    """The broker resets it and grants the frame that is owed: commands so far are not known to it."""
    made = world()
    made.reset(0, 1, 0)
    with pytest.raises(RunError, match="came back in frame 7"):
        made.step(commanded(7, {}))


@given(
    first=points,
    then=st.one_of(points, st.none()),
    split=st.integers(1, 19),
    period_ms=st.integers(3, 130),
)
@settings(max_examples=40, deadline=None)
def test_another_process_flies_on_bit_by_bit(
    first: Vector, then: Vector | None, split: int, period_ms: int
) -> None:
    """To a waypoint, then to another or with no command, saved in the middle of a sub-step or not."""

    def frame(number: int) -> Frame:
        target = first if number < 10 else then
        told = {} if target is None else {"a": (WaypointCommand(object="uav", position=target, speed=20.0),)}
        return commanded(number, told, t_ns=number * period_ms * 1_000_000)

    original, other = world(), world()
    for number in range(1, split):
        original.step(frame(number))
    kept = original.checkpoint()
    other.reset(0, 1, 0)
    other.restore(kept)
    assert other.checkpoint() == kept
    for number in range(split, 20):
        one, two = original.step(frame(number)), other.step(frame(number))
        assert encode_payload(one.products["scene"]) == encode_payload(two.products["scene"])
        assert one.counts == two.counts


def test_two_agents_cannot_fly_one_object() -> None:
    command = VelocityCommand(object="uav", velocity=(1.0, 0.0, 0.0))
    with pytest.raises(PayloadError, match=r"'a'.*'b'.*'uav'"):
        world().step(commanded(1, {"a": (command,), "b": (command,)}))


@pytest.mark.parametrize(
    "command",
    [
        VelocityCommand(object="uav", velocity=(math.nan, 0.0, 0.0)),
        WaypointCommand(object="uav", position=(0.0, math.inf, 0.0), speed=1.0),
    ],
)
def test_a_command_that_is_not_finite_is_refused(command: Command) -> None:
    with pytest.raises(PayloadError, match="not finite"):
        world().step(commanded(1, {"agent": (command,)}))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"start_m": (0.0, 0.0, 0.0)}, "start inside"),
        ({"maximum_m": (5.0, -1.0, 50.0)}, "start inside"),
        ({"clearance_m": 0.3}, "half the diagonal"),
    ],
)
def test_contradicting_settings_are_refused(changes: dict[str, object], message: str) -> None:
    with pytest.raises(ScenarioError, match=message):
        world(flown(**changes))


def test_two_objects_of_one_name_are_refused() -> None:
    with pytest.raises(ScenarioError, match="second object is named 'uav'"):
        world(flown(), flown())


def test_an_object_that_is_put_somewhere_at_once_is_there_at_rest_and_flies_on_from_there() -> None:
    made = world()
    fly(made, VelocityCommand(object="uav", velocity=(6.0, 0.0, 0.0)), 5)
    there = (50.0, -40.0, 12.0)
    command = WaypointCommand(object="uav", position=there, speed=3.0, at_once=True)
    position, velocity, _ = state(fly(made, command, 1, first=6)[0])
    assert position.tolist() == list(there)
    assert velocity.tolist() == [0.0, 0.0, 0.0]
    north = VelocityCommand(object="uav", velocity=(0.0, 6.0, 0.0))
    position, velocity, _ = state(fly(made, north, 10, first=7)[-1])
    assert position == pytest.approx([50.0, -40.0 + ACCELERATION / 2, 12.0], abs=1e-3)
    assert velocity == pytest.approx([0.0, ACCELERATION, 0.0])


@pytest.mark.parametrize("point", [(0.0, 0.0, 81.0), (0.0, -3.0, 0.0)], ids=["too high", "in the ground"])
def test_an_object_is_not_put_where_it_cannot_be(point: Vector) -> None:
    made = world(flown(maximum_m=(100.0, 100.0, 80.0), minimum_m=(-100.0, -100.0, 1.0)))
    with pytest.raises(PayloadError, match="'uav' cannot be at "):
        fly(made, WaypointCommand(object="uav", position=point, speed=3.0, at_once=True), 1)
