"""AirSim's calls by name: state, sensors, and the clock. `motion_calls` has those that fly.

Names, parameters and results are those that the Python client 1.8.1 sends and expects.
"""

from __future__ import annotations

import asyncio
import inspect
import logging
import math
import re
from collections.abc import Awaitable, Callable, Iterable, Mapping
from typing import Any

from caviar_protocol.space.coordinates import Pose, Vector
from caviar_protocol.space.scene import object_pose
from caviar_protocol.topics import CameraDevice, LidarDevice, LidarScan
from caviar_services.airsim.bridge import Bridge, Snapshot, Vehicle, boxes_overlap
from caviar_services.airsim.images import image_response
from caviar_services.airsim.rpc import CallError, Compact, Params
from caviar_services.airsim.wire import (
    NOWHERE,
    Map,
    NedFrame,
    flag,
    number,
    sensor_points,
    table,
    text,
    vector_map,
)

VERSION = 1
"""Of the interface, as the client 1.8.1 has it."""
LANDED, FLYING = 0, 1
MOST_IMAGES = 64
"""Pictures of a call."""
MOST_FRAMES = 10**9

Call = Callable[..., Awaitable[object]]

_log = logging.getLogger("caviar.airsim")


class Offer:
    """Calls by name, and the refusal of all others.

    Example:
        >>> async def ping():
        ...     return True
        >>> asyncio.run(Offer({"ping": ping}).handle("ping", []))
        True
    """

    def __init__(self, calls: Mapping[str, Call]) -> None:
        self.calls = dict(sorted(calls.items()))

    async def handle(self, method: str, params: Params) -> object:
        """Answer a call.

        Raises:
            CallError: It is not offered, has too many or too few parameters, or cannot be done.
        """
        call = self.calls.get(method)
        if call is None:
            raise CallError(f"{method[:80]!r} is not offered here; offered: {', '.join(self.calls)}")
        try:
            inspect.signature(call).bind(*params)
        except TypeError as error:
            names = ", ".join(inspect.signature(call).parameters)
            raise CallError(f"{method} takes ({names}), and {len(params)} values came: {error}") from None
        return await call(*params)


class StateCalls:
    """Calls about the connection, the clock, and where things are.

    Args:
        bridge: Of the run.
        sensors: Devices by further names that clients use for them.
        lidar_in_sensor_axes: Whether points are in axes of the sensor, and not of the vehicle's start.
    """

    def __init__(
        self, bridge: Bridge, sensors: Mapping[str, str], *, lidar_in_sensor_axes: bool = False
    ) -> None:
        self._bridge, self._sensors = bridge, sensors
        self._lidar_in_sensor_axes = lidar_in_sensor_axes

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
            "simGetImage": self.image,
            "simGetImages": self.images,
            "getLidarData": self.lidar,
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
        """Whether no frame goes by."""
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
            "kinematics_estimated": _kinematics(now, vehicle, ned),
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
        return _kinematics(await self._bridge.newest(), vehicle, await self._bridge.ned())

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

    # --- sensors --------------------------------------------------------------------------------------

    async def image(
        self, camera_name: object, image_type: object, vehicle_name: object = "", external: object = False
    ) -> bytes:
        """One picture as PNG."""
        request = {"camera_name": camera_name, "image_type": image_type, "compress": True}
        (found,) = await self._images([request], vehicle_name, external)
        data: bytes = found["image_data_uint8"]
        return data

    async def images(self, requests: object, vehicle_name: object = "", external: object = False) -> Compact:
        """AirSim's ``ImageResponse`` for each ``ImageRequest``, all of one frame."""
        return Compact(await self._images(requests, vehicle_name, external))

    async def _images(self, requests: object, vehicle_name: object, external: object) -> list[Map]:
        vehicle = self._bridge.vehicle(text(vehicle_name, "vehicle_name"))
        if not isinstance(requests, list) or len(requests) > MOST_IMAGES:
            raise CallError(f"requests is no list of at most {MOST_IMAGES} ImageRequest")
        now, ned = await self._bridge.newest(), await self._bridge.ned()
        wanted = []
        for entry in requests:
            request = table(entry, "ImageRequest")
            name = text(request.get("camera_name"), "camera_name")
            kind = request.get("image_type")
            if isinstance(kind, bool) or not isinstance(kind, int):
                raise CallError(f"image_type is {kind!r:.80}; give an ImageType, a whole number")
            device = self._device(now, vehicle, name, CameraDevice, bool(external))
            as_float = bool(request.get("pixels_as_float", False))
            wanted.append((name, device, kind, as_float, bool(request.get("compress", True))))

        def made() -> list[Map]:
            return [
                {
                    **image_response(now.images, device, kind, as_float, compress, ned.pose),
                    "camera_name": name,
                    "time_stamp": now.t_ns,
                }
                for name, device, kind, as_float, compress in wanted
            ]

        # A thread, as a PNG takes milliseconds in which frames and other clients would wait.
        return await asyncio.to_thread(made)

    async def lidar(self, lidar_name: object = "", vehicle_name: object = "") -> Compact:
        """AirSim's ``LidarData``: the scan of the newest frame."""
        vehicle = self._bridge.vehicle(text(vehicle_name, "vehicle_name"))
        now, ned = await self._bridge.newest(), await self._bridge.ned()
        device = self._device(now, vehicle, text(lidar_name, "lidar_name"), LidarDevice)
        if not now.lidars:
            raise CallError(
                "there is no product 'lidar' in this frame; it needs a service of the run with role "
                "'sensors' and use 'lidar'"
            )
        scan = next((scan for lidar in now.lidars for scan in lidar.scans if scan.sensor == device), None)
        if scan is None:
            raise CallError(f"LIDAR {device!r} made no scan in this frame")
        return Compact(await asyncio.to_thread(self._lidar_data, now, ned, scan))

    def _lidar_data(self, now: Snapshot, ned: NedFrame, scan: LidarScan) -> Map:
        points = sensor_points(scan.points) if self._lidar_in_sensor_axes else ned.points(scan.in_world())
        return {
            "point_cloud": points,
            "time_stamp": now.t_ns,
            "pose": ned.pose(Pose(scan.position, scan.orientation)),
            "segmentation": scan.object.tolist(),
        }

    def _device(
        self,
        now: Snapshot,
        vehicle: Vehicle,
        name: str,
        kind: type[CameraDevice | LidarDevice],
        external: bool = False,
    ) -> str:
        """Name of the device that a client means: an alias, its name with or without the vehicle, or its
        number on the vehicle."""
        devices = [device for device in now.scene.devices if isinstance(device, kind)]
        own = sorted(device.name for device in devices if device.parent == vehicle.object)
        known = {device.name for device in devices}
        if not external:
            if not name and own:
                return own[0]
            if name.isdecimal() and int(name) < len(own):
                return own[int(name)]
        for candidate in (self._sensors.get(name, name), f"{vehicle.object}/{name}"):
            if candidate in known:
                return candidate
        called = "camera" if kind is CameraDevice else "LIDAR"
        numbered = [f"{i} ({device})" for i, device in enumerate(own)]
        others = sorted(known - set(own)) + [k for k, v in self._sensors.items() if v in known]
        raise CallError(
            f"there is no {called} {name!r} on vehicle {vehicle.name!r}; there are: "
            f"{', '.join([*numbered, *others]) or 'none'}; settings.sensors of the agent gives further names"
        )


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


def _kinematics(now: Snapshot, vehicle: Vehicle, ned: NedFrame) -> Map:
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
