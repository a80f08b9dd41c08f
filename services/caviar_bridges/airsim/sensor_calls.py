"""AirSim's calls that look and measure: pictures, LIDAR, cameras, and what a vehicle navigates by.

Sensors measure without noise: what they say is what the run has.
"""

from __future__ import annotations

import asyncio
import math
from collections.abc import Callable, Mapping
from functools import cached_property, partial
from typing import NamedTuple

import numpy as np

from caviar_bridges.airsim.bridge import Bridge, Snapshot, Vehicle
from caviar_bridges.airsim.calls import Call, kinematics_of
from caviar_bridges.airsim.images import image_response
from caviar_bridges.airsim.rpc import CallError, Compact
from caviar_bridges.airsim.wire import Map, NedFrame, sensor_points, table, text, vector_map
from caviar_protocol.arrays import Float64Array
from caviar_protocol.space.coordinates import Pose, Vector, unrotated
from caviar_protocol.space.scene import device_pose
from caviar_protocol.topics import CameraDevice, LidarDevice, LidarScan

MOST_IMAGES = 64
"""Pictures of a call."""
CAMERAS = ("front_center", "front_right", "front_left", "bottom_center", "back_center")
"""Names of AirSim's cameras, by number."""
NEAR_M = 0.1
"""[m] of the near plane in projection matrices."""

GRAVITY = 9.80665
"""[m/s²]"""
SEA_LEVEL_PA, SEA_LEVEL_K = 101_325.0, 288.15
LAPSE_K_M, TROPOPAUSE_M = 0.0065, 11_000.0
AIR_J_KG_K = 287.05287
"""Of the standard atmosphere, ISO 2533:1975: pressure, temperature and its lapse, and the gas constant."""
DIPOLE_GAUSS = 0.312
"""Field of the Earth at the equator, of a dipole along its axis: north B·cos φ, down 2·B·sin φ."""


def atmosphere(altitude: float) -> tuple[float, float, float]:
    """The standard atmosphere, ISO 2533:1975, up to 20 km.

    Args:
        altitude: Above mean sea level [m].

    Returns:
        Pressure [Pa], temperature [K] and density [kg/m³].

    Example:
        >>> [round(x, 3) for x in atmosphere(1000.0)]
        [89874.563, 281.65, 1.112]
    """
    kelvin = SEA_LEVEL_K - LAPSE_K_M * min(altitude, TROPOPAUSE_M)
    pascal = SEA_LEVEL_PA * (kelvin / SEA_LEVEL_K) ** (GRAVITY / (AIR_J_KG_K * LAPSE_K_M))
    pascal *= math.exp(-GRAVITY * max(0.0, altitude - TROPOPAUSE_M) / (AIR_J_KG_K * kelvin))
    return pascal, kelvin, pascal / (AIR_J_KG_K * kelvin)


class Motion(NamedTuple):
    """Motion of a vehicle, as its sensors measure it."""

    t_ns: int
    kinematics: Map
    """AirSim's ``KinematicsState``: world axes are NED, angular ones are of the body."""
    geo_point: Map

    def in_body(self, vector: Vector) -> Map:
        """``Vector3r`` in forward, right, down of a vector in north, east, down."""
        q = self.kinematics["orientation"]
        return vector_map(unrotated([q[f"{part}_val"] for part in "wxyz"], vector))


def _imu(seen: Motion) -> Map:
    """Specific force: what a body at rest feels is 1 g upward."""
    x, y, z = seen.kinematics["linear_acceleration"].values()
    return {
        "time_stamp": seen.t_ns,
        "orientation": seen.kinematics["orientation"],
        "angular_velocity": seen.kinematics["angular_velocity"],
        "linear_acceleration": seen.in_body((x, y, z - GRAVITY)),
    }


def _barometer(seen: Motion) -> Map:
    altitude = seen.geo_point["altitude"]
    pressure, _, _ = atmosphere(altitude)
    return {
        "time_stamp": seen.t_ns,
        "altitude": altitude,
        "pressure": pressure,
        "qnh": SEA_LEVEL_PA / 100.0,
    }


def _magnetometer(seen: Motion) -> Map:
    latitude = math.radians(seen.geo_point["latitude"])
    field = (DIPOLE_GAUSS * math.cos(latitude), 0.0, 2.0 * DIPOLE_GAUSS * math.sin(latitude))
    return {
        "time_stamp": seen.t_ns,
        "magnetic_field_body": seen.in_body(field),
        "magnetic_field_covariance": [0.0] * 9,
    }


def _gps(seen: Motion) -> Map:
    return {
        "time_stamp": seen.t_ns,
        "gnss": {
            "geo_point": seen.geo_point,
            "eph": 0.0,
            "epv": 0.0,
            "velocity": seen.kinematics["linear_velocity"],
            "fix_type": 3,  # GNSS_FIX_3D_FIX
            "time_utc": seen.t_ns // 1000,
        },
        "is_valid": True,
    }


NAVIGATION: Mapping[str, Callable[[Motion], Map]] = {
    "getImuData": _imu,
    "getBarometerData": _barometer,
    "getMagnetometerData": _magnetometer,
    "getGpsData": _gps,
}
"""Call by what it answers; every vehicle has one of each, whatever the name."""


def is_blocked(triangles: Float64Array, start: Vector, end: Vector) -> bool:
    """Tell whether a triangle lies between two points (Möller and Trumbore, 1997).

    Args:
        triangles: Corners [m], Shape ``[T, 3, 3]``.
        start, end: [m]

    Example:
        >>> wall = np.array([[[5.0, -9.0, -9.0], [5.0, 9.0, -9.0], [5.0, 0.0, 9.0]]])
        >>> [is_blocked(wall, (0.0, 0.0, 0.0), (x, 0.0, 0.0)) for x in (4.0, 9.0)]
        [False, True]
    """
    way = np.subtract(end, start)
    first, second = triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]
    normal, offset = np.cross(way, second), start - triangles[:, 0]
    across = np.cross(offset, first)
    with np.errstate(divide="ignore", invalid="ignore"):  # of triangles along the way
        scale = 1.0 / (first * normal).sum(axis=1)
        u, v = (offset * normal).sum(axis=1) * scale, across @ way * scale
        t = (second * across).sum(axis=1) * scale
        return bool(((u >= 0) & (v >= 0) & (u + v <= 1) & (t > 0) & (t < 1)).any())


class SensorCalls:
    """Calls of cameras, LIDARs, and sensors of motion.

    Args:
        bridge: Of the run.
        sensors: Devices by further names that clients use for them.
        lidar_in_sensor_axes: Whether points are in axes of the sensor, and not of the vehicle's start.
        load_scenery: Gives the triangles of the scenery [m], Shape ``[T, 3, 3]``; called once, when a call
            needs them.
    """

    def __init__(
        self,
        bridge: Bridge,
        sensors: Mapping[str, str],
        *,
        lidar_in_sensor_axes: bool = False,
        load_scenery: Callable[[], Float64Array] = lambda: np.zeros((0, 3, 3)),
    ) -> None:
        self._bridge, self._sensors, self._load_scenery = bridge, sensors, load_scenery
        self._lidar_in_sensor_axes = lidar_in_sensor_axes

    def offered(self) -> dict[str, Call]:
        """The calls, by name."""
        return {
            "simGetImage": self.image,
            "simGetImages": self.images,
            "simGetCameraInfo": self.camera_info,
            "getLidarData": self.lidar,
            "simGetGroundTruthEnvironment": self.environment,
            "simTestLineOfSightToPoint": self.sees,
            "simTestLineOfSightBetweenPoints": self.is_clear,
            "simGetWorldExtents": self.extents,
            **{name: partial(self._measured, answer) for name, answer in NAVIGATION.items()},
        }

    @cached_property
    def _scenery(self) -> Float64Array:
        return self._load_scenery()

    async def sees(self, point: object, vehicle_name: object = "") -> bool:
        """Tell whether no scenery stands between a vehicle and a ``GeoPoint``."""
        _, flown = await self._bridge.flown(text(vehicle_name, "vehicle_name"))
        end = (await self._bridge.ned()).from_geo_point(point, "point")
        return not await asyncio.to_thread(lambda: is_blocked(self._scenery, flown.position, end))

    async def is_clear(self, point1: object, point2: object) -> bool:
        """Tell whether no scenery stands between two ``GeoPoint``."""
        ned = await self._bridge.ned()
        start, end = ned.from_geo_point(point1, "point1"), ned.from_geo_point(point2, "point2")
        return not await asyncio.to_thread(lambda: is_blocked(self._scenery, start, end))

    async def extents(self) -> list[Map]:
        """The least and the greatest ``GeoPoint`` of the scenery."""
        ned = await self._bridge.ned()
        corners = (await asyncio.to_thread(lambda: self._scenery)).reshape(-1, 3)
        if not len(corners):
            raise CallError("the run has no scenery, and so no extents")
        low, high = corners.min(axis=0).tolist(), corners.max(axis=0).tolist()
        return [ned.geo_point((low[0], low[1], low[2])), ned.geo_point((high[0], high[1], high[2]))]

    async def _measured(
        self, answer: Callable[[Motion], Map], sensor_name: object = "", vehicle_name: object = ""
    ) -> Map:
        text(sensor_name, "sensor_name")
        return answer(await self._motion(vehicle_name))

    async def _motion(self, vehicle_name: object) -> Motion:
        vehicle, flown = await self._bridge.flown(text(vehicle_name, "vehicle_name"))
        now, ned = await self._bridge.newest(), await self._bridge.ned()
        return Motion(now.t_ns, kinematics_of(now, vehicle, ned), ned.geo_point(flown.position))

    async def environment(self, vehicle_name: object = "") -> Map:
        """AirSim's ``EnvironmentState``."""
        seen = await self._motion(vehicle_name)
        pressure, temperature, density = atmosphere(seen.geo_point["altitude"])
        return {
            "position": seen.kinematics["position"],
            "geo_point": seen.geo_point,
            "gravity": vector_map((0.0, 0.0, GRAVITY)),
            "air_pressure": pressure,
            "temperature": temperature,
            "air_density": density,
        }

    async def camera_info(
        self, camera_name: object, vehicle_name: object = "", external: object = False
    ) -> Map:
        """AirSim's ``CameraInfo``: where a camera is, and how it projects."""
        vehicle = self._bridge.vehicle(text(vehicle_name, "vehicle_name"))
        now, ned = await self._bridge.newest(), await self._bridge.ned()
        name = self._device(now, vehicle, text(camera_name, "camera_name"), CameraDevice, bool(external))
        (camera,) = (d for d in now.scene.devices if isinstance(d, CameraDevice) and d.name == name)
        scale = 1.0 / math.tan(camera.field_of_view / 2.0)
        # Forward, right, down and 1 to clip coordinates of Unreal, as AirSim has it, with a reversed depth.
        matrix = [
            [0.0, scale, 0.0, 0.0],
            [0.0, 0.0, -scale * camera.width / camera.height, 0.0],
            [0.0, 0.0, 0.0, NEAR_M],
            [-1.0, 0.0, 0.0, 0.0],
        ]
        return {
            "pose": ned.pose(device_pose(now.scene, camera)),
            "fov": math.degrees(camera.field_of_view),
            "proj_mat": {"matrix": matrix},
        }

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
        # AirSim's five cameras have a name and a number, which mean the same one.
        names = [name]
        if name in CAMERAS:
            names.append(str(CAMERAS.index(name)))
        elif name.isdecimal() and int(name) < len(CAMERAS):
            names.append(CAMERAS[int(name)])
        for alias in names:
            for candidate in (self._sensors.get(alias, alias), f"{vehicle.object}/{alias}"):
                if candidate in known:
                    return candidate
        if not external:
            if not name and own:
                return own[0]
            for digits in names:
                if digits.isdecimal() and int(digits) < len(own):
                    return own[int(digits)]
        called = "camera" if kind is CameraDevice else "LIDAR"
        numbered = [f"{i} ({device})" for i, device in enumerate(own)]
        others = sorted(known - set(own)) + [k for k, v in self._sensors.items() if v in known]
        raise CallError(
            f"there is no {called} {name!r} on vehicle {vehicle.name!r}; there are: "
            f"{', '.join([*numbered, *others]) or 'none'}; settings.sensors of the agent gives further names"
        )
