"""AirSim's calls that fly a vehicle; each returns once its manoeuvre is done, or another call replaces it."""

from __future__ import annotations

import asyncio
import logging
import math
from collections.abc import Mapping
from typing import Annotated, Any

import msgspec

from caviar_bridges.airsim.bridge import Bridge, Vehicle
from caviar_bridges.airsim.calls import Call
from caviar_bridges.airsim.rpc import CallError
from caviar_bridges.airsim.wire import (
    LEVEL,
    flag,
    ned_yaw,
    number,
    quaternion_map,
    table,
    text,
    vector,
    vector_map,
)
from caviar_bridges.manoeuvres import (
    ALONG,
    Flown,
    FlyPath,
    FlyVelocity,
    Heading,
    Hover,
    Land,
    Manoeuvre,
    Turn,
)
from caviar_protocol.arrays import quantity
from caviar_protocol.space.coordinates import Vector, euler_from_quaternion

MOST_POINTS = 10_000
"""Of a path."""
FASTEST = 1000.0
"""[m/s]"""
FORWARD_ONLY = 1
"""Heading of AirSim's ``DrivetrainType``: the vehicle heads along its way."""
LEAST_MARGIN = math.radians(0.1)
SAME_YAW = math.radians(1.0)

_log = logging.getLogger("caviar.airsim")


class Habits(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Defaults of flight where a call does not say it."""

    speed_m_s: Annotated[float, quantity("m/s", "on the way home", gt=0)] = 5.0
    climb_m_s: Annotated[float, quantity("m/s", "of take-off and landing", gt=0)] = 2.0
    takeoff_m: Annotated[float, quantity("m", "that a take-off goes up", gt=0)] = 3.0
    reach_m: Annotated[float, quantity("m", "so near, a point is reached", gt=0)] = 0.5


class MotionCalls:
    """Calls that fly.

    Args:
        bridge: Of the run.
        habits: How vehicles fly where a call does not say it.
    """

    def __init__(self, bridge: Bridge, habits: Habits) -> None:
        self._bridge, self._habits = bridge, habits
        self._noted: set[str] = set()

    def offered(self) -> dict[str, Call]:
        """The calls, by name."""
        return {
            "enableApiControl": self.enable,
            "isApiControlEnabled": self.is_enabled,
            "armDisarm": self.arm,
            "takeoff": self.takeoff,
            "land": self.land,
            "goHome": self.go_home,
            "hover": self.hover,
            "cancelLastTask": self.cancel,
            "moveToPosition": self.move_to_position,
            "moveToZ": self.move_to_z,
            "moveOnPath": self.move_on_path,
            "moveByVelocity": self.move_by_velocity,
            "moveByVelocityZ": self.move_by_velocity_z,
            "moveByVelocityBodyFrame": self.move_by_velocity_body,
            "moveByVelocityZBodyFrame": self.move_by_velocity_z_body,
            "rotateToYaw": self.rotate_to_yaw,
            "rotateByYawRate": self.rotate_by_yaw_rate,
            "simSetVehiclePose": self.set_vehicle_pose,
            "simSetObjectPose": self.set_object_pose,
            "reset": self.reset,
        }

    # --- permission -----------------------------------------------------------------------------------

    async def enable(self, is_enabled: object, vehicle_name: object = "") -> None:
        """Take over, or give back, a vehicle."""
        vehicle = self._vehicle(vehicle_name)
        vehicle.api_enabled = flag(is_enabled, "is_enabled")
        if not vehicle.api_enabled:
            vehicle.begin(Hover(vehicle.object))

    async def is_enabled(self, vehicle_name: object = "") -> bool:
        """Tell whether a vehicle is taken over."""
        return self._vehicle(vehicle_name).api_enabled

    async def arm(self, arm: object, vehicle_name: object = "") -> bool:
        """Arm or disarm a vehicle that is taken over; of another one False, as in AirSim after a reset."""
        vehicle = self._vehicle(vehicle_name)
        if not vehicle.api_enabled:
            return False
        vehicle.armed = flag(arm, "arm")
        return True

    # --- manoeuvres -----------------------------------------------------------------------------------

    async def takeoff(self, timeout_sec: object = 20, vehicle_name: object = "") -> bool:
        """Go up, from the ground; a vehicle that flies already stays where it is."""
        vehicle, flown = await self._ready("takeoff", vehicle_name)
        x, y, z = flown.position
        up = self._habits.takeoff_m if vehicle.landed else 0.0
        path = self._path(vehicle, [(x, y, z + up)], self._habits.climb_m_s, timeout_sec)
        return await self._flown(vehicle, path)

    async def land(self, timeout_sec: object = 60, vehicle_name: object = "") -> bool:
        """Go down until the ground or another surface bears the vehicle."""
        vehicle, _ = await self._ready("land", vehicle_name)
        down = await self._flown(vehicle, Land(vehicle.object, self._habits.climb_m_s, _timeout(timeout_sec)))
        vehicle.landed = down
        return down

    async def go_home(self, timeout_sec: object = 3e38, vehicle_name: object = "") -> bool:
        """Fly to where the vehicle started."""
        vehicle, flown = await self._ready("goHome", vehicle_name)
        home = vehicle.home or flown.position
        return await self._flown(vehicle, self._path(vehicle, [home], self._habits.speed_m_s, timeout_sec))

    async def hover(self, vehicle_name: object = "") -> bool:
        """Brake, and stay."""
        vehicle, _ = await self._ready("hover", vehicle_name)
        return await self._flown(vehicle, Hover(vehicle.object))

    async def cancel(self, vehicle_name: object = "") -> None:
        """End what is under way: the vehicle brakes, and the call returns False."""
        vehicle = self._vehicle(vehicle_name)
        vehicle.begin(Hover(vehicle.object))

    async def move_to_position(
        self,
        x: object,
        y: object,
        z: object,
        velocity: object,
        timeout_sec: object = 3e38,
        drivetrain: object = 0,
        yaw_mode: object = None,
        lookahead: object = -1,
        adaptive_lookahead: object = 1,
        vehicle_name: object = "",
    ) -> bool:
        """Fly to a point, and stop there."""
        vehicle, flown = await self._ready("moveToPosition", vehicle_name)
        point = await self._point((number(x, "x"), number(y, "y"), number(z, "z")))
        heading = self._heading(flown, drivetrain, yaw_mode)
        return await self._flown(vehicle, self._path(vehicle, [point], velocity, timeout_sec, heading))

    async def move_to_z(
        self,
        z: object,
        velocity: object,
        timeout_sec: object = 3e38,
        yaw_mode: object = None,
        lookahead: object = -1,
        adaptive_lookahead: object = 1,
        vehicle_name: object = "",
    ) -> bool:
        """Fly up or down to a height."""
        vehicle, flown = await self._ready("moveToZ", vehicle_name)
        (_, _, height), (east, north, _) = await self._point((0.0, 0.0, number(z, "z"))), flown.position
        heading = self._heading(flown, 0, yaw_mode)
        path = self._path(vehicle, [(east, north, height)], velocity, timeout_sec, heading)
        return await self._flown(vehicle, path)

    async def move_on_path(
        self,
        path: object,
        velocity: object,
        timeout_sec: object = 3e38,
        drivetrain: object = 0,
        yaw_mode: object = None,
        lookahead: object = -1,
        adaptive_lookahead: object = 1,
        vehicle_name: object = "",
    ) -> bool:
        """Fly from point to point, and stop at the last one."""
        vehicle, flown = await self._ready("moveOnPath", vehicle_name)
        if not isinstance(path, list) or not 0 < len(path) <= MOST_POINTS:
            raise CallError(f"path is no list of 1 to {MOST_POINTS} Vector3r")
        points = [await self._point(vector(point, f"path[{i}]")) for i, point in enumerate(path)]
        heading = self._heading(flown, drivetrain, yaw_mode)
        return await self._flown(vehicle, self._path(vehicle, points, velocity, timeout_sec, heading))

    async def move_by_velocity(
        self,
        vx: object,
        vy: object,
        vz: object,
        duration: object,
        drivetrain: object = 0,
        yaw_mode: object = None,
        vehicle_name: object = "",
    ) -> bool:
        """Keep a velocity for a time, then brake."""
        vehicle, flown = await self._ready("moveByVelocity", vehicle_name)
        velocity = await self._velocity(vx, vy, vz)
        heading = self._heading(flown, drivetrain, yaw_mode)
        manoeuvre = FlyVelocity(vehicle.object, velocity, _duration(duration), heading=heading)
        return await self._flown(vehicle, manoeuvre)

    async def move_by_velocity_z(
        self,
        vx: object,
        vy: object,
        z: object,
        duration: object,
        drivetrain: object = 0,
        yaw_mode: object = None,
        vehicle_name: object = "",
    ) -> bool:
        """Keep a horizontal velocity and a height for a time, then brake."""
        vehicle, flown = await self._ready("moveByVelocityZ", vehicle_name)
        velocity = await self._velocity(vx, vy, 0.0)
        _, _, height = await self._point((0.0, 0.0, number(z, "z")))
        climb, heading = self._habits.climb_m_s, self._heading(flown, drivetrain, yaw_mode)
        manoeuvre = FlyVelocity(vehicle.object, velocity, _duration(duration), height, climb, heading)
        return await self._flown(vehicle, manoeuvre)

    async def move_by_velocity_body(
        self,
        vx: object,
        vy: object,
        vz: object,
        duration: object,
        drivetrain: object = 0,
        yaw_mode: object = None,
        vehicle_name: object = "",
    ) -> bool:
        """Keep a velocity that is given forward and to the right of the heading at the beginning."""
        north, east = await self._from_body(vx, vy, vehicle_name)
        return await self.move_by_velocity(north, east, vz, duration, drivetrain, yaw_mode, vehicle_name)

    async def move_by_velocity_z_body(
        self,
        vx: object,
        vy: object,
        z: object,
        duration: object,
        drivetrain: object = 0,
        yaw_mode: object = None,
        vehicle_name: object = "",
    ) -> bool:
        """Keep a velocity forward and to the right, and a height."""
        north, east = await self._from_body(vx, vy, vehicle_name)
        return await self.move_by_velocity_z(north, east, z, duration, drivetrain, yaw_mode, vehicle_name)

    async def rotate_to_yaw(
        self, yaw: object, timeout_sec: object = 3e38, margin: object = 5, vehicle_name: object = ""
    ) -> bool:
        """Turn to a heading [°], clockwise from north."""
        vehicle, _ = await self._ready("rotateToYaw", vehicle_name)
        heading = math.radians(number(yaw, "yaw", -1e6, 1e6))
        near = max(LEAST_MARGIN, math.radians(number(margin, "margin", 0.0, 180.0)))
        turn = Turn(vehicle.object, math.pi / 2 - heading, near, _timeout(timeout_sec))
        return await self._flown(vehicle, turn)

    async def rotate_by_yaw_rate(self, yaw_rate: object, duration: object, vehicle_name: object = "") -> bool:
        """Brake, and turn for a time with a rate [°/s], clockwise."""
        vehicle, _ = await self._ready("rotateByYawRate", vehicle_name)
        heading = Heading(rate=-math.radians(number(yaw_rate, "yaw_rate", -1e4, 1e4)))
        manoeuvre = FlyVelocity(vehicle.object, (0.0, 0.0, 0.0), _duration(duration), heading=heading)
        return await self._flown(vehicle, manoeuvre)

    # --- places ---------------------------------------------------------------------------------------

    async def set_vehicle_pose(
        self, pose: object, ignore_collision: object = True, vehicle_name: object = ""
    ) -> None:
        """Put a vehicle at a pose, at rest; parts that are not-a-number, and an orientation of zeros, stay.

        A world that is paused has the vehicle there in its next frame, and the call returns before that.
        """
        vehicle, flown = await self._bridge.flown(text(vehicle_name, "vehicle_name"))
        ned, given = await self._bridge.ned(), _with_known(table(pose, "pose"))
        wanted = ned.pose_to_enu(
            {key: given[key] or _SOMEWHERE[key] for key in ("position", "orientation")}, "pose"
        )
        position = wanted.position if given["position"] else flown.position
        yaw, pitch, roll = euler_from_quaternion(wanted.orientation)
        placed = vehicle.put(position, yaw if given["orientation"] else flown.yaw)
        if given["orientation"] and (abs(pitch) > SAME_YAW or abs(roll) > SAME_YAW):
            self._note("attitude", "a pose has pitch or roll, which worlds of this run do not set")
        if self._bridge.gate.is_open:
            await placed

    async def set_object_pose(self, object_name: object, pose: object, teleport: object = True) -> bool:
        """Put a vehicle at a pose; False for any other object, as no command moves it."""
        name = text(object_name, "object_name")
        for vehicle in self._bridge.vehicles.values():
            if name in (vehicle.name, vehicle.object):
                await self.set_vehicle_pose(pose, True, vehicle.name)
                return True
        vehicles = ", ".join(self._bridge.vehicles)
        self._note(
            "object",
            f"simSetObjectPose of {name!r:.80} returns False: worlds of this run move their objects "
            f"themselves; vehicles can be put somewhere: {vehicles}",
        )
        return False

    async def reset(self) -> None:
        """Begin the next episode; in the last one, put all vehicles where they started."""
        now = await self._bridge.newest()
        placed = []
        for vehicle in self._bridge.vehicles.values():
            vehicle.reset()
            if now.is_last_episode and vehicle.home is not None:
                placed.append(vehicle.put(vehicle.home, vehicle.home_yaw))
        if not self._bridge.gate.is_open:
            self._bridge.gate.let(frames=1)
        if now.is_last_episode:
            await asyncio.gather(*placed)
        else:
            await self._bridge.next_episode()

    # --- what calls share -----------------------------------------------------------------------------

    def _vehicle(self, name: object) -> Vehicle:
        return self._bridge.vehicle(text(name, "vehicle_name"))

    def _require_control(self, vehicle: Vehicle, method: str) -> None:
        if not vehicle.api_enabled:
            raise CallError(
                f"{method}: vehicle {vehicle.name!r} is not under API control; call enableApiControl(True) "
                "first"
            )

    async def _ready(self, method: str, vehicle_name: object) -> tuple[Vehicle, Flown]:
        """A vehicle that may fly, and where it is."""
        vehicle, flown = await self._bridge.flown(text(vehicle_name, "vehicle_name"))
        self._require_control(vehicle, method)
        if not vehicle.armed:
            raise CallError(f"{method}: vehicle {vehicle.name!r} is not armed; call armDisarm(True) first")
        return vehicle, flown

    def _heading(self, flown: Flown, drivetrain: object, yaw_mode: object) -> Heading:
        """Heading of AirSim's ``DrivetrainType`` and ``YawMode``: along the way, to a yaw, or with a rate."""
        if drivetrain == FORWARD_ONLY:
            return ALONG
        mode = yaw_mode if isinstance(yaw_mode, dict) else {}
        degrees = number(mode.get("yaw_or_rate", 0.0), "yaw_mode.yaw_or_rate", -1e6, 1e6)
        if mode.get("is_rate", True):
            return Heading(rate=-math.radians(degrees)) if degrees else Heading(yaw=flown.yaw)
        return Heading(yaw=math.pi / 2 - math.radians(degrees))

    async def _from_body(self, vx: object, vy: object, vehicle_name: object) -> tuple[float, float]:
        """Northward and eastward parts [m/s] of a velocity forward and to the right."""
        _, flown = await self._bridge.flown(text(vehicle_name, "vehicle_name"))
        forward, right = (number(v, k, -FASTEST, FASTEST) for v, k in ((vx, "vx"), (vy, "vy")))
        yaw = ned_yaw(flown.yaw)
        return (
            forward * math.cos(yaw) - right * math.sin(yaw),
            forward * math.sin(yaw) + right * math.cos(yaw),
        )

    async def _flown(self, vehicle: Vehicle, manoeuvre: Manoeuvre) -> bool:
        done = vehicle.begin(manoeuvre)
        if not isinstance(manoeuvre, Hover):
            vehicle.landed = False
        return await done

    def _path(
        self,
        vehicle: Vehicle,
        points: list[Vector],
        velocity: object,
        timeout_sec: object,
        heading: Heading = ALONG,
    ) -> FlyPath:
        speed, reach = number(velocity, "velocity", 1e-3, FASTEST), self._habits.reach_m
        if heading.rate is not None:
            self._note("yaw", "a vehicle on its way to points turns with no rate; it heads along the way")
        return FlyPath(vehicle.object, points, speed, reach, _timeout(timeout_sec), heading.yaw)

    async def _point(self, point: Vector) -> Vector:
        return (await self._bridge.ned()).point_to_enu(point)

    async def _velocity(self, *parts: object) -> Vector:
        x, y, z = (
            number(part, name, -FASTEST, FASTEST)
            for part, name in zip(parts, ("vx", "vy", "vz"), strict=True)
        )
        return (await self._bridge.ned()).velocity_to_enu((x, y, z))

    def _note(self, key: str, words: str) -> None:
        """Log once a request that has no effect."""
        if key not in self._noted:
            self._noted.add(key)
            _log.warning("%s; this is said once", words)


_SOMEWHERE = {"position": vector_map((0.0, 0.0, 0.0)), "orientation": quaternion_map(LEVEL)}


def _with_known(pose: Mapping[str, Any]) -> dict[str, Mapping[str, Any] | None]:
    """Position and orientation of a pose; None for one of which a part is not a number, and for an
    orientation of zeros."""
    found: dict[str, Mapping[str, Any] | None] = {}
    for key in ("position", "orientation"):
        parts = table(pose.get(key), f"pose.{key}")
        unknown = any(isinstance(part, float) and math.isnan(part) for part in parts.values())
        nothing = key == "orientation" and not any(parts.values())
        found[key] = None if unknown or nothing else parts
    return found


def _duration(value: object) -> float:
    return number(value, "duration", 0.0, math.inf)


def _timeout(value: object) -> float:
    return number(value, "timeout_sec", 0.0, math.inf)
