"""Verification of a dataset: what is missing, altered, or does not follow from physics.

`verify` compares files with the catalogue, and `physics` the content of each scene with what is computed anew
from positions, scenery and H.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from caviar_clients.datasets.catalogue import TABLES, Catalogue
from caviar_clients.datasets.directory import DatasetDirectory
from caviar_clients.datasets.physics import Finding, PhysicsChecks
from caviar_clients.datasets.remote import RemoteDataset, located
from caviar_clients.datasets.rows import EpisodeRows, rows_of
from caviar_protocol.errors import RecordingError
from caviar_protocol.recording import Recording

TOLERANCE = 1e-12
"""Of figures of the catalogue that are computed anew, relative: they are the same arithmetic."""


def verify(path: str | Path, progress: Callable[[int, int], None] = lambda *_: None) -> Iterator[Finding]:
    """Verify a dataset.

    Args:
        path: Folder or address of the dataset.
        progress: Called after each episode with how many are verified, and how many there are.

    Yields:
        What is wrong, episode by episode.

    Raises:
        RecordingError: The folder is no dataset.
    """
    directory, remote = located(path)
    catalogue = Catalogue(directory.catalogue)
    listed = catalogue.episodes()
    on_disk = set(directory.finished() if remote is None else remote.episodes())
    failed = dict(catalogue.failures())
    for number in range(catalogue.planned):
        if number not in listed:
            found = f"none; it failed: {failed[number]}" if number in failed else "none"
            yield Finding(number, None, "", "episode", "a row of the catalogue", found)
    for number in sorted(on_disk - set(listed)):
        yield Finding(number, None, "", "episode", "no recording that is not in the catalogue", "a recording")
    settings = catalogue.settings
    checks = PhysicsChecks(directory.assets, settings)
    for done, number in enumerate(listed, 1):
        if remote is None:
            yield from _episode(directory, catalogue, checks, settings, number)
        else:
            yield from _fetched(remote, catalogue, checks, settings, number)
        progress(done, len(listed))


def _fetched(
    remote: RemoteDataset,
    catalogue: Catalogue,
    checks: PhysicsChecks,
    settings: dict[str, Any],
    number: int,
) -> Iterator[Finding]:
    """Verify an episode as it is at the address now, whatever the cache has."""
    with TemporaryDirectory(prefix="caviar-verify-") as folder:
        directory = DatasetDirectory(Path(folder))
        try:
            remote.fetch_episode(number, directory)
        except RecordingError as error:
            yield Finding(number, None, "", "recording", "a whole recording", str(error))
            return
        yield from _episode(directory, catalogue, checks, settings, number)


def _episode(
    directory: DatasetDirectory,
    catalogue: Catalogue,
    checks: PhysicsChecks,
    settings: dict[str, Any],
    number: int,
) -> Iterator[Finding]:
    folder = directory.episode(number)
    try:
        with warnings.catch_warnings(action="ignore"):  # of damage, which is a finding
            recording = Recording(folder)
        damage = [*recording.damage, *recording.run_digest().damage]
    except RecordingError as error:
        yield Finding(number, None, "", "recording", "a whole recording", str(error))
        return
    if damage or not recording.complete:
        said = damage[0] if damage else "it breaks off"
        yield Finding(number, None, "", "recording", "a whole recording", said)
        return
    try:
        yield from _against_catalogue(catalogue, rows_of(recording), number)
        yield from _stamps(recording, settings, number)
        yield from checks.episode(recording)
    except RecordingError as error:
        yield Finding(number, None, "", "recording", "products that can be read", str(error))


def _against_catalogue(catalogue: Catalogue, rows: EpisodeRows, number: int) -> Iterator[Finding]:
    """Rows of the catalogue that are not those of the recording, the first of each table."""
    anew = {
        "episodes": (rows.episode,),
        "scenes": rows.scenes,
        "users": rows.users,
        "products": rows.products,
    }
    for table, (_, key) in TABLES.items():
        order = ", ".join(key)
        columns, listed = catalogue.query(
            f"SELECT * FROM {table} WHERE episode = ? ORDER BY {order}",  # noqa: S608 - names of our own
            (number,),
        )
        places = [columns.index(name) for name in key]
        expected = sorted(anew[table], key=lambda row: [row[place] for place in places])
        if len(expected) != len(listed):
            yield Finding(number, None, "", f"catalogue: {table}", f"{len(expected)} rows", f"{len(listed)}")
            continue
        for right, row in zip(expected, listed, strict=True):
            different = [at for at, name in enumerate(columns) if not _same(right[at], row[at])]
            if different:
                at = different[0]
                scene = row[columns.index("scene")] if "scene" in columns else None
                user = row[columns.index("rx")] if "rx" in columns else ""
                what = f"catalogue: {table}.{columns[at]}"
                yield Finding(number, scene, user, what, str(right[at]), str(row[at]))
                break


def _same(right: object, value: object) -> bool:
    if isinstance(right, float) and isinstance(value, float):
        return abs(right - value) <= TOLERANCE * max(abs(right), abs(value))
    return right == value


def _stamps(recording: Recording, settings: dict[str, Any], number: int) -> Iterator[Finding]:
    """Scenes that are missing, or stamped with another instant than the scenario has."""
    run = settings.get("scenario", {}).get("run", {})
    period, instants = int(run.get("sampling_period_ns", 0)), run.get("instants_s", ())
    expected = int(run.get("frames", len(recording)))
    frames = [recording.entry(index) for index in range(len(recording))]
    if [entry.frame for entry in frames] != list(range(expected)):
        has = ", ".join(str(entry.frame) for entry in frames[:8])
        more = ", …" if len(frames) > 8 else ""
        yield Finding(number, None, "", "scenes", f"0 to {expected - 1}", has + more)
        return
    for entry in frames:
        right = round(instants[entry.frame] * 1e9) if instants else entry.frame * period
        if entry.t_ns != right:
            yield Finding(number, entry.frame, "", "stamp", f"{right} ns", f"{entry.t_ns} ns")
        if entry.episode != number:
            yield Finding(number, entry.frame, "", "episode", str(number), str(entry.episode))


def as_rows(findings: list[Finding]) -> list[dict[str, Any]]:
    """Findings as plain values, for a file."""
    return [
        {
            "episode": one.episode,
            "scene": one.scene,
            "user": one.user,
            "what": one.what,
            "expected": one.expected,
            "found": one.found,
        }
        for one in findings
    ]
