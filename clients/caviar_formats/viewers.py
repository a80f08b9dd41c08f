"""Formats that viewers open: ``foxglove`` and ``ros2``, MCAP for Foxglove and ROS 2, and ``rerun``.

All have a file or folder for each episode, of which `moments` collects what viewers show frame by frame.
Times are those of the simulation.
"""

from __future__ import annotations

import re
import shutil
import textwrap
from abc import abstractmethod
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from caviar_clients.cli.plot import beam_amplitude
from caviar_clients.datasets.user_rows import Users
from caviar_clients.plots.rays import RANGE_DB, rays
from caviar_clients.plots.style import SKY, VERMILION
from caviar_formats.base import Format, Part
from caviar_protocol.arrays import Float64Array, Payload
from caviar_protocol.errors import RunError
from caviar_protocol.messages import Status
from caviar_protocol.space.coordinates import Pose, compose, unit_vectors
from caviar_protocol.space.scene import device_pose, object_pose
from caviar_protocol.topics import (
    AntennaArray,
    AntennaDevice,
    Camera,
    Channel,
    Depth,
    Lidar,
    Link,
    Scene,
)
from caviar_protocol.topics.sensors import CameraImage, DepthImage, LidarScan
from caviar_space.meshes import Mesh, joined, placed
from caviar_view.answers import SERIES
from caviar_view.world import World

P = TypeVar("P", bound=Payload)
WORLD = "world"
"""Frame of reference whose axes are those of the world."""
LOBE_M, TICK_M = 10.0, 3.0
"""Lengths of the strongest direction of a beam, and of the ticks of paths whose route is unknown [m]."""
CUBE, LINE_STRIP, TRIANGLE_LIST, FLOAT32 = 1, 4, 11, 7
"""Numbers of visualization_msgs/Marker and sensor_msgs/PointField."""
ORIGIN = Pose((0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0))
# Turns axes x right, y down, z forward into those of a device, x forward, y left, z up.
_OPTICAL = Pose((0.0, 0.0, 0.0), (0.5, -0.5, 0.5, -0.5))
# Red, green and blue of Matplotlib's «viridis» at even distances.
_VIRIDIS = np.array([[68, 1, 84], [59, 82, 139], [33, 145, 140], [94, 201, 98], [253, 231, 37]]) / 255


@dataclass(frozen=True, eq=False)
class Moment:
    """Content of a frame that viewers show."""

    t_ns: int
    objects: list[tuple[str, str, Pose, list[float]]]
    """Name, class, pose in the world, and length, width and height [m]."""
    mounts: list[tuple[str, str, Pose]]
    """Parent, name and pose in the parent's axes of devices and, with x right and y down, of pictures."""
    rays: list[tuple[Float64Array, float, list[float]]]
    """Points [m], Shape ``[N, 3]``, gain [dB] on the first carrier that the pair uses, and colour by it, of
    the strongest paths of each pair."""
    beams: list[tuple[AntennaDevice, Pose, int]]
    """Arrays of several elements, their poses in the world, and beams that were chosen for them."""
    users: dict[str, dict[str, float]]
    """Values of `SERIES`, and both chosen beams, by ``RX/TX/CARRIER``."""
    scans: list[LidarScan]
    """Of this frame; no held ones. Neither are `images`."""
    images: list[CameraImage | DepthImage]


class ShownFrame(Protocol):
    """A frame of a recording or of an observer."""

    t_ns: int

    @property
    def products(self) -> Sequence[Any]:
        """Products that are not absent, each with its ``provenance`` and ``payload``."""

    def payloads(self, topic: str, cls: type[P]) -> dict[str, P]:
        """Payloads of a topic by source."""

    def scene(self) -> Scene | None:
        """The scenes of all worlds as one."""


def moment(frame: ShownFrame) -> Moment:
    """Collect what viewers show of a frame.

    Args:
        frame: The frame.

    Raises:
        RecordingError: Bytes are damaged or missing.
    """
    scene = frame.scene()
    fresh = [p for p in frame.products if p.provenance.status is Status.FRESH]
    pictures = [p.payload for p in fresh if p.provenance.topic in ("camera", "depth")]
    images = [
        image for payload in pictures if isinstance(payload, Camera | Depth) for image in payload.images
    ]
    objects, mounts = list[Any](), [(WORLD, optical(image), camera_pose(image)) for image in images]
    beams, users, drawn = dict[tuple[str, int], None](), dict[str, dict[str, float]](), list[Any]()
    for link in frame.payloads("link", Link).values():
        columns = {name: values(link) for name, (_, values) in SERIES.items()}
        columns |= {"tx_beam": link.tx_beam, "rx_beam": link.rx_beam}
        for at, (tx, rx, carrier) in enumerate(zip(link.tx, link.rx, link.carrier, strict=True)):
            row = {name: float(column[at]) for name, column in columns.items() if column is not None}
            users[f"{rx}/{tx}/{carrier}"] = {name: x for name, x in row.items() if np.isfinite(x)}
            beams |= {(tx, int(link.tx_beam[at])): None, (rx, int(link.rx_beam[at])): None}
    chosen = list[tuple[AntennaDevice, Pose, int]]()
    if scene is not None:
        poses = (object_pose(scene, at) for at in range(len(scene.names)))
        objects = list(zip(scene.names, scene.classes, poses, scene.dimensions.tolist(), strict=True))
        mounts += [(d.parent or WORLD, d.name, Pose(d.position, d.orientation)) for d in scene.devices]
        arrays = {d.name: d for d in scene.devices if isinstance(d, AntennaDevice) and d.array.size > 1}
        chosen = [
            (arrays[name], device_pose(scene, arrays[name]), beam)
            for name, beam in beams
            if beam >= 0 and name in arrays
        ]
        found = rays(scene, next(iter(frame.payloads("channel", Channel).values()), None))
        top = found.all_gains.max(initial=-np.inf)
        for lines, gains in ((found.lines, found.gains), (found.ticks(TICK_M), found.tick_gains)):
            for line, gain in zip(lines, gains.tolist(), strict=True):
                share = np.clip(1 + (gain - top) / RANGE_DB, 0, 1)
                color = [float(np.interp(share, np.linspace(0, 1, 5), c)) for c in _VIRIDIS.T]
                drawn.append((line, gain, color))
    return Moment(
        t_ns=frame.t_ns,
        objects=objects,
        mounts=mounts,
        rays=drawn,
        beams=chosen,
        users=users,
        scans=[scan for p in fresh if isinstance(p.payload, Lidar) for scan in p.payload.scans],
        images=images,
    )


def optical(image: CameraImage | DepthImage) -> str:
    """Name of the frame of reference of a picture: x right, y down, z forward."""
    return f"{image.sensor}_optical"


def camera_pose(image: CameraImage | DepthImage) -> Pose:
    """Pose in the world of the frame of reference of a picture."""
    return compose(Pose(image.position, image.orientation), _OPTICAL)


@lru_cache(512)
def lobe(array: AntennaArray, beam: int) -> Mesh:
    """Make the surface of a beam's amplitude where it is within 10 dB of the greatest, which is at `LOBE_M`.

    Args:
        array: Of the device.
        beam: Number in its codebook.

    Returns:
        In the device's axes [m].
    """
    # Finer than the narrowest beam: of N elements half a wavelength apart the first null is at 2/N rad.
    zenith = np.linspace(0, np.pi, min(361, 4 * max(18, array.rows) + 1))
    azimuth = np.linspace(-np.pi, np.pi, min(721, 8 * max(18, array.columns) + 1))
    directions = unit_vectors(np.stack(np.meshgrid(zenith, azimuth, indexing="ij"), -1).reshape(-1, 2))
    gain = beam_amplitude(array, beam, directions)
    gain /= max(float(gain.max()), 1e-9)
    at = np.arange(len(gain)).reshape(len(zenith), len(azimuth))
    a, b, c, d = (part.ravel() for part in (at[:-1, :-1], at[1:, :-1], at[1:, 1:], at[:-1, 1:]))
    faces = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])
    # Without side lobes, which are 13 dB down: a beam of a large array has hundreds.
    used, faces = np.unique(faces[(gain[faces] > 10**-0.5).any(1)], return_inverse=True)
    return Mesh(LOBE_M * (gain[:, None] * directions)[used], faces.reshape(-1, 3).astype(np.int32))


def picture(image: CameraImage | DepthImage) -> tuple[str, str, NDArray[Any]]:
    """Name of the topic of a picture, encoding as ROS and Foxglove name it, and pixels."""
    if isinstance(image, DepthImage):
        return "depth", "32FC1", np.array(image.depth)
    return "image", "rgb8", np.array(image.rgb)


def projections(image: CameraImage | DepthImage) -> tuple[list[float], list[float]]:
    """Matrices K (3 × 3) and P (3 × 4) of the pinhole, row by row, with pixel centres at whole numbers."""
    optics = image.intrinsics
    cx, cy = optics.cx - 0.5, optics.cy - 0.5
    return (
        [optics.fx, 0.0, cx, 0.0, optics.fy, cy, 0.0, 0.0, 1.0],
        [optics.fx, 0.0, cx, 0.0, 0.0, optics.fy, cy, 0.0, 0.0, 0.0, 1.0, 0.0],
    )


def rgb(color: str) -> list[float]:
    """Red, green and blue, 0…1, of ``#rrggbb``."""
    return [value / 255 for value in bytes.fromhex(color[1:])]


class _Viewer(Format):
    """A format with a file or folder for each episode."""

    extra = "viewers"
    of_all_users = True
    whole_episodes = True
    loses = (
        "Paths on other carriers than the first that a pair uses, and those of a second channel service. "
        "Matrices, impulse responses, and all but the 25 strongest paths of a pair; meshes of objects, which "
        "are boxes; labels of pictures, normals; scenery of more than 150,000 triangles is thinned; products "
        "that were held are there once."
    )

    def write(self, part: Part, folder: Path) -> None:
        dataset = part.users.dataset
        files = {
            f.relative_to(dataset.assets).as_posix(): f for f in dataset.assets.rglob("*") if f.is_file()
        }
        world = World(files, dataset.settings["scenario"])
        for episode in np.unique(part.scenes["episode"]).tolist():
            recording = dataset.episode(episode)
            scenes = part.scenes["scene"][part.scenes["episode"] == episode].tolist()
            found = (moment(recording.frame(episode, scene)) for scene in scenes)
            self.write_episode(folder / f"episode-{episode:06d}", world, found)

    @abstractmethod
    def write_episode(self, place: Path, world: World, moments: Iterator[Moment]) -> None:
        """Write an episode.

        Args:
            place: Of the file or folder, without a suffix.
            world: Its scenery.
            moments: Its frames.
        """


_FRAMES = """Lengths are in metres.

Frames of reference are `world` (x to the east, y to the north, z up), objects and devices by name (x forward,
y left, z up), and `CAMERA_optical` (x right, y down, z forward)."""


def _series() -> str:
    """Values of a user, for a README."""
    series = (f"`{name}` [{unit}]" for name, (unit, _) in SERIES.items())
    text = f"{', '.join(series)}, and the chosen `tx_beam` and `rx_beam`."
    return textwrap.fill(text, 105, initial_indent="  ", subsequent_indent="  ")


class Foxglove(_Viewer):
    """MCAP with the schemas of Foxglove, which Foxglove and Lichtblick open, and Rerun in part."""

    packages = ("foxglove",)

    def write_episode(self, place: Path, world: World, moments: Iterator[Moment]) -> None:
        import foxglove

        context = foxglove.Context()
        with foxglove.open_mcap(place.with_suffix(".mcap"), allow_overwrite=True, context=context):
            file = FoxgloveMessages(context)
            for number, now in enumerate(moments):
                file.stamp(now.t_ns)
                if not number:
                    file.scenery(world)
                file.add(now)

    def readme(self, users: Users) -> str:
        return f"""# {users.dataset.name} for Foxglove

`episode-N.mcap`: an episode, with simulated times. Messages have Foxglove's schemas in Protocol Buffers;
those of `/users` are JSON. {_FRAMES}

- `/tf`: FrameTransforms of objects in the world, and of devices on their objects.
- `/scenery`: SceneUpdate of the first frame, triangles by material.
- `/objects`: SceneUpdate, a box for each object, with its class.
- `/rays`: SceneUpdate, a line for each path on the first carrier that its pair uses, yellow for the
  strongest; metadata has its gain [dB] there. A path whose route is not known has a tick of {TICK_M:g} m at
  either end.
- `/beams`: SceneUpdate when a beam changes: amplitudes of the chosen beams without side lobes, {LOBE_M:g} m
  at the most.
- `/lidar/SENSOR`: PointCloud in the axes of the sensor, with ranges [m] and the pose of the sensor.
- `/camera/SENSOR/image`, `depth`, `calibration`: RawImage of colours, RawImage of depths [m],
  CameraCalibration.
- `/users/RX/TX/CARRIER`: for plots, without what is not finite,
{_series()}

`rerun mcap convert` draws transforms, points and pictures of these files.
"""


class FoxgloveMessages:
    """Messages of Foxglove to a file or a server: topics have channels from their first message on.

    Args:
        context: Of the SDK, which the file or the server is of.
    """

    def __init__(self, context: Any) -> None:
        import foxglove
        from foxglove import channels, messages

        self._channel, self._channels, self.fg = foxglove.Channel, channels, messages
        self._context, self._topics = context, dict[str, Any]()
        self._beams: list[tuple[str, int]] | None = None

    def stamp(self, t_ns: int) -> None:
        """Set the time of what follows [ns]."""
        self._t_ns, self._stamp = t_ns, self.fg.Timestamp(*divmod(t_ns, 10**9))

    def scenery(self, world: World) -> None:
        """Show the scenery, and with the next frame all beams again: a viewer that comes has seen nothing."""
        self._beams, entities = None, []
        for group in world.groups:
            about = {"triangles": len(group.mesh.faces), "of": group.of}
            surface = self._surface(group.mesh, rgb(group.color))
            entities.append(self._entity(f"{group.kind} of {group.material}", about, triangles=[surface]))
        self._update("/scenery", entities)

    def add(self, now: Moment) -> None:
        """Show a frame."""
        fg = self.fg
        transforms = [(WORLD, name, pose) for name, _, pose, _ in now.objects] + now.mounts
        self._log("/tf", fg.FrameTransforms(transforms=[self._transform(*each) for each in transforms]))
        boxes = []
        for name, kind, pose, size in now.objects:
            cube = fg.CubePrimitive(
                pose=self._pose(pose), size=self._vector(size), color=self._color(rgb(SKY))
            )
            boxes.append(self._entity(name, {"class": kind}, cubes=[cube]))
        self._update("/objects", boxes)
        lines = []
        for number, (points, gain, color) in enumerate(now.rays):
            line = fg.LinePrimitive(
                type=fg.LinePrimitiveLineType.LineStrip,
                pose=self._pose(ORIGIN),
                thickness=0.15,
                points=self._points(points),
                color=self._color(color),
            )
            lines.append(self._entity(f"path {number}", {"gain_db": f"{gain:.2f}"}, lines=[line]))
        self._update("/rays", lines)
        beams = [(device.name, beam) for device, _, beam in now.beams]
        if beams != self._beams:
            self._beams, lobes = beams, []
            for device, _, beam in now.beams:
                surface = self._surface(lobe(device.array, beam), rgb(VERMILION), 0.4)
                name = f"beam {beam} of {device.name}"
                lobes.append(
                    self._entity(name, {"beam": beam}, device.name, frame_locked=True, triangles=[surface])
                )
            self._update("/beams", lobes)
        for scan in now.scans:
            rows = np.concatenate([scan.points, scan.range[:, None]], axis=1).astype("<f4")
            kind = fg.PackedElementFieldNumericType.Float32
            fields = [
                fg.PackedElementField(name=name, offset=4 * at, type=kind)
                for at, name in enumerate(("x", "y", "z", "range"))
            ]
            cloud = fg.PointCloud(
                timestamp=self._stamp,
                frame_id=WORLD,
                pose=self._pose(Pose(scan.position, scan.orientation)),
                point_stride=16,
                fields=fields,
                data=rows.tobytes(),
            )
            self._log(f"/lidar/{scan.sensor}", cloud)
        lenses = dict[str, Any]()
        for image in now.images:
            topic, encoding, pixels = picture(image)
            height, width = pixels.shape[:2]
            shared: dict[str, Any] = {
                "timestamp": self._stamp,
                "frame_id": optical(image),
                "width": width,
                "height": height,
            }
            step = pixels.strides[0]
            raw = fg.RawImage(**shared, encoding=encoding, step=step, data=pixels.tobytes())
            self._log(f"/camera/{image.sensor}/{topic}", raw)
            k, p = projections(image)
            turned = [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]
            lenses[image.sensor] = fg.CameraCalibration(**shared, K=k, R=turned, P=p)
        for sensor, calibration in lenses.items():
            self._log(f"/camera/{sensor}/calibration", calibration)
        for user, values in now.users.items():
            self._log(f"/users/{user}", values)

    def _log(self, topic: str, message: Any) -> None:
        if topic not in self._topics and isinstance(message, dict):
            numbers = {name: {"type": "number"} for name in (*SERIES, "tx_beam", "rx_beam")}
            schema = {"type": "object", "title": "caviar.User", "properties": numbers}
            self._topics[topic] = self._channel(topic, schema=schema, context=self._context)
        elif topic not in self._topics:
            kind = getattr(self._channels, f"{type(message).__name__}Channel")
            self._topics[topic] = kind(topic, context=self._context)
        self._topics[topic].log(message, log_time=self._t_ns)

    def _update(self, topic: str, entities: list[Any]) -> None:
        # Each message has all of its topic, so that a jump in time shows what there is then.
        fg = self.fg
        gone = [fg.SceneEntityDeletion(timestamp=self._stamp, type=fg.SceneEntityDeletionType.All)]
        self._log(topic, fg.SceneUpdate(deletions=gone, entities=entities))

    def _entity(self, name: str, about: dict[str, Any], frame: str = WORLD, **parts: Any) -> Any:
        pairs = [self.fg.KeyValuePair(key=key, value=str(value)) for key, value in about.items()]
        return self.fg.SceneEntity(timestamp=self._stamp, frame_id=frame, id=name, metadata=pairs, **parts)

    def _surface(self, mesh: Mesh, color: list[float], alpha: float = 1.0) -> Any:
        return self.fg.TriangleListPrimitive(
            pose=self._pose(ORIGIN),
            points=self._points(mesh.vertices),
            color=self._color(color, alpha),
            indices=mesh.faces.ravel().tolist(),
        )

    def _transform(self, parent: str, name: str, pose: Pose) -> Any:
        return self.fg.FrameTransform(
            timestamp=self._stamp,
            parent_frame_id=parent,
            child_frame_id=name,
            translation=self._vector(pose.position),
            rotation=self._turned(pose),
        )

    def _pose(self, pose: Pose) -> Any:
        return self.fg.Pose(position=self._vector(pose.position), orientation=self._turned(pose))

    def _turned(self, pose: Pose) -> Any:
        w, x, y, z = pose.orientation
        return self.fg.Quaternion(x=x, y=y, z=z, w=w)

    def _vector(self, values: Sequence[float]) -> Any:
        x, y, z = values
        return self.fg.Vector3(x=x, y=y, z=z)

    def _points(self, points: Float64Array) -> list[Any]:
        return [self.fg.Point3(x=x, y=y, z=z) for x, y, z in points.tolist()]

    def _color(self, color: list[float], alpha: float = 1.0) -> Any:
        r, g, b = color
        return self.fg.Color(r=r, g=g, b=b, a=alpha)


class Ros2(_Viewer):
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
{_FRAMES}
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
{_series()}
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


class Rerun(_Viewer):
    """Recordings of Rerun."""

    packages = ("rerun",)
    extra = "rerun"

    def write_episode(self, place: Path, world: World, moments: Iterator[Moment]) -> None:
        import rerun as rr

        name = f"{place.parent.name.removesuffix('.part')} {place.name}"
        # By size alone: by default what is logged in 0.2 s is a chunk, each of two kilobytes for a number.
        batches = rr.ChunkBatcherConfig(flush_tick=3600.0)
        stream = rr.RecordingStream(
            "caviar", recording_id=name, send_properties=False, batcher_config=batches
        )
        stream.save(place.with_suffix(".rrd"))
        stream.log("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        for group in world.groups:
            stream.log(
                ["world", "scenery", f"{group.kind} of {group.material}"],
                _rerun_mesh(group.mesh, rgb(group.color)),
                static=True,
            )
        for now in moments:
            stream.set_time("time", duration=np.timedelta64(now.t_ns, "ns"))
            boxes = rr.Boxes3D(
                centers=[pose.position for _, _, pose, _ in now.objects],
                quaternions=[_rerun_turned(pose) for _, _, pose, _ in now.objects],
                sizes=[size for *_, size in now.objects],
                labels=[name for name, *_ in now.objects],
                colors=[rgb(SKY)] * len(now.objects),
            )
            stream.log("world/objects", boxes)
            strips, colors = [points for points, _, _ in now.rays], [color for *_, color in now.rays]
            stream.log("world/rays", rr.LineStrips3D(strips, colors=colors, radii=0.08))
            lobes = [
                Mesh(placed(lobe(device.array, beam), np.ones(3), pose), lobe(device.array, beam).faces)
                for device, pose, beam in now.beams
            ]
            stream.log("world/beams", _rerun_mesh(joined(lobes), [*rgb(VERMILION), 0.4]))
            for scan in now.scans:
                pose = Pose(scan.position, scan.orientation)
                points = np.array(scan.points)  # a copy: Rerun ends the process where memory is not aligned
                stream.log(["world", "lidar", scan.sensor], _rerun_pose(pose), rr.Points3D(points))
            for image in now.images:
                topic, _, pixels = picture(image)
                optics, (height, width) = image.intrinsics, pixels.shape[:2]
                # Pixel centres are at +½ there, too.
                pinhole = rr.Pinhole(
                    focal_length=(optics.fx, optics.fy),
                    principal_point=(optics.cx, optics.cy),
                    resolution=(width, height),
                )
                camera = ["world", "camera", image.sensor]
                stream.log(camera, _rerun_pose(camera_pose(image)), pinhole)
                shown = rr.DepthImage(pixels, meter=1.0) if topic == "depth" else rr.Image(pixels)
                stream.log([*camera, topic], shown)
            for user, values in now.users.items():
                for name, value in values.items():
                    stream.log(["users", *user.split("/"), name], rr.Scalars(value))
        stream.disconnect()

    def readme(self, users: Users) -> str:
        return f"""# {users.dataset.name} for Rerun

`episode-N.rrd`: an episode, with simulated times on the timeline `time`. {_FRAMES}

- `world/scenery`: meshes by material.
- `world/objects`: boxes, with names.
- `world/rays`: paths on the first carrier that their pair uses, yellow for the strongest. One whose route is
  not known has a tick of {TICK_M:g} m at either end.
- `world/beams`: amplitudes of the chosen beams without side lobes, {LOBE_M:g} m at the most.
- `world/lidar/SENSOR`: points. `world/camera/CAMERA`: `image`, and `depth` [m].
- `users/RX/TX/CARRIER/NAME`: for plots, without what is not finite,
{_series()}
"""


def _rerun_turned(pose: Pose) -> list[float]:
    w, *xyz = pose.orientation
    return [*xyz, w]


def _rerun_pose(pose: Pose) -> Any:
    import rerun as rr

    return rr.Transform3D(translation=pose.position, quaternion=_rerun_turned(pose))


def _rerun_mesh(mesh: Mesh, color: list[float]) -> Any:
    import rerun as rr

    return rr.Mesh3D(vertex_positions=mesh.vertices, triangle_indices=mesh.faces, albedo_factor=color)
