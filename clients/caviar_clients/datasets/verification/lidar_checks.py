"""LIDAR scans computed anew: the sensor service of the scenario scans each recorded scene again.

Scenery, bodies, pose, antennas and seed of the noise are those of the scene, so on the same kind of processor
grid and points are equal to the last cell. Other processors round rays otherwise, and a few cells differ.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, cast

import numpy as np

from caviar_clients.datasets.verification import Finding
from caviar_protocol.errors import CaviarError, SetupError
from caviar_protocol.messages import Status
from caviar_protocol.recording import RecordedFrame
from caviar_protocol.scenario.conversion import convert_settings
from caviar_protocol.topics import Lidar, LidarScan, OccupancyGrid
from caviar_services.frame import Frame, FrameInput
from caviar_services.registry import load
from caviar_services.sensors.lidar import OBSTACLE, RX, TX
from caviar_services.service import Preparation, RunInfo, Service

SHARE = 0.05
"""Of all obstacle cells, or points, of both scans: so many may differ by rounding."""
POINT_M = 0.01
"""Between a point and the same ray's point computed anew."""
POSE = 1e-6
"""Of a scan's position [m] and orientation."""


class LidarChecks:
    """Scans recorded scenes again with the LIDAR services of a scenario.

    Args:
        files: Scenery and meshes of the dataset, by asset name.
        services: Tables ``services`` of the scenario.
    """

    def __init__(self, files: Mapping[str, Path], services: Mapping[str, Mapping[str, Any]]) -> None:
        self.skipped = ""
        """Why scans are not computed anew on this machine; empty: they are, or there is none."""
        self._files = files
        self._settings = {
            name: spec.get("settings", {})
            for name, spec in services.items()
            if spec.get("role") == "sensors" and spec.get("use") == "lidar"
        }
        self._services: dict[tuple[str, bool], Service[Any]] = {}

    def frame(self, frame: RecordedFrame, meshes: Mapping[str, Path]) -> Iterator[Finding]:
        """Check all scans of a scene.

        Args:
            frame: Scene, and the products of its LIDARs.
            meshes: Of the recording: those that came while the run went on.

        Yields:
            Of each scan the first thing that is wrong; ``user`` is the LIDAR.
        """
        for product in frame.products:
            source, lidar = product.provenance.source, product.payload
            is_fresh = product.provenance.status is Status.FRESH
            if not (is_fresh and isinstance(lidar, Lidar) and source in self._settings) or self.skipped:
                continue
            try:
                anew = self._scanned(
                    frame, source, meshes, any(scan.grid is not None for scan in lidar.scans)
                )
            except SetupError as error:
                self.skipped = str(error)
                return
            except CaviarError as error:
                what, expected = f"product lidar of {source}", "scans that its sensors can make of the scene"
                yield Finding(frame.episode, frame.number, "", what, expected, str(error))
                continue
            right = {scan.sensor: scan for scan in anew.scans}
            found = {scan.sensor: scan for scan in lidar.scans}
            if right.keys() != found.keys():
                names = (", ".join(sorted(one)) or "none" for one in (right, found))
                yield Finding(frame.episode, frame.number, "", f"LIDARs of {source}", *names)
            for sensor in sorted(right.keys() & found.keys()):
                for difference in _differences(right[sensor], found[sensor]):
                    yield Finding(frame.episode, frame.number, sensor, *difference)
                    break

    def _scanned(
        self, frame: RecordedFrame, source: str, meshes: Mapping[str, Path], with_grid: bool
    ) -> Lidar:
        service = self._services.get((source, with_grid))
        if service is None:
            cls = load("sensors", "lidar")
            service = cls(convert_settings(cls.Settings, self._settings[source]), RunInfo(name=source))
            parts = frozenset({"grid"} if with_grid else ())
            service.prepare(Preparation(demand={"lidar": parts}, assets=self._files))
            self._services[source, with_grid] = service
        if meshes:  # named by their content: those of an earlier episode do no harm
            service.use_meshes(meshes)
        result = service.step(
            Frame(
                episode=frame.episode,
                number=frame.number,
                t_ns=frame.t_ns,
                inputs=tuple(
                    FrameInput(product.provenance, payload=product.payload)
                    for product in frame.products
                    if product.provenance.topic == "scene"
                ),
                service=source,
                seed=frame.entry.seed,
                seed_episode=frame.episode,
            )
        )
        return cast(Lidar, result.products["lidar"])


def _differences(right: LidarScan, found: LidarScan) -> Iterator[tuple[str, ...]]:
    """What is wrong with a scan: quantity, expected, found."""
    for name in ("position", "orientation"):
        expected, got = getattr(right, name), getattr(found, name)
        if not np.allclose(expected, got, rtol=0, atol=POSE):
            yield f"{name} of the LIDAR", *(", ".join(f"{v:.3f}" for v in one) for one in (expected, got))
    if right.grid is not None and found.grid is not None:
        yield from _grid_differences(right.grid, found.grid)
    yield from _point_differences(right, found)


def _grid_differences(right: OccupancyGrid, found: OccupancyGrid) -> Iterator[tuple[str, ...]]:
    places = [(grid.occupancy.shape, grid.origin, grid.cell) for grid in (right, found)]
    if places[0] != places[1]:
        yield "place of the LIDAR grid", *("{} cells from {} m of {} m".format(*one) for one in places)
        return
    if np.array_equal(right.occupancy, found.occupancy):
        return
    # By float64 arithmetic on the scene alone: these are equal everywhere.
    for name, mark in (("TX", TX), ("RX", RX)):
        at = [np.argwhere(grid.occupancy == mark).tolist() for grid in (right, found)]
        if at[0] != at[1]:
            texts = (", ".join(map(str, one[:3])) or "none" for one in at)
            yield f"{name} in the LIDAR grid", *texts
    occupied = [grid.occupancy == OBSTACLE for grid in (right, found)]
    common, union = (occupied[0] & occupied[1]).sum(), (occupied[0] | occupied[1]).sum()
    if union - common > SHARE * union:
        counts = [int(one.sum()) for one in occupied]
        expected = f"{counts[0]} cells, by a scan of the scene"
        yield "obstacles of the LIDAR grid", expected, f"{counts[1]}, of which {common} are those"


def _point_differences(right: LidarScan, found: LidarScan) -> Iterator[tuple[str, ...]]:
    rays, at, of = np.intersect1d(right.ray, found.ray, return_indices=True)
    near = np.ones(len(rays), np.bool_)
    for name in ("points", "points_world"):
        one, other = getattr(right, name), getattr(found, name)
        if one is not None and other is not None:
            near &= np.linalg.norm(one[at] - other[of], axis=1) < POINT_M
    common, union = near.sum(), len(right.ray) + len(found.ray) - len(rays)
    if union - common > SHARE * union:
        expected = f"{len(right.ray)}, by a scan of the scene"
        yield "points of the LIDAR", expected, f"{len(found.ray)}, of which {common} are those"
