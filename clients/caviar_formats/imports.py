"""Datasets from files of other programs: what a format reads, and the one place that writes it.

A format yields objects of `ImportedScene`. They are played as a run whose world and channel are those of
the files, so that the product's own recorder writes them; link and catalogue are made as of other datasets.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path
from typing import Any, ClassVar

import msgspec
import numpy as np

from caviar_clients.datasets.catalogue import Catalogue
from caviar_clients.datasets.directory import DatasetDirectory, writing_dataset
from caviar_clients.datasets.episode import EpisodeTask, play_episode
from caviar_clients.datasets.plan import plan_dataset
from caviar_clients.files import writing
from caviar_protocol.arrays import Complex128Array, Float64Array, UInt8Array
from caviar_protocol.errors import CaviarError, RunError
from caviar_protocol.messages import Input
from caviar_protocol.scenario import Carrier, DeviceSpec, Scenario, ServiceSpec
from caviar_protocol.scenario.schema import Run
from caviar_protocol.space.antenna_arrays import steering_vector
from caviar_protocol.space.coordinates import rotation_matrix, unit_vectors
from caviar_protocol.space.scene import antennas, device_pose
from caviar_protocol.topics import AntennaDevice, Channel, ChannelMatrix, Scene
from caviar_services.channel.paths import PathTable, stable_ids
from caviar_services.service import Frame, Preparation, Prepared, Service, StepResult
from caviar_services.world.base import ObjectState

RUNG = "imported"
"""Step of the fidelity ladder of a channel from files: arrays see plane waves."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Paths:
    """Paths of a transmitter and a receiver, in any order: columns of topic ``channel``."""

    tx: str
    rx: str
    los: bool
    a: Complex128Array
    """Amplitude gain with exp(−j2πfτ), Shape ``[C, P]``."""
    tau: Float64Array
    """[s], Shape ``[P]``."""
    aod: Float64Array
    """(zenith, azimuth) in world axes [rad], Shape ``[P, 2]``."""
    aoa: Float64Array
    """Direction that the wave comes from, likewise."""
    doppler: Float64Array | None = None
    """[Hz], Shape ``[C, P]``; None: the files have none, and it is 0."""
    interactions: UInt8Array | None = None
    """As of `Channel`, Shape ``[P, D]``; None: the files have none."""
    points: Float64Array | None = None
    """[m], Shape ``[P, D, 3]``."""


@dataclass(frozen=True, eq=False, kw_only=True)
class ImportedScene:
    """A scene as files have it."""

    episode: int
    scene: int
    devices: tuple[AntennaDevice, ...]
    """Antennas; those without ``parent`` have their poses in the world."""
    paths: Sequence[Paths]
    objects: tuple[ObjectState, ...] = ()


@dataclass(frozen=True, kw_only=True)
class Source:
    """Files that are read as a dataset."""

    path: Path
    scenes: Iterable[ImportedScene]
    """In order of episode and scene."""
    carriers: tuple[Carrier, ...]
    scenes_of_episode: int = 1
    sampling_period_ns: int = 100_000_000
    lacks: str = ""
    """Parts of a dataset that the files have not, for the notes of its recordings."""
    assumed: str = ""
    """Values that the files leave open, for the notes too."""


def import_dataset(
    source: Source, out: Path, on_episode: Callable[[int], None] = lambda episodes: None
) -> Path:
    """Write a dataset of what a format reads, whole or not at all.

    Args:
        source: Of `Format.read`.
        out: Folder that is made; it may be there, and empty.
        on_episode: Called after each episode with their number.

    Returns:
        The folder.

    Raises:
        RunError: The folder holds something, the files are damaged, or their numbers are none of a dataset.
    """
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise RunError(f"{out} is there and not empty; choose another folder with --out")
    directory = DatasetDirectory(out.with_name(f"{out.name}.part"))
    with writing(directory.path):
        if directory.path.exists() and not directory.catalogue.exists():
            raise RunError(f"{directory.path} is in the way, and no import that was cut off; remove it")
        with writing_dataset(directory):  # another import that writes there is refused
            shutil.rmtree(directory.episodes)
            directory.episodes.mkdir()
            for file in directory.path.glob(f"{directory.catalogue.name}*"):
                file.unlink()
            try:
                _write(source, directory, on_episode)
            except BaseException:
                shutil.rmtree(directory.path, ignore_errors=True)
                raise
        directory.path.replace(out)
    return out


def _write(source: Source, directory: DatasetDirectory, on_episode: Callable[[int], None]) -> None:
    plan, count = plan_dataset(_scenario(source), episodes=1), 0
    catalogue = Catalogue(directory.catalogue, writable=True)
    for episode, scenes in groupby(source.scenes, key=lambda scene: scene.episode):
        _playing.clear()
        _playing.update((scene.scene, scene) for scene in scenes)
        if sorted(_playing) != list(range(source.scenes_of_episode)):
            raise RunError(
                f"{source.path}: episode {episode} has scenes {sorted(_playing)}, and not 0 to "
                f"{source.scenes_of_episode - 1}"
            )
        result = play_episode(EpisodeTask(plan.scenario, episode, str(directory.path)))
        if result.rows is None:
            raise RunError(f"{source.path}, episode {episode}: {result.error}")
        catalogue.add(result.rows, result.measured)
        count = episode + 1
        on_episode(count)
    if not count:
        raise RunError(f"{source.path} has no scene")
    catalogue.plan(plan.settings() | {"device": ""}, count)
    catalogue.close()
    directory.assets.mkdir(exist_ok=True)


def _scenario(source: Source) -> Scenario:
    """Describe the run that plays what is imported: world and channel of the files, and the link of both."""
    notes = tuple(text for text in (source.lacks, source.assumed) if text)
    budget, here = 1e6, f"{__name__}:"
    services = {
        "world": ServiceSpec(
            role="world",
            use=f"{here}ImportedWorld",
            budget_ms=budget,
            settings={"source": str(source.path.resolve())},
        ),
        "channel": ServiceSpec(role="channel", use=f"{here}ImportedChannel", budget_ms=budget),
        "link": ServiceSpec(role="link", use="beams", budget_ms=budget),
        "recorder": ServiceSpec(role="recorder", use="mcap", budget_ms=budget, settings={"notes": notes}),
    }
    name = "".join(sign if sign.isalnum() and sign.isascii() else "-" for sign in source.path.resolve().stem)
    return Scenario(
        run=Run(
            name=f"imported-{name}"[:100],
            frames=source.scenes_of_episode,
            sampling_period_ns=source.sampling_period_ns,
            record=("scene", "channel", "channel.h", "link"),
        ),
        carriers=source.carriers,
        services=services,
        devices=(DeviceSpec(name="imported", kind="antenna", role="both", on="none"),),
    )


# Scenes of the episode that is being played, by number: the services below are made by the run, in this
# process.
_playing: dict[int, ImportedScene] = {}


class ImportedWorldSettings(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Settings of the world of files."""

    source: str
    """File or folder."""


class ImportedWorld(Service[ImportedWorldSettings]):
    """The world of files that are imported."""

    role = "world"
    outputs = ("scene",)
    Settings = ImportedWorldSettings

    def prepare(self, preparation: Preparation) -> Prepared:
        """Declare the names of everything, which the files have."""
        return Prepared(prefixes=("",))

    def step(self, frame: Frame) -> StepResult:
        """Make the scene of a frame."""
        imported = _playing[frame.number]
        states = sorted(imported.objects, key=lambda state: state.name)

        def column(name: str, width: int) -> Float64Array:
            return np.array([getattr(state, name) for state in states], np.float64).reshape(-1, width)

        scene = Scene(
            names=tuple(state.name for state in states),
            classes=tuple(state.class_ for state in states),
            assets=("",) * len(states),
            position=column("position", 3),
            orientation=column("orientation", 4),
            velocity=column("velocity", 3),
            dimensions=column("dimensions", 3),
            devices=tuple(sorted(imported.devices, key=lambda device: device.name)),
        )
        return StepResult(products={"scene": scene})


class ImportedChannel(Service[msgspec.Struct]):
    """The channel of files that are imported."""

    role = "channel"
    inputs = (Input(topic="scene"),)
    outputs = ("channel",)
    attributes_to_set: ClassVar[tuple[str, ...]] = ()
    rung = RUNG

    def step(self, frame: Frame) -> StepResult:
        """Make the channel of a frame: paths in the order of `Channel`, and H of plane waves."""
        scene, carriers = frame.scene(), self.run.carriers
        ends = [antennas(scene, end) for end in ("tx", "rx")]
        tx, rx = (tuple(device.name for device in devices) for devices in ends)
        by_pair = {(paths.tx, paths.rx): paths for paths in _playing[frame.number].paths}
        nothing = Paths(
            tx="", rx="", los=False, a=np.zeros((len(carriers), 0), complex), tau=np.zeros(0),
            aod=np.zeros((0, 2)), aoa=np.zeros((0, 2)),
        )  # fmt: skip
        pairs = [by_pair.get((one, other), nothing) for one in tx for other in rx]
        depth = max((0 if p.interactions is None else p.interactions.shape[1] for p in pairs), default=0)
        rows = [_columns(paths, depth) for paths in (*pairs, nothing)]
        columns = {name: np.concatenate([row[name] for row in rows]) for name in rows[0]}
        counts = [len(paths.tau) for paths in pairs]
        types, points = columns["interactions"], columns["points"]
        objects = np.full(types.shape, -1, np.int32)
        table = PathTable(
            pair=np.repeat(np.arange(len(counts)), counts),
            transfer=np.zeros((len(carriers), sum(counts), 3, 3), np.complex128),
            types=types,
            objects=objects,
            points=points,
            object_names=("",),
            object_velocity=np.zeros((1, 3)),
        )
        channel = Channel(
            rung=RUNG,
            carriers=carriers,
            tx=tx,
            rx=rx,
            los=np.array([paths.los for paths in pairs], bool).reshape(len(tx), len(rx)),
            offsets=np.concatenate([[0], np.cumsum(counts)]).astype(np.int64),
            id=stable_ids(table),
            a=np.ascontiguousarray(columns["a"].T),
            tau=columns["tau"],
            aod=columns["aod"],
            aoa=columns["aoa"],
            doppler=np.ascontiguousarray(columns["doppler"].T),
            interactions=types,
            points=points,
            objects=objects,
        )
        channel = msgspec.structs.replace(channel, h=tuple(self._matrices(scene, channel, ends)))
        return StepResult(products={"channel": channel}, fidelity=RUNG, counts={"paths": sum(counts)})

    def _matrices(
        self, scene: Scene, channel: Channel, ends: Sequence[Sequence[AntennaDevice]]
    ) -> Iterable[ChannelMatrix]:
        """Make H of each carrier and pair of uniform arrays: h = Σ a·response_rx·response_tx."""
        rotations = [
            [rotation_matrix(device_pose(scene, d).orientation) for d in devices] for devices in ends
        ]
        for c in range(len(channel.carriers)):
            for t, tx in enumerate(ends[0]):
                for r, rx in enumerate(ends[1]):
                    cut = channel.pair(tx.name, rx.name)
                    sent = steering_vector(tx.array, unit_vectors(channel.aod[cut]) @ rotations[0][t])
                    taken = steering_vector(rx.array, unit_vectors(channel.aoa[cut]) @ rotations[1][r])
                    h = (taken * channel.a[c, cut, None]).T @ sent
                    yield ChannelMatrix(carrier=c, tx=t, rx=r, h=h)


def _columns(paths: Paths, depth: int) -> dict[str, Any]:
    """Sort paths as `Channel` has them: its columns, with the path along axis 0, and zeros for what lacks."""
    count, carriers = len(paths.tau), len(paths.a)
    types, points = np.zeros((count, depth), np.uint8), np.zeros((count, depth, 3))
    if paths.interactions is not None:
        types[:, : paths.interactions.shape[1]] = paths.interactions
    if paths.points is not None:
        points[:, : paths.points.shape[1]] = paths.points
    points[types == 0] = 0.0
    keys = [(types != 0).sum(1), *types.T, paths.tau, *paths.aod.T, *paths.aoa.T]
    order = np.lexsort(keys[::-1])
    doppler = np.zeros((carriers, count)) if paths.doppler is None else paths.doppler
    columns = {"a": paths.a.T, "tau": paths.tau, "aod": paths.aod, "aoa": paths.aoa, "doppler": doppler.T}
    return {name: np.asarray(values)[order] for name, values in columns.items()} | {
        "interactions": types[order],
        "points": points[order],
    }


def damaged(path: Path, place: str, why: str) -> CaviarError:
    """Make the error of a file that cannot be read.

    Args:
        path: The file.
        place: In it, as ``line 7``; empty: the whole.
        why: What is wrong there, and what is expected.
    """
    return RunError(f"{path}{', ' if place else ''}{place}: {why}")
