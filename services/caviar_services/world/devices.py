"""Devices of a scenario, fixed in the world or mounted on its objects."""

from __future__ import annotations

import math
from collections.abc import Sequence

from caviar_protocol.coordinates import Vector, quaternion_from_euler
from caviar_protocol.errors import ScenarioError
from caviar_protocol.scenario import DeviceSpec
from caviar_protocol.scenario_checks import owned_by
from caviar_protocol.topics.scene import AntennaArray, AntennaDevice, CameraDevice, Device, LidarDevice

_HEIGHT = {"centre": 0.0, "roof": 0.5, "floor": -0.5}


class Mounts:
    """Which devices exist in a frame, and where they are mounted.

    A pattern with ``count`` devices gives them to the objects that came first. Who has one
    keeps it, since all that came earlier have one too or have left.
    """

    def __init__(self, specs: Sequence[DeviceSpec]) -> None:
        self._fixed = tuple(_device(spec, spec.name, "", (0.0, 0.0, 0.0)) for spec in specs if not spec.on)
        self._mounted = tuple(spec for spec in specs if spec.on)
        self._arrived: list[str] = []
        self._objects: Sequence[tuple[str, Vector]] | None = None
        self._devices: tuple[Device, ...] = ()
        """Of the objects of the frame before, which mostly are those of the next one."""

    @property
    def fixed_names(self) -> tuple[str, ...]:
        """Names of the devices that stand in the world without a parent."""
        return tuple(device.name for device in self._fixed)

    @property
    def arrived(self) -> tuple[str, ...]:
        """The objects of the last frame, those that came first in front."""
        return tuple(self._arrived)

    def clear(self, arrived: Sequence[str] = ()) -> None:
        """Forget who came first: a new episode begins, or goes on behind a frame with these objects."""
        self._arrived = list(arrived)
        self._objects = None

    def devices(self, objects: Sequence[tuple[str, Vector]]) -> tuple[Device, ...]:
        """Devices of a frame, sorted by name.

        ``objects`` are the names and dimensions [m] of all objects of the frame. Those that
        were not there in the previous frame count as having come in the given order.
        """
        if objects == self._objects:
            return self._devices
        dimensions = dict(objects)
        known = set(self._arrived)
        self._arrived = [name for name in self._arrived if name in dimensions]
        self._arrived += [name for name, _ in objects if name not in known]
        found = list(self._fixed)
        for spec in self._mounted:
            carriers = [name for name in self._arrived if _matches(spec, name)][: spec.count]
            found += [_device(spec, f"{name}/{spec.name}", name, dimensions[name]) for name in carriers]
        self._objects, self._devices = objects, tuple(sorted(found, key=lambda device: device.name))
        return self._devices


def _matches(spec: DeviceSpec, name: str) -> bool:
    # The whole name comes first: names of objects may hold brackets, which are special in patterns.
    return name == spec.on or owned_by((spec.on,), name)


def _device(spec: DeviceSpec, name: str, parent: str, dimensions: Vector) -> Device:
    x, y, z = spec.position_m
    position = (x, y, z + _HEIGHT[spec.mount] * dimensions[2])
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
                array=spec.array or AntennaArray(),
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
