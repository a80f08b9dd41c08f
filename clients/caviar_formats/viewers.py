"""Content of a frame that viewers show, and the class of their formats: ``foxglove``, ``ros2`` and ``rerun``.

All have a file or folder for each episode, and the times of the simulation.
"""

from __future__ import annotations

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
from caviar_clients.plots.rays import RANGE_DB, rays
from caviar_formats.base import Format, Part
from caviar_protocol.arrays import Float64Array, Payload
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
from caviar_space.meshes import Mesh
from caviar_view.answers import SERIES
from caviar_view.world import World

P = TypeVar("P", bound=Payload)
WORLD = "world"
"""Frame of reference whose axes are those of the world."""
LOBE_M, TICK_M = 10.0, 3.0
"""Lengths of the strongest direction of a beam, and of the ticks of paths whose route is unknown [m]."""
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


class Viewer(Format):
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


FRAMES = """Lengths are in metres.

Frames of reference are `world` (x to the east, y to the north, z up), objects and devices by name (x forward,
y left, z up), and `CAMERA_optical` (x right, y down, z forward)."""
"""Paragraphs of a README."""


def series_text() -> str:
    """Describe the values of a user, for a README."""
    series = (f"`{name}` [{unit}]" for name, (unit, _) in SERIES.items())
    text = f"{', '.join(series)}, and the chosen `tx_beam` and `rx_beam`."
    return textwrap.fill(text, 105, initial_indent="  ", subsequent_indent="  ")
