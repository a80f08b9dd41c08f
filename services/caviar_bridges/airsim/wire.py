"""AirSim's types as maps, and poses and motions between its NED axes and ENU.

Positions count from an origin, which AirSim has where the vehicle starts.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from caviar_bridges.airsim.rpc import CallError
from caviar_protocol.arrays import Float32Array
from caviar_protocol.space.coordinates import Pose, Vector, unrotated
from caviar_space.engine_axes import NED, Motion

EARTH_RADIUS_M = 6_378_137.0
"""[m] of the sphere on which geographic positions lie: the equator of WGS 84."""
GEO_ORIGIN = (47.641468, -122.140165, 122.0)
"""Latitude [°], longitude [°] and altitude [m] of the origin, as AirSim's settings have it by default."""
FAR = 1e6
"""[m, m/s] beyond which a number is taken for a mistake."""
LEVEL = (1.0, 0.0, 0.0, 0.0)

Map = dict[str, Any]


def vector_map(vector: Vector) -> Map:
    """AirSim's ``Vector3r``.

    Example:
        >>> vector_map((1.0, 2.0, -3.0))
        {'x_val': 1.0, 'y_val': 2.0, 'z_val': -3.0}
    """
    x, y, z = vector
    return {"x_val": x, "y_val": y, "z_val": z}


def quaternion_map(orientation: tuple[float, float, float, float]) -> Map:
    """AirSim's ``Quaternionr``."""
    w, x, y, z = orientation
    return {"w_val": w, "x_val": x, "y_val": y, "z_val": z}


NOWHERE: Map = {
    "position": vector_map((math.nan,) * 3),
    "orientation": quaternion_map((math.nan,) * 4),
}
"""The pose that AirSim answers for an object that there is not."""


def number(value: object, name: str, least: float = -FAR, most: float = FAR) -> float:
    """Check a number of a call.

    Args:
        value: What came.
        name: What it is called in the error.
        least, most: What it has to lie between; an infinite bound allows any number but NaN.

    Raises:
        CallError: It is none, or out of range.

    Example:
        >>> number(3, "velocity", 0.0)
        3.0
    """
    if isinstance(value, bool) or not isinstance(value, int | float) or not least <= value <= most:
        raise CallError(f"{name} is {value!r:.80}; give a number from {least:g} to {most:g}")
    return float(value)


def flag(value: object, name: str) -> bool:
    """Check a truth value of a call.

    Raises:
        CallError: It is none.
    """
    if not isinstance(value, bool):
        raise CallError(f"{name} is {value!r:.80}; give True or False")
    return value


def text(value: object, name: str) -> str:
    """Check a text of a call. Numbers count as their digits, since cameras once had numbers.

    Raises:
        CallError: It is none.
    """
    if isinstance(value, int) and not isinstance(value, bool):
        return str(value)
    if not isinstance(value, str) or len(value) > 256:
        raise CallError(f"{name} is {value!r:.80}; give a text of at most 256 characters")
    return value


def table(value: object, name: str) -> Mapping[str, Any]:
    """Check a map of a call, such as a pose.

    Raises:
        CallError: It is none.
    """
    if not isinstance(value, dict):
        raise CallError(f"{name} is {value!r:.80}; give AirSim's type, which is sent as a map")
    return value


def vector(value: object, name: str) -> Vector:
    """Check a ``Vector3r`` of a call.

    Raises:
        CallError: It is none, or a part is no number.
    """
    parts = table(value, name)
    x, y, z = (number(parts.get(key), f"{name}.{key}") for key in ("x_val", "y_val", "z_val"))
    return (x, y, z)


@dataclass(frozen=True)
class NedFrame:
    """Poses and motions of a run in NED, counted from an origin.

    Args:
        origin: In ENU [m].
        geo_origin: Latitude [°], longitude [°] and altitude [m] there.

    Example:
        >>> ned = NedFrame((10.0, 20.0, 1.0))
        >>> ned.pose(Pose((13.0, 24.0, 6.0), LEVEL))["position"]
        {'x_val': 4.0, 'y_val': 3.0, 'z_val': -5.0}
        >>> ned.point_to_enu((4.0, 3.0, -5.0))
        (13.0, 24.0, 6.0)
    """

    origin: Vector
    geo_origin: Vector = (0.0, 0.0, 0.0)

    def pose(self, pose: Pose) -> Map:
        """AirSim's ``Pose`` of a pose in ENU."""
        found = NED.from_enu(Pose(self._from_origin(pose.position), pose.orientation))
        return {"position": vector_map(found.position), "orientation": quaternion_map(found.orientation)}

    def pose_to_enu(self, pose: Mapping[str, Any], name: str = "pose") -> Pose:
        """A pose in ENU of AirSim's ``Pose``.

        Raises:
            CallError: It is none.
        """
        position = vector(pose.get("position"), f"{name}.position")
        parts = table(pose.get("orientation"), f"{name}.orientation")
        w, x, y, z = (
            number(parts.get(key), f"{name}.orientation.{key}", -1.01, 1.01)
            for key in ("w_val", "x_val", "y_val", "z_val")
        )
        size = math.hypot(w, x, y, z)
        if abs(size - 1.0) > 0.01:
            raise CallError(f"{name}.orientation has the norm {size:.3g}; give a unit quaternion")
        found = NED.to_enu(Pose(position, (w / size, x / size, y / size, z / size)))
        return Pose(self._to_origin(found.position), found.orientation)

    def point_to_enu(self, point: Vector) -> Vector:
        """A point in ENU [m] of one in NED."""
        return self._to_origin(NED.to_enu(Pose(point, LEVEL)).position)

    def velocity_to_enu(self, velocity: Vector) -> Vector:
        """A velocity in ENU [m/s] of one in NED."""
        return NED.motion_to_enu(Motion(velocity)).velocity

    def point(self, point: Vector) -> Vector:
        """A point in NED [m] of one in ENU."""
        return NED.from_enu(Pose(self._from_origin(point), LEVEL)).position

    def velocity(self, velocity: Vector) -> Vector:
        """A velocity, or a direction, in NED of one in ENU."""
        return NED.motion_from_enu(Motion(velocity)).velocity

    def kinematics(self, pose: Pose, velocity: Vector, angular_velocity: Vector, acceleration: Vector) -> Map:
        """AirSim's ``KinematicsState``.

        Args:
            pose: In ENU.
            velocity: [m/s], in ENU.
            angular_velocity: [rad/s], in ENU.
            acceleration: [m/s²], in ENU.
        """
        motion = NED.motion_from_enu(Motion(velocity, angular_velocity))
        # Angular velocities of AirSim are in body axes.
        there = NED.from_enu(Pose(self._from_origin(pose.position), pose.orientation))
        return {
            **self.pose(pose),
            "linear_velocity": vector_map(motion.velocity),
            "angular_velocity": vector_map(unrotated(there.orientation, motion.angular_velocity)),
            "linear_acceleration": vector_map(self.velocity(acceleration)),
            "angular_acceleration": vector_map((0.0, 0.0, 0.0)),
        }

    def points(self, points: Float32Array) -> list[float]:
        """Points in ENU [m], Shape ``[N, 3]``, as AirSim's list of 3·N numbers in NED."""
        moved = points.astype(np.float64) - np.array(self.origin)
        ned = moved @ np.array(NED.world).T
        flat: list[float] = ned.astype(np.float32).reshape(-1).tolist()
        return flat

    def geo_point(self, position: Vector) -> Map:
        """AirSim's ``GeoPoint`` of a position in ENU [m], on a sphere that is flat around the origin."""
        latitude, longitude, altitude = self.geo_origin
        east, north, up = self._from_origin(position)
        return {
            "latitude": latitude + math.degrees(north / EARTH_RADIUS_M),
            "longitude": longitude + math.degrees(east / (EARTH_RADIUS_M * math.cos(math.radians(latitude)))),
            "altitude": altitude + up,
        }

    def from_geo_point(self, point: object, name: str) -> Vector:
        """The position in ENU [m] of AirSim's ``GeoPoint``.

        Raises:
            CallError: It is none.
        """
        parts = table(point, name)
        latitude, longitude, altitude = (
            number(parts.get(key), f"{name}.{key}") for key in ("latitude", "longitude", "altitude")
        )
        at, along, above = self.geo_origin
        east = math.radians(longitude - along) * EARTH_RADIUS_M * math.cos(math.radians(at))
        north = math.radians(latitude - at) * EARTH_RADIUS_M
        return self._to_origin((east, north, altitude - above))

    def _from_origin(self, position: Vector) -> Vector:
        (x, y, z), (a, b, c) = position, self.origin
        return (x - a, y - b, z - c)

    def _to_origin(self, position: Vector) -> Vector:
        (x, y, z), (a, b, c) = position, self.origin
        return (x + a, y + b, z + c)


def sensor_points(points: Float32Array) -> list[float]:
    """Points in a sensor's own axes [m], forward–left–up, Shape ``[N, 3]``, as forward–right–down.

    Example:
        >>> sensor_points(np.array([[5.0, 1.0, 2.0]], np.float32))
        [5.0, -1.0, -2.0]
    """
    flat: list[float] = (points * np.array([1.0, -1.0, -1.0], np.float32)).reshape(-1).tolist()
    return flat


def ned_yaw(yaw_enu: float) -> float:
    """Heading [rad], clockwise from north, of a yaw that counts counter-clockwise from east.

    Example:
        >>> round(math.degrees(ned_yaw(0.0)), 6)  # to the east
        90.0
    """
    return math.remainder(math.pi / 2 - yaw_enu, math.tau)
