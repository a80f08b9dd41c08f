"""AirSim's calls by name: state, and the clock. `motion_calls` has those that fly, `sensor_calls` those that
look and measure.

Names, parameters and results are those that the Python client 1.8.1 sends and expects.
"""

from __future__ import annotations

import inspect
import logging
import math
import re
from collections.abc import Awaitable, Callable, Iterable, Mapping
from typing import Any

from caviar_bridges.airsim.bridge import Bridge, Snapshot, Vehicle, boxes_overlap
from caviar_bridges.airsim.rpc import CallError, Params
from caviar_bridges.airsim.wire import (
    NOWHERE,
    Map,
    NedFrame,
    flag,
    number,
    text,
    vector_map,
)
from caviar_protocol.space.coordinates import Vector
from caviar_protocol.space.scene import object_pose

VERSION = 1
"""Of the interface, as the client 1.8.1 has it."""
LANDED, FLYING = 0, 1
MOST_FRAMES = 10**9

MOST_NAMED = 1000
"""Calls of which the log says that they are refused, or without effect."""

_UNSEEN = "there is no view to draw in"
_CLEAR = "cameras of a run see no weather"
WITHOUT_EFFECT = {
    **dict.fromkeys(("simSetTraceLine", "simFlushPersistentMarkers"), _UNSEEN),
    **dict.fromkeys(("simPlotPoints", "simPlotLineStrip", "simPlotLineList", "simPlotArrows"), _UNSEEN),
    **dict.fromkeys(("simPlotStrings", "simPlotTransforms", "simPlotTransformsWithNames"), _UNSEEN),
    **dict.fromkeys(("simEnableWeather", "simSetWeatherParameter"), _CLEAR),
    "simPrintLogMessage": _UNSEEN,
    "simSetWind": "the wind is that of the world's settings",
    "simSetCameraPose": "cameras stay as the scenario mounts them",
}
"""Calls that are accepted and do nothing, and why: scripts go on without what they ask for."""

Call = Callable[..., Awaitable[object]]

_log = logging.getLogger("caviar.airsim")


class Offer:
    """Calls by name, and the refusal of all others.

    Example:
        >>> import asyncio
        >>> async def ping():
        ...     return True
        >>> asyncio.run(Offer({"ping": ping}).handle("ping", []))
        True
    """

    def __init__(self, calls: Mapping[str, Call]) -> None:
        self.calls = dict(sorted(calls.items()))
        self._named: set[str] = set()

    async def handle(self, method: str, params: Params) -> object:
        """Answer a call.

        Raises:
            CallError: It is not offered, has too many or too few parameters, or cannot be done.
        """
        if method in WITHOUT_EFFECT:
            self._name(method, f"is accepted and without effect: {WITHOUT_EFFECT[method]}")
            return None
        try:
            return await self._answer(method, params)
        except CallError as error:
            # The client's `join` shows no error of a motion call, so that the log has to.
            self._name(method, f"is refused: {error}")
            raise

    async def _answer(self, method: str, params: Params) -> object:
        call = self.calls.get(method)
        if call is None:
            raise CallError(f"{method[:80]!r} is not offered here; offered: {', '.join(self.calls)}")
        try:
            inspect.signature(call).bind(*params)
        except TypeError as error:
            names = ", ".join(inspect.signature(call).parameters)
            raise CallError(f"{method} takes ({names}), and {len(params)} values came: {error}") from None
        return await call(*params)

    def _name(self, method: str, words: str) -> None:
        if method not in self._named and len(self._named) < MOST_NAMED:
            self._named.add(method)
            shown = words.partition("; offered: ")[0]
            _log.warning("a script's call %.80r %s; this is said once", method, shown)


class StateCalls:
    """Calls about the connection, the clock, and where things are.

    Args:
        bridge: Of the run.
    """

    def __init__(self, bridge: Bridge) -> None:
        self._bridge = bridge

    def offered(self) -> dict[str, Call]:
        """The calls, by name."""
        return {
            "ping": self.ping,
            "getServerVersion": self.version,
            "getMinRequiredClientVersion": self.version,
            "listVehicles": self.vehicles,
            "getHomeGeoPoint": self.home,
            "getMultirotorState": self.state,
            "simGetGroundTruthKinematics": self.kinematics,
            "simGetVehiclePose": self.vehicle_pose,
            "simGetObjectPose": self.object_pose,
            "simListSceneObjects": self.objects,
            "simGetCollisionInfo": self.collision,
            "simPause": self.pause,
            "simIsPaused": self.is_paused,
            "simContinueForTime": self.continue_for_time,
            "simContinueForFrames": self.continue_for_frames,
        }

    # --- the connection and the clock -----------------------------------------------------------------

    async def ping(self) -> bool:
        """Answer True."""
        return True

    async def version(self) -> int:
        """Version of the interface."""
        return VERSION

    async def pause(self, is_paused: object) -> None:
        """Hold the world at its next frame, and return once it is held; or let it go."""
        if not flag(is_paused, "is_paused"):
            self._bridge.gate.resume()
            return
        self._bridge.gate.pause()
        await self._bridge.gate.held.wait()

    async def is_paused(self) -> bool:
        """Tell whether no frame goes by."""
        return not self._bridge.gate.is_open

    async def continue_for_frames(self, frames: object) -> None:
        """Let so many frames go by, and return once the world is held again."""
        count = number(frames, "frames", 1, MOST_FRAMES)
        if count != int(count):
            raise CallError(f"frames is {count}; give a whole number")
        await self._bridge.newest()
        await self._bridge.gate.let(frames=int(count))

    async def continue_for_time(self, seconds: object) -> None:
        """Let simulated time go by, up to the first frame at its end, and return once the world is held."""
        length_ns = round(number(seconds, "seconds", 1e-9, 1e8) * 1e9)
        now = await self._bridge.newest()
        await self._bridge.gate.let(until_ns=now.t_ns + length_ns)

    # --- where things are -----------------------------------------------------------------------------

    async def vehicles(self) -> list[str]:
        """Names of the vehicles."""
        return list(self._bridge.vehicles)

    async def home(self, vehicle_name: object = "") -> Map:
        """AirSim's ``GeoPoint`` of where the vehicle started."""
        vehicle, flown = await self._bridge.flown(text(vehicle_name, "vehicle_name"))
        return (await self._bridge.ned()).geo_point(vehicle.home or flown.position)

    async def state(self, vehicle_name: object = "") -> Map:
        """AirSim's ``MultirotorState``."""
        vehicle, flown = await self._bridge.flown(text(vehicle_name, "vehicle_name"))
        now, ned = await self._bridge.newest(), await self._bridge.ned()
        return {
            "collision": _collision(now, vehicle, ned),
            "kinematics_estimated": kinematics_of(now, vehicle, ned),
            "gps_location": ned.geo_point(flown.position),
            "timestamp": now.t_ns,
            "landed_state": LANDED if vehicle.landed else FLYING,
            "rc_data": _NO_REMOTE_CONTROL,
            "ready": True,
            "ready_message": "",
            "can_arm": True,
        }

    async def kinematics(self, vehicle_name: object = "") -> Map:
        """AirSim's ``KinematicsState``."""
        vehicle, _ = await self._bridge.flown(text(vehicle_name, "vehicle_name"))
        return kinematics_of(await self._bridge.newest(), vehicle, await self._bridge.ned())

    async def vehicle_pose(self, vehicle_name: object = "") -> Map:
        """AirSim's ``Pose`` of a vehicle."""
        vehicle, _ = await self._bridge.flown(text(vehicle_name, "vehicle_name"))
        return await self.object_pose(vehicle.object)

    async def object_pose(self, object_name: object) -> Map:
        """AirSim's ``Pose`` of an object; not-a-number where there is none, as AirSim has it."""
        pose = await self._bridge.pose_of(text(object_name, "object_name"))
        return NOWHERE if pose is None else (await self._bridge.ned()).pose(pose)

    async def objects(self, name_regex: object = ".*") -> list[str]:
        """Names of the objects that match an expression as a whole."""
        pattern = text(name_regex, "name_regex")
        try:
            expression = re.compile(pattern)
        except re.error as error:
            raise CallError(f"name_regex {pattern!r} is no regular expression: {error}") from None
        return [name for name in (await self._bridge.newest()).scene.names if expression.fullmatch(name)]

    async def collision(self, vehicle_name: object = "") -> Map:
        """AirSim's ``CollisionInfo``: with which object the vehicle overlaps, if any."""
        vehicle, _ = await self._bridge.flown(text(vehicle_name, "vehicle_name"))
        return _collision(await self._bridge.newest(), vehicle, await self._bridge.ned())


_NO_REMOTE_CONTROL: Map = {
    "timestamp": 0,
    **dict.fromkeys(("pitch", "roll", "throttle", "yaw", "left_z", "right_z"), 0.0),
    "switches": 0,
    "vendor_id": "",
    "is_initialized": False,
    "is_valid": False,
}


def _row(table: Iterable[Any]) -> Vector:
    x, y, z = (float(part) for part in table)
    return (x, y, z)


def kinematics_of(now: Snapshot, vehicle: Vehicle, ned: NedFrame) -> Map:
    """AirSim's ``KinematicsState`` of a vehicle that is in the scene."""
    scene = now.scene
    index = scene.names.index(vehicle.object)
    turning = scene.angular_velocity
    return ned.kinematics(
        object_pose(scene, index),
        _row(scene.velocity[index]),
        (0.0, 0.0, 0.0) if turning is None else _row(turning[index]),
        vehicle.acceleration,
    )


def _collision(now: Snapshot, vehicle: Vehicle, ned: NedFrame) -> Map:
    scene = now.scene
    index = scene.names.index(vehicle.object)
    hit = next((i for i in range(len(scene.names)) if i != index and boxes_overlap(scene, index, i)), None)
    nothing = vector_map((0.0, 0.0, 0.0))
    position = ned.pose(object_pose(scene, index))["position"]
    away = nothing
    if hit is not None:
        apart = scene.position[index] - scene.position[hit]
        size = math.hypot(*apart) or 1.0
        away = vector_map(ned.velocity(_row(apart / size)))
    return {
        "has_collided": hit is not None,
        "normal": away,
        "impact_point": position if hit is not None else nothing,
        "position": position,
        "penetration_depth": 0.0,
        "time_stamp": now.t_ns if hit is not None else 0,
        "object_name": "" if hit is None else scene.names[hit],
        "object_id": -1 if hit is None else hit,
    }
