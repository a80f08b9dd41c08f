"""Where ends and objects are at an instant, and what their moves do to the images that paths lead to."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from caviar_protocol.arrays import BoolArray, Float64Array
from caviar_protocol.errors import PayloadError
from caviar_protocol.space.scene import antennas
from caviar_protocol.topics import Interaction, Scene
from caviar_services.channel.interpolation.joined import Joined
from caviar_services.channel.paths import Antenna


@dataclass(frozen=True, eq=False)
class Places:
    """Positions [m] or, of two instants' difference, displacements [m]; or velocities [m/s]."""

    start: Float64Array
    """Of each path's TX, Shape ``[K, 3]``."""
    end: Float64Array
    """Of each path's RX, Shape ``[K, 3]``."""
    objects: Float64Array
    """Of what stands at each of its points, Shape ``[K, D, 3]``; 0 for scenery."""

    def __sub__(self, other: Places) -> Places:
        return Places(self.start - other.start, self.end - other.end, self.objects - other.objects)

    def scaled(self, factor: float) -> Places:
        """All times a factor."""
        return Places(factor * self.start, factor * self.end, factor * self.objects)

    @property
    def most(self) -> Float64Array:
        """Sum of the lengths, objects twice, as a mirror moves an image: Shape ``[K]``."""
        moved: Float64Array = (
            np.linalg.norm(self.start, axis=-1)
            + np.linalg.norm(self.end, axis=-1)
            + 2 * np.linalg.norm(self.objects, axis=-1).sum(-1)
        )
        return moved


def ends_of(scene: Scene, joined: Joined) -> tuple[list[Antenna], list[Antenna]]:
    """Transmitters and receivers of the joined paths in a scene.

    Raises `PayloadError` where it lacks one of them.
    """
    found = []
    for role, names in (("tx", joined.tx), ("rx", joined.rx)):
        devices = {device.name: device for device in antennas(scene, role)}
        missing = [name for name in names if name not in devices]
        if missing:
            raise PayloadError(
                f"the scene lacks {role} {missing[0]!r}, which the keyframes have; pass that of the instant, "
                "or none"
            )
        found.append([Antenna.of(scene, devices[name]) for name in names])
    return found[0], found[1]


def places(scene: Scene, joined: Joined) -> Places:
    """Positions in a scene."""
    return _of(scene, joined, "position")


def velocities(scene: Scene, joined: Joined) -> Places:
    """Velocities in a scene."""
    return _of(scene, joined, "velocity")


def _of(scene: Scene, joined: Joined, field: str) -> Places:
    transmitters, receivers = ends_of(scene, joined)
    tx, rx = np.divmod(joined.pair, max(len(joined.rx), 1))
    index = {name: number for number, name in enumerate(scene.names)}
    values = np.concatenate([getattr(scene, field), np.zeros((1, 3))])
    named = [values[index.get(name, -1)] for name in joined.object_names]
    of_objects = np.array([*named, np.zeros(3)])
    return Places(
        np.array([getattr(antenna, field) for antenna in transmitters]).reshape(-1, 3)[tx],
        np.array([getattr(antenna, field) for antenna in receivers]).reshape(-1, 3)[rx],
        of_objects[joined.objects],
    )


def corners(places: Places, points: Float64Array, joined: Joined) -> Float64Array:
    """TX, points, RX of each path; points behind the last lie on RX: Shape ``[K, D + 2, 3]``."""
    inside = np.where((joined.types != 0)[..., None], points, places.end[:, None])
    return np.concatenate([places.start[:, None], inside, places.end[:, None]], axis=1)


def normals(corners: Float64Array, joined: Joined) -> Float64Array:
    """Of the mirrors, from the way the wave turns there; 0 where nothing is reflected: ``[K, D, 3]``."""
    segment = np.diff(corners, axis=1)
    length = np.linalg.norm(segment, axis=-1, keepdims=True)
    along = segment / np.where(length > 0, length, 1.0)
    turn = np.diff(along, axis=1)
    size = np.linalg.norm(turn, axis=-1, keepdims=True)
    mirror: BoolArray = (joined.types == Interaction.REFLECTION)[..., None]
    return np.where(mirror & (size > 0), turn / np.where(size > 0, size, 1.0), 0.0)


def image_moves(moved: Places, normals: Float64Array) -> tuple[Float64Array, Float64Array]:
    """How the vectors TX → image of RX and RX → image of TX [m] change, Shape ``[K, 3]`` each.

    A mirror with normal n that moves by o moves the image of a point that moves by x by
    x − 2n(n·x) + 2n(n·o): exact while the mirror does not turn.
    """
    depth = normals.shape[1]
    to_end, to_start = moved.end, moved.start
    for d in reversed(range(depth)):
        to_end = _mirrored(to_end, normals[:, d], moved.objects[:, d])
    for d in range(depth):
        to_start = _mirrored(to_start, normals[:, d], moved.objects[:, d])
    return to_end - moved.start, to_start - moved.end


def _mirrored(move: Float64Array, normal: Float64Array, mirror: Float64Array) -> Float64Array:
    across = ((mirror - move) * normal).sum(-1, keepdims=True)
    moved: Float64Array = move + 2 * across * normal
    return moved
