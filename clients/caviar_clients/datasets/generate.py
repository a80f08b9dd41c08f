"""Generation of a dataset: which episodes are to be played, in what they are kept, and what failed."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Protocol

from caviar_clients.datasets.catalogue import Catalogue
from caviar_clients.datasets.cluster import Episodes
from caviar_clients.datasets.directory import DatasetDirectory, writing_dataset
from caviar_clients.datasets.episode import EpisodeResult, EpisodeTask
from caviar_clients.datasets.estimate import Estimate, check_disk, estimate, try_worker
from caviar_clients.datasets.plan import DatasetPlan, differences, fingerprint
from caviar_clients.datasets.rows import rows_of
from caviar_clients.datasets.traffic import SharedTraffic
from caviar_protocol.errors import RunError
from caviar_protocol.recording import Recording


class Observer(Protocol):
    """Is told how a generation goes on."""

    def note(self, text: str) -> None:
        """A line for the user."""

    def traffic(self, now_s: float, end_s: float) -> None:
        """How far the pass through the traffic has come [s]."""

    def estimated(self, found: Estimate, free: int, episodes: int, workers: int) -> None:
        """What the episodes that are left take, and what is free on the disk [B]."""

    def ended(self, result: EpisodeResult) -> None:
        """An episode ended, well or not."""


@dataclass
class Outcome:
    """How a generation ended."""

    episodes: int = 0
    """That were played by it."""
    scenes: int = 0
    bytes: int = 0
    """Of their recordings."""
    wall_s: float = 0.0
    """From the first episode to the last."""
    before: int = 0
    """Episodes that were there before."""
    failed: dict[int, str] = field(default_factory=dict)
    """Error by episode."""


def generate(
    plan: DatasetPlan, out: Path, observer: Observer, *, workers: int = 0, scheduler: str = ""
) -> Outcome:
    """Play the episodes of a dataset that are not there.

    Args:
        plan: The dataset.
        out: Its folder; one that holds a part of the dataset is continued.
        observer: Is told of what happens.
        workers: Processes of this machine; 0: one for each core.
        scheduler: Address of a Dask scheduler; empty: processes of this machine.

    Returns:
        What was played, and what failed.

    Raises:
        RunError: The folder holds another dataset, or cannot be written; the disk is too small; no scene can
            be played.
    """
    directory = DatasetDirectory(out)
    with writing_dataset(directory):
        catalogue = Catalogue(directory.catalogue, writable=True)
        try:
            return _generate(plan, directory, catalogue, observer, workers, scheduler)
        finally:
            catalogue.close()


def _generate(
    plan: DatasetPlan,
    directory: DatasetDirectory,
    catalogue: Catalogue,
    observer: Observer,
    workers: int,
    scheduler: str,
) -> Outcome:
    _agree(plan, directory, catalogue)
    _agree_with_disk(directory, catalogue, observer)
    there = set(catalogue.episodes())
    left = [number for number in range(plan.episodes) if number not in there]
    outcome = Outcome(before=len(there))
    if not left:
        return outcome
    traffic = SharedTraffic(plan.scenario)
    traffic.save(plan.episodes, observer.traffic)
    with Episodes(workers, scheduler, observer.note) as episodes:
        _estimate(plan, directory, left, traffic, episodes, observer)
        began = time.monotonic()
        for result in episodes.play(_tasks(plan, directory, left, traffic)):
            _keep(result, catalogue, outcome)
            outcome.wall_s = time.monotonic() - began
            observer.ended(result)
    return outcome


def _tasks(
    plan: DatasetPlan, directory: DatasetDirectory, left: list[int], traffic: SharedTraffic
) -> Iterator[EpisodeTask]:
    out = str(directory.path.resolve())
    for number in left:
        yield EpisodeTask(plan.scenario, number, out, cached=traffic.states_of(number))


def _keep(result: EpisodeResult, catalogue: Catalogue, outcome: Outcome) -> None:
    if result.rows is None:
        outcome.failed[result.episode] = result.error
        failed = datetime.now(UTC).isoformat(timespec="seconds")
        catalogue.add_failure(result.episode, failed, result.error, str(result.measured.get("host", "")))
        return
    catalogue.add(result.rows, result.measured)
    outcome.episodes += 1
    outcome.scenes += len(result.rows.scenes)
    outcome.bytes += result.rows.episode[4]


def _estimate(
    plan: DatasetPlan,
    directory: DatasetDirectory,
    left: list[int],
    traffic: SharedTraffic,
    episodes: Episodes,
    observer: Observer,
) -> None:
    tried = [left[len(left) * quarter // 4] for quarter in (1, 2, 3)]
    cached = {name: data for number in tried for name, data in traffic.states_of(number).items()}
    trials = episodes.run_on_each(try_worker, plan.scenario, str(directory.path.resolve()), tried, cached)
    good = [trial for trial in trials if trial.scenes]
    if not good:
        raise RunError(f"no scene can be played: {trials[0].error}")
    found = estimate(good, len(left), plan.scenes)
    observer.estimated(found, check_disk(directory.path, found.bytes), len(left), episodes.workers)


def _agree(plan: DatasetPlan, directory: DatasetDirectory, catalogue: Catalogue) -> None:
    """Raise `RunError` where the folder holds another dataset; note the plan where it does not."""
    settings, before = plan.settings(), catalogue.settings
    if (catalogue.episodes() or directory.finished()) and fingerprint(before) != fingerprint(settings):
        found = list(differences(before, settings))
        more = f" (and {len(found) - 3} more)" if len(found) > 3 else ""
        raise RunError(
            f"{directory.path} holds another dataset: {'; '.join(found[:3])}{more}; give another --out, or "
            "--overwrite to remove it"
        )
    catalogue.plan(settings, max(plan.episodes, catalogue.planned))


def _agree_with_disk(directory: DatasetDirectory, catalogue: Catalogue, observer: Observer) -> None:
    """List the recordings that a killed command had not listed, and forget those that were removed."""
    on_disk, listed = set(directory.finished()), set(catalogue.episodes())
    for number in sorted(on_disk - listed):
        catalogue.add(rows_of(Recording(directory.episode(number))), {})
    if gone := sorted(listed - on_disk):
        observer.note(
            f"{len(gone)} recordings were removed, episode {gone[0]} the first: they are played again"
        )
        catalogue.forget(gone)
