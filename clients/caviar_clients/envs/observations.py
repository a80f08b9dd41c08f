"""What an agent may observe, by name.

To add a part: one subclass of `Part`, one line in `PARTS`.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from difflib import get_close_matches
from typing import Any, ClassVar

import msgspec
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from caviar_clients.envs.users import Users
from caviar_clients.sessions.base import Frame
from caviar_protocol.errors import ScenarioError
from caviar_protocol.messages import Input
from caviar_protocol.scenario import Scenario
from caviar_protocol.space.scene import Pair, device_pose, device_velocity, directions
from caviar_protocol.topics import Camera, Depth, Lidar, Link, Scene


class Moment(msgspec.Struct, frozen=True):
    """What is known at a frame."""

    frame: Frame
    scene: Scene
    link: Link | None
    """Of the frame before; None in frame 0."""
    users: tuple[tuple[int, Pair], ...]
    """(place, pair) of those who are there."""


FAR = 1e6
"""Bound of what has none of its own: metres, metres a second, magnitudes."""


class Part(ABC):
    """One part of the observation. ``sensor`` is what stands behind the colon of its name."""

    inputs: ClassVar[tuple[Input, ...]] = ()
    """What it needs beside the scene and the link of the frame before."""
    needs_sensor: ClassVar[str] = ""
    """Kind of the device that it is of; empty: none."""

    def __init__(self, scenario: Scenario, users: Users, sensor: str) -> None:
        self.users, self.sensor = users, sensor

    @property
    @abstractmethod
    def space(self) -> spaces.Box:
        """Its shape and bounds."""

    @abstractmethod
    def read(self, moment: Moment) -> NDArray[Any] | None:
        """Its value at a frame; None where it is not known: zeros then."""


class _PerUser(Part):
    """Numbers for each place; zeros for an empty one."""

    width: ClassVar[int] = 1
    bound: ClassVar[float] = FAR

    @property
    def space(self) -> spaces.Box:
        return spaces.Box(-self.bound, self.bound, self._shape, np.float32)

    @property
    def _shape(self) -> tuple[int, ...]:
        return (len(self.users) * self.width,)

    def _blank(self) -> NDArray[np.float32]:
        return np.zeros(self._shape, np.float32)


class AngleOfArrival(_PerUser):
    """Azimuth [rad] of the transmitter from the receiver along the straight line, in the receiver's axes:
    what the position of a user tells (the paper, section 4). Shape ``[U]``."""

    bound = math.pi

    def read(self, moment: Moment) -> NDArray[np.float32]:
        values = self._blank()
        pairs = [pair for _, pair in moment.users]
        _, at_rx = directions(moment.scene, pairs)
        for (place, _), (x, y, _) in zip(moment.users, at_rx, strict=True):
            values[place] = math.atan2(y, x)
        return values


class AngleOfDeparture(_PerUser):
    """Azimuth [rad] of the receiver from the transmitter along the straight line, in the transmitter's
    axes. Shape ``[U]``."""

    bound = math.pi

    def read(self, moment: Moment) -> NDArray[np.float32]:
        values = self._blank()
        pairs = [pair for _, pair in moment.users]
        at_tx, _ = directions(moment.scene, pairs)
        for (place, _), (x, y, _) in zip(moment.users, at_tx, strict=True):
            values[place] = math.atan2(y, x)
        return values


class Position(_PerUser):
    """Position [m] of the receiver in the world, x, y, z place by place. Shape ``[3·U]``."""

    width = 3

    def read(self, moment: Moment) -> NDArray[np.float32]:
        values = self._blank()
        for place, pair in moment.users:
            values[3 * place : 3 * place + 3] = device_pose(moment.scene, pair.rx).position
        return values


class Velocity(_PerUser):
    """Velocity [m/s] of the receiver in world axes, place by place. Shape ``[3·U]``."""

    width = 3

    def read(self, moment: Moment) -> NDArray[np.float32]:
        values = self._blank()
        for place, pair in moment.users:
            values[3 * place : 3 * place + 3] = device_velocity(moment.scene, pair.rx)
        return values


class LastMagnitude(_PerUser):
    """|y| of the frame before, the mean over carriers; 0 in frame 0. Shape ``[U]``."""

    def read(self, moment: Moment) -> NDArray[np.float32]:
        values = self._blank()
        link = moment.link
        if link is None:
            return values
        of_pair: dict[tuple[str, str], list[float]] = {}
        for tx, rx, abs_y in zip(link.tx, link.rx, link.abs_y.tolist(), strict=True):
            of_pair.setdefault((tx, rx), []).append(abs_y)
        for place, pair in moment.users:
            found = of_pair.get((pair.tx.name, pair.rx.name))
            if found:
                values[place] = sum(found) / len(found)
        return values


class LidarGrid(Part):
    """Occupancy grid of a LIDAR: 0 free, 1 obstacle, −1 TX, −2 RX. Shape ``[X, Y, Z]``."""

    inputs = (Input(topic="lidar", parts=("grid",)),)
    needs_sensor = "lidar"

    def __init__(self, scenario: Scenario, users: Users, sensor: str) -> None:
        super().__init__(scenario, users, sensor)
        self._shape = _grid_shape(scenario)

    @property
    def space(self) -> spaces.Box:
        return spaces.Box(-2, 1, self._shape, np.int8)

    def read(self, moment: Moment) -> NDArray[np.int8] | None:
        for lidar in moment.frame.of("lidar", Lidar).values():
            for scan in lidar.scans:
                if scan.sensor.rpartition("/")[2] == self.sensor and scan.grid is not None:
                    return scan.grid.occupancy
        return None


class DepthImage(Part):
    """Depth image [m] of a camera; 0: nothing is hit. Shape ``[H, W]``."""

    inputs = (Input(topic="depth"),)
    needs_sensor = "camera"

    def __init__(self, scenario: Scenario, users: Users, sensor: str) -> None:
        super().__init__(scenario, users, sensor)
        width, height = next(d.size_px for d in scenario.devices if d.name == sensor)
        self._shape = (height, width)

    @property
    def space(self) -> spaces.Box:
        return spaces.Box(0, FAR, self._shape, np.float32)

    def read(self, moment: Moment) -> NDArray[np.float32] | None:
        for depth in moment.frame.of("depth", Depth).values():
            for image in depth.images:
                if image.sensor.rpartition("/")[2] == self.sensor:
                    return image.depth
        return None


class CameraImage(DepthImage):
    """RGB image of a camera. Shape ``[H, W, 3]``."""

    inputs = (Input(topic="camera"),)

    @property
    def space(self) -> spaces.Box:
        return spaces.Box(0, 255, (*self._shape, 3), np.uint8)

    def read(self, moment: Moment) -> NDArray[Any] | None:
        for camera in moment.frame.of("camera", Camera).values():
            for image in camera.images:
                if image.sensor.rpartition("/")[2] == self.sensor:
                    return image.rgb
        return None


PARTS: Mapping[str, Callable[[Scenario, Users, str], Part]] = {
    "aoa": AngleOfArrival,
    "aod": AngleOfDeparture,
    "position": Position,
    "velocity": Velocity,
    "last_abs_y": LastMagnitude,
    "lidar_grid": LidarGrid,
    "depth": DepthImage,
    "camera": CameraImage,
}
"""Parts by name. One of a sensor may name it behind a colon: ``camera:dash``."""


def part(scenario: Scenario, users: Users, name: str) -> Part:
    """The part of that name. `ScenarioError` for one that does not exist, or whose sensor does not."""
    kind, _, sensor = name.partition(":")
    cls: Any = PARTS.get(kind)
    if cls is None:
        near = get_close_matches(kind, PARTS, n=1)
        hint = f"did you mean {near[0]!r}? " if near else ""
        raise ScenarioError(f"no observation is called {name!r}; {hint}there are: {', '.join(PARTS)}")
    device = cls.needs_sensor
    if not device:
        if sensor:
            raise ScenarioError(f"{name!r}: {kind!r} is not of a sensor; write {kind!r}")
        return cls(scenario, users, "")  # type: ignore[no-any-return]  # a subclass of Part
    names = [d.name for d in scenario.devices if d.kind == device]
    if not sensor and len(names) == 1:
        sensor = names[0]
    if sensor not in names:
        there = (
            ", ".join(f"{kind}:{n}" for n in names)
            or f"none, as the scenario has no device of kind {device!r}"
        )
        raise ScenarioError(f"observation {name!r} names no {device} of the scenario; there are: {there}")
    return cls(scenario, users, sensor)  # type: ignore[no-any-return]  # a subclass of Part


def _grid_shape(scenario: Scenario) -> tuple[int, int, int]:
    """Shape of the grid as the LIDAR's settings have it."""
    for spec in scenario.services.values():
        grid = spec.settings.get("grid") if spec.role == "sensors" else None
        if grid is None:
            continue
        if "cells" in grid:
            x, y, z = grid["cells"]
            return int(x), int(y), int(z)
        extents = zip(grid["minimum_m"], grid["maximum_m"], grid["cell_m"], strict=True)
        x, y, z = (max(1, math.ceil((high - low) / edge - 1e-9)) for low, high, edge in extents)
        return x, y, z
    raise ScenarioError("observation 'lidar_grid' needs [services.<lidar>.settings.grid] in the scenario")
