"""Arrays of the topics ``scene``, ``lidar``, ``camera``, ``depth`` and ``segmentation`` of a recording.

The second axis has a row for each name: of an object in ``scene``, of a device in ``scene.devices``, of a
sensor in the others. `caviar_protocol.recording.topics` has the topics with a row for each user.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from functools import cached_property
from typing import Any, ClassVar, Generic, Self, TypeVar

import numpy as np

from caviar_protocol.arrays import Int32Array, Int64Array, Payload
from caviar_protocol.errors import RecordingError, suggestion
from caviar_protocol.recording.arrays import Column, Rows, TopicArrays, payload_column
from caviar_protocol.space.scene import device_pose, device_velocity
from caviar_protocol.topics import (
    Action,
    AntennaDevice,
    Camera,
    Depth,
    Lidar,
    Scene,
    Segmentation,
)
from caviar_protocol.topics.link import MotionCommand
from caviar_protocol.topics.scene import Device
from caviar_protocol.topics.sensors import CameraImage, DepthImage

P = TypeVar("P", bound=Payload)


class NamedArrays(TopicArrays[P, str], Generic[P]):
    """A topic whose arrays have a row for each name, sorted."""

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the second axis."""
        return self.keys

    def index(self, names: Iterable[str]) -> Int64Array:
        """Place of each name on the second axis, to align arrays: ``position[:, devices.index(channel.rx)]``.

        Args:
            names: Names of rows.

        Returns:
            Shape as there are names.

        Raises:
            RecordingError: A name is not there.

        Example:
            >>> from caviar_protocol.recording import Recording
            >>> recording = Recording("runs/smoke-20261122-101500")
            >>> recording["scene"].index(["uav", "car"]).tolist()
            [1, 0]
        """
        names = list(names)
        for name in names:
            if name not in self._place_of:
                hint = suggestion(name, self.keys)
                raise RecordingError(f"{self.place} has no {name!r} in these frames; {hint}")
        return np.array([self._place_of[name] for name in names], dtype=np.int64)

    def select(
        self,
        *,
        episode: int | None = None,
        frames: Iterable[int] | None = None,
        names: str | Iterable[str] | None = None,
    ) -> Self:
        """These frames and these names only; each argument that is left out allows all.

        Args:
            episode: Number of an episode.
            frames: Numbers of frames in their episodes.
            names: Name of a row, or several.

        Raises:
            RecordingError: A frame, an episode or a name is not there; the text says what is.

        Example:
            >>> from caviar_protocol.recording import Recording
            >>> recording = Recording("runs/smoke-20261122-101500")
            >>> recording["scene"].select(names="uav").velocity.shape
            (100, 1, 3)
        """
        return super().select(episode=episode, frames=frames)._narrowed([(0, "row named", names)])

    def sorted_keys(self, keys: Iterable[str]) -> Iterable[str]:
        return sorted(keys)


# --- objects and devices ------------------------------------------------------------------------------------


class SceneArrays(NamedArrays[Scene]):
    """Topic ``scene``: objects, of all worlds.

    Example:
        >>> from caviar_protocol.recording import Recording
        >>> recording = Recording("runs/smoke-20261122-101500")
        >>> scene = recording["scene"]
        >>> scene.names, scene.classes, scene.position.shape  # frames × objects × 3
        (('car', 'uav'), ('car', 'uav'), (100, 2, 3))
    """

    axis: ClassVar[str] = "N"

    def _turning(self, scene: Scene) -> Rows:
        turning = scene.angular_velocity
        return list(np.zeros_like(scene.velocity) if turning is None else turning)

    position = payload_column(np.float64, Scene, "position")
    orientation = payload_column(np.float64, Scene, "orientation")
    velocity = payload_column(np.float64, Scene, "velocity")
    angular_velocity = Column(
        np.float64, 3, unit="rad/s", doc="in world axes; 0 where the world does not say", rows=_turning
    )
    dimensions = payload_column(np.float64, Scene, "dimensions")

    @property
    def classes(self) -> tuple[str, ...]:
        """Class of each object (``car``, ``uav``, …), where it first occurs. Length N."""
        found: dict[str, str] = {}
        for scene in self:
            if scene is not None:
                for name, kind in zip(scene.names, scene.classes, strict=True):
                    found.setdefault(name, kind)
        return tuple(found.get(name, "") for name in self.keys)

    @property
    def devices(self) -> DeviceArrays:
        """The antennas and sensors of the same frames, where they are in the world."""
        # Of the same frames, but not of the same rows: those are objects.
        return DeviceArrays(self._recording, self.topic, self.sources, self._indices)

    def keys_of(self, payload: Scene) -> Sequence[str]:
        return payload.names


def _each_device(value: Callable[[Scene, Device], Any]) -> Callable[[Any, Scene], Rows]:
    return lambda _, scene: [value(scene, device) for device in scene.devices]


class DeviceArrays(NamedArrays[Scene]):
    """Devices of topic ``scene``, fixed ones and those mounted on objects, in world axes.

    Example:
        >>> from caviar_protocol.recording import Recording
        >>> recording = Recording("runs/smoke-20261122-101500")
        >>> devices = recording["scene"].devices
        >>> devices.position[0, devices.index(["bs"])].shape
        (1, 3)
    """

    axis: ClassVar[str] = "D"

    position = Column(
        np.float64,
        3,
        unit="m",
        doc="reference point, in the world",
        rows=_each_device(lambda scene, device: device_pose(scene, device).position),
    )
    orientation = Column(
        np.float64,
        4,
        doc="(w, x, y, z), device axes into world axes",
        rows=_each_device(lambda scene, device: device_pose(scene, device).orientation),
    )
    velocity = Column(np.float64, 3, unit="m/s", doc="in world axes", rows=_each_device(device_velocity))

    @property
    def devices(self) -> dict[str, Device]:
        """Each device as its first frame states it: role, array, power, optics. By name."""
        found: dict[str, Device] = {}
        for scene in self:
            for device in scene.devices if scene is not None else ():
                found.setdefault(device.name, device)
        return {name: found[name] for name in self.keys if name in found}

    def antennas(self, role: str) -> tuple[str, ...]:
        """Names of the antennas that transmit or receive.

        Args:
            role: ``"tx"`` for those that transmit, ``"rx"`` for those that receive.

        Example:
            >>> from caviar_protocol.recording import Recording
            >>> recording = Recording("runs/smoke-20261122-101500")
            >>> recording["scene"].devices.antennas("rx")
            ('car/rx', 'uav/rx-uav')
        """
        return tuple(
            name
            for name, device in self.devices.items()
            if isinstance(device, AntennaDevice) and device.role in (role, "both")
        )

    def keys_of(self, payload: Scene) -> Sequence[str]:
        return [device.name for device in payload.devices]


_NO_VECTOR = (np.nan, np.nan, np.nan)


def _motions(action: Action) -> list[MotionCommand]:
    return [c for c in action.commands if isinstance(c, MotionCommand)]


def _each_motion(field: str, missing: Any) -> Callable[[Any, Action], Rows]:
    """Rows of a field that only some commands have."""
    return lambda _, action: [getattr(command, field, missing) for command in _motions(action)]


class MotionArrays(NamedArrays[Action]):
    """Commands of topic ``action`` that move objects, by object."""

    axis: ClassVar[str] = "N"

    waypoint = Column(
        np.float64, 3, unit="m", doc="where to; NaN: not commanded", rows=_each_motion("position", _NO_VECTOR)
    )
    speed = Column(
        np.float64,
        unit="m/s",
        doc="at most, towards the waypoint or along the path",
        rows=_each_motion("speed", np.nan),
    )
    velocity = Column(
        np.float64,
        3,
        unit="m/s",
        doc="in world axes; NaN: not commanded",
        rows=_each_motion("velocity", _NO_VECTOR),
    )
    orientation = Column(
        np.float64,
        4,
        doc="attitude, w, x, y, z; NaN: not commanded",
        rows=_each_motion("orientation", (np.nan, *_NO_VECTOR)),
    )
    thrust = Column(
        np.float64,
        unit="m/s2",
        doc="over the mass, with an attitude; NaN: not commanded",
        rows=_each_motion("thrust", np.nan),
    )

    def keys_of(self, payload: Action) -> Sequence[str]:
        return [command.object for command in _motions(payload)]


# --- sensors ------------------------------------------------------------------------------------------------


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
        return self.recorded("lidar.grid", grids)

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
        """Names that ``object`` points into: all that occur in these frames, sorted."""
        return self._all_names("object_names")


class CameraArrays(SensorArrays[Camera]):
    """Topic ``camera``: pictures, top row first, as high and wide as the largest; 0 where there is none."""

    rgb = payload_column(np.uint8, CameraImage, "rgb", axes=0, rows=_each_reading("rgb"))


class DepthArrays(SensorArrays[Depth]):
    """Topic ``depth``: depth images, and normals where they were recorded."""

    def _normals(self, payload: Depth) -> Rows:
        return self.recorded("depth.normals", [image.normals for image in payload.images])

    depth = payload_column(np.float32, DepthImage, "depth", axes=0, rows=_each_reading("depth"))
    normals = Column(np.float32, "H", "W", 3, doc="unit, world axes; 0: no hit", rows=_normals)


class SegmentationArrays(SensorArrays[Segmentation]):
    """Topic ``segmentation``: images of objects, and of materials where they were recorded."""

    def _materials(self, payload: Segmentation) -> Rows:
        images = self.recorded("segmentation.materials", [image.material for image in payload.images])
        return _renumbered(images, payload.material_names, self.material_names)

    object = Column(
        np.int32, "H", "W", doc="index into ``object_names``; −1: no hit", rows=SensorArrays._objects
    )
    material = Column(np.int32, "H", "W", doc="index into ``material_names``; −1: no hit", rows=_materials)

    @cached_property
    def object_names(self) -> tuple[str, ...]:
        """Names that ``object`` points into: all that occur in these frames, sorted."""
        return self._all_names("object_names")

    @cached_property
    def material_names(self) -> tuple[str, ...]:
        """Names that ``material`` points into: all that occur in these frames, sorted."""
        return self._all_names("material_names")
