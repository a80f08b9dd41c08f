"""Verification of a dataset, as a whole and episode by episode."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from pathlib import Path, PurePosixPath
from tempfile import TemporaryDirectory
from typing import Any

from caviar_clients.datasets.catalogue import MEASURED_TABLES, Catalogue
from caviar_clients.datasets.directory import DatasetDirectory
from caviar_clients.datasets.remote import RemoteDataset, is_address, located
from caviar_clients.datasets.rows import rows_of, whole_recording
from caviar_clients.datasets.verification import Finding, catalogue_checks, listed, runs
from caviar_clients.datasets.verification.physics import PhysicsChecks
from caviar_protocol.errors import AssetError, RecordingError
from caviar_protocol.messages import Status
from caviar_protocol.recording import FrameEntry, Recording
from caviar_space.scenery import scenery_assets

_BUNDLED = "sionna:"


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
        settings = catalogue.settings
        yield from catalogue_checks.impossible_values(catalogue, MEASURED_TABLES)
        known = catalogue.episodes()
        yield from catalogue_checks.missing_episodes(catalogue, known)
        yield from _not_listed(directory.finished() if remote is None else remote.episodes(), known)
        yield from catalogue_checks.orphans(catalogue)
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
        recording = whole_recording(lambda: Recording(folder), with_digests=True)
        rows = rows_of(recording)
    except RecordingError as error:
        yield _damaged(number, str(error), str(folder.parent))
        return
    run = settings.get("scenario", {}).get("run", {})
    yield from catalogue_checks.against_recording(catalogue, rows, number)
    yield from _scenes_and_stamps(recording, run, number)
    yield from _seeds(recording, run, number)
    yield from _products(recording, run, number)
    try:
        yield from checks.episode(recording)
    except RecordingError as error:
        yield Finding(number, None, "", "recording", "products that can be read", str(error))


def _damaged(number: int, said: str, folder: str) -> Finding:
    """A recording that cannot be used, and what to do about it."""
    name = DatasetDirectory(Path()).episode(number).name
    way_out = "the generate command plays the episode again"
    if is_address(folder) or (Path(folder) / name).exists():
        way_out = f"remove {folder}/{name}, and {way_out}"
    return Finding(number, None, "", "recording", "a whole recording", f"{said}; {way_out}")


# --- recordings ---------------------------------------------------------------------------------------------


def _scenes_and_stamps(recording: Recording, run: Mapping[str, Any], number: int) -> Iterator[Finding]:
    """Scenes that are missing, or stamped with another instant than the table ``run`` of the scenario has."""
    period, instants = int(run.get("sampling_period_ns", 0)), run.get("instants_s", ())
    expected = int(run.get("frames", len(recording)))
    entries = _entries(recording)
    if [entry.frame for entry in entries] != list(range(expected)):
        has = ", ".join(str(entry.frame) for entry in entries[:8])
        more = ", …" if len(entries) > 8 else ""
        yield Finding(number, None, "", "scenes", f"0 to {expected - 1}", has + more)
        return
    for entry in entries:
        right = round(instants[entry.frame] * 1e9) if instants else entry.frame * period
        if entry.t_ns != right:
            yield Finding(number, entry.frame, "", "stamp", f"{right} ns", f"{entry.t_ns} ns")
        if entry.episode != number:
            yield Finding(number, entry.frame, "", "episode", str(number), str(entry.episode))


def _seeds(recording: Recording, run: Mapping[str, Any], number: int) -> Iterator[Finding]:
    """Seeds that are not that of the dataset: all episodes have it, and services derive theirs from it and
    from the number of the episode (`caviar_protocol.seeding`)."""
    if "seed" not in run:
        return
    right = run["seed"]
    if recording.metadata.seed != right:
        yield Finding(number, None, "", "seed of the recording", str(right), str(recording.metadata.seed))
    wrong = [entry for entry in _entries(recording) if entry.seed != right]
    if wrong:
        where = listed(runs(entry.frame for entry in wrong), "scene")
        yield Finding(number, wrong[0].frame, "", "seed", str(right), f"{wrong[0].seed} in {where}")


def _products(recording: Recording, run: Mapping[str, Any], number: int) -> Iterator[Finding]:
    """Topics and sources that some scenes lack: those that the scenario records, and those of other scenes.

    Of each topic and source there is a finding at the first scene that lacks it.
    """
    entries = _entries(recording)
    lacks: dict[tuple[str, str], list[int]] = {}
    causes: dict[tuple[str, str], str] = {}
    known = {(item.topic, item.source) for entry in entries for item in entry.inputs}
    named = {topic for topic, _ in known}
    known |= {(topic, "") for name in run.get("record", ()) if (topic := name.partition(".")[0]) not in named}
    for entry in entries:
        there = {(i.topic, i.source) for i in entry.inputs if i.status is not Status.ABSENT}
        for item in entry.inputs:
            if item.status is Status.ABSENT:
                causes.setdefault((item.topic, item.source), item.cause)
        for key in known - there:
            lacks.setdefault(key, []).append(entry.frame)
    for (topic, source), scenes in sorted(lacks.items()):
        cause = causes.get((topic, source), "")
        found = f"none in {listed(runs(scenes), 'scene')}{': ' * bool(cause)}{cause}"
        what = f"product {topic}{' of ' * bool(source)}{source}"
        yield Finding(number, scenes[0], "", what, "one in each scene", found)


def _entries(recording: Recording) -> list[FrameEntry]:
    return [recording.entry(index) for index in range(len(recording))]


# --- files that a dataset shares ----------------------------------------------------------------------------


def lacking_scenery(settings: Mapping[str, Any], assets: Mapping[str, Path]) -> Iterator[Finding]:
    """Files of scenery that the scenario's worlds name and that are not in the dataset, or cannot be read.

    Args:
        settings: Of the dataset.
        assets: Files of the dataset by asset name.
    """
    for spec in settings.get("scenario", {}).get("services", {}).values():
        scenery = spec.get("settings", {}).get("scenery") if spec.get("role") == "world" else None
        if not isinstance(scenery, str) or not (scenery.endswith(".xml") or scenery.startswith(_BUNDLED)):
            continue
        # Of a user's file the folder is left out, and the file of a bundled scene may have another name.
        if scenery.startswith(_BUNDLED):
            described = [one for one in assets if PurePosixPath(one).match("scenery/*.xml")]
            name = described[0] if described else f"scenery/{scenery.removeprefix(_BUNDLED)}.xml"
        else:
            name = f"scenery/{PurePosixPath(scenery.removeprefix('file:')).name}"
        if name not in assets:
            yield Finding(-1, None, "", "scenery", f"the file assets/{name} in the dataset", "none")
            continue
        try:
            scenery_assets(str(assets[name].resolve()))
        except AssetError as error:
            yield Finding(-1, None, "", "scenery", f"assets/{name} with all that it names", str(error))
