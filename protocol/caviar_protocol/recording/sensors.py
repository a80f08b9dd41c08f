"""What a recording has as arrays of topics ``lidar``, ``camera``, ``depth`` and ``segmentation``."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cached_property
from typing import Any, ClassVar, Generic, TypeVar

import numpy as np

from caviar_protocol.arrays import Int32Array, Payload
from caviar_protocol.recording.arrays import Column, Rows, payload_column
from caviar_protocol.recording.topics import NamedArrays, recorded_part
from caviar_protocol.topics import Camera, Depth, Lidar, Segmentation
from caviar_protocol.topics.sensors import CameraImage, DepthImage

P = TypeVar("P", bound=Payload)


def _readings(payload: Any) -> Sequence[Any]:
    """Scans or images of one product."""
    readings: Sequence[Any] = payload.scans if isinstance(payload, Lidar) else payload.images
    return readings


def _each_reading(field: str) -> Callable[[Any, Any], Rows]:
    return lambda _, payload: [getattr(reading, field) for reading in _readings(payload)]


class SensorArrays(NamedArrays[P], Generic[P]):
    """A topic with a row for each sensor."""

    axis: ClassVar[str] = "S"

    position = Column(
        np.float64, 3, unit="m", doc="of the sensor, in the world", rows=_each_reading("position")
    )
    orientation = Column(
        np.float64, 4, doc="(w, x, y, z), sensor axes into world axes", rows=_each_reading("orientation")
    )

    def keys_of(self, payload: P) -> Sequence[str]:
        return [reading.sensor for reading in _readings(payload)]

    def _all_names(self, field: str) -> tuple[str, ...]:
        """Names in a field of any of these frames, sorted; those of the whole where this is a block of it."""
        if isinstance(self._reference, SensorArrays):
            return self._reference._all_names(field)
        return tuple(sorted({name for payload in self for name in getattr(payload, field, ())}))

    def _objects(self, payload: Any) -> Rows:
        indices = [reading.object for reading in _readings(payload)]
        return _renumbered(indices, payload.object_names, self._all_names("object_names"))


def _renumbered(indices: list[Int32Array], own: tuple[str, ...], names: tuple[str, ...]) -> Rows:
    """Indices into the names of one product as indices into those of all; −1 stays."""
    place = {name: at for at, name in enumerate(names)}
    table = np.array([*(place[name] for name in own), -1], dtype=np.int32)
    return [table[index] for index in indices]


class LidarArrays(SensorArrays[Lidar]):
    """Topic ``lidar``: the hits of each scan in ray order; axis H is as long as the scan with most hits."""

    def _grids(self, payload: Lidar) -> Rows:
        grids = [None if scan.grid is None else scan.grid.occupancy for scan in payload.scans]
        return recorded_part(self, "lidar.grid", grids)

    hits = Column(np.int64, doc="number of hits", rows=lambda _, lidar: [len(s.ray) for s in lidar.scans])
    points = Column(np.float32, "H", 3, unit="m", doc="hits, sensor axes", rows=_each_reading("points"))
    points_world = Column(
        np.float32,
        *("H", 3),
        unit="m",
        doc="hits, world axes",
        rows=lambda _, lidar: [scan.in_world() for scan in lidar.scans],
    )
    range = Column(np.float32, "H", unit="m", doc="distance to the hit", rows=_each_reading("range"))
    ray = Column(np.int32, "H", doc="index of the ray", rows=_each_reading("ray"))
    object = Column(np.int32, "H", doc="index into ``object_names``", rows=SensorArrays._objects)
    grid = Column(np.int8, "X", "Y", "Z", doc="0 free, 1 obstacle, −1 TX, −2 RX; see `present`", rows=_grids)

    @cached_property
    def object_names(self) -> tuple[str, ...]:
        """What ``object`` points into: all names that occur in these frames, sorted."""
        return self._all_names("object_names")


class CameraArrays(SensorArrays[Camera]):
    """Topic ``camera``: pictures, top row first, as high and wide as the largest; 0 where there is none."""

    rgb = payload_column(np.uint8, CameraImage, "rgb", axes=0, rows=_each_reading("rgb"))


class DepthArrays(SensorArrays[Depth]):
    """Topic ``depth``: depth images, and normals where they were recorded."""

    def _normals(self, payload: Depth) -> Rows:
        return recorded_part(self, "depth.normals", [image.normals for image in payload.images])

    depth = payload_column(np.float32, DepthImage, "depth", axes=0, rows=_each_reading("depth"))
    normals = Column(np.float32, "H", "W", 3, doc="unit, world axes; 0: no hit", rows=_normals)


class SegmentationArrays(SensorArrays[Segmentation]):
    """Topic ``segmentation``: images of objects, and of materials where they were recorded."""

    def _materials(self, payload: Segmentation) -> Rows:
        images = recorded_part(self, "segmentation.materials", [image.material for image in payload.images])
        return _renumbered(images, payload.material_names, self.material_names)

    object = Column(
        np.int32, "H", "W", doc="index into ``object_names``; −1: no hit", rows=SensorArrays._objects
    )
    material = Column(np.int32, "H", "W", doc="index into ``material_names``; −1: no hit", rows=_materials)

    @cached_property
    def object_names(self) -> tuple[str, ...]:
        """What ``object`` points into: all names that occur in these frames, sorted."""
        return self._all_names("object_names")

    @cached_property
    def material_names(self) -> tuple[str, ...]:
        """What ``material`` points into: all names that occur in these frames, sorted."""
        return self._all_names("material_names")
