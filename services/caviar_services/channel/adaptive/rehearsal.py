"""Scenes before the first frame, to time every rung on: the scenario's antennas on bodies that drive."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from itertools import count, islice

import numpy as np
from msgspec.structs import replace

from caviar_protocol.scenario import DeviceSpec
from caviar_protocol.scenario.schema import fixed_device, mounted_device
from caviar_protocol.space.coordinates import Vector, quaternion_from_euler
from caviar_protocol.topics import Scene
from caviar_protocol.topics.scene import Device

_NEAREST, _SPACING = 12.0, 3.0
"""[m]: bodies stand about the first fixed antenna on a spiral."""

_GOLDEN_ANGLE = 2.4
"""[rad] from one to the next: never in line."""

_TRIED = 20
"""Places on the spiral that are looked at for each one that is needed."""

_DIMENSIONS = (4.5, 1.8, 1.6)
"""Of a body [m]: a car's."""

_HEIGHT = 1.5
"""[m] above the ground, of antennas whose objects have no body."""

_STEP = 0.5
"""[m] that bodies drive from one scene to the next: far enough that nothing is where it was."""

Free = Callable[[Vector], bool]
"""Whether a body may stand at a place."""


def rehearsal_scene(
    devices: Sequence[DeviceSpec],
    room: Mapping[str, int],
    ground_m: float = 0.0,
    is_free: Free = lambda place: True,
    step: int = 0,
) -> Scene:
    """All antennas that a scenario announces, and traffic: bodies that carry them, and as many that do not.

    Parameters
    ----------
    devices
        Of the scenario.
    room
        Bodies of each mesh that there may be, by asset; ``""`` is a box.
    ground_m
        Height of the ground [m].
    is_free
        Places where it is not true are left out, if there are enough others.
    step
        Scenes of successive steps are those of traffic that drives.
    """
    antennas = [spec for spec in devices if spec.kind == "antenna" and spec.role]
    fixed = [spec for spec in antennas if not spec.on]
    mounted = [spec for spec in antennas if spec.on for _ in range(spec.count)]
    found: list[Device] = [fixed_device(spec) for spec in fixed]
    middle = fixed[0].position_m if fixed else (0.0, 0.0, 0.0)
    spiral = _places(middle, ground_m + _DIMENSIONS[2] / 2, is_free, 2 * len(mounted))
    assets, names, position, orientation, velocity = _bodies(room), [], [], [], []
    for number, (place, heading) in enumerate(spiral):
        spec = mounted[number] if number < len(mounted) else None
        name, asset = f"rehearsal-{number:04d}", next(assets, None)
        along = np.array([math.cos(heading), math.sin(heading), 0.0])
        here = np.array(place) + step * _STEP * along
        carried = None if spec is None else mounted_device(spec, name, _DIMENSIONS)
        # An antenna in the middle of its object would be inside a body: its object is to have none.
        if carried is not None and (asset is None or carried.position == (0.0, 0.0, 0.0)):
            x, y, _ = here.tolist()
            found.append(_alone(carried, (x, y, ground_m + _HEIGHT + 0.1 * number)))
        elif asset is not None:
            found += [] if carried is None else [carried]
            names.append((name, asset))
            position.append(here)
            orientation.append(quaternion_from_euler(heading))
            velocity.append(_STEP * along)
    size = len(names)
    return Scene(
        names=tuple(name for name, _ in names),
        classes=("",) * size,
        assets=tuple(asset for _, asset in names),
        position=np.array(position).reshape(-1, 3),
        orientation=np.array(orientation).reshape(-1, 4),
        velocity=np.array(velocity).reshape(-1, 3),
        dimensions=np.tile(_DIMENSIONS, (size, 1)),
        devices=tuple(sorted(found, key=lambda device: device.name)),
    )


def _places(middle: Vector, height: float, is_free: Free, wanted: int) -> list[tuple[Vector, float]]:
    """Places on the spiral, free ones first, and headings along it [rad]."""

    def place(number: int) -> tuple[Vector, float]:
        radius, angle = _NEAREST + _SPACING * number, _GOLDEN_ANGLE * number
        x, y = middle[0] + radius * math.cos(angle), middle[1] + radius * math.sin(angle)
        return (x, y, height), angle + math.pi / 2

    every = [place(number) for number in range(_TRIED * wanted)]
    free = list(islice((found for found in every if is_free(found[0])), wanted))
    return free if len(free) == wanted else [*free, *(found for found in every if found not in free)][:wanted]


def _bodies(room: Mapping[str, int]) -> Iterator[str]:
    """Assets by turns while there is room; boxes where there is no mesh."""
    meshes = {asset: size for asset, size in room.items() if asset} or dict(room)
    for turn in count():
        left = [asset for asset in sorted(meshes) if turn < meshes[asset]]
        if not left:
            return
        yield from left


def _alone(device: Device, position: Vector) -> Device:
    """A device that stands in the world."""
    return replace(device, parent="", position=position)
