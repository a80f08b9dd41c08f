"""Data of the page of a dataset: users of the catalogue, times of episodes, a sample of recordings."""

from __future__ import annotations

import random
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from datetime import datetime
from functools import partial
from typing import Annotated, Any

import msgspec
import numpy as np

from caviar_clients.datasets.catalogue import Catalogue
from caviar_clients.datasets.reader import Dataset
from caviar_clients.datasets.rows import UserRow, whole_recording
from caviar_clients.datasets.texts import time_text
from caviar_clients.datasets.user_rows import Columns
from caviar_clients.plots.rays import OUTLINE, Footprints, from_above
from caviar_clients.plots.sensors import object_colours
from caviar_protocol.arrays import BoolArray, Float64Array, Int64Array, UInt8Array
from caviar_protocol.errors import RecordingError
from caviar_protocol.recording import RecordedFrame, Recording
from caviar_protocol.space.scene import antennas, device_pose
from caviar_protocol.topics import Camera, Channel, Depth, Lidar, LidarScan, Scene, Segmentation

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
        """Mask of the users that have a position."""
        return np.isfinite(self.x) & np.isfinite(self.y)


_USER_COLUMNS = (
    "x_m", "y_m", "valid", "los", "paths", "gain_db", "delay_spread_s", "tx_beam", "rx_beam", "carrier", "tx",
)  # fmt: skip


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

    def arrays_of(found: list[Any]) -> list[Any]:
        columns = Columns.of_rows(UserRow, _USER_COLUMNS, found)
        *numbers, carrier, tx = columns.values()
        return [*numbers, np.array([groups[pair] for pair in zip(carrier, tx, strict=True)], dtype=int)]

    together = max(1, _ROWS_AT_ONCE * len(episodes) // max(rows, 1))
    parts = [arrays_of([])]
    for start in range(0, len(episodes), together):
        wanted = episodes[start : start + together]
        _, found = catalogue.query(
            f"SELECT {', '.join(_USER_COLUMNS)} FROM users WHERE episode BETWEEN ? AND ?",  # noqa: S608 - our own
            (wanted[0], wanted[-1]),
        )
        parts.append(arrays_of(found))
        progress("users of the catalogue", min(start + together, len(episodes)), len(episodes))
    return UserColumns(tuple(pairs), *map(np.concatenate, zip(*parts, strict=True)))


# --- a sample of the recordings --------------------------------------------------------------------------

AZIMUTH_EDGES = np.linspace(-180.0, 180.0, 181)
ZENITH_EDGES = np.linspace(0.0, 180.0, 181)
"""Limits of the classes of angles [°]."""


def _angle_counts(angles: Float64Array) -> Int64Array:
    """Count directions (zenith and azimuth [rad], Shape ``[P, 2]``) by class, Shape ``[2, 180]``."""
    zenith, azimuth = np.degrees(angles).T
    return np.stack(
        [
            np.histogram(zenith, ZENITH_EDGES)[0],
            np.histogram((azimuth + 180.0) % 360.0 - 180.0, AZIMUTH_EDGES)[0],
        ]
    )


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
    """Pictures of one camera at one instant."""

    sensor: str
    moment: str
    images: dict[str, UInt8Array]
    """Picture by kind: ``picture``, ``depth``, ``objects``."""


@dataclass
class Sample:
    """Numbers of some recordings.

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
    angles: Int64Array = field(default_factory=lambda: np.zeros((4, 2, 180), dtype=np.int64))
    """Counts of directions: at departure and arrival of all paths, then of the strongest path of each user;
    each by class of zenith and of azimuth, Shape ``[4, 2, 180]``."""
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
        """Number of episodes that were read."""
        return len(self.episodes) - len(self.left_out)

    def add(self, other: Sample) -> None:
        """Add what was read of an episode."""
        self.scenes += other.scenes
        self.cut |= other.cut
        self.paths += other.paths
        self.angles += other.angles
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
            recording = whole_recording(partial(data.episode, number))
            _read_episode(part, recording, topics, at, scans=len(sample.scans))
            sample.add(part)
        except RecordingError as error:
            sample.left_out.append((number, str(error)))
        progress("sample of the recordings", at + 1, len(numbers))
    return sample


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
    best = []
    for tx in channel.tx:
        for rx in channel.rx:
            pair = channel.pair(tx, rx)
            if tx != rx and power[pair].any():
                best.append(pair.start + int(power[pair].argmax()))
    ends = channel.aod[some], channel.aoa[some], channel.aod[best], channel.aoa[best]
    sample.angles += np.stack(list(map(_angle_counts, ends)))


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


# --- times of the generation -----------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Throughput:
    """Speed of the generation: scenes per second over time, and the time of each service."""

    edges_s: Float64Array
    """Limits of the intervals, from the first episode, interruptions left out [s], Shape ``[N + 1]``."""
    rate: Float64Array
    """Scenes per second, Shape ``[N]``."""
    interruptions_s: tuple[float, ...]
    """Where nothing was played for long, on the same axis [s]."""
    scenes: int
    """Of the episodes whose times are known."""
    episodes: int
    busy_s: float
    """Wall time of the episodes, added up: with two workers two seconds pass in one [s]."""
    services_s: Mapping[str, float]
    """Wall time of each service, added up; what is left of ``busy_s`` is start, reset and saving [s]."""
    hosts: int
    processes: int

    @property
    def elapsed_s(self) -> float:
        """Without interruptions [s]."""
        return float(self.edges_s[-1])


INTERVALS = 60
_INTERRUPTION_S = 60.0


def read_throughput(catalogue: Catalogue) -> Throughput | None:
    """Read how fast the episodes were played; None where no times are known."""
    _, rows = catalogue.query(
        "SELECT t.started, t.wall_s, t.host, t.pid, t.detail, e.scenes FROM timings t JOIN episodes e "
        "USING (episode) WHERE t.started IS NOT NULL AND t.wall_s > 0"
    )
    if not rows:
        return None
    started, wall, hosts, pids, details, scenes = zip(*rows, strict=True)
    begin = np.array([_instant(catalogue, text) for text in started])
    walls, counts = np.array(wall), np.array(scenes, dtype=float)
    begin, interruptions = _without_interruptions(begin, walls)
    # Intervals are of two episodes or more each, unless there are few.
    intervals = min(INTERVALS, max(len(rows) // 2, min(len(rows), 10)))
    edges = np.linspace(0.0, float((begin + walls).max()), intervals + 1)
    # Scenes of an episode are spread evenly over its time.
    played = [float((counts * np.clip((edge - begin) / walls, 0.0, 1.0)).sum()) for edge in edges]
    services: dict[str, float] = {}
    for detail in details:
        for name, seconds in _services_s(catalogue, detail).items():
            services[name] = services.get(name, 0.0) + seconds
    return Throughput(
        edges_s=edges,
        rate=np.diff(played) / np.diff(edges),
        interruptions_s=interruptions,
        scenes=int(counts.sum()),
        episodes=len(rows),
        busy_s=float(walls.sum()),
        services_s=services,
        hosts=len(set(hosts)),
        processes=len(set(zip(hosts, pids, strict=True))),
    )


def _instant(catalogue: Catalogue, text: str) -> float:
    """Seconds since 1970 of a time of the table of times."""
    try:
        return datetime.fromisoformat(text).timestamp()
    except (ValueError, OverflowError) as error:
        raise RecordingError(
            f"{catalogue.path}: timings.started is {text!r:.80}, no time of ISO 8601"
        ) from error


class _Detail(msgspec.Struct):
    services_s: dict[str, Annotated[float, msgspec.Meta(ge=0)]] = {}


def _services_s(catalogue: Catalogue, text: str | None) -> dict[str, float]:
    """Wall time of each service by the table of times [s]."""
    try:
        return msgspec.json.decode(text or "{}", type=_Detail).services_s
    except (msgspec.MsgspecError, UnicodeError) as error:
        raise RecordingError(f"{catalogue.path}: timings.detail is {text!r:.80}: {error}") from error


def _without_interruptions(begin: Float64Array, wall: Float64Array) -> tuple[Float64Array, tuple[float, ...]]:
    """Times from the first one, moved together where nothing was played for long, and where that was."""
    longest = max(_INTERRUPTION_S, 10.0 * float(np.median(wall)))
    order = np.argsort(begin, kind="stable")
    moved, cut, busy_until, places = np.zeros(len(begin)), float(begin[order[0]]), -np.inf, list[float]()
    for at in order:
        if begin[at] - busy_until > longest and np.isfinite(busy_until):
            cut += float(begin[at] - busy_until)
            places.append(float(begin[at]) - cut)
        moved[at] = begin[at] - cut
        busy_until = max(busy_until, float(begin[at] + wall[at]))
    return moved, tuple(places)


@dataclass(frozen=True, eq=False)
class Content:
    """Data of all sections of a page."""

    data: Dataset
    catalogue: Catalogue
    topics: set[str]
    users: UserColumns
    sample: Sample
    footprints: Footprints | None
    scenery_error: str
