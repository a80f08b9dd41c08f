"""Topics ``lidar``, ``camera``, ``depth`` and ``segmentation``: what sensors see."""

from __future__ import annotations

from typing import Annotated

import msgspec
import numpy as np

from caviar_protocol.arrays import (
    Float32Array,
    Int8Array,
    Int32Array,
    Payload,
    Quaternion,
    UInt8Array,
    Vector3,
    array,
    quantity,
)
from caviar_protocol.space.coordinates import rotation_matrix


class OccupancyGrid(Payload, frozen=True, kw_only=True, omit_defaults=True):
    """The paper's quantised point cloud, in world axes: 0 free, 1 obstacle, −1 TX, −2 RX.

    Cell (i, j, k) is that of a point with index round((v − origin)/cell), clipped.

    Example:
        >>> cells = np.zeros((20, 20, 4), np.int8)
        >>> grid = OccupancyGrid(origin=(-10.0, -10.0, 0.0), cell=(1.0, 1.0, 2.0), occupancy=cells)
        >>> np.round((np.array([0.0, 0.0, 4.0]) - grid.origin) / grid.cell).tolist()  # the cell of a point
        [10.0, 10.0, 2.0]
    """

    origin: Vector3
    """Coordinates of index (0, 0, 0)."""
    cell: Vector3
    """Edge lengths of a cell."""
    occupancy: Annotated[Int8Array, array("|i1", "X", "Y", "Z", unit="1", doc="0, 1, −1 or −2")]


class LidarScan(Payload, frozen=True, kw_only=True, omit_defaults=True):
    """One turn of one LIDAR: the rays that hit something, in ray order.

    Ray ``r`` belongs to beam ``r // azimuth_steps`` (lowest elevation first) and azimuth step
    ``r % azimuth_steps`` (counter-clockwise from the device's +x axis). A LIDAR may be set to leave
    ``points_world`` out since 1.4; then they are the points turned by the orientation, at the position.
    Readers of earlier versions need it: where one is in the run, leave it in.

    Example:
        >>> hit = np.array([[5.0, 0.0, 0.0]], np.float32)  # 5 m ahead
        >>> scan = LidarScan(
        ...     sensor="car/top",
        ...     position=(0.0, 0.0, 2.0),
        ...     orientation=(1.0, 0.0, 0.0, 0.0),
        ...     ray=np.array([0], np.int32),
        ...     points=hit,
        ...     range=np.array([5.0], np.float32),
        ...     object=np.array([0], np.int32),
        ... )
        >>> scan.in_world().tolist()
        [[5.0, 0.0, 2.0]]
        >>> Lidar(object_names=("wall",), scans=(scan,)).object_names[scan.object[0]]
        'wall'
    """

    sensor: str
    """Name of the device."""
    position: Vector3
    """Pose of the sensor in the world at this frame."""
    orientation: Quaternion
    """Rotates the sensor's axes into world axes."""
    ray: Annotated[Int32Array, array("<i4", "N", unit="1", doc="index of the ray")]
    # Single precision: 1e-5 m at 100 m, and a scan has 1e5 points in every frame.
    points: Annotated[Float32Array, array("<f4", "N", 3, unit="m", doc="hit, sensor axes")]
    points_world: (
        Annotated[
            Float32Array,
            array("<f4", "N", 3, unit="m", doc="hit, world axes"),
        ]
        | None
    ) = None
    range: Annotated[Float32Array, array("<f4", "N", unit="m", doc="distance to the hit")]
    # Names in one table: as text they would be the largest part of a scan.
    object: Annotated[Int32Array, array("<i4", "N", unit="1", doc="index into object_names")]
    grid: OccupancyGrid | None = None
    """Where part ``grid`` is in demand."""

    def in_world(self) -> Float32Array:
        """Hits in world axes: ``points_world``, or else those of ``points`` and the pose.

        Returns:
            Coordinates [m], Shape ``[N, 3]``.
        """
        if self.points_world is not None:
            return self.points_world
        # In double precision up to the sum, so that a point is rounded once.
        turned = self.points.astype(np.float64) @ rotation_matrix(self.orientation).T
        world: Float32Array = (turned + np.array(self.position)).astype(np.float32)
        return world


class Lidar(Payload, frozen=True, kw_only=True, omit_defaults=True):
    """Scans of all LIDARs of a service, sorted by sensor name."""

    object_names: tuple[str, ...]
    """What `LidarScan.object` points into: moving objects and scenery by name."""
    scans: tuple[LidarScan, ...]
    """One a sensor."""


class Intrinsics(msgspec.Struct, frozen=True, kw_only=True, omit_defaults=True):
    """Pinhole intrinsics: a point (x, y, z) in camera axes (x right, y down, z forward) is at
    pixel (fx·x/z + cx, fy·y/z + cy), pixel centres at +½.

    Example:
        >>> eye = Intrinsics(fx=320.0, fy=320.0, cx=320.0, cy=240.0)
        >>> x, y, z = 1.0, 0.0, 10.0  # 1 m to the right, 10 m ahead
        >>> eye.fx * x / z + eye.cx, eye.fy * y / z + eye.cy
        (352.0, 240.0)
    """

    fx: Annotated[float, quantity("px", "focal length, horizontal")]
    fy: Annotated[float, quantity("px", "focal length, vertical")]
    cx: Annotated[float, quantity("px", "principal point, horizontal")]
    cy: Annotated[float, quantity("px", "principal point, vertical")]


# Optics and pose travel with each picture, so that it is read without its scenario.
class _Image(Payload, frozen=True, kw_only=True, omit_defaults=True):
    """Sensor of an image, its optics and its pose."""

    sensor: str
    """Name of the device."""
    intrinsics: Intrinsics
    """How its camera projects."""
    position: Vector3
    """Pose of the sensor in the world at this frame."""
    orientation: Quaternion
    """Rotates the device's axes (it looks along +x, +z up) into world axes."""


class CameraImage(_Image, frozen=True, kw_only=True, omit_defaults=True):
    """One RGB image, top row first, sRGB.

    Example:
        >>> eye = Intrinsics(fx=320.0, fy=320.0, cx=320.0, cy=240.0)
        >>> pose = {"position": (0.0, 0.0, 5.0), "orientation": (1.0, 0.0, 0.0, 0.0)}
        >>> black = np.zeros((480, 640, 3), np.uint8)
        >>> image = CameraImage(sensor="pole/eye", intrinsics=eye, **pose, rgb=black)
        >>> Camera(images=(image,)).images[0].rgb.shape
        (480, 640, 3)
    """

    rgb: Annotated[UInt8Array, array("|u1", "H", "W", 3, unit="1", doc="red, green, blue")]


class Camera(Payload, frozen=True, kw_only=True, omit_defaults=True):
    """RGB images of all cameras of a service, sorted by sensor name."""

    images: tuple[CameraImage, ...]
    """One a camera."""


class DepthImage(_Image, frozen=True, kw_only=True, omit_defaults=True):
    """One depth image, and the surface normals where computed.

    Example:
        >>> eye = Intrinsics(fx=320.0, fy=320.0, cx=320.0, cy=240.0)
        >>> pose = {"position": (0.0, 0.0, 5.0), "orientation": (1.0, 0.0, 0.0, 0.0)}
        >>> nothing = np.zeros((480, 640), np.float32)
        >>> image = DepthImage(sensor="pole/eye", intrinsics=eye, **pose, depth=nothing)
        >>> bool((image.depth == 0).all())  # no ray hit anything
        True
    """

    # 0 for no hit, since NaN may not leave a service (clause 21).
    depth: Annotated[Float32Array, array("<f4", "H", "W", unit="m", doc="along the optical axis; 0: no hit")]
    normals: (
        Annotated[
            Float32Array,
            array("<f4", "H", "W", 3, unit="1", doc="unit, world axes, to the camera's side; 0: no hit"),
        ]
        | None
    ) = None


class Depth(Payload, frozen=True, kw_only=True, omit_defaults=True):
    """Depth images of all cameras of a service, sorted by sensor name."""

    images: tuple[DepthImage, ...]
    """One a camera."""


class SegmentationImage(_Image, frozen=True, kw_only=True, omit_defaults=True):
    """One image of object ids, and of material ids where asked for.

    Example:
        >>> eye = Intrinsics(fx=320.0, fy=320.0, cx=320.0, cy=240.0)
        >>> pose = {"position": (0.0, 0.0, 5.0), "orientation": (1.0, 0.0, 0.0, 0.0)}
        >>> sky = np.full((480, 640), -1, np.int32)
        >>> image = SegmentationImage(sensor="pole/eye", intrinsics=eye, **pose, object=sky)
        >>> Segmentation(object_names=("road",), images=(image,)).images[0].object.max().item()
        -1
    """

    object: Annotated[Int32Array, array("<i4", "H", "W", unit="1", doc="index into object_names; −1: no hit")]
    material: (
        Annotated[Int32Array, array("<i4", "H", "W", unit="1", doc="index into material_names; −1: no hit")]
        | None
    ) = None


class Segmentation(Payload, frozen=True, kw_only=True, omit_defaults=True):
    """Segmentation images of all cameras of a service, sorted by sensor name."""

    object_names: tuple[str, ...]
    """What `SegmentationImage.object` points into: moving objects and scenery by name."""
    material_names: Annotated[
        tuple[str, ...], quantity("1", "names of materials; empty unless part ``materials``")
    ] = ()
    images: tuple[SegmentationImage, ...]
    """One a camera."""
