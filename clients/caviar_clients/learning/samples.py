"""Samples of a dataset for supervised learning: what a policy observes in each scene, and what each of the
beam pairs of every user achieves there.

Scenes are read with the code of environments and agents (`caviar_protocol.observations`), all places at once:
a policy sees the same numbers here and in a run of the dataset's scenario.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple, cast

import msgspec
import numpy as np
from numpy.typing import NDArray

from caviar_clients.datasets.reader import Dataset
from caviar_clients.datasets.settings import fingerprint
from caviar_clients.files import writing
from caviar_clients.learning.checkpoints import locked
from caviar_clients.learning.tracks import link_settings
from caviar_protocol.arrays import BoolArray, Float32Array, Float64Array, Int64Array
from caviar_protocol.errors import RecordingError, ScenarioError, suggestion
from caviar_protocol.observations import Moment, Observer, Users
from caviar_protocol.recording import RecordedFrame
from caviar_protocol.scenario import Scenario
from caviar_protocol.space.beams import best_pairs, straight_beams
from caviar_protocol.space.codebooks import beam_count
from caviar_protocol.space.scene import device_pose, directions
from caviar_protocol.topics import AntennaArray, Channel, Link
from caviar_services.link.base import channels_of
from caviar_services.link.beam_scores import sweep_users
from caviar_services.link.link_budget import LinkBudget

Report = Callable[[float], None]
"""Called with the share of the scenes that have been read."""


class Selection(NamedTuple):
    """Users of a dataset that are samples."""

    users: tuple[str, ...] = ("*",)
    """Receivers, as names with ``*`` and ``?``."""
    transmitters: tuple[str, ...] = ("*",)
    """Likewise."""
    carrier: str = ""
    """Empty: the first of the scenario."""


EVERYONE = Selection()
"""All receivers of all transmitters."""


@dataclass(frozen=True, eq=False)
class Samples:
    """N users in S scenes of a dataset, with P = Nt·Nr pairs of beams by their index ``tx_beam·Nr +
    rx_beam``."""

    arrays: tuple[AntennaArray, AntennaArray]
    """Of transmitter and receiver."""
    places: int
    """Of users in a scene at most, U."""
    observed: Mapping[str, NDArray[Any]]
    """By part what a policy observes, Shape ``[S, …]``."""
    row_shapes: Mapping[str, tuple[int, ...] | None]
    """By part the shape of one user's values; None: all users of a scene share them."""
    episode: Int64Array
    """Of each scene, Shape ``[S]``."""
    scene: Int64Array
    """Position of each user's scene in ``observed``, Shape ``[N]`` as all below."""
    place: Int64Array
    """In the observation."""
    abs_y: Float32Array
    """|y| of each pair, Shape ``[N, P]``; zeros without a path."""
    best: Int64Array
    """Index of the best pair."""
    straight: Int64Array
    """Index of the pair along the straight line."""
    position: Float64Array
    """Of the receiver in the world [m], Shape ``[N, 3]``."""
    towards_rx: Float64Array
    """Unit vector to the receiver in the transmitter's axes, Shape ``[N, 3]``."""
    towards_tx: Float64Array
    """Likewise to the transmitter, in the receiver's axes."""
    has_path: BoolArray
    los: BoolArray
    power_over_noise: Float64Array
    """SNR of |y| = 1."""

    def __len__(self) -> int:
        """Number of users."""
        return len(self.scene)

    @property
    def beams(self) -> tuple[int, int]:
        """Sizes of the codebooks, Nt and Nr."""
        return beam_count(self.arrays[0]), beam_count(self.arrays[1])

    def rows(self, name: str, users: NDArray[np.int64]) -> NDArray[Any]:
        """Values of a part for some users.

        Args:
            name: Of the part; not one that users share.
            users: Positions, Shape ``[n]``.

        Returns:
            Shape ``[n, …]``.
        """
        shape = self.row_shapes[name]
        assert shape is not None, name  # noqa: S101 - of callers
        by_place = self.observed[name].reshape(len(self.episode), self.places, *shape)
        return by_place[self.scene[users], self.place[users]]

    def where(self, users: BoolArray) -> Samples:
        """These users only; the scenes stay.

        Args:
            users: Mask, Shape ``[N]``.
        """
        return replace(self, **{name: getattr(self, name)[users] for name in _OF_USERS})


_OF_USERS = (
    "scene", "place", "abs_y", "best", "straight", "position", "towards_rx", "towards_tx",
    "has_path", "los", "power_over_noise",
)  # fmt: skip
_FORMAT = 2


def dataset_key(dataset: Dataset) -> str:
    """Digest of a dataset: of its settings, and of the contents of its episodes.

    Args:
        dataset: The dataset.
    """
    table = dataset.table("episodes")
    listed = zip(table["episode"].tolist(), table["digest"].tolist(), strict=True)
    text = f"{fingerprint(dataset.settings)} {sorted(listed)}"
    return hashlib.sha256(text.encode()).hexdigest()


def read_samples(
    dataset: Dataset,
    observe: Sequence[str],
    selection: Selection = EVERYONE,
    report: Report = lambda share: None,
) -> Samples:
    """Read the users of a dataset into memory.

    Args:
        dataset: With topics ``scene`` and ``channel``, and those of the sensors that are observed.
        observe: Parts of the observation, as in `caviar_protocol.observations.OBSERVATION_PARTS`.
        selection: Which users.
        report: Called while it reads.

    Raises:
        ScenarioError: A part does not exist, or no user is of this name.
        RecordingError: A topic was not recorded, or users have different codebooks.
    """
    reader = _Reader(dataset, selection)
    columns = reader.columns(lambda share: report(share / 2))
    observer = reader.observer(observe)
    shapes = {name: observer.bounds[name] for name in observe}
    arrays = {name: np.empty((reader.scenes, *shapes[name].shape), shapes[name].dtype) for name in observe}
    reader.fill(observer, arrays, lambda share: report((1 + share) / 2))
    return Samples(
        arrays=(reader.places.places[0].tx, reader.places.places[0].rx),
        places=len(reader.places),
        observed=arrays,
        row_shapes={name: observer.row_shape(name) for name in observe},
        **columns,
    )


def stored_samples(
    folder: Path,
    dataset: Dataset,
    observe: Sequence[str],
    selection: Selection = EVERYONE,
    report: Report = lambda share: None,
) -> Samples:
    """Read the users of a dataset once, into files that all trainings of a folder share; they are mapped.

    Args:
        folder: In which a folder for this dataset and selection is made.
        dataset: As of `read_samples`, and so all below.
        observe: Parts.
        selection: Which users.
        report: Called while it reads.

    Raises:
        ScenarioError, RecordingError: As of `read_samples`.
        RunError: The disk refuses.
    """
    reader = _Reader(dataset, selection)
    key = hashlib.sha256(f"{_FORMAT} {dataset_key(dataset)} {selection}".encode()).hexdigest()[:16]
    mine = folder / f"{dataset.name}-{key}"
    with writing(mine / "columns.npz"), locked(mine / "lock", f"{dataset.name} in {mine}", 600.0):
        if not (mine / "columns.npz").is_file():
            columns = reader.columns(report)
            np.savez(mine / "columns.draft.npz", **cast(dict[str, Any], columns))
            (mine / "columns.draft.npz").rename(mine / "columns.npz")
        observer = reader.observer(observe)
        files = {name: mine / f"{name.replace(':', '-')}.npy" for name in observe}
        missing = [name for name in observe if not files[name].is_file()]
        drafts = {name: files[name].with_suffix(".draft") for name in missing}
        if missing:
            arrays = {
                name: np.lib.format.open_memmap(
                    drafts[name], "w+", bounds.dtype, (reader.scenes, *bounds.shape)
                )
                for name, bounds in observer.bounds.items()
                if name in missing
            }
            reader.fill(reader.observer(missing), arrays, report)
            for name, array in arrays.items():
                array.flush()
                drafts[name].rename(files[name])
    with np.load(mine / "columns.npz") as stored:
        columns = dict(stored)
    return Samples(
        arrays=(reader.places.places[0].tx, reader.places.places[0].rx),
        places=len(reader.places),
        observed={name: np.load(file, mmap_mode="r") for name, file in files.items()},
        row_shapes={name: observer.row_shape(name) for name in observe},
        **columns,
    )


class _Reader:
    """Reads the scenes of a dataset, in the order of its episodes."""

    def __init__(self, dataset: Dataset, selection: Selection) -> None:
        self._dataset, self._selection = dataset, selection
        self.scenario = msgspec.convert(dataset.settings["scenario"], Scenario)
        carriers = [carrier.name for carrier in self.scenario.carriers]
        self._carrier = selection.carrier or carriers[0]
        if self._carrier not in carriers:
            raise ScenarioError(
                f"{dataset.location} has no carrier {self._carrier!r}; {suggestion(self._carrier, carriers)}"
            )
        self.places = Users(self.scenario, selection.users, (), selection.transmitters)
        beams = {place.beams for place in self.places.places}
        if len(beams) > 1:
            shown = ", ".join(f"{tx} × {rx}" for tx, rx in sorted(beams))
            raise RecordingError(
                f"{dataset.location} has users with beams {shown}; a classifier chooses of one codebook: "
                "name users or transmitters that have the same"
            )
        self.beams = beams.pop()
        self.scenes = int(dataset.table("episodes")["scenes"].sum())

    def observer(self, observe: Sequence[str]) -> Observer:
        found = Observer(self.scenario, self.places, observe)
        if self._dataset.episodes:
            recorded = self._dataset.episode(self._dataset.episodes[0]).topics
            for entry in found.inputs:
                if entry.topic not in recorded:
                    raise RecordingError(
                        f"{self._dataset.location} has no {entry.topic}, which {', '.join(observe)} is read "
                        f"from; generate it with {entry.topic!r} in `record`, or observe other parts"
                    )
        return found

    def _frames(self, report: Report) -> Iterator[tuple[RecordedFrame, RecordedFrame | None]]:
        """Each scene, with the one before it in its episode."""
        done = 0
        for episode in self._dataset.episodes:
            frames = list(self._dataset.episode(episode).frames())
            for before, frame in pairwise([None, *frames]):
                assert frame is not None  # noqa: S101 - only the first is None
                yield frame, before
                done += 1
            report(done / self.scenes)

    def fill(self, observer: Observer, arrays: Mapping[str, NDArray[Any]], report: Report) -> None:
        """Observe all scenes."""
        for row, (frame, before) in enumerate(self._frames(report)):
            scene = frame.scene()
            if scene is None:
                raise RecordingError(f"{self._dataset.location} has no scene in {_place(frame)}")
            links = before.payloads("link", Link) if before is not None else {}
            moment = Moment(frame, scene, next(iter(links.values()), None), self.places.present(scene))
            for name, value in observer.read(moment).items():
                arrays[name][row] = value

    def columns(self, report: Report) -> dict[str, NDArray[Any]]:
        """Fields of `Samples` that have a row for each user, and ``episode``."""
        rows: dict[str, list[Any]] = {name: [] for name in (*_OF_USERS, "episode")}
        settings = link_settings(self.scenario)
        for at, (frame, _) in enumerate(self._frames(report)):
            rows["episode"].append(frame.episode)
            scene, products = frame.scene(), frame.payloads("channel", Channel)
            if scene is None or not products:
                raise RecordingError(
                    f"{self._dataset.location} has no scene or no channel in {_place(frame)}; generate it "
                    'with "scene" and "channel" in `record`'
                )
            channel = next(iter(products.values()))
            budget = LinkBudget.for_scene(
                scene, channel.carriers, settings.noise_figure_db, settings.temperature_k
            )
            channels = channels_of(channel, budget.users)
            swept = dict[int, Float64Array]()
            for group in sweep_users(budget.users, channels.h):
                swept.update(zip(group.users, group.abs_y, strict=True))
            towards_rx, towards_tx = directions(scene, budget.users)
            number = {
                (user.tx.name, user.rx.name): u
                for u, user in enumerate(budget.users)
                if user.carrier.name == self._carrier
            }
            for place, pair in self.places.present(scene):
                u = number.get((pair.tx.name, pair.rx.name))
                if u is None:
                    continue
                nothing = np.zeros(self.beams)
                abs_y = swept.get(u, nothing)
                best = best_pairs(abs_y[None], 1)
                straight = straight_beams(pair.tx.array, towards_rx[u], pair.rx.array, towards_tx[u])
                values = (
                    at, place, abs_y.reshape(-1).astype(np.float32),
                    max(0, int(best.tx_beam[0, 0]) * self.beams[1] + int(best.rx_beam[0, 0])),
                    straight[0] * self.beams[1] + straight[1],
                    device_pose(scene, pair.rx).position, towards_rx[u], towards_tx[u],
                    channels.has_path[u], channels.los[u], budget.power_over_noise[u],
                )  # fmt: skip
                for name, value in zip(_OF_USERS, values, strict=True):
                    rows[name].append(value)
        if not rows["scene"]:
            raise ScenarioError(
                f"{self._dataset.location} has no user {' or '.join(self._selection.users)} on carrier "
                f"{self._carrier!r}; name others"
            )
        return {name: np.array(values) for name, values in rows.items()}


def _place(frame: RecordedFrame) -> str:
    return f"episode {frame.episode}, scene {frame.number}"
