"""What ``caviar dataset look`` shows of a dataset: users of the catalogue, times, a sample of recordings."""

from __future__ import annotations

import random
import warnings
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from caviar_clients.datasets.catalogue import Catalogue
from caviar_clients.datasets.look.units import time_text
from caviar_clients.datasets.reader import Dataset
from caviar_clients.plots.rays import Footprints
from caviar_clients.plots.sensors import object_colours
from caviar_protocol.arrays import BoolArray, Float64Array, Int64Array, UInt8Array
from caviar_protocol.errors import RecordingError
from caviar_protocol.recording import RecordedFrame, Recording
from caviar_protocol.space.scene import antennas, device_pose
from caviar_protocol.topics import (
    Camera,
    Channel,
    Depth,
    Lidar,
    LidarScan,
    Scene,
    Segmentation,
)

Progress = Callable[[str, int, int], None]
"""``progress(what, done, of)``: how far a part of the work is."""

SAMPLE_EPISODES, SAMPLE_SCENES = 40, 50
"""Recorded arrays are read of so many episodes at most, and of the first so many scenes of each."""

LAGS = 10
"""Scenes of an episode are compared with so many before them."""

SCANS, PICTURED_EPISODES, CAMERAS = 3, 2, 4
"""LIDAR scans that are drawn, episodes of which pictures are, and cameras of each."""

PICTURE_PX = 640
"""Width of a picture at most [pixels]; of larger ones each second or third pixel is shown."""

MOST_TRANSMITTERS = 2000
"""Places of transmitters that are kept."""

_ROWS_AT_ONCE = 200_000
"""Rows of the catalogue that are read at once, about: each takes 1 kB until it is in an array."""


# --- users of the catalogue ------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class UserColumns:
    """Users of all scenes, a row each: numbers of the catalogue, NaN or −1 where there is none."""

    groups: tuple[tuple[str, str], ...]
    """(carrier, transmitter)"""
    x: Float64Array
    """[m]"""
    y: Float64Array
    valid: BoolArray
    """Whether a path reaches it."""
    los: BoolArray
    paths: Int64Array
    gain_db: Float64Array
    spread_s: Float64Array
    tx_beam: Int64Array
    rx_beam: Int64Array
    group: Int64Array
    """Index into ``groups``."""

    def __len__(self) -> int:
        return len(self.x)

    @property
    def placed(self) -> BoolArray:
        """Which of them have a position."""
        return np.isfinite(self.x) & np.isfinite(self.y)


_USER_COLUMNS: dict[str, Any] = {
    "x_m": float, "y_m": float, "valid": bool, "los": bool, "paths": int, "gain_db": float,
    "delay_spread_s": float, "tx_beam": int, "rx_beam": int,
}  # fmt: skip


def read_users(catalogue: Catalogue, progress: Progress) -> UserColumns:
    """Read the users of all episodes, in parts, so that a large catalogue takes the memory of its numbers.

    Args:
        catalogue: Of the dataset.
        progress: Is told of the parts.
    """
    episodes = catalogue.episodes()
    _, ((rows,),) = catalogue.query("SELECT count(*) FROM users")
    _, pairs = catalogue.query("SELECT DISTINCT carrier, tx FROM users ORDER BY carrier, tx")
    groups = {pair: at for at, pair in enumerate(pairs)}
    together = max(1, _ROWS_AT_ONCE * len(episodes) // max(rows, 1))
    names = ", ".join(_USER_COLUMNS)
    parts: list[list[Any]] = [[] for _ in range(len(_USER_COLUMNS) + 1)]
    for start in range(0, len(episodes), together):
        wanted = episodes[start : start + together]
        _, found = catalogue.query(
            f"SELECT {names}, carrier, tx FROM users WHERE episode BETWEEN ? AND ?",  # noqa: S608 - our own
            (wanted[0], wanted[-1]),
        )
        if found:
            *columns, carrier, tx = zip(*found, strict=True)
            for part, values, kind in zip(parts, columns, _USER_COLUMNS.values(), strict=False):
                given = [-1 if value is None else value for value in values] if kind is int else values
                part.append(np.array(given, dtype=kind))
            parts[-1].append(np.array([groups[pair] for pair in zip(carrier, tx, strict=True)], dtype=int))
        progress("users of the catalogue", min(start + together, len(episodes)), len(episodes))
    kinds = (*_USER_COLUMNS.values(), int)
    arrays: list[Any] = [
        np.concatenate(part or [np.zeros(0, kind)]) for part, kind in zip(parts, kinds, strict=True)
    ]
    return UserColumns(tuple(pairs), *arrays)


# --- a sample of the recordings --------------------------------------------------------------------------

AZIMUTH_EDGES = np.linspace(-180.0, 180.0, 181)
ZENITH_EDGES = np.linspace(0.0, 180.0, 181)
"""Limits of the classes of angles [°]."""


@dataclass
class Angles:
    """How often directions occur, at one end of the paths: counts by class, zenith and azimuth."""

    zenith: Int64Array = field(default_factory=lambda: np.zeros(len(ZENITH_EDGES) - 1, dtype=np.int64))
    azimuth: Int64Array = field(default_factory=lambda: np.zeros(len(AZIMUTH_EDGES) - 1, dtype=np.int64))

    def add(self, angles: Float64Array) -> None:
        """Count directions.

        Args:
            angles: Zenith and azimuth [rad], Shape ``[P, 2]``.
        """
        degrees = np.degrees(angles)
        self.zenith += np.histogram(degrees[:, 0], ZENITH_EDGES)[0]
        self.azimuth += np.histogram((degrees[:, 1] + 180.0) % 360.0 - 180.0, AZIMUTH_EDGES)[0]


@dataclass(frozen=True, eq=False)
class Scan:
    """A LIDAR scan from above."""

    title: str
    points: Float64Array
    """x, y, z in the world [m], Shape ``[N, 3]``."""
    grid: tuple[Float64Array, tuple[float, float, float, float]] | None
    """Cells from above, Shape ``[y, x]``: 0 free, 1 obstacle, −1 transmitter, −2 receiver; and lowest and
    highest x, lowest and highest y [m]. None: the points are shown."""
    position: tuple[float, float]
    boxes: Float64Array
    """Objects of the scene from above [m], Shape ``[N, 4, 2]``."""


@dataclass(frozen=True, eq=False)
class Shot:
    """What one camera saw at one instant."""

    sensor: str
    moment: str
    images: dict[str, UInt8Array]
    """Picture by kind: ``picture``, ``depth``, ``objects``."""


@dataclass
class Sample:
    """What was read of some recordings.

    Args:
        episodes: Numbers of the episodes.
        there: Of how many they are drawn.
    """

    episodes: tuple[int, ...]
    there: int
    left_out: list[tuple[int, str]] = field(default_factory=list)
    """Episodes of these whose recordings cannot be read, and why; nothing of them is in what follows."""
    scenes: int = 0
    cut: bool = False
    """Whether the episodes have more scenes than were read."""
    paths: int = 0
    departure: Angles = field(default_factory=Angles)
    arrival: Angles = field(default_factory=Angles)
    strongest_departure: Angles = field(default_factory=Angles)
    """Of the strongest path of each user only."""
    strongest_arrival: Angles = field(default_factory=Angles)
    has_h: bool = False
    apart_s: list[float] = field(default_factory=list)
    """Time between two scenes [s], of which ``correlation`` is."""
    correlation: list[float] = field(default_factory=list)
    consecutive: list[bool] = field(default_factory=list)
    """Whether the scenes follow one another."""
    transmitters: set[tuple[float, float]] = field(default_factory=set)
    """Where they are in the sample [m], to 0.1 m."""
    scans: list[Scan] = field(default_factory=list)
    shots: list[Shot] = field(default_factory=list)

    @property
    def read(self) -> int:
        """How many episodes were read."""
        return len(self.episodes) - len(self.left_out)

    def add(self, other: Sample) -> None:
        """Add what was read of an episode."""
        self.scenes += other.scenes
        self.cut |= other.cut
        self.paths += other.paths
        for name in ("departure", "arrival", "strongest_departure", "strongest_arrival"):
            counts, more = getattr(self, name), getattr(other, name)
            counts.zenith += more.zenith
            counts.azimuth += more.azimuth
        self.has_h |= other.has_h
        self.apart_s += other.apart_s
        self.correlation += other.correlation
        self.consecutive += other.consecutive
        self.transmitters |= set(sorted(other.transmitters)[: MOST_TRANSMITTERS - len(self.transmitters)])
        self.scans += other.scans
        self.shots += other.shots


def read_sample(data: Dataset, topics: set[str], progress: Progress) -> Sample:
    """Read recorded arrays of a seeded sample of the episodes; one that is damaged is left out as a whole.

    Args:
        data: The dataset.
        topics: Which it has.
        progress: Is told of the episodes.
    """
    there = numbers = data.finished()
    if len(there) > SAMPLE_EPISODES:
        numbers = sorted(random.Random(0).sample(numbers, SAMPLE_EPISODES))  # noqa: S311 - no secret
    sample = Sample(tuple(numbers), there=len(there))
    for at, number in enumerate(numbers):
        part = Sample((number,), there=1)
        try:
            _read_episode(part, _whole(data, number), topics, at, scans=len(sample.scans))
            sample.add(part)
        except RecordingError as error:
            sample.left_out.append((number, str(error)))
        progress("sample of the recordings", at + 1, len(numbers))
    return sample


def _whole(data: Dataset, number: int) -> Recording:
    """The recording of an episode, without a gap."""
    with warnings.catch_warnings(action="ignore"):  # of damage, which is the error
        recording = data.episode(number)
    if recording.damage or not recording.complete:
        raise RecordingError(recording.damage[0] if recording.damage else f"{recording.path} breaks off")
    return recording


def _read_episode(part: Sample, recording: Recording, topics: set[str], at: int, scans: int) -> None:
    """Read the first scenes of an episode, which is the ``at``-th of the sample."""
    part.cut = len(recording) > SAMPLE_SCENES
    before = deque[tuple[int, dict[Any, Any]]](maxlen=LAGS)
    scanned = scans >= SCANS or "lidar" not in topics
    pictured = at >= PICTURED_EPISODES or not topics & {"camera", "depth", "segmentation"}
    length = min(len(recording), SAMPLE_SCENES)
    # Not always the first scene: episodes may begin alike.
    scan_from, picture_from = length * scans // SCANS, length * at // PICTURED_EPISODES
    for place, frame in zip(range(length), recording.frames(), strict=False):
        part.scenes += 1
        scene = frame.scene()
        if scene is not None:
            _add_transmitters(part, scene)
        for channel in frame.payloads("channel", Channel).values() if "channel" in topics else ():
            _add_angles(part, channel)
            _add_correlation(part, frame.t_ns, channel, before)
        if not scanned and place >= scan_from:
            scanned = _add_scan(part, frame, scene)
        if not pictured and place >= picture_from:
            pictured = _add_shots(part, frame, scene)


def _add_transmitters(sample: Sample, scene: Scene) -> None:
    for device in antennas(scene, "tx"):
        x, y, _ = device_pose(scene, device).position
        if len(sample.transmitters) < MOST_TRANSMITTERS:
            sample.transmitters.add((round(x, 1), round(y, 1)))


def _add_angles(sample: Sample, channel: Channel) -> None:
    power = (np.abs(channel.a) ** 2).sum(axis=0)
    some = power > 0.0
    sample.paths += int(some.sum())
    sample.departure.add(channel.aod[some])
    sample.arrival.add(channel.aoa[some])
    best = []
    for tx in channel.tx:
        for rx in channel.rx:
            pair = channel.pair(tx, rx)
            if tx != rx and power[pair].any():
                best.append(pair.start + int(power[pair].argmax()))
    sample.strongest_departure.add(channel.aod[best])
    sample.strongest_arrival.add(channel.aoa[best])


def _add_correlation(
    sample: Sample, t_ns: int, channel: Channel, before: deque[tuple[int, dict[Any, Any]]]
) -> None:
    """Compare the matrix of each user with those of the scenes before."""
    now = {}
    for item in channel.h:
        norm = float(np.linalg.norm(item.h))
        if norm > 0.0:
            user = channel.carriers[item.carrier].name, channel.tx[item.tx], channel.rx[item.rx]
            now[user] = item.h / norm
    sample.has_h |= bool(channel.h)
    for age, (earlier_ns, earlier) in enumerate(reversed(before)):
        for user, h in now.items():
            other = earlier.get(user)
            if other is not None and other.shape == h.shape:
                sample.apart_s.append((t_ns - earlier_ns) * 1e-9)
                sample.correlation.append(min(float(np.abs(np.vdot(other, h))), 1.0))
                sample.consecutive.append(age == 0)
    before.append((t_ns, now))


def _add_scan(sample: Sample, frame: RecordedFrame, scene: Scene | None) -> bool:
    from caviar_clients.plots.rays import OUTLINE, from_above

    for lidar in frame.payloads("lidar", Lidar).values():
        for scan in lidar.scans:
            if not len(scan.range) and scan.grid is None:
                continue
            boxes = from_above(scene, OUTLINE) if scene is not None else np.zeros((0, 4, 2))
            points = np.array(scan.in_world(), dtype=np.float64).reshape(-1, 3)
            x, y, _ = scan.position
            title = f"{scan.sensor}\n{_moment(frame)}"
            sample.scans.append(Scan(title, points, _grid(scan), (x, y), boxes))
            return True
    return False


def _grid(scan: LidarScan) -> tuple[Float64Array, tuple[float, float, float, float]] | None:
    if scan.grid is None:
        return None
    cells = np.asarray(scan.grid.occupancy)
    above = np.where((cells < 0).any(axis=2), cells.min(axis=2), cells.max(axis=2))
    (x, y, _), (dx, dy, _) = scan.grid.origin, scan.grid.cell
    columns, rows = above.shape
    extent = (x - dx / 2, x + (columns - 0.5) * dx, y - dy / 2, y + (rows - 0.5) * dy)
    return above.T.astype(np.float64), extent


def _add_shots(sample: Sample, frame: RecordedFrame, scene: Scene | None) -> bool:
    images: dict[str, dict[str, UInt8Array]] = {}
    for camera in frame.payloads("camera", Camera).values():
        for seen in camera.images:
            images.setdefault(seen.sensor, {})["picture"] = np.array(_smaller(seen.rgb))
    for depth in frame.payloads("depth", Depth).values():
        for distances in depth.images:
            images.setdefault(distances.sensor, {})["depth"] = _depth_picture(_smaller(distances.depth))
    moving = frozenset(scene.names) if scene is not None else frozenset[str]()
    for segmentation in frame.payloads("segmentation", Segmentation).values():
        colours = np.vstack([object_colours(segmentation.object_names, moving), np.ones((1, 3))])
        for ids in segmentation.images:
            picture = np.round(255.0 * colours[_smaller(ids.object)]).astype(np.uint8)
            images.setdefault(ids.sensor, {})["objects"] = picture
    # A camera that stands still before those on objects, which are called after them.
    for sensor in sorted(images, key=lambda name: ("/" in name, name))[:CAMERAS]:
        sample.shots.append(Shot(sensor, _moment(frame), images[sensor]))
    return bool(images)


def _smaller(image: Any) -> Any:
    step = -(-image.shape[1] // PICTURE_PX)
    return image[::step, ::step]


def _depth_picture(depth: Any) -> UInt8Array:
    """Depth as brightness, near is bright, on a logarithmic scale; black where nothing was hit."""
    hit = depth > 0.0
    near, far = np.percentile(depth[hit], [0.1, 99.9]) if hit.any() else (1.0, 10.0)
    share = np.log(np.where(hit, depth, far) / near) / max(float(np.log(far / near)), 1e-6)
    level = np.where(hit, 235.0 - 195.0 * np.clip(share, 0.0, 1.0), 0.0)
    return np.repeat(np.round(level).astype(np.uint8)[..., None], 3, axis=2)


def _moment(frame: RecordedFrame) -> str:
    return f"episode {frame.episode}, scene {frame.number}, t = {time_text(frame.t_ns * 1e-9)}"


@dataclass(frozen=True, eq=False)
class Content:
    """All that the sections are made of."""

    data: Dataset
    catalogue: Catalogue
    topics: set[str]
    users: UserColumns
    sample: Sample
    footprints: Footprints | None
    scenery_error: str
