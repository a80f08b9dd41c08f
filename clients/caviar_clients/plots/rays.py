"""Shapes that maps and viewers draw: the paths of a channel, objects and scenery from above."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np

from caviar_protocol.arrays import BoolArray, Float64Array
from caviar_protocol.space.coordinates import rotation_matrix, unit_vectors
from caviar_protocol.space.scene import device_pose, object_pose
from caviar_protocol.topics import Channel, Scene
from caviar_protocol.topics.channel import Interaction
from caviar_space.ground import STEEP, Piece, ground_and_buildings

PATHS_OF_A_PAIR = 25
"""Paths of a pair that are drawn, the strongest ones: diffuse scattering makes thousands."""

RANGE_DB = 50.0
"""Paths weaker than the strongest by more than this have the last colour."""

# Cosine of the angle by which a straight path's directions may differ from the straight line.
_STRAIGHT = np.cos(np.radians(0.5))


@dataclass(frozen=True, eq=False)
class Rays:
    """Paths in the world; gains are those of the first carrier [dB].

    A path without interaction points is a line only if it leaves and arrives along the straight line
    between its ends. Otherwise, as with components that a statistical model draws, its route is
    unknown, and it has two ticks, one at either end.
    """

    lines: list[Float64Array]
    """Transmitter, points and receiver [m], Shape ``[N, 3]`` each."""
    gains: Float64Array
    """Shape ``[lines]``."""
    ends: Float64Array
    """Where ticks stand [m], Shape ``[T, 3]``."""
    towards: Float64Array
    """Directions of the ticks, unit vectors, Shape ``[T, 3]``."""
    tick_gains: Float64Array
    """Shape ``[T]``."""

    @property
    def all_gains(self) -> Float64Array:
        """Gains of lines and ticks [dB]."""
        return np.concatenate([self.gains, self.tick_gains])

    def ticks(self, length_m: float) -> Float64Array:
        """Compute both ends of each tick [m], Shape ``[T, 2, 3]``."""
        result: Float64Array = np.stack([self.ends, self.ends + length_m * self.towards], axis=1)
        return result


def rays(scene: Scene, channel: Channel | None) -> Rays:
    """Select the strongest paths of each pair whose devices are in the scene.

    Args:
        scene: Poses of the devices.
        channel: The paths; None: there are none.
    """
    lines: list[Float64Array] = []
    gains: list[float] = []
    ticks: list[Float64Array] = []
    tick_gains: list[float] = []
    if channel is not None and len(channel.carriers):
        places = {d.name: np.array(device_pose(scene, d).position) for d in scene.devices}
        # Of the first carrier that a pair uses: on others its amplitudes are 0.
        power = np.abs(channel.a[(channel.a != 0).argmax(0), np.arange(len(channel.tau))]) ** 2
        used = channel.interactions != Interaction.NONE
        leaving, coming = unit_vectors(channel.aod), unit_vectors(channel.aoa)
        for tx in channel.tx:
            for rx in channel.rx:
                if tx not in places or rx not in places:
                    continue
                start, end = places[tx], places[rx]
                pair = channel.pair(tx, rx)
                strongest = np.argsort(-power[pair], kind="stable")[:PATHS_OF_A_PAIR] + pair.start
                strongest = strongest[power[strongest] > 0]
                known = used[strongest].any(axis=1)
                known |= _straight(start, end, leaving[strongest], coming[strongest])
                for path, is_known in zip(strongest, known, strict=True):
                    gain = 10 * float(np.log10(power[path]))
                    if is_known:
                        lines.append(np.vstack([start, channel.points[path][used[path]], end]))
                        gains.append(gain)
                    else:
                        ticks += [np.stack([start, leaving[path]]), np.stack([end, coming[path]])]
                        tick_gains += [gain, gain]
    table = np.array(ticks).reshape(-1, 2, 3)
    return Rays(lines, np.array(gains), table[:, 0], table[:, 1], np.array(tick_gains))


def scale(gains: Float64Array) -> tuple[float, float]:
    """Choose the limits of the colours [dB] for paths of these gains, of which there is at least one."""
    # A little below the weakest: equal limits, as those of a single path, are no scale.
    top = float(gains.max())
    return max(float(gains.min()), top - RANGE_DB) - 1e-9, top


def _straight(
    start: Float64Array, end: Float64Array, leaving: Float64Array, coming: Float64Array
) -> BoolArray:
    """Find the paths that leave towards the other end and arrive from there, Shape ``[N]``."""
    line = end - start
    distance = float(np.linalg.norm(line))
    if distance == 0:
        return np.ones(len(leaving), np.bool_)
    line = line / distance
    result: BoolArray = (leaving @ line >= _STRAIGHT) & (coming @ -line >= _STRAIGHT)
    return result


View = tuple[tuple[float, float], tuple[float, float]]
"""Limits of x and of y [m]."""


def view_around(
    low: Float64Array,
    high: Float64Array,
    margin_m: float,
    least_m: float,
    shape: tuple[float, float],
    scale: float = 1.0,
) -> View:
    """Choose the limits of what lies between two corners.

    Args:
        low: Corner, x and y [m].
        high: The opposite corner.
        margin_m: Room beside it [m].
        least_m: Half the width and the height at least [m].
        shape: Least width and height, as shares of the greater of both: neither a tower nor a strip.
        scale: Of its size.
    """
    centre, half = (low + high) / 2, np.maximum((high - low) / 2 * scale + margin_m, least_m)
    half = np.maximum(half, half.max() * np.array(shape))
    (left, bottom), (right, top) = (centre - half).tolist(), (centre + half).tolist()
    return (left, right), (bottom, top)


OUTLINE = ((0.5, 0.5), (0.5, -0.5), (-0.5, -0.5), (-0.5, 0.5))
"""Corners of an object's box from above, of its length and width."""


def from_above(scene: Scene, points: Sequence[Sequence[float]]) -> Float64Array:
    """Place points on each object of a scene.

    Args:
        scene: The scene with N objects.
        points: x and y of each point on a box from −½ to ½.

    Returns:
        x and y in the world [m], Shape ``[N, len(points), 2]``.
    """
    found = np.zeros((len(scene.names), len(points), 2))
    for i in range(len(scene.names)):
        rotation = rotation_matrix(scene.orientation[i].tolist())[:2, :2]
        found[i] = scene.position[i, :2] + (np.array(points) * scene.dimensions[i, :2]) @ rotation.T
    return found


Box = tuple[Sequence[float], Sequence[float]]
"""Lowest and highest corner [m]."""


@dataclass(frozen=True, eq=False)
class Footprints:
    """Scenery as a map draws it, in world x and y [m]."""

    faces: Float64Array
    """Triangles to fill, Shape ``[F, 3, 2]``."""
    edges: Float64Array
    """Outlines, Shape ``[E, 2, 2]``."""


def footprints(meshes: Iterable[tuple[Path, Float64Array]]) -> Footprints:
    """Compute the footprints of PLY meshes; ground is left out.

    Args:
        meshes: File of each mesh, and its 4×4 transform into the world.
    """
    _, buildings = ground_and_buildings(meshes)
    return Footprints(
        faces=np.concatenate([_level(shape) for shape in buildings] or [np.zeros((0, 3, 2))]),
        edges=np.concatenate([_outline(shape) for shape in buildings] or [np.zeros((0, 2, 2))]),
    )


def with_boxes(drawn: Footprints | None, boxes: Sequence[Box]) -> Footprints:
    """Add the footprints of boxes along the world's axes.

    Args:
        drawn: Footprints of meshes; None: there are none.
        boxes: Lowest and highest corner of each box [m].

    Example:
        >>> with_boxes(None, [((0.0, 0.0, 0.0), (2.0, 1.0, 5.0))]).faces.shape
        (2, 3, 2)
    """
    corners = np.array([[[x0, y0], [x1, y0], [x1, y1], [x0, y1]] for (x0, y0, *_), (x1, y1, *_) in boxes])
    faces = corners[:, [[0, 1, 2], [0, 2, 3]]].reshape(-1, 3, 2)
    edges = np.stack([corners, np.roll(corners, -1, axis=1)], axis=2).reshape(-1, 2, 2)
    if drawn is not None:
        faces, edges = np.concatenate([drawn.faces, faces]), np.concatenate([drawn.edges, edges])
    return Footprints(faces=faces, edges=edges)


def obstacle_boxes(services: Any) -> list[Box]:
    """Find the boxes that block the channels of a scenario: their setting ``obstacles``.

    Args:
        services: Of the scenario as it was recorded, perhaps by another version: nothing about its form is
            certain.

    Example:
        >>> box = {"minimum_m": [0, 0, 0], "maximum_m": [2, 1, 5]}
        >>> obstacle_boxes({"channel": {"role": "channel", "settings": {"obstacles": [box]}}})
        [([0, 0, 0], [2, 1, 5])]
    """
    specs = [spec for spec in services.values() if isinstance(spec, dict)] if services else []
    found = [
        settings.get("obstacles", ())
        for spec in specs
        if spec.get("role") == "channel" and isinstance(settings := spec.get("settings"), dict)
    ]
    return [(box["minimum_m"], box["maximum_m"]) for boxes in found for box in boxes]


def lanes_of(net: Path, offset_m: Sequence[float], yaw_deg: float) -> list[Float64Array]:
    """Read the centre lines of the lanes of a SUMO network.

    Args:
        net: ``.net.xml``.
        offset_m: Place of the network's origin in the world [m].
        yaw_deg: What the network is turned by [°].

    Returns:
        Points in world x and y [m], Shape ``[P, 2]`` each.
    """
    turn = np.exp(1j * np.radians(yaw_deg))
    lanes = []
    for lane in ElementTree.parse(net).iter("lane"):  # noqa: S314 - a file of the user's
        points = [point.split(",") for point in lane.get("shape", "").split()]
        line = turn * np.array([complex(float(x), float(y)) for x, y, *_ in points])
        lanes.append(np.stack([line.real, line.imag], axis=-1) + np.asarray(offset_m[:2], float))
    return lanes


def covered_objects(scene: Scene, roofs: Iterable[Footprints]) -> Iterator[tuple[str, int]]:
    """Count the corners of each object's box that lie within footprints, from above.

    Args:
        scene: The objects.
        roofs: Footprints of buildings.

    Yields:
        Name, and number of the centre and the four corners that lie within.
    """
    faces = np.concatenate([np.zeros((0, 3, 2)), *(drawn.faces for drawn in roofs)])
    a, edges = faces, np.roll(faces, -1, axis=1) - faces
    low, high = faces.min(axis=1), faces.max(axis=1)
    unit = np.array([(0, 0, 0), (1, 1, 0), (1, -1, 0), (-1, 1, 0), (-1, -1, 0)]) / 2
    for i, name in enumerate(scene.names):
        pose = object_pose(scene, i)
        corners = (unit * scene.dimensions[i]) @ rotation_matrix(pose.orientation).T + np.array(pose.position)
        count = 0
        around = (low <= corners[:, :2].max(axis=0)) & (high >= corners[:, :2].min(axis=0))
        near = np.flatnonzero(around.all(axis=1))
        for x, y in corners[:, :2]:
            to = np.array((x, y)) - a[near]
            side = edges[near, :, 0] * to[..., 1] - edges[near, :, 1] * to[..., 0]
            count += bool(((side >= 0).all(axis=1) | (side <= 0).all(axis=1)).any())
        yield name, count


def _level(shape: Piece) -> Float64Array:
    faces: Float64Array = shape.corners[shape.steepness >= STEEP][..., :2]
    return faces


def _outline(shape: Piece) -> Float64Array:
    """Collect edges where the roof ends, and level edges of walls for buildings without a roof."""
    # An edge of one level face alone is where the roof ends; one of two faces is inside it.
    pairs = np.stack([shape.faces, np.roll(shape.faces, -1, axis=1)], axis=-1)
    ends = np.stack([shape.corners, np.roll(shape.corners, -1, axis=1)], axis=2)
    level = shape.steepness >= STEEP
    keys = np.sort(pairs[level].reshape(-1, 2), axis=1)
    _, first, times = np.unique(keys, axis=0, return_index=True, return_counts=True)
    border = ends[level].reshape(-1, 2, 3)[first[times == 1]]
    walls = ends[~level].reshape(-1, 2, 3)
    walls = walls[np.abs(walls[:, 0, 2] - walls[:, 1, 2]) < 0.05]
    outline: Float64Array = np.concatenate([border, walls])[..., :2]
    return outline
