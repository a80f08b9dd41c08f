"""Format ``ros2``: bags of ROS 2 with standard messages."""

from __future__ import annotations

import re
import shutil
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from caviar_clients.datasets.user_rows import Users
from caviar_clients.plots.style import SKY
from caviar_formats.viewers import (
    FRAMES,
    ORIGIN,
    TICK_M,
    WORLD,
    Moment,
    Viewer,
    optical,
    picture,
    projections,
    rgb,
    series_text,
)
from caviar_protocol.arrays import Float64Array
from caviar_protocol.errors import RunError
from caviar_protocol.space.coordinates import Pose
from caviar_view.world import World

CUBE, LINE_STRIP, TRIANGLE_LIST, FLOAT32 = 1, 4, 11, 7
"""Numbers of visualization_msgs/Marker and sensor_msgs/PointField."""


class Ros2(Viewer):
    """Bags of ROS 2, in MCAP, with standard messages."""

    packages = ("rosbags",)

    def write_episode(self, place: Path, world: World, moments: Iterator[Moment]) -> None:
        from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer

        shutil.rmtree(place, ignore_errors=True)
        # Version 8 of the metadata, which ROS 2 Iron and everything newer reads.
        writer = Writer(place, version=8, storage_plugin=StoragePlugin.MCAP)
        writer.set_compression(CompressionMode.STORAGE, CompressionFormat.ZSTD)
        with writer:
            bag = _Bag(writer)
            for number, now in enumerate(moments):
                bag.stamp(now.t_ns)
                if not number:
                    bag.scenery(world)
                bag.add(now)

    def readme(self, users: Users) -> str:
        return f"""# {users.dataset.name} as bags of ROS 2

`episode-N`: a bag, `episode-N.mcap` and its `metadata.yaml`, with simulated times, as of `use_sim_time`.
{FRAMES}
What is no letter, digit or slash in a name is an underscore in topics.

- `/tf`: tf2_msgs/TFMessage of objects in the world, and of devices on their objects.
- `/scenery`: visualization_msgs/MarkerArray of the first frame, triangles by material.
- `/objects`: visualization_msgs/MarkerArray, a box for each object.
- `/objects/NAME/pose`: geometry_msgs/PoseStamped of the centre of the box.
- `/rays`: visualization_msgs/MarkerArray, lines of paths on the first carrier that their pair uses, yellow
  for the strongest. A path whose route is not known has a tick of {TICK_M:g} m at either end.
- `/lidar/SENSOR/points`: sensor_msgs/PointCloud2 in the world, with ranges [m].
- `/camera/SENSOR/image`, `depth`, `camera_info`: sensor_msgs/Image `rgb8`, Image `32FC1` [m], CameraInfo.
- `/users/RX/TX/CARRIER/NAME`: std_msgs/Float64, without what is not finite,
{series_text()}
"""


class _Bag:
    """Messages of a bag: topics have connections from their first message on."""

    def __init__(self, writer: Any) -> None:
        from rosbags.typesys import Stores, get_typestore

        self._writer, self._topics = writer, dict[str, tuple[str, Any]]()
        self._store = get_typestore(Stores.ROS2_HUMBLE)
        self._known = set[str]()

    def stamp(self, t_ns: int) -> None:
        self._t_ns, self._time = t_ns, self._new("builtin_interfaces/Time", *divmod(t_ns, 10**9))

    def scenery(self, world: World) -> None:
        markers = []
        for number, group in enumerate(world.groups):
            corners = self._points(group.mesh.vertices[group.mesh.faces].reshape(-1, 3))
            name, color = f"{group.kind} of {group.material}", rgb(group.color)
            markers.append(self._marker(name, number, TRIANGLE_LIST, color=color, points=corners))
        self._markers("/scenery", markers)

    def add(self, now: Moment) -> None:
        new = self._new
        transforms = []
        for parent, name, pose in [(WORLD, name, pose) for name, _, pose, _ in now.objects] + now.mounts:
            moved = new("geometry_msgs/Transform", self._vector(pose.position), self._turned(pose))
            transforms.append(new("geometry_msgs/TransformStamped", self._header(parent), name, moved))
        self._log("/tf", new("tf2_msgs/TFMessage", transforms))
        boxes = []
        for number, (name, _, pose, size) in enumerate(now.objects):
            boxes.append(self._marker(name, number, CUBE, pose=pose, scale=size, color=rgb(SKY)))
            stamped = new("geometry_msgs/PoseStamped", self._header(WORLD), self._pose(pose))
            self._log(f"/objects/{name}/pose", stamped)
        self._markers("/objects", boxes)
        lines = []
        for number, (points, _, color) in enumerate(now.rays):
            lines.append(
                self._marker(
                    "paths",
                    number,
                    LINE_STRIP,
                    scale=(0.15, 0.0, 0.0),
                    color=color,
                    points=self._points(points),
                )
            )
        self._markers("/rays", lines)
        for scan in now.scans:
            rows = np.concatenate([scan.in_world(), scan.range[:, None]], axis=1).astype("<f4")
            names = enumerate(("x", "y", "z", "range"))
            fields = [new("sensor_msgs/PointField", name, 4 * at, FLOAT32, 1) for at, name in names]
            shape = 1, len(rows), fields, False, 16, 16 * len(rows), rows.view(np.uint8).ravel(), True
            cloud = new("sensor_msgs/PointCloud2", self._header(WORLD), *shape)
            self._log(f"/lidar/{scan.sensor}/points", cloud)
        lenses = dict[str, Any]()
        for image in now.images:
            topic, encoding, pixels = picture(image)
            (height, width), header = pixels.shape[:2], self._header(optical(image))
            content = encoding, 0, pixels.strides[0], pixels.view(np.uint8).ravel()
            self._log(
                f"/camera/{image.sensor}/{topic}", new("sensor_msgs/Image", header, height, width, *content)
            )
            k, p = (np.array(matrix) for matrix in projections(image))
            region = new("sensor_msgs/RegionOfInterest", 0, 0, 0, 0, False)
            shared = header, height, width, "plumb_bob", np.zeros(5), k, np.eye(3).ravel(), p, 0, 0, region
            lenses[image.sensor] = new("sensor_msgs/CameraInfo", *shared)
        for sensor, lens in lenses.items():
            self._log(f"/camera/{sensor}/camera_info", lens)
        for user, values in now.users.items():
            for name, value in values.items():
                self._log(f"/users/{user}/{name}", new("std_msgs/Float64", value))

    def _new(self, kind: str, *values: Any) -> Any:
        return self._store.types[kind.replace("/", "/msg/")](*values)

    def _log(self, name: str, message: Any) -> None:
        kind = message.__msgtype__
        if name not in self._topics:
            topic = re.sub(r"/(?=\d)", "/_", re.sub(r"[^A-Za-z0-9/]", "_", name))
            if topic in self._known:
                raise RunError(
                    f"two names are the topic {topic!r} of ROS, one of them is {name!r}; rename it"
                )
            self._known.add(topic)
            self._topics[name] = self._writer.add_connection(topic, kind, typestore=self._store)
        self._writer.write(self._topics[name], self._t_ns, self._store.serialize_cdr(message, kind))

    def _markers(self, topic: str, markers: list[Any]) -> None:
        self._log(topic, self._new("visualization_msgs/MarkerArray", [self._marker(action=3), *markers]))

    def _marker(
        self, name: str = "", number: int = 0, kind: int = 0, action: int = 0, pose: Pose = ORIGIN,
        scale: Sequence[float] = (1.0, 1.0, 1.0), color: Sequence[float] = (1.0, 1.0, 1.0),
        points: Sequence[Any] = (), colors: Sequence[Any] = (),
    ) -> Any:  # fmt: skip
        new, header, none = self._new, self._header(WORLD), np.zeros(0, np.uint8)
        return new(
            "visualization_msgs/Marker", header, name, number, kind, action, self._pose(pose),
            self._vector(scale), self._color(color), new("builtin_interfaces/Duration", 0, 0), False, points,
            colors, "", new("sensor_msgs/CompressedImage", header, "", none), [], "", "",
            new("visualization_msgs/MeshFile", "", none), False,
        )  # fmt: skip

    def _header(self, frame: str) -> Any:
        return self._new("std_msgs/Header", self._time, frame)

    def _pose(self, pose: Pose) -> Any:
        place = self._new("geometry_msgs/Point", *pose.position)
        return self._new("geometry_msgs/Pose", place, self._turned(pose))

    def _turned(self, pose: Pose) -> Any:
        w, x, y, z = pose.orientation
        return self._new("geometry_msgs/Quaternion", x, y, z, w)

    def _vector(self, values: Sequence[float]) -> Any:
        return self._new("geometry_msgs/Vector3", *values)

    def _points(self, points: Float64Array) -> list[Any]:
        return [self._new("geometry_msgs/Point", *point) for point in points.tolist()]

    def _color(self, color: Sequence[float]) -> Any:
        return self._new("std_msgs/ColorRGBA", *color, 1.0)
