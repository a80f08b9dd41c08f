"""AirSim's calls between frames: what a vehicle flies, when a call returns, and what holds the world."""

from __future__ import annotations

import asyncio
import math
from collections.abc import Awaitable
from typing import Any

import numpy as np
import pytest
from airsim_harness import PERIOD_NS, START, Body, Flight
from msgspec.structs import replace

from caviar_bridges.airsim.calls import WITHOUT_EFFECT
from caviar_bridges.airsim.rpc import CallError
from caviar_bridges.airsim.sensor_calls import NAVIGATION, atmosphere
from caviar_bridges.airsim.wire import NedFrame
from caviar_protocol.topics import Lidar, LidarScan, VelocityCommand, WaypointCommand


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
    kept = VelocityCommand(object="uav", velocity=(-1.0, 3.0, 2.0), yaw=math.pi / 2)  # to the north
    assert [replace(command, yaw=round(command.yaw, 6)) for command in commands[:5]] == [
        replace(kept, yaw=round(math.pi / 2, 6))
    ] * 5
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


def yaw_of(orientation: Any) -> float:
    """Heading [°], clockwise from north, of a level orientation."""
    return math.degrees(2 * math.atan2(orientation["z_val"], orientation["w_val"]))


def test_a_vehicle_turns_with_a_rate_and_keeps_or_follows_its_heading_as_asked() -> None:
    """A yaw mode with a rate of 0 keeps the heading; ``ForwardOnly`` follows the way."""
    keeps, follows = (0, {"is_rate": True, "yaw_or_rate": 0.0}), (1, {"is_rate": False, "yaw_or_rate": 0.0})
    given = (0, {"is_rate": False, "yaw_or_rate": -45.0})

    async def fly() -> list[float]:
        flight, found = await ready(), list[float]()
        for call in (
            ("rotateByYawRate", 30.0, 2.0),
            ("moveByVelocity", 0.0, 4.0, -1.0, 2.0, *keeps),
            ("moveToPosition", 0.0, 0.0, -4.0, 4.0, 60.0, *follows),
            ("moveToPosition", 9.0, 0.0, -4.0, 4.0, 60.0, *given),
        ):
            await flight.during(call)
            found.append(yaw_of((await flight.call("simGetVehiclePose"))["orientation"]))
        return found

    assert do(fly()) == pytest.approx([60.0, 60.0, -90.0, -45.0], abs=1.5)


@pytest.mark.parametrize(
    ("method", "last"), [("moveByVelocityBodyFrame", 0.0), ("moveByVelocityZBodyFrame", -6.0)]
)
def test_a_velocity_in_body_axes_goes_forward_and_to_the_right(method: str, last: float) -> None:
    async def fly() -> list[float]:
        flight = await ready()
        await flight.during(("moveToZ", -6.0, 5.0), ("rotateToYaw", 90.0, 20.0, 0.1))  # to the east
        before = np.array(await place(flight))
        await flight.during((method, 3.0, 1.0, last, 3.0))
        return list(np.array(await place(flight)) - before)

    # Less than 3 m south and 9 m east by the time in which it speeds up.
    assert do(fly()) == pytest.approx([-3.0, 9.0, 0.0], abs=1.0)


def test_sensors_of_motion_measure_what_the_run_has() -> None:
    async def ask() -> Any:
        flight = await ready()
        at_rest = [await flight.call(name, "", "uav") for name in NAVIGATION]
        task = asyncio.ensure_future(flight.call("moveByVelocity", 12.0, 0.0, 0.0, 9.0))
        for _ in range(15):
            await flight.step()
        imu, place_ = await flight.call("getImuData"), await flight.call("simGetGroundTruthEnvironment")
        gps = await flight.call("getGpsData")
        task.cancel()
        return at_rest, imu, gps, place_

    (imu, pressure, field, gps), moving, flown, there = do(ask())
    assert list(imu["linear_acceleration"].values()) == pytest.approx([0.0, 0.0, -9.80665])
    # 1 km of the standard atmosphere has 898.7 hPa; this origin is at sea level.
    assert (pressure["altitude"], pressure["pressure"]) == (0.0, 101_325.0)
    assert list(field["magnetic_field_body"].values()) == pytest.approx([0.312, 0.0, 0.0])  # at the equator
    assert gps["gnss"]["geo_point"] == {"latitude": 0.0, "longitude": 0.0, "altitude": 0.0}
    # It speeds up northward, where it heads, with 5 m/s², and is still doing so after 1.5 s.
    assert list(moving["linear_acceleration"].values()) == pytest.approx([5.0, 0.0, -9.80665], abs=0.01)
    north = there["position"]["x_val"]
    assert north > 4.0
    assert flown["gnss"]["geo_point"]["latitude"] == pytest.approx(math.degrees(north / 6_378_137.0))
    assert flown["gnss"]["velocity"]["x_val"] == pytest.approx(7.0, abs=0.6)
    assert there["air_density"] == pytest.approx(1.225, abs=1e-3)


@pytest.mark.parametrize(
    ("altitude", "pressure", "kelvin", "density"),  # of the tables of ISO 2533:1975
    [
        (-1000.0, 113_929.0, 294.65, 1.3470),
        (5000.0, 54_020.0, 255.65, 0.73612),
        (15_000.0, 12_044.6, 216.65, 0.19367),
    ],
)
def test_the_atmosphere_is_the_standard_one(
    altitude: float, pressure: float, kelvin: float, density: float
) -> None:
    assert atmosphere(altitude) == pytest.approx((pressure, kelvin, density), rel=1e-4)


def test_a_camera_is_found_by_airsims_names_and_numbers_and_says_how_it_sees() -> None:
    async def ask() -> list[Any]:
        flight = Flight()
        await flight.step()
        return [
            await flight.call("simGetCameraInfo", name)
            for name in ("0", "front_center", "front", "uav/front")
        ]

    found = do(ask())
    assert all(info == found[0] for info in found)
    assert found[0]["fov"] == 90.0
    # What is 10 m ahead, 5 m to the right and 2 m below lands at half the width; 4 × 3 pixels.
    x, y, _, w = np.array(found[0]["proj_mat"]["matrix"]) @ [10.0, 5.0, 2.0, 1.0]
    assert (x / -w, y / w) == pytest.approx((0.5, 2.0 / 10.0 * 4 / 3))


def test_a_line_of_sight_ends_at_a_wall_of_the_scenery() -> None:
    """A wall 10 m north of the start, 4 m wide and 6 m high."""
    x, y, _ = START
    corners = np.array(
        [[x - 2, y + 10, 0.0], [x + 2, y + 10, 0.0], [x + 2, y + 10, 6.0], [x - 2, y + 10, 6.0]]
    )
    ned = NedFrame(START)
    places = {
        "behind": (x, y + 20, 3.0),
        "above": (x, y + 20, 20.0),
        "before": (x + 1, y + 9, 3.0),
        "beside": (x + 9, y + 20, 3.0),
    }

    async def ask() -> tuple[dict[str, bool], bool, Any]:
        flight = Flight(walls=corners[[[0, 1, 2], [0, 2, 3]]])
        await flight.step()
        seen = {
            name: await flight.call("simTestLineOfSightToPoint", ned.geo_point(place))
            for name, place in places.items()
        }
        ends = [ned.geo_point(places[name]) for name in ("above", "behind")]
        return (
            seen,
            await flight.call("simTestLineOfSightBetweenPoints", *ends),
            await flight.call("simGetWorldExtents"),
        )

    seen, beyond, (low, high) = do(ask())
    assert seen == {"behind": False, "above": True, "before": True, "beside": True}
    assert beyond is True
    assert ned.from_geo_point(low, "low") == pytest.approx(corners.min(axis=0), abs=1e-6)
    assert ned.from_geo_point(high, "high") == pytest.approx(corners.max(axis=0), abs=1e-6)


def test_what_is_without_effect_or_not_offered_is_named_once(caplog: pytest.LogCaptureFixture) -> None:
    async def ask() -> int:
        flight, refused = await ready(), 0
        for _ in range(3):
            for name in WITHOUT_EFFECT:
                assert await flight.call(name, "whatever", 1) is None
            for number in range(200):
                try:
                    await flight.call(f"simDream{number}")
                except CallError:
                    refused += 1
        return refused

    with caplog.at_level("WARNING", "caviar.airsim"):
        assert do(ask()) == 600
    assert len(caplog.messages) == len(set(caplog.messages)) == len(WITHOUT_EFFECT) + 200
    assert sum("is not offered here" in line for line in caplog.messages) == 200


def test_an_object_that_no_command_moves_is_not_put_anywhere() -> None:
    async def ask() -> list[Any]:
        flight = Flight(cars={"car.1": (50.0, 75.0, 0.75)})
        await flight.step()
        return [await flight.call("simSetObjectPose", name, {}) for name in ("car.1", "nothing")]

    assert do(ask()) == [False, False]


def test_a_pose_of_zeros_keeps_the_heading() -> None:
    zeros = {
        "position": dict.fromkeys(("x_val", "y_val", "z_val"), 0.0),
        "orientation": dict.fromkeys(("w_val", "x_val", "y_val", "z_val"), 0.0),
    }

    async def fly() -> Any:
        flight = await ready()
        await flight.during(("rotateToYaw", 120.0, 20.0, 0.1), ("simSetVehiclePose", zeros, True))
        return await flight.call("simGetVehiclePose")

    pose = do(fly())
    assert list(pose["position"].values()) == pytest.approx([0.0] * 3, abs=1e-6)
    assert yaw_of(pose["orientation"]) == pytest.approx(120.0, abs=0.5)


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
