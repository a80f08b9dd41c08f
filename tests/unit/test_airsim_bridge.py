"""AirSim's calls between frames: what a vehicle flies, when a call returns, and what holds the world."""

from __future__ import annotations

import asyncio
import math
from collections.abc import Awaitable
from typing import Any

import numpy as np
import pytest
from airsim_harness import PERIOD_NS, START, Body, Flight

from caviar_protocol.topics import Lidar, LidarScan, VelocityCommand, WaypointCommand
from caviar_services.airsim.rpc import CallError


def do(work: Awaitable[Any]) -> Any:
    """Its result, which has to come within seconds."""

    async def bounded() -> Any:
        return await asyncio.wait_for(work, 20)

    return asyncio.run(bounded())


async def ready(**values: Any) -> Flight:
    flight = Flight(**values)
    await flight.ready()
    return flight


async def place(flight: Flight) -> list[float]:
    """Position in NED, of the newest frame."""
    await flight.step()
    found = await flight.call("simGetVehiclePose")
    return [round(part, 3) + 0.0 for part in found["position"].values()]


def test_a_square_is_flown_with_each_call_returning_at_its_corner() -> None:
    async def fly() -> list[list[float]]:
        flight = await ready()
        corners = []
        assert await flight.during(("takeoff", 20.0)) == [True]
        for x, y in ((20.0, 0.0), (20.0, 20.0), (0.0, 20.0), (0.0, 0.0)):
            assert await flight.during(("moveToPosition", x, y, -5.0, 6.0)) == [True]
            corners.append(await place(flight))
        return corners

    corners = do(fly())
    wanted = [[20, 0, -5], [20, 20, -5], [0, 20, -5], [0, 0, -5]]
    assert np.abs(np.array(corners) - wanted).max() < 0.6


def test_takeoff_climbs_three_metres_and_landing_comes_down_again() -> None:
    async def fly() -> list[Any]:
        flight = await ready()
        states = []
        for call in ("takeoff", "land", "takeoff"):
            assert await flight.during((call, 60.0)) == [True]
            where = await place(flight)
            states.append((where, (await flight.call("getMultirotorState"))["landed_state"]))
        return states

    (up, flying), (down, landed), (again, _) = do(fly())
    assert (up[2], flying) == (pytest.approx(-3.0, abs=0.5), 1)
    assert (down[2], landed) == (pytest.approx(0.0, abs=0.02), 0)
    assert again[2] == pytest.approx(-3.0, abs=0.5)


def test_a_velocity_is_kept_for_its_time_and_then_braked() -> None:
    async def fly() -> list[object]:
        flight = await ready()
        assert await flight.during(("moveByVelocity", 3.0, -1.0, -2.0, 0.5)) == [True]
        await flight.step()
        return [commands[0] for commands in flight.log[1:]]

    commands = do(fly())
    assert commands[:5] == [VelocityCommand(object="uav", velocity=(-1.0, 3.0, 2.0))] * 5
    assert commands[5:] == [VelocityCommand(object="uav", velocity=(0.0, 0.0, 0.0))] * len(commands[5:])


def test_a_height_is_reached_while_a_horizontal_velocity_is_kept() -> None:
    async def fly() -> list[float]:
        flight = await ready()
        await flight.during(("moveByVelocityZ", 2.0, 0.0, -6.0, 8.0))
        return await place(flight)

    x, y, z = do(fly())
    assert (z, y) == (pytest.approx(-6.0, abs=0.1), 0.0)
    assert 14.0 < x < 17.0


def test_a_path_is_flown_through_its_points() -> None:
    points = [(5.0, 0.0, -4.0), (5.0, 8.0, -4.0), (-2.0, 8.0, -6.0)]
    path = [dict(zip(("x_val", "y_val", "z_val"), point, strict=True)) for point in points]

    async def fly() -> list[list[float]]:
        flight = await ready()
        running = asyncio.ensure_future(flight.call("moveOnPath", path, 3.0))
        seen = []
        while not running.done():
            seen.append(await place(flight))
        assert running.result() is True
        return seen

    seen = np.array(do(fly()))
    for point in points:
        assert np.linalg.norm(seen - point, axis=1).min() < 0.6


@pytest.mark.parametrize("heading", [0.0, 90.0, -135.0, 179.0])
def test_a_vehicle_turns_where_it_has_to_head_and_moves_by_centimetres(heading: float) -> None:
    async def fly() -> tuple[float, list[float]]:
        flight = await ready()
        await flight.during(("takeoff", 20.0), ("rotateToYaw", heading, 20.0, 2.0))
        where = await place(flight)
        w, x, y, z = (await flight.call("simGetVehiclePose"))["orientation"].values()
        return math.degrees(math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))), where

    yaw, where = do(fly())
    assert math.remainder(yaw - heading, 360.0) == pytest.approx(0.0, abs=2.0)
    assert math.hypot(*where[:2]) < 0.1


def test_a_new_call_replaces_the_one_under_way_which_returns_false() -> None:
    async def fly() -> list[Any]:
        flight = await ready()
        first = asyncio.ensure_future(flight.call("moveToPosition", 90.0, 0.0, -5.0, 5.0))
        await flight.step()
        second = asyncio.ensure_future(flight.call("moveToPosition", 0.0, 9.0, -5.0, 5.0))
        await flight.step()
        await flight.call("cancelLastTask")
        return [await first, await second]

    assert do(fly()) == [False, False]


def test_a_call_that_is_not_done_in_its_time_or_is_blocked_returns_false() -> None:
    """The first in simulated seconds; the second stands before the end of its world."""

    async def fly() -> tuple[Any, int, Any]:
        flight = await ready()
        (late,) = await flight.during(("moveToPosition", 90.0, 0.0, -5.0, 5.0, 2.0))
        frames = flight.frame
        (blocked,) = await flight.during(("moveToPosition", 0.0, 0.0, -500.0, 15.0))
        return late, frames, blocked

    late, frames, blocked = do(fly())
    assert (late, blocked) == (False, False)
    assert 20 <= frames <= 25


def test_home_is_where_the_vehicle_started() -> None:
    async def fly() -> list[float]:
        flight = await ready()
        await flight.during(("moveToPosition", 5.0, 6.0, -7.0, 8.0), ("goHome", 60.0))
        return await place(flight)

    assert do(fly()) == pytest.approx([0.0, 0.0, 0.0], abs=0.5)


def test_the_world_is_held_by_a_pause_and_goes_exactly_as_far_as_it_is_let() -> None:
    async def fly() -> list[int]:
        flight = await ready()
        running = asyncio.ensure_future(flight.run())
        await flight.call("simPause", True)
        assert await flight.call("simIsPaused")
        seen = [await now(flight)]
        for call in (("simContinueForFrames", 3), ("simContinueForTime", 0.5), ("simContinueForTime", 0.05)):
            await flight.call(*call)
            seen.append(await now(flight))
            for _ in range(20):
                await asyncio.sleep(0)
        seen.append(await now(flight))
        await flight.call("simPause", False)
        assert not await flight.call("simIsPaused")
        await asyncio.sleep(0.01)
        running.cancel()
        seen.append(await now(flight))
        return seen

    begun, three, half, least, still, free = do(fly())
    assert [three - begun, half - three, least - half, still - least] == [3, 5, 1, 0]
    assert free > still


async def now(flight: Flight) -> int:
    return int((await flight.call("getMultirotorState"))["timestamp"]) // PERIOD_NS


def test_in_lock_step_a_motion_ends_with_the_frame_that_completes_it() -> None:
    """The world is held at the end of the time of the motion, and its call returns there."""

    async def fly() -> tuple[Any, list[float]]:
        flight = await ready(paused=False)
        running = asyncio.ensure_future(flight.run())
        await flight.call("simPause", True)
        motion = asyncio.ensure_future(flight.call("moveByVelocity", 2.0, 0.0, 0.0, 0.3))
        await asyncio.sleep(0)
        await flight.call("simContinueForTime", 0.3)
        done = await motion
        velocity = (await flight.call("simGetGroundTruthKinematics"))["linear_velocity"]
        running.cancel()
        return done, list(velocity.values())

    done, velocity = do(fly())
    assert done is True
    assert velocity[0] == pytest.approx(1.5)  # 0.3 s with 5 m/s²


def test_a_world_that_begins_paused_stays_at_its_first_frame() -> None:
    async def fly() -> int:
        flight = Flight(paused=True)
        running = asyncio.ensure_future(flight.run())
        await flight.call("simContinueForFrames", 2)
        running.cancel()
        return await now(flight)

    assert do(fly()) == 2


def test_two_vehicles_fly_on_their_own_and_commands_are_sorted() -> None:
    async def fly() -> tuple[Any, Any, Any]:
        flight = Flight(Body("b"), Body("a", (40.0, 75.0, 1.5)))
        await flight.ready()
        rest = (60.0, 0, None, -1, 1, "b")
        up = asyncio.ensure_future(flight.call("takeoff", 20.0, "a"))
        results = await flight.during(("moveToPosition", 0.0, 9.0, -5.0, 5.0, *rest))
        heights = [round(body.flyer.state.position[2] - 1.5, 1) for body in flight.bodies]
        return [await up, *results], heights, [[c.object for c in step] for step in flight.log[-2:]]  # type: ignore[attr-defined]

    assert do(fly()) == ([True, True], [5.0, 3.0], [["a", "b"]] * 2)


def test_a_vehicle_is_put_somewhere_in_the_next_frame_and_turned_there() -> None:
    yaw = math.radians(90.0)
    pose = {
        "position": {"x_val": 4.0, "y_val": 5.0, "z_val": -6.0},
        "orientation": {"w_val": math.cos(yaw / 2), "x_val": 0.0, "y_val": 0.0, "z_val": math.sin(yaw / 2)},
    }

    async def fly() -> tuple[list[float], Any, Any]:
        flight = await ready()
        await flight.during(("simSetVehiclePose", pose, True))
        where = await place(flight)
        turned = (await flight.call("simGetVehiclePose"))["orientation"]
        unknown = {key: dict.fromkeys(part, math.nan) for key, part in pose.items()}
        await flight.during(("simSetVehiclePose", unknown, True))
        (moved,) = await flight.during(("simSetObjectPose", "uav", pose))
        assert any(isinstance(c, WaypointCommand) and c.at_once for step in flight.log for c in step)
        return where, turned, moved

    where, turned, moved = do(fly())
    assert where == pytest.approx([4.0, 5.0, -6.0], abs=0.1)
    assert 2 * math.atan2(turned["z_val"], turned["w_val"]) == pytest.approx(yaw, abs=0.02)
    assert moved is True


def test_a_reset_of_the_last_episode_puts_vehicles_home_without_control() -> None:
    async def fly() -> tuple[list[float], Any, bool]:
        flight = await ready()
        await flight.during(("moveToPosition", 5.0, 6.0, -7.0, 8.0), ("reset",))
        return await place(flight), await flight.call("isApiControlEnabled"), flight.ended

    assert do(fly()) == ([0.0, 0.0, 0.0], False, False)


def test_a_reset_of_an_earlier_episode_ends_it() -> None:
    async def fly() -> bool:
        flight = Flight(is_last_episode=False)
        resetting = asyncio.ensure_future(flight.call("reset"))
        while not flight.ended:
            await flight.step()
        assert not resetting.done()
        flight.bridge.begin_episode()
        await flight.step()
        await resetting
        return True

    assert do(fly())


def test_objects_are_found_by_expression_and_pose() -> None:
    async def ask() -> list[Any]:
        flight = Flight(cars={"car.1": (36.0, 80.0, 0.75), "car.2": (90.0, 80.0, 0.75)})
        await flight.step()
        return [
            await flight.call("simListSceneObjects"),
            await flight.call("simListSceneObjects", r"car\..*"),
            await flight.call("simListSceneObjects", "car"),
            list((await flight.call("simGetObjectPose", "car.1"))["position"].values()),
            list((await flight.call("simGetObjectPose", "tree"))["position"].values()),
        ]

    every, cars, part, where, nowhere = do(ask())
    assert (every, cars, part) == (["car.1", "car.2", "uav"], ["car.1", "car.2"], [])
    assert where == [5.0, 1.0, 0.75]
    assert all(map(math.isnan, nowhere))


@pytest.mark.parametrize(
    ("place", "hit"), [((37.0, 75.2, 1.5), True), ((37.9, 75.0, 1.5), False), ((37.0, 75.2, 3.2), False)]
)
def test_a_collision_is_an_overlap_with_another_object(place: Any, hit: bool) -> None:
    """The car is 4.5 m long, turned by 0.3 rad; its front is 2.15 m west of its centre in the first case."""

    async def ask() -> Any:
        flight = Flight(cars={"car.1": place})
        await flight.step()
        return await flight.call("simGetCollisionInfo")

    found = do(ask())
    assert (found["has_collided"], found["object_name"]) == (hit, "car.1" if hit else "")


def test_lidar_points_count_from_where_the_vehicle_started() -> None:
    points = np.array([[5.0, 0.0, 0.0], [0.0, 2.0, 1.0]], np.float32)
    scan = LidarScan(
        sensor="uav/lidar",
        position=START,
        orientation=(math.sqrt(0.5), 0.0, 0.0, math.sqrt(0.5)),  # ahead is north
        ray=np.arange(2, dtype=np.int32),
        points=points,
        range=np.linalg.norm(points, axis=1).astype(np.float32),
        object=np.array([0, 1], np.int32),
    )

    async def ask() -> Any:
        flight = Flight(lidars=(Lidar(object_names=("wall", "road"), scans=(scan,)),))
        await flight.step()
        return (await flight.call("getLidarData")).result

    found = do(ask())
    assert found["point_cloud"] == pytest.approx([5.0, 0.0, 0.0, 0.0, -2.0, -1.0], abs=1e-5)
    assert found["segmentation"] == [0, 1]


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (
            ("simSetTimeOfDay", True),
            "'simSetTimeOfDay' is not offered here; offered: armDisarm, cancelLastTask",
        ),
        (("moveToZ", -5.0), "moveToZ takes (z, velocity, timeout_sec"),
        (("moveToPosition", 1.0, 2.0, -3.0, 0.0), "velocity is 0.0; give a number from 0.001 to 1000"),
        (("moveToPosition", 1.0, None, -3.0, 1.0), "y is None; give a number"),
        (("moveOnPath", [], 3.0), "path is no list of 1 to 10000 Vector3r"),
        (("moveOnPath", [{"x_val": 1.0}], 3.0), "path[0].y_val is None; give a number"),
        (("simContinueForFrames", 1.5), "frames is 1.5; give a whole number"),
        (("simContinueForTime", 0.0), "seconds is 0.0; give a number"),
        (("simListSceneObjects", "("), "name_regex '(' is no regular expression"),
        (
            ("simGetImages", [{"camera_name": "7", "image_type": 0}]),
            "there is no camera '7' on vehicle 'uav'",
        ),
        (("simGetImages", [{"camera_name": "0", "image_type": "x"}]), "image_type is 'x'; give an ImageType"),
        (("getLidarData", "roof"), "there is no LIDAR 'roof' on vehicle 'uav'; there are: 0 (uav/lidar)"),
        (("getLidarData", ""), "there is no product 'lidar' in this frame"),
        (("getMultirotorState", "Drone9"), "there is no vehicle 'Drone9'; there are: uav"),
        (("simSetObjectPose", "car.1", {}), "object 'car.1' cannot be put anywhere"),
        (("simPause", 1), "is_paused is 1; give True or False"),
    ],
)
def test_what_cannot_be_done_is_refused_with_value_and_remedy(call: Any, words: str) -> None:
    async def ask() -> str:
        flight = await ready()
        with pytest.raises(CallError) as error:
            await flight.call(*call)
        return str(error.value)

    assert words in do(ask())


def test_a_vehicle_flies_only_under_control_and_armed() -> None:
    async def ask() -> list[str]:
        flight, found = Flight(), []
        await flight.step()
        for before in (None, ("enableApiControl", True)):
            if before:
                await flight.call(*before)
            with pytest.raises(CallError) as error:
                await flight.call("takeoff")
            found.append(str(error.value))
        return found

    first, second = do(ask())
    assert "call enableApiControl(True) first" in first
    assert "call armDisarm(True) first" in second
