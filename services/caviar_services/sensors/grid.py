"""The paper's quantised point cloud: which cells of a box around the road hold an obstacle.

Oliveira et al., "Simulation of Machine Learning-Based 6G Systems in Virtual Worlds" (2021); as in
the data sets of the ITU ML5G-PHY beam-selection challenge.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from fnmatch import fnmatchcase
from typing import Annotated

import msgspec
import numpy as np

from caviar_protocol.arrays import Float32Array, Float64Array, Int64Array, quantity
from caviar_protocol.space.coordinates import Vector
from caviar_protocol.space.scene import antennas, device_pose
from caviar_protocol.topics import LidarDevice, OccupancyGrid, Scene

FREE, OBSTACLE, TX, RX = 0, 1, -1, -2

MAX_CELLS = 1 << 26
"""Cells of a grid at most."""


class GridSettings(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Where the grid is and what goes into it. Give either ``cells`` or ``cell_m``.

    Index i along an axis stands for coordinate minimum + i·cell, with cell =
    (maximum − minimum)/cells.
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
    """Indices of points: round((v − minimum)/cell), half to even, clipped; Shape ``[N, 3]`` to ``[N, 3]``."""
    steps = np.rint((points - np.array(settings.minimum_m)) / np.array(settings.cell))
    indices: Int64Array = np.clip(steps, 0, np.array(settings.shape) - 1).astype(np.int64)
    return indices


def occupancy(
    points: Float32Array,
    distance: Float32Array,
    tx: Sequence[Vector],
    rx: Sequence[Vector],
    settings: GridSettings,
) -> OccupancyGrid:
    """The grid of one scan.

    Parameters
    ----------
    points
        Hits in world coordinates [m], Shape ``[N, 3]``.
    distance
        Their distances from the sensor [m], Shape ``[N]``.
    tx, rx
        Positions [m] of transmitters and receivers. They stand over obstacles, receivers over
        transmitters.
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
    """World positions of the transmitters and receivers that a sensor's grid marks."""
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
