"""Small worlds for the LIDAR's tests, and ranges by the slab method in float64."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from caviar_labs.stability.lab import Thing, scene
from caviar_protocol.arrays import BoolArray, Float64Array, Int64Array
from caviar_protocol.messages import GrantInput, Status
from caviar_protocol.space.coordinates import Pose, UnitQuaternion, Vector, rotation_matrix
from caviar_protocol.topics import Lidar, LidarDevice, Scene
from caviar_protocol.topics.scene import Device
from caviar_services.sensors.lidar import LidarSensors, LidarSettings
from caviar_services.service import Frame, FrameInput, Preparation, RunInfo

UPRIGHT: UnitQuaternion = (1.0, 0.0, 0.0, 0.0)


@dataclass(frozen=True)
class Body:
    """A box, or an object with a mesh."""

    position: Vector
    dimensions: Vector
    orientation: UnitQuaternion = UPRIGHT
    asset: str = ""


def scene_of(bodies: Mapping[str, Body], *devices: Device) -> Scene:
    """The scene of these objects and devices."""
    things = [
        Thing(name, body.position, body.dimensions, body.orientation, asset=body.asset)
        for name, body in bodies.items()
    ]
    return scene(devices, things)


def prepared(
    assets: Mapping[str, Path] | None = None,
    settings: LidarSettings | None = None,
    parts: frozenset[str] = frozenset(),
) -> LidarSensors:
    """A LIDAR service that is ready for frame 0."""
    service = LidarSensors(settings or LidarSettings(bodies_per_asset=8), RunInfo(name="lidar"))
    service.prepare(Preparation(demand={"lidar": parts}, assets=assets or {}))
    return service


def observed(service: LidarSensors, scene: Scene, number: int = 0, seed: int = 0) -> Lidar:
    """What the service makes of a scene."""
    provenance = GrantInput(topic="scene", source="world", status=Status.FRESH, frame=number)
    frame = Frame(
        episode=0, number=number, t_ns=0, seed=seed, inputs=(FrameInput(provenance, payload=scene),)
    )
    product = service.step(frame).products["lidar"]
    assert isinstance(product, Lidar)
    return product


def directions(device: LidarDevice) -> Float64Array:
    """Unit vectors of a LIDAR's rays in its own axes, ray by ray; Shape ``[N, 3]``."""
    rays = np.arange(device.beams * device.azimuth_steps)
    beam, step = np.divmod(rays, device.azimuth_steps)
    share = beam / max(device.beams - 1, 1)
    elevation = device.elevation_min + share * (device.elevation_max - device.elevation_min)
    azimuth = 2 * np.pi * step / device.azimuth_steps
    return np.stack(
        [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)], axis=1
    )


def slab_ranges(bodies: Sequence[Body], sensor: Pose, rays: Float64Array, grown: float = 0.0) -> Float64Array:
    """Distance [m] along each ray (sensor axes, Shape ``[N, 3]``) to each box; infinite for a miss.

    The slab method of Kay and Kajiya (1986): in the box's axes, the ray is inside where it is
    between both planes of every pair. ``grown`` [m] moves every face outwards. Shape ``[B, N]``.
    """
    world = rays @ rotation_matrix(sensor.orientation).T
    found = []
    for body in bodies:
        turn = rotation_matrix(body.orientation)
        origin = (np.array(sensor.position) - body.position) @ turn
        along = world @ turn
        half = np.array(body.dimensions) / 2 + grown
        with np.errstate(divide="ignore"):
            a, b = (-half - origin) / along, (half - origin) / along
        enter, leave = np.minimum(a, b).max(axis=1), np.maximum(a, b).min(axis=1)
        found.append(np.where((enter <= leave) & (enter > 0), enter, np.inf))
    return np.array(found)


@dataclass(frozen=True, eq=False)
class Expected:
    """What a scan must hold; rays that pass an edge closer than the margin are left out."""

    ranges: Float64Array
    nearest: Int64Array
    clear: BoolArray


def expected(bodies: Sequence[Body], sensor: Pose, device: LidarDevice, margin: float = 2e-3) -> Expected:
    """The scan of boxes alone, ray by ray; infinite range where nothing is hit."""
    exact, small, large = (
        slab_ranges(bodies, sensor, directions(device), grown) for grown in (0.0, -margin, margin)
    )
    ranges = exact.min(axis=0)
    clear = np.isfinite(small.min(axis=0)) == np.isfinite(large.min(axis=0))
    nearest = exact.argmin(axis=0)
    clear &= (small.argmin(axis=0) == large.argmin(axis=0)) & (nearest == small.argmin(axis=0))
    # Near an edge a ray may enter by either of two faces: the range then jumps with the margin.
    with np.errstate(invalid="ignore"):
        spread = np.where(np.isfinite(ranges), small.min(axis=0) - large.min(axis=0), 0.0)
    clear &= ~(spread > 20 * margin)
    return Expected(ranges, nearest, clear)
