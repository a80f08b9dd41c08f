"""What a recording has as arrays of topics ``lidar``, ``camera``, ``depth`` and ``segmentation``."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from functools import cached_property
from typing import Any, ClassVar, Generic, TypeVar

import numpy as np

from caviar_protocol.arrays import Int32Array, Payload
from caviar_protocol.recording.arrays import Column, Rows
from caviar_protocol.recording.topics import NamedArrays, recorded_part
from caviar_protocol.topics import Camera, Depth, Lidar, Segmentation

P = TypeVar("P", bound=Payload)


class _SensorArrays(NamedArrays[P], Generic[P]):
    """A topic with one row a sensor."""

    axis: ClassVar[str] = "S"

    def _readings(self, payload: Any) -> Sequence[Any]:
        """Scans or images of one product."""
        readings: Sequence[Any] = payload.images
        return readings

    def keys_of(self, payload: P) -> Sequence[str]:
        return [reading.sensor for reading in self._readings(payload)]

    def _positions(self, payload: P) -> Rows:
        return [reading.position for reading in self._readings(payload)]

    def _orientations(self, payload: P) -> Rows:
        return [reading.orientation for reading in self._readings(payload)]

    position = Column(np.float64, 3, unit="m", doc="of the sensor, in the world", rows=_positions)
    orientation = Column(np.float64, 4, doc="(w, x, y, z), sensor axes into world axes", rows=_orientations)


class _NamesObjects(_SensorArrays[P], Generic[P]):
    """A sensor whose readings name the objects that they hit."""

    @cached_property
    def object_names(self) -> tuple[str, ...]:
        """What ``object`` points into: all names that occur in these frames, sorted."""
        if isinstance(self._reference, _NamesObjects):
            return self._reference.object_names
        return _all_names(getattr(payload, "object_names", ()) for payload in self)

    def _objects(self, payload: Any) -> Rows:
        return _renumbered(
            [reading.object for reading in self._readings(payload)], payload.object_names, self.object_names
        )


def _all_names(lists: Iterable[tuple[str, ...]]) -> tuple[str, ...]:
    return tuple(sorted({name for names in lists for name in names}))


def _renumbered(indices: list[Int32Array], own: tuple[str, ...], names: tuple[str, ...]) -> Rows:
    """Indices into the names of one product as indices into those of all; −1 stays."""
    place = {name: at for at, name in enumerate(names)}
    table = np.array([*(place[name] for name in own), -1], dtype=np.int32)
    return [table[index] for index in indices]


class LidarArrays(_NamesObjects[Lidar]):
    """Topic ``lidar``: the hits of each scan in ray order; axis H is as long as the scan with most hits."""

    def _readings(self, payload: Any) -> Sequence[Any]:
        scans: Sequence[Any] = payload.scans
        return scans

    def _hits(self, payload: Lidar) -> Rows:
        return [len(scan.ray) for scan in payload.scans]

    def _points(self, payload: Lidar) -> Rows:
        return [scan.points for scan in payload.scans]

    def _points_world(self, payload: Lidar) -> Rows:
        return [scan.in_world() for scan in payload.scans]

    def _ranges(self, payload: Lidar) -> Rows:
        return [scan.range for scan in payload.scans]

    def _rays(self, payload: Lidar) -> Rows:
        return [scan.ray for scan in payload.scans]

    def _grids(self, payload: Lidar) -> Rows:
        grids = [None if scan.grid is None else scan.grid.occupancy for scan in payload.scans]
        return recorded_part(self, "lidar.grid", grids)

    hits = Column(np.int64, doc="number of hits", rows=_hits)
    points = Column(np.float32, "H", 3, unit="m", doc="hits, sensor axes", rows=_points)
    points_world = Column(np.float32, "H", 3, unit="m", doc="hits, world axes", rows=_points_world)
    range = Column(np.float32, "H", unit="m", doc="distance to the hit", rows=_ranges)
    ray = Column(np.int32, "H", doc="index of the ray", rows=_rays)
    object = Column(np.int32, "H", doc="index into ``object_names``", rows=_NamesObjects._objects)
    grid = Column(
        np.int8,
        "X",
        "Y",
        "Z",
        doc="0 free, 1 obstacle, −1 TX, −2 RX; see `present`",
        rows=_grids,
    )


class CameraArrays(_SensorArrays[Camera]):
    """Topic ``camera``: pictures, top row first, as high and wide as the largest; 0 where there is none."""

    def _pictures(self, payload: Camera) -> Rows:
        return [image.rgb for image in payload.images]

    rgb = Column(np.uint8, "H", "W", 3, doc="red, green, blue (sRGB)", rows=_pictures)


class DepthArrays(_SensorArrays[Depth]):
    """Topic ``depth``: depth images, and normals where they were recorded."""

    def _depths(self, payload: Depth) -> Rows:
        return [image.depth for image in payload.images]

    def _normals(self, payload: Depth) -> Rows:
        return recorded_part(self, "depth.normals", [image.normals for image in payload.images])

    depth = Column(np.float32, "H", "W", unit="m", doc="along the optical axis; 0: no hit", rows=_depths)
    normals = Column(np.float32, "H", "W", 3, doc="unit, world axes; 0: no hit", rows=_normals)


class SegmentationArrays(_NamesObjects[Segmentation]):
    """Topic ``segmentation``: images of objects, and of materials where they were recorded."""

    @cached_property
    def material_names(self) -> tuple[str, ...]:
        """What ``material`` points into: all names that occur in these frames, sorted."""
        if isinstance(self._reference, SegmentationArrays):
            return self._reference.material_names
        return _all_names(payload.material_names for payload in self if payload is not None)

    def _materials(self, payload: Segmentation) -> Rows:
        images = recorded_part(self, "segmentation.materials", [image.material for image in payload.images])
        return _renumbered(images, payload.material_names, self.material_names)

    object = Column(
        np.int32, "H", "W", doc="index into ``object_names``; −1: no hit", rows=_NamesObjects._objects
    )
    material = Column(np.int32, "H", "W", doc="index into ``material_names``; −1: no hit", rows=_materials)
