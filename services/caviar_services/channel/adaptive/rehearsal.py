"""A scene before the first frame: the scenario's antennas, so that every rung can be tried and timed."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from caviar_protocol.coordinates import quaternion_from_euler
from caviar_protocol.scenario import DeviceSpec
from caviar_protocol.topics import AntennaArray, AntennaDevice, Scene

_NEAREST = 12.0
_SPACING = 3.0
_HEIGHT = 1.5
"""[m]: mounted antennas stand about the first fixed one on a spiral, as high as those of vehicles."""


def rehearsal_scene(devices: Sequence[DeviceSpec]) -> Scene:
    """All antennas that a scenario announces: fixed ones where they are, the others about them."""
    antennas = [spec for spec in devices if spec.kind == "antenna" and spec.role]
    fixed = [spec for spec in antennas if not spec.on]
    middle = fixed[0].position_m if fixed else (0.0, 0.0, 0.0)
    found = [_device(spec, spec.name, spec.position_m) for spec in fixed]
    mounted = [(spec, number) for spec in antennas if spec.on for number in range(spec.count)]
    for place, (spec, number) in enumerate(mounted):
        radius, angle = _NEAREST + _SPACING * place, 2.4 * place  # [rad]: the golden angle, never in line
        position = (
            middle[0] + radius * math.cos(angle),
            middle[1] + radius * math.sin(angle),
            _HEIGHT + 0.1 * place,
        )
        found.append(_device(spec, f"{spec.name}-{number}", position))
    return Scene(
        names=(),
        classes=(),
        assets=(),
        position=np.zeros((0, 3)),
        orientation=np.zeros((0, 4)),
        velocity=np.zeros((0, 3)),
        dimensions=np.zeros((0, 3)),
        devices=tuple(sorted(found, key=lambda device: device.name)),
    )


def _device(spec: DeviceSpec, name: str, position: tuple[float, float, float]) -> AntennaDevice:
    return AntennaDevice(
        name=name,
        position=position,
        orientation=quaternion_from_euler(
            math.radians(spec.yaw_deg), math.radians(spec.pitch_deg), math.radians(spec.roll_deg)
        ),
        role=spec.role or "both",
        array=spec.array or AntennaArray(),
        power_dbm=spec.power_dbm,
    )
