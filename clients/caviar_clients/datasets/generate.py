"""Generation of a dataset: which episodes are to be played, in what they are kept, and what failed."""

from __future__ import annotations

import shutil
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Protocol

from caviar_clients.datasets.catalogue import Catalogue, fingerprint
from caviar_clients.datasets.cluster import Episodes
from caviar_clients.datasets.directory import DatasetDirectory, writing_dataset
from caviar_clients.datasets.episode import EpisodeResult, EpisodeTask
from caviar_clients.datasets.estimate import Estimate, check_disk, estimate, try_worker
from caviar_clients.datasets.plan import DatasetPlan, differences
from caviar_clients.datasets.remote import RemoteDataset, is_address
from caviar_clients.datasets.rows import rows_of
from caviar_clients.datasets.texts import counted
from caviar_clients.datasets.traffic import SharedTraffic
from caviar_protocol.errors import RunError
from caviar_protocol.recording import Recording


class Observer(Protocol):
    """Is told how a generation goes on."""

    def note(self, text: str) -> None:
        """A line for the user."""

    def traffic(self, now_s: float, end_s: float) -> None:
        """How far the pass through the traffic has come [s]."""

    def estimated(self, found: Estimate, free: int | None, episodes: int, workers: int) -> None:
        """What the episodes that are left take, and what is free on the disk [B]; None: of an address."""

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
    plan: DatasetPlan, out: str | Path, observer: Observer, *, workers: int = 0, scheduler: str = ""
) -> Outcome:
    """Play the episodes of a dataset that are not there.

    Args:
        plan: The dataset.
        out: Its folder or address; one that holds a part of the dataset is continued.
        observer: Is told of what happens.
        workers: Processes of this machine; 0: one for each core.
        scheduler: Address of a Dask scheduler; empty: processes of this machine.

    Returns:
        What was played, and what failed.

    Raises:
        RunError: The folder holds another dataset, or cannot be written; the disk is too small; no scene can
            be played.
    """
    remote = RemoteDataset(str(out)) if is_address(out) else None
    directory = DatasetDirectory(Path(out)) if remote is None else remote.written()
    with writing_dataset(directory):
        if remote is not None:
            _fetch_catalogue(remote, directory)
        catalogue = Catalogue(directory.catalogue, writable=True)
        ledger = _Ledger(str(out), directory, remote, catalogue)
        try:
            _agree(plan, ledger)  # what is refused here changes nothing at an address
            try:
                return _generate(plan, ledger, observer, workers, scheduler)
            finally:
                ledger.upload()
        finally:
            catalogue.close()


def _fetch_catalogue(remote: RemoteDataset, directory: DatasetDirectory) -> None:
    """Have the catalogue of an address, where this machine has none, or that of another dataset."""
    fetched = directory.path / "fetched.sqlite"
    if not remote.fetch_catalogue(fetched):
        directory.catalogue.unlink(missing_ok=True)
        return
    try:
        # Of the same dataset the one of this machine may know of more: a killed command uploads nothing.
        if not directory.catalogue.exists() or _settings(fetched) != _settings(directory.catalogue):
            fetched.replace(directory.catalogue)
    finally:
        fetched.unlink(missing_ok=True)


def _settings(file: Path) -> str:
    catalogue = Catalogue(file)
    try:
        return fingerprint(catalogue.settings)
    finally:
        catalogue.close()


@dataclass(frozen=True)
class _Ledger:
    """What is there of a dataset, and where."""

    out: str
    """Folder or address, as the user wrote it."""
    directory: DatasetDirectory
    """Of the catalogue; of a folder that of the recordings too."""
    remote: RemoteDataset | None
    catalogue: Catalogue

    @property
    def place(self) -> str:
        """Folder or address, as every process of this machine sees it."""
        return self.out if self.remote is not None else str(self.directory.path.resolve())

    def finished(self) -> list[int]:
        """Numbers of the episodes whose recordings are there."""
        return self.directory.finished() if self.remote is None else self.remote.episodes()

    def add_unlisted(self, number: int) -> None:
        """List a recording that is there, and that a killed command had not listed."""
        if self.remote is not None:
            self.remote.fetch_episode(number, self.directory)
        folder = self.directory.episode(number)
        rows = rows_of(Recording(folder))
        if rows.episode[0] != number:
            raise RunError(
                f"{folder} has the recording of episode {rows.episode[0]}, not of {number}: remove it, and "
                "the episode is played"
            )
        self.catalogue.add(rows, {})
        if self.remote is not None:
            shutil.rmtree(folder)

    def upload(self) -> None:
        """Have the catalogue of now at the address."""
        if self.remote is None or not self.catalogue.settings:
            return
        with tempfile.TemporaryDirectory(dir=self.directory.work) as folder:
            copy = Path(folder) / self.directory.catalogue.name
            self.catalogue.copy_to(copy)
            self.remote.put_catalogue(copy)


def _generate(
    plan: DatasetPlan, ledger: _Ledger, observer: Observer, workers: int, scheduler: str
) -> Outcome:
    catalogue = ledger.catalogue
    _agree_with_recordings(ledger, observer)
    there = set(catalogue.episodes())
    left = [number for number in range(plan.episodes) if number not in there]
    outcome = Outcome(before=len(there))
    if not left:
        return outcome
    traffic = SharedTraffic(plan.scenario)
    traffic.save(plan.episodes, observer.traffic)
    with Episodes(workers, scheduler, observer.note) as episodes:
        _estimate(plan, ledger, left, traffic, episodes, observer)
        began = time.monotonic()
        for result in episodes.play(_tasks(plan, ledger.place, left, traffic)):
            _keep(result, catalogue, outcome)
            outcome.wall_s = time.monotonic() - began
            observer.ended(result)
    there = {*catalogue.episodes(), *outcome.failed}
    if lost := [number for number in left if number not in there]:
        raise RunError(
            f"{counted(len(lost), 'episode')} ended without a result, episode {lost[0]} the first; the same "
            "command goes on"
        )
    return outcome


def _tasks(plan: DatasetPlan, out: str, left: list[int], traffic: SharedTraffic) -> Iterator[EpisodeTask]:
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
    ledger: _Ledger,
    left: list[int],
    traffic: SharedTraffic,
    episodes: Episodes,
    observer: Observer,
) -> None:
    tried = [left[len(left) * quarter // 4] for quarter in (1, 2, 3)]
    cached = {name: data for number in tried for name, data in traffic.states_of(number).items()}
    trials = episodes.run_on_each(try_worker, plan.scenario, ledger.place, tried, cached)
    good = [trial for trial in trials if trial.scenes]
    if not good:
        raise RunError(f"no scene can be played: {trials[0].error}")
    found = estimate(good, len(left), plan.scenes)
    free = check_disk(ledger.directory.path, found.bytes) if ledger.remote is None else None
    observer.estimated(found, free, len(left), episodes.workers)


def _agree(plan: DatasetPlan, ledger: _Ledger) -> None:
    """Raise `RunError` where another dataset is there; note the plan where none is."""
    catalogue = ledger.catalogue
    settings, before = plan.settings(), catalogue.settings
    if (catalogue.episodes() or ledger.finished()) and fingerprint(before) != fingerprint(settings):
        found = list(differences(before, settings))
        more = f" (and {len(found) - 3} more)" if len(found) > 3 else ""
        raise RunError(
            f"{ledger.out} holds another dataset: {'; '.join(found[:3])}{more}; give another --out "
            "(--overwrite deletes the dataset that is there, with all its episodes)"
        )
    catalogue.plan(settings, max(plan.episodes, catalogue.planned))
    ledger.upload()  # so that another machine can go on where this one is lost


def _agree_with_recordings(ledger: _Ledger, observer: Observer) -> None:
    """List the recordings that a killed command had not listed, and forget those that were removed."""
    recorded, listed = set(ledger.finished()), set(ledger.catalogue.episodes())
    for number in sorted(recorded - listed):
        ledger.add_unlisted(number)
    if gone := sorted(listed - recorded):
        observer.note(f"{counted(len(gone), 'recording')} removed, episode {gone[0]} the first: played again")
        ledger.catalogue.forget(gone)
