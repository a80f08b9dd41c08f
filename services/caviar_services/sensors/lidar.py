"""Spinning LIDARs, by tracing one ray per beam and azimuth step."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Annotated, Any, ClassVar

import msgspec
import numpy as np

from caviar_protocol.arrays import BoolArray, Float32Array, Float64Array, Int32Array, Payload, quantity
from caviar_protocol.coordinates import Pose
from caviar_protocol.errors import ScenarioError
from caviar_protocol.topics import Lidar, LidarDevice, LidarScan, Scene
from caviar_protocol.topics.scene import Device
from caviar_services.sensors.base import Sensors, SensorSettings, pose_outside, turned
from caviar_services.sensors.geometry import NO_HIT, TracedScene, visible_names
from caviar_services.sensors.grid import GridSettings, antenna_positions, occupancy
from caviar_services.service import Frame, Preparation, Prepared, StepResult


class LidarSettings(SensorSettings, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Settings of the LIDAR service."""

    grid: GridSettings | None = None
    """The quantised grid that each scan carries where somebody asks for it (``lidar.grid``)."""
    points_every: Annotated[int, quantity("frame", "from one whose scans have points to the next", ge=1)] = 1
    """The scans between have the grid alone: of 64 × 1,800 rays the points take 3.6 MB a frame."""


@dataclass(frozen=True, eq=False)
class _Rays:
    """The rays of one sensor at one instant, as rows x, y, z, Shape ``[3, N]``."""

    device: LidarDevice
    pose: Pose
    local: Float64Array
    """Unit vectors in the sensor's axes."""
    world: Float64Array
    """The same in world axes."""


@dataclass(frozen=True, eq=False)
class _Returns:
    """The rays of one sensor that came back."""

    rays: _Rays
    hit: BoolArray
    distance: Float32Array
    """[m], of those that hit."""
    owner: Int32Array
    """What they hit, for `TracedScene.name_of`."""


class LidarSensors(Sensors[LidarSettings]):
    """All LIDARs of the scene, each frame one whole turn at the frame's instant.

    Every object of the scene is solid for them, their own carrier too. A hit nearer than a
    device's ``min_range`` hides what is behind it and is not reported.

    Scans carry the grid where part ``grid`` is asked for (clause 5).
    """

    _with_grid = False
    _with_points = True
    outputs: ClassVar[tuple[str, ...]] = ("lidar",)
    uses_scenery: ClassVar[bool] = True
    Settings: ClassVar[type[msgspec.Struct]] = LidarSettings

    def prepare(self, preparation: Preparation) -> Prepared:
        """See `Sensors.prepare`; `ScenarioError` where a grid is asked for that is not described."""
        parts = preparation.demand.get("lidar", frozenset())
        if "grid" in parts and self.settings.grid is None:
            raise ScenarioError(
                "a service of this run asks for the quantised grid; say where it is with "
                "grid = { minimum_m = […], maximum_m = […], cells = […] }",
                key=f"services.{self.run.name}.settings.grid",
            )
        self._with_grid = "grid" in parts
        return super().prepare(preparation)

    def step(self, frame: Frame) -> StepResult:
        """See `Sensors.step`."""
        self._with_points = frame.number % self.settings.points_every == 0
        return super().step(frame)

    def example_devices(self) -> tuple[Device, ...]:
        """One small LIDAR at the origin."""
        return (LidarDevice(name="warm-up", beams=2, azimuth_steps=8),)

    def observe(self, mi: Any, traced: TracedScene, scene: Scene) -> dict[str, Payload]:
        """One scan of each LIDAR; all rays of a frame are traced at once."""
        devices = sorted(
            (d for d in scene.devices if isinstance(d, LidarDevice)), key=lambda device: device.name
        )
        bundles = [_rays(traced, scene, device) for device in devices]
        returns = _traced(mi, traced, bundles) if bundles else []
        kept = returns if self._with_points else []
        names, index = visible_names(traced.owner_names, [item.owner for item in kept])
        scans = tuple(self._scan(scene, item, index) for item in returns)
        return {"lidar": Lidar(object_names=names, scans=scans)}

    def _scan(self, scene: Scene, returns: _Returns, index: Int32Array) -> LidarScan:
        rays, hit = returns.rays, returns.hit
        distance = returns.distance.astype(np.float64)
        points = _scaled(rays.local, hit, distance)
        # Relative to the sensor in float64, so that only the sum is rounded to float32.
        world = (_scaled(rays.world, hit, distance) + np.array(rays.pose.position)).astype(np.float32)
        grid = None
        if self._with_grid and self.settings.grid is not None:
            tx, rx = antenna_positions(scene, rays.device, self.settings.grid)
            grid = occupancy(world, returns.distance, tx, rx, self.settings.grid)
        shown = slice(None if self._with_points else 0)
        return LidarScan(
            sensor=rays.device.name,
            position=rays.pose.position,
            orientation=rays.pose.orientation,
            ray=np.flatnonzero(hit)[shown].astype(np.int32),
            points=points[shown].astype(np.float32),
            points_world=world[shown],
            range=returns.distance[shown],
            object=index[returns.owner[shown]],
            grid=grid,
        )


@lru_cache(maxsize=32)
def ray_directions(
    beams: int, azimuth_steps: int, elevation_min: float, elevation_max: float
) -> Float64Array:
    """Unit vectors of a LIDAR's rays in its own axes, in ray order; Shape ``[3, beams·steps]``.

    Elevations are equally spaced from ``elevation_min`` to ``elevation_max`` [rad], both included;
    one beam alone is at ``elevation_min``. Azimuths begin at +x, counter-clockwise.
    """
    elevation = np.linspace(elevation_min, elevation_max, beams)[:, None]
    azimuth = 2 * np.pi * np.arange(azimuth_steps) / azimuth_steps
    rows = np.broadcast_arrays(
        np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)
    )
    directions = np.stack([row.ravel() for row in rows])
    directions.flags.writeable = False
    return directions


def _rays(traced: TracedScene, scene: Scene, device: LidarDevice) -> _Rays:
    pose = pose_outside(traced, scene, device)
    local = ray_directions(device.beams, device.azimuth_steps, device.elevation_min, device.elevation_max)
    return _Rays(device, pose, local, turned(pose, local))


def _traced(mi: Any, traced: TracedScene, bundles: list[_Rays]) -> list[_Returns]:
    sizes = [rays.local.shape[1] for rays in bundles]
    origins = np.repeat(np.array([rays.pose.position for rays in bundles]).T, sizes, axis=1)
    # A little more than the range, which is applied exactly below, in float64.
    reach = np.repeat([rays.device.max_range * (1 + 1e-6) for rays in bundles], sizes)
    hits = traced.trace(mi, origins, np.concatenate([rays.world for rays in bundles], axis=1), reach)
    ends = np.cumsum(sizes)[:-1]
    return [
        _returns(rays, distance, owner)
        for rays, distance, owner in zip(
            bundles, np.split(hits.distance, ends), np.split(hits.owner, ends), strict=True
        )
    ]


def _returns(rays: _Rays, distance: Float32Array, owner: Int32Array) -> _Returns:
    hit = (
        (owner != NO_HIT)
        & (distance >= np.float64(rays.device.min_range))
        & (distance <= np.float64(rays.device.max_range))
    )
    return _Returns(rays, hit, distance[hit], owner[hit])


def _scaled(directions: Float64Array, hit: BoolArray, distance: Float64Array) -> Float64Array:
    """Rows x, y, z of unit vectors to points, Shape ``[3, N]`` to ``[H, 3]``."""
    points = np.empty((len(distance), 3))
    for axis in range(3):
        np.multiply(directions[axis][hit], distance, out=points[:, axis])
    return points
