"""Recorded users as arrays: what each of their beam pairs achieves in every frame, and what is observed.

A beam has no influence on the next channel, so that a recording tells what any choice would have achieved.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

import msgspec
import numpy as np
from numpy.typing import NDArray

from caviar_protocol.arrays import BoolArray, Float64Array, Int64Array, Payload
from caviar_protocol.errors import RecordingError, ScenarioError
from caviar_protocol.observations import Bounds, Moment, Observer, Place, Users, is_feedback
from caviar_protocol.recording import RecordedFrame, Recording
from caviar_protocol.scenario import DeviceSpec, Scenario
from caviar_protocol.scenario.schema import ServiceSpec, owned_by
from caviar_protocol.space.beams import straight_beams
from caviar_protocol.space.scene import Pair, directions
from caviar_protocol.topics import Channel, Scene
from caviar_services.link.base import User, channels_of
from caviar_services.link.beam_scores import sweep_users
from caviar_services.link.beams import BeamLinkSettings
from caviar_services.link.link_budget import LinkBudget

P = TypeVar("P", bound=Payload)


class NoProducts:
    """The products of a frame beside scene and link: none."""

    def payloads(self, topic: str, cls: type[P]) -> Mapping[str, P]:
        """None of any topic."""
        return {}


@dataclass(frozen=True)
class _OnePlace:
    """A scenario of one transmitter and one receiver: each user is observed by itself."""

    devices: Sequence[DeviceSpec]
    services: Mapping[str, ServiceSpec] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class Track:
    """One user in consecutive frames of a recorded episode."""

    recording: Path
    episode: int
    first: int
    """Number of its first frame."""
    user: tuple[str, str, str]
    """Transmitter, receiver and carrier."""
    rows: slice
    """Its frames in the arrays of `Tracks`."""

    def __len__(self) -> int:
        return self.rows.stop - self.rows.start  # type: ignore[no-any-return]  # a slice is of anything


@dataclass(frozen=True, eq=False)
class Tracks:
    """All users of some recordings; F frames of all tracks, one after the other.

    Example:
        >>> tracks = read_tracks(["runs/smoke-20261122-101500"], ("aod", "last_beam"), users="uav/*")
        >>> len(tracks.tracks), tracks.swept.shape, sorted(tracks.seen)
        (1, (100, 32), ['aod'])
    """

    tracks: tuple[Track, ...]
    scenario: Scenario
    """Of the first recording."""
    users: Users
    """The one place that each user has when it is observed by itself."""
    pair: Pair
    """Stands for all: they have the same arrays."""
    scene: Scene
    """Of the first frame."""
    bounds: Mapping[str, Bounds]
    """Of each part that is observed."""
    feedback: Observer
    """Reads the parts that depend on the beams of the frame before."""
    settings: BeamLinkSettings
    """Of the first recording's link."""
    seen: Mapping[str, NDArray[Any]]
    """The other parts, Shape ``[F, …]``."""
    swept: Float64Array
    """|y| of each beam pair by its index, Shape ``[F, Nt·Nr]``; zeros without a path."""
    straight: Int64Array
    """Index of the pair along the straight line, Shape ``[F]``."""
    has_path: BoolArray
    """Shape ``[F]``."""
    los: BoolArray
    """Shape ``[F]``."""
    power_over_noise: Float64Array
    """SNR of |y| = 1, Shape ``[F]``."""
    number: Int64Array
    """Of the frame, Shape ``[F]``."""
    t_ns: Int64Array
    """[ns], Shape ``[F]``."""

    @property
    def place(self) -> Place:
        """The arrays of both ends."""
        return self.users.places[0]

    def rms(self) -> Float64Array:
        """Root mean square of the entries of H, Shape ``[F]``; 1 without a path.

        The beams of both ends are unitary transforms: all |y|² together are all |h|² together.
        """
        mean: Float64Array = np.sqrt(np.mean(self.swept**2, axis=1))
        return np.where(mean > 0, mean, 1.0)


def read_tracks(
    recordings: Sequence[Path | str],
    observe: Sequence[str],
    users: str | Sequence[str] = "*",
    carrier: str | None = None,
) -> Tracks:
    """Read the users of recordings.

    Args:
        recordings: Directories of runs that recorded topics ``scene`` and ``channel``, with part ``h``.
        observe: Parts of the observation, as in `caviar_protocol.observations.OBSERVATION_PARTS`;
            none of sensors.
        users: Receivers, as names with ``*`` and ``?``.
        carrier: By its name; None: the first.

    Raises:
        ScenarioError: A part does not exist, or no user is of this name.
        RecordingError: A recording lacks a topic, or users have other arrays than those before.
    """
    patterns = (users,) if isinstance(users, str) else tuple(users)
    made = _Reader(tuple(observe), patterns, carrier)
    for path in recordings:
        made.read(Path(path))
    return made.tracks(recordings)


@dataclass
class _Rows:
    """Rows of a track, frame by frame."""

    track: Track
    last: int
    columns: dict[str, list[Any]]


class _Reader:
    """Reads frame after frame; a track begins where a user comes."""

    def __init__(self, observe: tuple[str, ...], patterns: tuple[str, ...], carrier: str | None) -> None:
        self._observe, self._patterns, self._carrier = observe, patterns, carrier
        self._static = tuple(name for name in observe if not is_feedback(name))
        self._scenario: Scenario | None = None
        self._pair: Pair | None = None
        self._scene: Scene | None = None
        self._users: Users | None = None
        self._observer: Observer | None = None
        self._found: list[_Rows] = []
        self._open: dict[tuple[str, str, str], _Rows] = {}

    def read(self, path: Path) -> None:
        recording = Recording(path)
        scenario = msgspec.convert(recording.metadata.scenario, Scenario)
        self._scenario = self._scenario or scenario
        settings, episode = link_settings(scenario), -1
        for frame in recording.frames():
            if frame.episode != episode:
                episode = frame.episode
                self._open.clear()
            self._frame(path, frame, settings)
        self._open.clear()

    def _frame(self, path: Path, frame: RecordedFrame, settings: BeamLinkSettings) -> None:
        scene, products = frame.scene(), frame.payloads("channel", Channel)
        if scene is None or not products:
            raise RecordingError(
                f"{path} has no scene or no channel in frame {frame.number}: write record = "
                '["scene", "channel"] below [run] of its scenario, and run it again'
            )
        channel = next(iter(products.values()))
        self._scene = self._scene or scene
        figure, temperature = settings.noise_figure_db, settings.temperature_k
        budget = LinkBudget.for_scene(scene, channel.carriers, figure, temperature)
        channels = channels_of(channel, budget.users)
        swept = dict[int, Float64Array]()
        for group in sweep_users(budget.users, channels.h):
            swept.update(zip(group.users, group.abs_y, strict=True))
        towards_rx, towards_tx = directions(scene, budget.users)
        for u, user in self._wanted(budget.users, channel):
            observer = self._observing(user, path)
            shape = user.beam_pairs
            sent, taken = straight_beams(user.tx.array, towards_rx[u], user.rx.array, towards_tx[u])
            moment = Moment(NoProducts(), scene, None, ((0, user),))
            self._append(
                path, frame, user,
                {
                    "swept": swept[u].reshape(-1) if u in swept else np.zeros(shape),
                    "straight": sent * user.beams[1] + taken,
                    "has_path": channels.has_path[u],
                    "los": channels.los[u],
                    "power_over_noise": budget.power_over_noise[u],
                    "number": frame.number,
                    "t_ns": frame.t_ns,
                    **observer.read(moment),
                },
            )  # fmt: skip

    def _wanted(self, users: Sequence[User], channel: Channel) -> Iterator[tuple[int, User]]:
        carrier = self._carrier or channel.carriers[0].name
        for u, user in enumerate(users):
            if user.carrier.name == carrier and owned_by(self._patterns, user.rx.name):
                yield u, user

    def _observing(self, user: User, path: Path) -> Observer:
        """Observer of one user; made at the first one, whose arrays the others have."""
        if self._observer is None or self._pair is None:
            self._pair = user
            known = _OnePlace((_device(user.tx, "tx"), _device(user.rx, "rx")))
            self._users = Users(known, ("*",))
            self._observer = Observer(known, self._users, self._static)
            if self._observer.inputs:
                raise ScenarioError(
                    f"observe={self._observe!r}: of a recording positions, directions and what the link fed "
                    "back are observed, and nothing of sensors"
                )
        if (user.tx.array, user.rx.array) != (self._pair.tx.array, self._pair.rx.array):
            raise RecordingError(
                f"{path}: the arrays of {user} are not those of {self._pair.tx.name} → {self._pair.rx.name}; "
                "a policy chooses of one codebook: name receivers that have the same"
            )
        return self._observer

    def _append(self, path: Path, frame: RecordedFrame, user: User, row: Mapping[str, Any]) -> None:
        key = (user.tx.name, user.rx.name, user.carrier.name)
        rows = self._open.get(key)
        if rows is None or rows.last != frame.number - 1:
            track = Track(path, frame.episode, frame.number, key, slice(0, 0))
            rows = self._open[key] = _Rows(track, frame.number, {name: [] for name in row})
            self._found.append(rows)
        rows.last = frame.number
        for name, value in row.items():
            rows.columns[name].append(value)

    def tracks(self, recordings: Sequence[Path | str]) -> Tracks:
        if self._scenario is None or self._pair is None or self._users is None or self._scene is None:
            where = ", ".join(map(str, recordings)) or "no recording"
            on = "" if self._carrier is None else f" on carrier {self._carrier!r}"
            raise ScenarioError(f"no receiver of {where} is {' or '.join(self._patterns)}{on}; name others")
        columns = {
            name: np.array([v for rows in self._found for v in rows.columns[name]])
            for name in self._found[0].columns
        }
        tracks, first = [], 0
        for rows in self._found:
            last = first + len(rows.columns["number"])
            of = rows.track
            tracks.append(Track(of.recording, of.episode, of.first, of.user, slice(first, last)))
            first = last
        known = _OnePlace((_device(self._pair.tx, "tx"), _device(self._pair.rx, "rx")))
        everything = Observer(known, self._users, self._observe)
        return Tracks(
            tracks=tuple(tracks),
            scenario=self._scenario,
            users=self._users,
            pair=self._pair,
            scene=self._scene,
            bounds=everything.bounds,
            feedback=Observer(known, self._users, [n for n in self._observe if is_feedback(n)]),
            settings=link_settings(self._scenario),
            seen={name: columns.pop(name) for name in self._static},
            **columns,
        )


def link_settings(scenario: Scenario) -> BeamLinkSettings:
    """Settings of the scenario's link ``beams``; the default ones of another."""
    found = (
        spec.settings for spec in scenario.services.values() if (spec.role, spec.use) == ("link", "beams")
    )
    return msgspec.convert(next(found, {}), BeamLinkSettings)


def _device(device: Any, role: Any) -> DeviceSpec:
    return DeviceSpec(name=device.name.rpartition("/")[2], kind="antenna", role=role, array=device.array)
