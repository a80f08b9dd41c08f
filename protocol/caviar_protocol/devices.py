"""From the ``devices`` of a scenario to those of a `Scene`: which object carries one, and where."""

from __future__ import annotations

import math
from pathlib import PurePath

import msgspec

from caviar_protocol.coordinates import Vector, quaternion_from_euler
from caviar_protocol.errors import ScenarioError
from caviar_protocol.scenario import DeviceSpec
from caviar_protocol.scenario_checks import owned_by
from caviar_protocol.topics.scene import AntennaArray, AntennaDevice, CameraDevice, Device, LidarDevice

PATTERNS = "patterns/"
"""What the names of assets begin with that are patterns of antenna elements."""

_HEIGHT = {"centre": 0.0, "roof": 0.5, "floor": -0.5}
"""Mount point along z, in heights of the object's bounding box from its centre."""


def carries(spec: DeviceSpec, name: str) -> bool:
    """Whether the device may be mounted on the object ``name``."""
    # The whole name comes first: names of objects may hold brackets, which are special in patterns.
    return name == spec.on or owned_by((spec.on,), name)


def fixed_device(spec: DeviceSpec) -> Device:
    """The device of a scenario that stands in the world, without ``on``."""
    return _device(spec, spec.name, "", 0.0)


def mounted_device(spec: DeviceSpec, parent: str, dimensions: Vector) -> Device:
    """The device of a scenario on the object ``parent`` with a bounding box of ``dimensions`` [m]."""
    return _device(spec, f"{parent}/{spec.name}", parent, dimensions[2])


def pattern_asset(path: str) -> str:
    """Name of the asset that a pattern file of a scenario travels as."""
    return f"{PATTERNS}{PurePath(path).name}"


def _published(array: AntennaArray) -> AntennaArray:
    """An array of a scenario as it is in a scene: its pattern file by the name of the asset."""
    if not array.pattern_file:
        return array
    return msgspec.structs.replace(array, pattern_file=pattern_asset(array.pattern_file))


def _device(spec: DeviceSpec, name: str, parent: str, height: float) -> Device:
    x, y, z = spec.position_m
    position = (x, y, z + _HEIGHT[spec.mount] * height)
    orientation = quaternion_from_euler(
        math.radians(spec.yaw_deg), math.radians(spec.pitch_deg), math.radians(spec.roll_deg)
    )
    match spec.kind:
        case "antenna":
            if not spec.role:
                raise ScenarioError(
                    f'antenna {spec.name!r} lacks its role; write role = "tx", "rx" or "both"', key="devices"
                )
            return AntennaDevice(
                name=name,
                parent=parent,
                position=position,
                orientation=orientation,
                role=spec.role,
                array=_published(spec.array or AntennaArray()),
                power_dbm=spec.power_dbm,
            )
        case "lidar":
            return LidarDevice(
                name=name,
                parent=parent,
                position=position,
                orientation=orientation,
                beams=spec.beams,
                azimuth_steps=spec.azimuth_steps,
                elevation_min=math.radians(spec.elevation_deg[0]),
                elevation_max=math.radians(spec.elevation_deg[1]),
                min_range=spec.range_m[0],
                max_range=spec.range_m[1],
            )
        case "camera":
            return CameraDevice(
                name=name,
                parent=parent,
                position=position,
                orientation=orientation,
                width=spec.size_px[0],
                height=spec.size_px[1],
                field_of_view=math.radians(spec.field_of_view_deg),
            )
