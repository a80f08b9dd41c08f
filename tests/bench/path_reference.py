"""The paths of a scene: the union of what launches of many rays find, raw Sionna RT's and this project's.

Neither alone is complete. Sionna RT's solver takes planes for one whose rounded normals and offsets agree,
and points its rays the same way whatever its seed; so each of its launches here has some more rays than the
one before. This project's launches are turned against each other. Lengths are those of images in float64,
since Sionna's own delays are off by 10⁻⁵ m.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from caviar_protocol.arrays import Complex128Array, Float64Array
from caviar_protocol.space.antenna_arrays import steering_vector
from caviar_protocol.space.coordinates import rotation_matrix
from caviar_protocol.space.scene import antennas, device_pose
from caviar_protocol.topics import Channel, Interaction, Scene
from caviar_services.channel.paths import Antenna
from caviar_services.channel.propagation.image_method import image_points, path_lengths
from caviar_services.channel.sionna.model import SionnaChannel

SAME_POINT = 1e-3
"""[m]; paths whose points are all nearer are one."""


@dataclass(frozen=True, eq=False)
class Path:
    """A path of reflections."""

    start: Float64Array
    points: Float64Array
    """[m], Shape ``[D, 3]``."""
    end: Float64Array
    h: Complex128Array
    """What it adds to H."""

    @property
    def power(self) -> float:
        return float((np.abs(self.h) ** 2).sum())

    def is_same(self, other: Path) -> bool:
        return len(self.points) == len(other.points) and bool(
            (np.abs(self.points - other.points) < SAME_POINT).all()
        )


def united(paths: Sequence[Path], more: Sequence[Path]) -> list[Path]:
    """Paths of both, each once: one over faces that coincide may have been found twice."""
    found = list(paths)
    for path in more:
        found += absent([path], found)
    return found


def absent(paths: Sequence[Path], among: Sequence[Path]) -> list[Path]:
    """Those of the paths that are not among others."""
    return [path for path in paths if not any(path.is_same(other) for other in among)]


def paths_of(channel: Channel, scene: Scene) -> list[list[Path]]:
    """Paths of a product with one transmitter and one carrier, receiver by receiver."""
    (transmitter,) = (Antenna.of(scene, device) for device in antennas(scene, "tx"))
    found = []
    for number, device in enumerate(antennas(scene, "rx")):
        receiver = Antenna.of(scene, device)
        rows = range(int(channel.offsets[number]), int(channel.offsets[number + 1]))
        found.append([_path(channel, row, transmitter, receiver) for row in rows])
    return found


def _path(channel: Channel, row: int, transmitter: Antenna, receiver: Antenna) -> Path:
    points = channel.points[row][channel.interactions[row] != 0]
    places = np.array([transmitter.position, *points, receiver.position])
    sent, taken = places[1] - places[0], places[-2] - places[-1]
    transmit, receive = (
        steering_vector(antenna.array, direction / np.linalg.norm(direction) @ antenna.rotation)
        for antenna, direction in ((transmitter, sent), (receiver, taken))
    )
    h = channel.a[0, row] * np.outer(receive, transmit)
    return Path(places[0], points, places[-1], h)


class Sionna:
    """Sionna RT's own path solver in the scene of a model, with reflections alone."""

    def __init__(self, channel: SionnaChannel, rays: int, launches: int, depth: int = 3) -> None:
        import sionna.rt as rt

        self._channel = channel
        self._scene = channel._scene
        self._rays, self._launches, self._depth = rays, launches, depth
        self._solver = rt.PathSolver()

    def __call__(self, scene: Scene) -> list[list[Path]]:
        """Paths of each receiver; the bodies are where the model placed them last."""
        self._channel._activate()
        self._traced = self._scene.rt_scene
        self._arrange(scene)
        ends = [np.array(device_pose(scene, device).position) for device in self._devices(scene)]
        found: list[list[Path]] = [[] for _ in ends[1:]]
        for launch in range(self._launches):
            paths = self._solver(
                self._traced,
                max_depth=self._depth,
                samples_per_src=self._rays + launch * self._rays // 50,
                max_num_paths_per_src=2_000_000,
                synthetic_array=True,
                refraction=False,
            )
            for number, known in enumerate(found):
                found[number] = united(known, list(self._read(paths, number, ends[0], ends[1 + number])))
        return found

    @staticmethod
    def _devices(scene: Scene) -> list[Any]:
        return [*antennas(scene, "tx"), *antennas(scene, "rx")]

    def _arrange(self, scene: Scene) -> None:
        """Put the antennas of a scene where they are."""
        import sionna.rt as rt

        traced, devices = self._traced, self._devices(scene)
        for name in (*traced.transmitters, *traced.receivers):
            traced.remove(name)
        traced.tx_array, traced.rx_array = (
            rt.PlanarArray(
                num_rows=device.array.rows,
                num_cols=device.array.columns,
                vertical_spacing=0.5,
                horizontal_spacing=0.5,
                pattern=device.array.pattern,
                polarization="V",
            )
            for device in devices[:2]
        )
        for number, device in enumerate(devices):
            pose = device_pose(scene, device)
            turn = rotation_matrix(pose.orientation)
            yaw, pitch = np.arctan2(turn[1, 0], turn[0, 0]), -np.arcsin(turn[2, 0])
            roll = np.arctan2(turn[2, 1], turn[2, 2])
            place = (np.array(pose.position) - self._scene.centre).tolist()
            turned = [float(yaw), float(pitch), float(roll)]
            if number:
                traced.add(rt.Receiver(f"rx{number:03d}", position=place, orientation=turned))
            else:
                traced.add(rt.Transmitter("tx", position=place, orientation=turned))

    def _read(self, paths: Any, receiver: int, start: Float64Array, end: Float64Array) -> Iterator[Path]:
        scene = self._scene
        rows = np.flatnonzero(paths.valid.numpy()[receiver, 0])
        kinds, shapes, primitives = (
            column.numpy()[:, receiver, 0, :][:, rows].T.astype(np.int64)
            for column in (paths.interactions, paths.objects, paths.primitives)
        )
        a = paths.a[0].numpy()[receiver, :, 0][..., rows] + 1j * paths.a[1].numpy()[receiver, :, 0][..., rows]
        types = np.where(kinds != 0, Interaction.REFLECTION, 0).astype(np.uint8)
        origin, normal = scene.planes(shapes, primitives)
        starts, ends = (np.broadcast_to(place, (len(rows), 3)) for place in (start, end))
        points = image_points(starts, ends, types, origin, normal)
        length = path_lengths(starts, points, ends, types)
        wavelength = scene.wavelengths[0]
        phase = np.exp(-2j * np.pi * (length / wavelength % 1.0))
        for row in range(len(rows)):
            yield Path(start, points[row][types[row] != 0], end, a[..., row] * phase[row])


class OwnLaunches:
    """This project's launches, each turned against the others, by a model of launched candidates."""

    def __init__(self, channel: SionnaChannel, launches: int) -> None:
        self._channel, self._launches = channel, launches
        self._tracer = channel._finder.tracer
        self._launcher: Any = self._tracer._launcher
        self._each = self._launcher.each

    def __call__(self, step: Any, scene: Scene) -> list[list[Path]]:
        """Paths of each receiver; ``step`` gives the product of the channel for the scene."""
        found: list[list[Path]] = [[] for _ in antennas(scene, "rx")]
        for number in range(self._launches):
            self._tracer.forget()
            self._launcher.each = partial(self._each, number=number)
            more = paths_of(step(scene), scene)
            found = [united(known, new) for known, new in zip(found, more, strict=True)]
        self._tracer.forget()
        return found
