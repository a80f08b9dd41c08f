"""Devices of a scenario, fixed in the world or mounted on its objects."""

from __future__ import annotations

from collections.abc import Sequence

from caviar_protocol.scenario import DeviceSpec
from caviar_protocol.scenario.schema import carries, fixed_device, mounted_device
from caviar_protocol.space.coordinates import Vector
from caviar_protocol.topics.scene import Device


class Mounts:
    """Which devices exist in a frame, and where they are mounted.

    A pattern with ``count`` devices gives them to the objects that came first. Who has one
    keeps it, since all that came earlier have one too or have left.
    """

    def __init__(self, specs: Sequence[DeviceSpec]) -> None:
        self._fixed = tuple(fixed_device(spec) for spec in specs if not spec.on)
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
            carriers = [name for name in self._arrived if carries(spec, name)][: spec.count]
            found += [mounted_device(spec, name, dimensions[name]) for name in carriers]
        self._objects, self._devices = objects, tuple(sorted(found, key=lambda device: device.name))
        return self._devices
