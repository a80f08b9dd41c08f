"""Verification of a dataset: what is missing, altered, or does not follow from physics.

`verify` compares files with the catalogue (`catalogue_checks`), looks at what each recording has to have
(`recording_checks`), and at the content of each scene, computed anew from positions, scenery and H
(`physics`).
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from caviar_clients.datasets.catalogue import MEASURED_TABLES, Catalogue
from caviar_clients.datasets.directory import DatasetDirectory
from caviar_clients.datasets.remote import RemoteDataset, is_address, located
from caviar_clients.datasets.rows import rows_of
from caviar_clients.datasets.verification.catalogue_checks import (
    against_recording,
    check_structure,
    impossible_values,
    missing_episodes,
    orphans,
)
from caviar_clients.datasets.verification.checked_settings import checked_settings
from caviar_clients.datasets.verification.findings import Finding, as_rows, listed, runs
from caviar_clients.datasets.verification.physics import PhysicsChecks
from caviar_clients.datasets.verification.recording_checks import (
    lacking_scenery,
    products,
    scenes_and_stamps,
    seeds,
)
from caviar_protocol.errors import RecordingError
from caviar_protocol.recording import Recording

__all__ = ["Finding", "as_rows", "verify", "whole_recording"]


def verify(path: str | Path, progress: Callable[[int, int], None] = lambda *_: None) -> Iterator[Finding]:
    """Verify a dataset.

    Args:
        path: Folder or address of the dataset.
        progress: Called after each episode with how many are verified, and how many there are.

    Yields:
        What is wrong: of the dataset as a whole, then episode by episode.

    Raises:
        RecordingError: The folder is no dataset, or its catalogue is none that can be read.
    """
    directory, remote = located(path)
    catalogue = Catalogue(directory.catalogue)
    try:
        check_structure(catalogue)
        settings = checked_settings(catalogue)
        yield from impossible_values(catalogue, MEASURED_TABLES)
        known = catalogue.episodes()
        yield from missing_episodes(catalogue, known)
        yield from _not_listed(directory.finished() if remote is None else remote.episodes(), known)
        yield from orphans(catalogue)
        checks = PhysicsChecks(directory.assets, settings)
        scenery = list(lacking_scenery(settings, checks.files))
        if checks.scenery_error and not scenery:
            scenery = [Finding(-1, None, "", "scenery", "files that can be read", checks.scenery_error)]
        yield from scenery
        for done, number in enumerate(known, 1):
            if remote is None:
                yield from _episode(directory, catalogue, checks, settings, number)
            else:
                yield from _fetched(remote, catalogue, checks, settings, number)
            progress(done, len(known))
    finally:
        catalogue.close()


def _not_listed(there: list[int], known: list[int]) -> Iterator[Finding]:
    """Recordings that are not in the catalogue."""
    if more := sorted(set(there).difference(known)):
        found = f"{listed(runs(more), 'episode')}; the generate command adds what is whole"
        yield Finding(more[0], None, "", "episode", "no recording that is not in the catalogue", found)


def _fetched(
    remote: RemoteDataset,
    catalogue: Catalogue,
    checks: PhysicsChecks,
    settings: Mapping[str, Any],
    number: int,
) -> Iterator[Finding]:
    """Verify an episode as it is at the address now, whatever the cache has."""
    with TemporaryDirectory(prefix="caviar-verify-") as folder:
        directory = DatasetDirectory(Path(folder))
        try:
            remote.fetch_episode(number, directory)
        except RecordingError as error:
            yield _damaged(number, str(error), f"{remote.address}/episodes")
            return
        yield from _episode(directory, catalogue, checks, settings, number)


def _episode(
    directory: DatasetDirectory,
    catalogue: Catalogue,
    checks: PhysicsChecks,
    settings: Mapping[str, Any],
    number: int,
) -> Iterator[Finding]:
    folder = directory.episode(number)
    try:
        recording = whole_recording(folder)
        rows = rows_of(recording)
    except RecordingError as error:
        yield _damaged(number, str(error), str(folder.parent))
        return
    run = settings.get("scenario", {}).get("run", {})
    yield from against_recording(catalogue, rows, number)
    yield from scenes_and_stamps(recording, run, number)
    yield from seeds(recording, run, number)
    yield from products(recording, run, number)
    try:
        yield from checks.episode(recording)
    except RecordingError as error:
        yield Finding(number, None, "", "recording", "products that can be read", str(error))


def whole_recording(folder: Path) -> Recording:
    """Open a recording of which every byte is as it was written.

    Args:
        folder: Of the recording.

    Raises:
        RecordingError: It is damaged or breaks off; says where.
    """
    with warnings.catch_warnings(action="ignore"):  # of damage, which is the error
        recording = Recording(folder)
    damage = [*recording.damage, *recording.run_digest().damage]
    if damage:
        raise RecordingError(damage[0])
    if not recording.complete:
        raise RecordingError(f"{folder} breaks off")
    return recording


def _damaged(number: int, said: str, folder: str) -> Finding:
    """A recording that cannot be used, and what to do about it."""
    name = DatasetDirectory(Path()).episode(number).name
    way_out = "the generate command plays the episode again"
    if is_address(folder) or (Path(folder) / name).exists():
        way_out = f"remove {folder}/{name}, and {way_out}"
    return Finding(number, None, "", "recording", "a whole recording", f"{said}; {way_out}")
