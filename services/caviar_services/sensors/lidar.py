"""Spinning LIDARs, one ray per beam and azimuth step, and the occupancy grid of their points.

The grid is the paper's quantised point cloud: which cells of a box around the road hold an obstacle
(Oliveira et al., "Simulation of Machine Learning-Based 6G Systems in Virtual Worlds" (2021); as in the data
sets of the ITU ML5G-PHY beam-selection challenge).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from functools import lru_cache
from typing import Annotated, Any, ClassVar

import msgspec
import numpy as np

from caviar_protocol.arrays import Float32Array, Float64Array, Int32Array, Int64Array, Payload, quantity
from caviar_protocol.errors import ScenarioError
from caviar_protocol.scenario.conversion import Place
from caviar_protocol.space.coordinates import Pose, Vector, rotation_matrix
from caviar_protocol.space.scene import antennas, device_pose
from caviar_protocol.topics import Lidar, LidarDevice, LidarScan, OccupancyGrid, Scene
from caviar_protocol.topics.scene import Device
from caviar_services.drjit_setup import aligned_columns, aligned_doubles, aligned_indices, several
from caviar_services.sensors.base import Sensors, SensorSettings, TracedScene, sensor_poses, visible_names
from caviar_services.sensors.noise import SensorNoise, measured, noise_model
from caviar_services.service import Preparation, Prepared


class LidarSettings(SensorSettings, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Settings of the LIDAR service."""

    grid: GridSettings | None = None
    """The quantised grid that each scan carries where a service asks for it (``lidar.grid``)."""
    points_every: Annotated[
        int, quantity("frame", "from one whose scans have points to the next; 0: none", ge=0)
    ] = 1
    """The scans between have the grid alone: of 64 × 1,800 rays the points take 2.4 to 3.6 MB a frame."""
    points_world: bool = True
    """Whether scans have their points in world axes too. Without them a scan is a third smaller, and
    `LidarScan.in_world` computes them."""
    noise: dict[str, Any] | None = None
    """Errors of the ranges: ``{ use = "gaussian", range_std_m = 0.02, dropout = 0.01 }``, or another model of
    `caviar_services.sensors.noise` or of a plug-in; absent: none."""


@dataclass(frozen=True, eq=False)
class _Rays:
    """The rays of all sensors, sensor after sensor, in the ray tracer's arrays."""

    patterns: tuple[tuple[int, int, float, float], ...]
    """Beams, azimuth steps, lowest and highest elevation [rad] of each sensor."""
    first: Int64Array
    """Number of the first ray of each sensor, and after them that of all rays."""
    local: list[Any]
    """Unit vectors in the sensors' axes, x, y and z as `mitsuba.Float64`."""
    sensor: Any
    """Of each ray, as `mitsuba.UInt32`."""


@dataclass(frozen=True, eq=False)
class _Returns:
    """H rays of all sensors that came back, in their order."""

    ray: Int32Array
    """Number among all rays, Shape ``[H]``."""
    distance: Float32Array
    """[m], Shape ``[H]``."""
    face: Int64Array
    """The triangle that each hit, for `TracedScene.face_owner`, Shape ``[H]``."""
    points: Float32Array
    """In the sensors' axes [m], Shape ``[H, 3]``."""
    world: Float32Array | None
    """In world axes, from `TracedScene.centre` [m], Shape ``[H, 3]``; None: not asked for."""


class LidarSensors(Sensors[LidarSettings]):
    """All LIDARs of the scene, each frame one whole turn at the frame's instant.

    Every object of the scene is solid for them, their own carrier too. A hit nearer than a
    device's ``min_range`` hides what is behind it and is not reported.

    Scans carry the grid where part ``grid`` is asked for (clause 5).

    Args:
        settings: Grid, how often scans have points, and how many bodies there may be.
        run: What the service knows about the run.

    Example:
        >>> from caviar_services.service import RunInfo
        >>> LidarSensors(LidarSettings(points_every=10), RunInfo(name="lidar")).outputs
        ('lidar',)
    """

    _with_grid = False
    _noise: SensorNoise | None = None
    # Of the last frame; those of the next are mostly the same.
    _rays: _Rays | None = None
    outputs: ClassVar[tuple[str, ...]] = ("lidar",)
    uses_scenery: ClassVar[bool] = True
    Settings: ClassVar[type[msgspec.Struct]] = LidarSettings

    @classmethod
    def check_settings(cls, settings: LidarSettings, place: Place) -> None:
        """See `Service.check_settings`."""
        noise_model("lidar", settings.noise, place.at("noise"))

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
        self._noise = noise_model("lidar", self.settings.noise, Place("settings.noise"))
        return super().prepare(preparation)

    def example_devices(self) -> tuple[Device, ...]:
        """One small LIDAR at the origin."""
        return (LidarDevice(name="warm-up", beams=2, azimuth_steps=8),)

    def observe(self, mi: Any, traced: TracedScene, scene: Scene) -> dict[str, Payload]:
        """One scan of each LIDAR; all rays of a frame are traced at once."""
        sensors = sensor_poses(traced, scene, LidarDevice)
        if not sensors:
            return {"lidar": Lidar(object_names=(), scans=())}
        patterns = tuple(
            (device.beams, device.azimuth_steps, device.elevation_min, device.elevation_max)
            for device, _ in sensors
        )
        if self._rays is None or self._rays.patterns != patterns:
            self._rays = _rays(mi, patterns)
        with_world = self._with_grid or (self._with_points and self.settings.points_world)
        measure = self._measure if self._noise is not None else None
        returns = _trace(mi, traced, self._rays, sensors, with_world, measure)
        # Faces, not rays, are looked up: there are fewer of them, and most rays share theirs.
        hit = np.zeros(len(traced.face_owner), dtype=np.bool_)
        hit[returns.face if self._with_points else slice(0)] = True
        names, index = visible_names(traced.owner_names, [traced.face_owner[hit]])
        of_face = index[traced.face_owner]
        first = self._rays.first
        bounds = np.searchsorted(returns.ray, first)
        scans = tuple(
            self._scan(
                scene, device, pose, returns, slice(*bounds[i : i + 2]), first[i], of_face, traced.centre
            )
            for i, (device, pose) in enumerate(sensors)
        )
        return {"lidar": Lidar(object_names=names, scans=scans)}

    @property
    def _with_points(self) -> bool:
        # By the number of the frame, not counted: a service that was started again goes on in step.
        every = self.settings.points_every
        return every > 0 and self.frame.number % every == 0

    def _measure(self, device: LidarDevice, distance: Float32Array) -> Float32Array:
        """Ranges of a device's returns as it measures them [m], Shape ``[H]``; NaN: lost."""
        if self._noise is None:
            return distance
        # A generator for each device: the noise of one is the same whatever others there are.
        ranges = measured(self._noise, distance, self.frame.generator(f"noise/{device.name}"))
        ranges[~((ranges >= device.min_range) & (ranges <= device.max_range))] = np.nan
        return ranges

    def _scan(
        self,
        scene: Scene,
        device: LidarDevice,
        pose: Pose,
        returns: _Returns,
        own: slice,
        first: np.int64,
        object_of_face: Int32Array,
        centre: Float64Array,
    ) -> LidarScan:
        """The scan of the sensor whose returns are ``own`` and whose rays begin at ``first``."""
        grid = None
        world: Float32Array | Float64Array | None = returns.world
        if world is not None and centre.any():
            world = world + centre
        if self._with_grid and self.settings.grid is not None and world is not None:
            tx, rx = antenna_positions(scene, device, self.settings.grid)
            grid = occupancy(world[own], returns.distance[own], tx, rx, self.settings.grid)
        if not self._with_points:
            own = slice(0)
        if not self.settings.points_world:
            world = None
        return LidarScan(
            sensor=device.name,
            position=pose.position,
            orientation=pose.orientation,
            ray=returns.ray[own] - np.int32(first),
            points=returns.points[own],
            points_world=None if world is None else world[own].astype(np.float32),
            range=returns.distance[own],
            object=object_of_face.take(returns.face[own]),
            grid=grid,
        )


@lru_cache(maxsize=32)
def ray_directions(
    beams: int, azimuth_steps: int, elevation_min: float, elevation_max: float
) -> Float64Array:
    """Unit vectors of a LIDAR's rays in its own axes, in ray order.

    Azimuths begin at +x, counter-clockwise.

    Args:
        beams: Number of elevations, equally spaced; one beam alone is at ``elevation_min``.
        azimuth_steps: Number of azimuths.
        elevation_min: Lowest elevation [rad].
        elevation_max: Highest elevation [rad].

    Returns:
        Shape ``[3, beams·steps]``, beam after beam, read-only: calls with equal arguments share it.

    Example:
        >>> ray_directions(1, 2, 0.0, 0.0).round(6).tolist()  # forwards, then backwards
        [[1.0, -1.0], [0.0, 0.0], [0.0, 0.0]]
    """
    elevation = np.linspace(elevation_min, elevation_max, beams)[:, None]
    azimuth = 2 * np.pi * np.arange(azimuth_steps) / azimuth_steps
    rows = np.broadcast_arrays(
        np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)
    )
    directions = np.stack([row.ravel() for row in rows])
    directions.flags.writeable = False
    return directions


def _rays(mi: Any, patterns: tuple[tuple[int, int, float, float], ...]) -> _Rays:
    directions = [ray_directions(*pattern) for pattern in patterns]
    sizes = [rows.shape[1] for rows in directions]
    sensor = np.repeat(np.arange(len(sizes)), sizes)
    return _Rays(
        patterns=patterns,
        first=np.cumsum([0, *sizes]),
        local=[mi.Float64(row) for row in aligned_doubles(np.concatenate(directions, axis=1))],
        sensor=mi.UInt32(aligned_indices(sensor)),
    )


def _trace(
    mi: Any,
    traced: TracedScene,
    rays: _Rays,
    sensors: list[tuple[LidarDevice, Pose]],
    with_world: bool,
    measure: Callable[[LidarDevice, Float32Array], Float32Array] | None,
) -> _Returns:
    """Returns of rays from sensors at these poses, at ranges that ``measure`` may change.

    Positions and directions are float64 until they are those of a ray or a point.
    """
    # One kernel turns and traces all rays (on a GPU one for scenery and one for bodies), another makes the
    # points of those that came back. With rays and hits in NumPy, and parked bodies, a frame of
    # `street-canyon` took 45 ms of processor time, not 20.
    import drjit as dr

    def turned(local: list[Any], sensor: Any) -> list[Any]:
        """Vectors in the sensors' axes in world axes."""
        rows = [[dr.gather(mi.Float64, mounts[3 * i + j], sensor) for j in range(3)] for i in range(3)]
        return [row[0] * local[0] + row[1] * local[1] + row[2] * local[2] for row in rows]

    # Poses and ranges as columns by sensor, gathered by ray: one kernel for any number of sensors.
    mounts = [
        mi.Float64(row) for row in aligned_doubles(_mounts(sensors, traced.centre)[:, several(len(sensors))])
    ]
    of_ray = [dr.gather(mi.Float64, row, rays.sensor) for row in mounts[9:]]
    direction = turned(rays.local, rays.sensor)
    ray = mi.Ray3f(mi.Point3f(*map(mi.Float, of_ray[:3])), mi.Vector3f(*map(mi.Float, direction)))
    # A hit nearer than the least range is not looked through: what is there hides the rest (`LidarSensors`).
    nearest, farthest = of_ray[3:]
    # A little more than the range, which is applied exactly to what is found.
    ray.maxt = mi.Float(farthest * (1 + 1e-6))
    distance, face = traced.intersect(mi, ray)
    back = (mi.Float64(distance) >= nearest) & (mi.Float64(distance) <= farthest)
    dr.eval(distance, face, back)
    number: Any = dr.compress(back)
    if not dr.width(number):
        return _nothing(with_world)
    distance, face = dr.gather(mi.Float, distance, number), dr.gather(mi.UInt32, face, number)
    if measure is not None:
        # Before points are made of ranges: points, grid and ranges agree with each other.
        bounds = np.searchsorted(number.numpy(), rays.first)
        ranges = np.split(distance.numpy(), bounds[1:-1])
        noisy = np.concatenate(
            [measure(device, own) for (device, _), own in zip(sensors, ranges, strict=True)]
        )
        kept = np.flatnonzero(np.isfinite(noisy))
        if not len(kept):
            return _nothing(with_world)
        number, face = (
            mi.UInt32(aligned_indices(rows.numpy()[kept].astype(np.int64))) for rows in (number, face)
        )
        distance = mi.Float(aligned_columns(noisy[None, kept])[0])
    sensor: Any = dr.gather(mi.UInt32, rays.sensor, number)
    local = [dr.gather(mi.Float64, row, number) for row in rays.local]
    away = mi.Float64(distance)
    points: Any = dr.ravel(mi.Point3f(*(mi.Float(row * away) for row in local)))
    world: Any = None
    if with_world:
        # Relative to the sensor in float64, so that only the sum is rounded to float32.
        at = [dr.gather(mi.Float64, row, sensor) for row in mounts[9:12]]
        ends = (mi.Float(row * away + start) for row, start in zip(turned(local, sensor), at, strict=True))
        world = dr.ravel(mi.Point3f(*ends))
    dr.eval(distance, face, points, world)
    return _Returns(
        ray=number.numpy().view(np.int32),
        distance=distance.numpy(),
        face=face.numpy().astype(np.intp),
        points=points.numpy().reshape(-1, 3),
        world=None if world is None else world.numpy().reshape(-1, 3),
    )


def _mounts(sensors: list[tuple[LidarDevice, Pose]], centre: Float64Array) -> Float64Array:
    """Rotation matrix of each sensor, row by row, position from a centre [m], least and
    greatest range [m], Shape ``[14, S]``."""
    return np.array(
        [
            [
                *rotation_matrix(pose.orientation).ravel(),
                *(np.array(pose.position) - centre),
                device.min_range,
                device.max_range,
            ]
            for device, pose in sensors
        ]
    ).T


def _nothing(with_world: bool) -> _Returns:
    points = np.zeros((0, 3), dtype=np.float32)
    return _Returns(
        ray=np.zeros(0, dtype=np.int32),
        distance=np.zeros(0, dtype=np.float32),
        face=np.zeros(0, dtype=np.intp),
        points=points,
        world=points if with_world else None,
    )


FREE, OBSTACLE, TX, RX = 0, 1, -1, -2

MAX_CELLS = 1 << 26
"""Cells of a grid at most."""


class GridSettings(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Settings of the grid: its place and its content. Give either ``cells`` or ``cell_m``.

    Index i along an axis stands for coordinate minimum + i·cell, with cell =
    (maximum − minimum)/cells.

    Example:
        >>> grid = GridSettings(minimum_m=(0, 0, 0), maximum_m=(250, 200, 10), cell_m=(1.25, 1.0, 1.0))
        >>> grid.shape
        (200, 200, 10)
    """

    minimum_m: Annotated[tuple[float, float, float], quantity("m", "world coordinates of index 0")]
    maximum_m: Annotated[tuple[float, float, float], quantity("m", "world coordinates of the far corner")]
    cells: tuple[int, int, int] | None = None
    """Number of cells along x, y, z."""
    cell_m: Annotated[tuple[float, float, float], quantity("m", "edges of a cell")] | None = None
    """The number of cells is rounded up; the last one may reach beyond the maximum."""
    min_height_m: Annotated[float, quantity("m", "points at this world z or lower are dropped")] = 0.2
    max_range_m: Annotated[float, quantity("m", "points at this range or farther are dropped", gt=0)] = 100.0
    tx: str = "*"
    """Pattern of the transmitters' device names."""
    rx: str = ""
    """Pattern of the receivers' device names; empty: those on the LIDAR's own carrier."""

    def __post_init__(self) -> None:
        extent = [high - low for low, high in zip(self.minimum_m, self.maximum_m, strict=True)]
        if not all(0 < edge < math.inf for edge in extent):
            raise ValueError(f"maximum_m − minimum_m is {extent}; every edge must be greater than 0")
        if (self.cells is None) == (self.cell_m is None):
            raise ValueError("give either cells or cell_m")
        if not all(size > 0 for size in (self.cells or self.cell_m or ())):
            raise ValueError(f"{self.cells or self.cell_m} must be greater than 0 along every axis")
        if math.prod(self.shape) > MAX_CELLS:
            raise ValueError(f"{self.shape} is more than {MAX_CELLS} cells; make the cells larger")

    @property
    def shape(self) -> tuple[int, int, int]:
        """Number of cells along x, y, z."""
        if self.cells is not None:
            return self.cells
        # The tolerance keeps 250 m / 1.25 m at 200 cells whatever the division rounds to.
        x, y, z = (
            max(1, math.ceil((high - low) / edge - 1e-9))
            for low, high, edge in zip(self.minimum_m, self.maximum_m, self.cell_m or (), strict=True)
        )
        return x, y, z

    @property
    def cell(self) -> Vector:
        """Edges of a cell [m]."""
        if self.cell_m is not None:
            return self.cell_m
        x, y, z = (
            (high - low) / count
            for low, high, count in zip(self.minimum_m, self.maximum_m, self.shape, strict=True)
        )
        return x, y, z


def quantised(points: Float64Array, settings: GridSettings) -> Int64Array:
    """Find the cells of points: round((v − minimum)/cell), half to even, clipped to the grid.

    Args:
        points: World coordinates [m], Shape ``[N, 3]``.
        settings: The grid.

    Returns:
        Indices along x, y, z, Shape ``[N, 3]``.

    Example:
        >>> grid = GridSettings(minimum_m=(0, 0, 0), maximum_m=(10, 10, 10), cells=(10, 10, 10))
        >>> quantised(np.array([[0.5, 1.5, 99.0]]), grid).tolist()
        [[0, 2, 9]]
    """
    steps = np.rint((points - np.array(settings.minimum_m)) / np.array(settings.cell))
    indices: Int64Array = np.clip(steps, 0, np.array(settings.shape) - 1).astype(np.int64)
    return indices


def occupancy(
    points: Float32Array | Float64Array,
    distance: Float32Array,
    tx: Sequence[Vector],
    rx: Sequence[Vector],
    settings: GridSettings,
) -> OccupancyGrid:
    """Make the grid of one scan.

    Args:
        points: Hits in world coordinates [m], Shape ``[N, 3]``.
        distance: Their distances from the sensor [m], Shape ``[N]``.
        tx: Positions of transmitters [m]. They stand over obstacles.
        rx: Positions of receivers [m]. They stand over transmitters.
        settings: The grid.

    Example:
        >>> grid = GridSettings(minimum_m=(0, 0, 0), maximum_m=(4, 1, 1), cells=(4, 1, 1))
        >>> hit = np.array([[1.0, 0.0, 0.5]], np.float32)
        >>> occupancy(hit, np.array([1.0], np.float32), [(3.0, 0.0, 0.0)], [], grid).occupancy.ravel()
        array([ 0,  1,  0, -1], dtype=int8)
    """
    grid = np.full(settings.shape, FREE, dtype=np.int8)
    kept = (points[:, 2] > settings.min_height_m) & (distance < settings.max_range_m)
    for where, value in ((points[kept].astype(np.float64), OBSTACLE), (tx, TX), (rx, RX)):
        i, j, k = quantised(np.asarray(where, dtype=np.float64).reshape(-1, 3), settings).T
        grid[i, j, k] = value
    return OccupancyGrid(origin=settings.minimum_m, cell=settings.cell, occupancy=grid)


def antenna_positions(
    scene: Scene, sensor: LidarDevice, settings: GridSettings
) -> tuple[list[Vector], list[Vector]]:
    """Find the transmitters and receivers that a sensor's grid marks.

    Args:
        scene: The scenes of all worlds as one.
        sensor: The LIDAR.
        settings: The grid, with the patterns of device names.

    Returns:
        World positions [m] of the transmitters, and of the receivers.

    Example:
        >>> from caviar_services.testing.samples import scene
        >>> street = scene(0)
        >>> lidar = next(device for device in street.devices if isinstance(device, LidarDevice))
        >>> grid = GridSettings(minimum_m=(0, 0, 0), maximum_m=(1, 1, 1), cells=(1, 1, 1), tx="bs")
        >>> [len(positions) for positions in antenna_positions(street, lidar, grid)]
        [1, 1]
    """
    receivers = [
        device
        for device in antennas(scene, "rx")
        if (
            fnmatchcase(device.name, settings.rx)
            if settings.rx
            else sensor.parent and device.parent == sensor.parent
        )
    ]
    marked = {device.name for device in receivers}
    transmitters = [
        device
        for device in antennas(scene, "tx")
        if fnmatchcase(device.name, settings.tx) and device.name not in marked
    ]
    return (
        [device_pose(scene, device).position for device in transmitters],
        [device_pose(scene, device).position for device in receivers],
    )
