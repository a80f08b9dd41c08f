"""Verification of a dataset: its catalogue, and episode by episode what each recording has to have."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path, PurePosixPath
from tempfile import TemporaryDirectory
from typing import Any

from caviar_clients.datasets.catalogue import MEASURED_TABLES, TABLES, Catalogue, columns_of
from caviar_clients.datasets.directory import DatasetDirectory
from caviar_clients.datasets.remote import RemoteDataset, is_address, located
from caviar_clients.datasets.rows import EpisodeRows, column_types, rows_of, whole_recording
from caviar_clients.datasets.verification import Finding, gaps, listed, runs
from caviar_clients.datasets.verification.physics import PhysicsChecks
from caviar_protocol.arrays import MAX_COORDINATE_M
from caviar_protocol.errors import AssetError, RecordingError
from caviar_protocol.messages import Status
from caviar_protocol.recording import FrameEntry, Recording
from caviar_space.scenery import scenery_assets

_BUNDLED = "sionna:"
TOLERANCE = 1e-12
"""Of figures of the catalogue that are computed anew, relative: they are the same arithmetic."""

_PLACES = ("x_m", "y_m", "z_m")
_SIGNED = (*_PLACES, "gain_db", "snr_db")


def verify(
    path: str | Path,
    progress: Callable[[int, int], None] = lambda *_: None,
    note: Callable[[str], None] = lambda _: None,
) -> Iterator[Finding]:
    """Verify a dataset.

    Args:
        path: Folder or address of the dataset.
        progress: Called after each episode with how many are verified, and how many there are.
        note: Called with each thing that is no fault and worth knowing: what this machine cannot check.

    Yields:
        What is wrong: of the dataset as a whole, then episode by episode.

    Raises:
        RecordingError: The folder is no dataset, or its catalogue is none that can be read.
    """
    directory, remote = located(path)
    catalogue = Catalogue(directory.catalogue)
    try:
        settings = catalogue.settings
        yield from _impossible_values(catalogue, MEASURED_TABLES)
        known = catalogue.episodes()
        yield from _missing_episodes(catalogue, known)
        yield from _not_listed(directory.finished() if remote is None else remote.episodes(), known)
        yield from _orphans(catalogue)
        yield from _copies(catalogue, note)
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
        if checks.lidar.skipped:
            note(f"LIDAR scans are not computed anew: {checks.lidar.skipped}")
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
    yield from _against_recording(catalogue, rows, number)
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


# --- catalogue ----------------------------------------------------------------------------------------------

# A catalogue comes from anywhere, and SQLite keeps an infinite number, or a text in a column of numbers,
# where another program wrote it.


def _impossible_values(catalogue: Catalogue, tables: tuple[str, ...]) -> Iterator[Finding]:
    """Values that their columns cannot have: of another type, not finite, below 0 where they count something.

    Args:
        catalogue: Of the dataset.
        tables: That are looked at.

    Yields:
        The first row of each column that has one, with the number of the others.
    """
    for table in tables:
        for column, (expected, wrong) in _rules(table).items():
            place = [name for name in ("episode", "scene", "rx") if name in columns_of(table)]
            _, rows = catalogue.query(
                f"SELECT count(*) OVER (), {column}, {', '.join(place)} FROM {table} "  # noqa: S608 - our own
                f"WHERE {wrong} ORDER BY {', '.join(place)} LIMIT 1"
            )
            for count, value, *at in rows:
                where = dict(zip(place, at, strict=True))
                more = f", and {count - 1:,} more" if count > 1 else ""
                yield Finding(
                    _number(where["episode"]),
                    _number(where["scene"]) if "scene" in where else None,
                    str(where.get("rx", "")),
                    f"catalogue: {table}.{column}",
                    expected,
                    f"{value!r:.80}{more}",
                )


def refuse_impossible(catalogue: Catalogue, *, but: tuple[str, ...] = ()) -> None:
    """Check a catalogue before a page is made of it.

    Args:
        catalogue: Of the dataset.
        but: Columns that may have such values, as ``users.tx_beam``.

    Raises:
        RecordingError: It has values that cannot be; names the first one.
    """
    for one in _impossible_values(catalogue, (*TABLES, *MEASURED_TABLES)):
        column = one.what.removeprefix("catalogue: ")
        if column in but:
            continue
        at = "" if one.scene is None else f", scene {one.scene}"
        user = f", user {one.user}" if one.user else ""
        raise RecordingError(
            f"{catalogue.path}: {column} of episode {one.episode}{at}{user} is "
            f"{one.found}, not {one.expected}; caviar dataset verify says all that is wrong"
        )


def _number(value: object) -> int:
    return value if isinstance(value, int) else -1


def _rules(table: str) -> dict[str, tuple[str, str]]:
    """By column: what it has, in words, and the condition of SQL that holds where it has something else."""
    found = {}
    types = column_types(TABLES[table][0]) if table in TABLES else {}
    for name, kind in columns_of(table).items():
        python, optional = types.get(name, (None, True))
        if kind == "TEXT":
            words, right = "a text", f"typeof({name}) = 'text'"
        elif python is bool:
            words, right = "0 or 1", f"typeof({name}) = 'integer' AND {name} IN (0, 1)"
        elif kind == "INTEGER":
            words, right = "a whole number from 0 on", f"typeof({name}) = 'integer' AND {name} >= 0"
        else:
            limit = MAX_COORDINATE_M if name in _PLACES else 1e30
            words, low = (
                (f"a number within ±{limit:g}", -limit) if name in _SIGNED else ("a number from 0 on", 0)
            )
            right = f"typeof({name}) IN ('real', 'integer') AND {name} BETWEEN {low:g} AND {limit:g}"
        if optional:
            words, right = f"{words}, or none", f"({name} IS NULL OR {right})"
        found[name] = words, f"NOT ({right})"
    return found


def _missing_episodes(catalogue: Catalogue, known: list[int]) -> Iterator[Finding]:
    """Episodes that the dataset shall have and has not, those that failed by their errors.

    The cost is that of the episodes that are there, whatever number is planned.

    Args:
        catalogue: Of the dataset.
        known: Numbers of its episodes, ascending.
    """
    planned, there = catalogue.planned, set(known)
    by_error: dict[str, list[int]] = {}
    for number, error in catalogue.failures():
        if number not in there and 0 <= number < planned:
            by_error.setdefault(error, []).append(number)
    failed = sorted(number for numbers in by_error.values() for number in numbers)
    if ranges := gaps(sorted(there.union(failed)), planned):
        again = "run the generate command again"
        is_one = len(ranges) == 1 and ranges[0].stop - ranges[0].start == 1
        found = f"{listed(ranges, 'episode')} {'is' if is_one else 'are'} missing: {again}"
        yield Finding(ranges[0].start, None, "", "episode", "a row of the catalogue", found)
    for error, numbers in by_error.items():
        found = f"{listed(runs(numbers), 'episode')} failed: {error}"
        yield Finding(numbers[0], None, "", "episode", "a row of the catalogue", found)
    if beyond := [number for number in known if not 0 <= number < planned]:
        found = f"{listed(runs(beyond), 'episode')} beyond them"
        expected = f"episodes 0 to {planned - 1} as planned" if planned else "no episode, as none is planned"
        yield Finding(beyond[0], None, "", "catalogue: episodes", expected, found)


def _orphans(catalogue: Catalogue) -> Iterator[Finding]:
    """Rows of scenes, users and products whose episode is in no row of `episodes`.

    Args:
        catalogue: Of the dataset.

    Yields:
        Of each table and episode the first row, with the number of the others.
    """
    for table in ("scenes", "users", "products"):
        user = ", min(rx)" if table == "users" else ""
        _, rows = catalogue.query(
            f"SELECT episode, count(*), min(scene){user} FROM {table} "  # noqa: S608 - names of our own
            "WHERE episode NOT IN (SELECT episode FROM episodes) GROUP BY episode ORDER BY episode"
        )
        for episode, count, scene, *rx in rows:
            rows_of_it = f"{count:,} row{'s' * (count != 1)} without it"
            what = f"catalogue: {table}"
            yield Finding(
                episode, scene, rx[0] if rx else "", what, "a row of the episode in episodes", rows_of_it
            )


def _copies(catalogue: Catalogue, note: Callable[[str], None]) -> Iterator[Finding]:
    """Episodes whose scenes and channels are those of an earlier one: a leak from training into test.

    A scenario without anything that depends on the seed has such episodes alone. It is told from one that
    varies by its other episodes: none of them has other scenes, or other channels, from beginning to end.

    Args:
        catalogue: Of the dataset. Its digests are compared with the recordings episode by episode.
        note: As for `verify`.
    """
    _, rows = catalogue.query(
        "SELECT episode, topic, group_concat(substr(sha256, 1, 16), ' ') FROM (SELECT * FROM products "
        "WHERE topic IN ('scene', 'channel') AND status = 'fresh' ORDER BY episode, scene, topic, source) "
        "GROUP BY episode, topic ORDER BY episode, topic"
    )
    contents: dict[int, list[str]] = {}
    first: dict[str, str] = {}
    varies = False
    for episode, topic, digests in rows:
        contents.setdefault(episode, []).append(digests)
        known = first.setdefault(topic, digests).split()
        varies |= all(one != other for one, other in zip(known, digests.split(), strict=False))
    originals: dict[tuple[str, ...], int] = {}
    copies = {}
    for episode, content in contents.items():
        if (original := originals.setdefault(tuple(content), episode)) != episode:
            copies[episode] = original
    if not varies and copies:
        note(
            f"scenes and channels of {listed(runs(copies), 'episode')} are those of earlier ones: the "
            "scenario does not change from episode to episode, and a split has the same data in both parts"
        )
        return
    for episode, original in copies.items():
        expected = "scenes and channels of its own"
        yield Finding(episode, None, "", "content", expected, f"those of episode {original}")


def _against_recording(catalogue: Catalogue, rows: EpisodeRows, number: int) -> Iterator[Finding]:
    """Rows of the catalogue that are not those of the recording.

    Args:
        catalogue: Of the dataset.
        rows: Of the recording.
        number: Of the episode.

    Yields:
        The first row that lacks, the first that is too many, and the first of each column that differs, with
        the number of the others.
    """
    anew = {
        "episodes": (rows.episode,),
        "scenes": rows.scenes,
        "users": rows.users,
        "products": rows.products,
    }
    for table, (_, key) in TABLES.items():
        names = tuple(columns_of(table))
        _, found = catalogue.query(
            f"SELECT {', '.join(names)} FROM {table} WHERE episode = ?",  # noqa: S608 - names of our own
            (number,),
        )
        places = [names.index(name) for name in key]
        right = {tuple(row[place] for place in places): row for row in anew[table]}
        listed_rows = {tuple(row[place] for place in places): row for row in found}
        for keys, expected, said in (
            ([one for one in right if one not in listed_rows], "a row as of the recording", "none"),
            ([one for one in listed_rows if one not in right], "no row, as the recording has none", "a row"),
        ):
            if keys:
                first = min(keys, key=str)
                yield _row_finding(table, key, first, "", expected, said + _and_more(keys))
        different: dict[int, list[Any]] = {}
        for one in right.keys() & listed_rows.keys():
            pairs = zip(right[one], listed_rows[one], strict=True)
            for at in (at for at, (expected, value) in enumerate(pairs) if not _same(expected, value)):
                different.setdefault(at, []).append(one)
        for at, keys in sorted(different.items()):
            first = min(keys)
            said = f"{listed_rows[first][at]}{_and_more(keys)}"
            yield _row_finding(table, key, first, f".{names[at]}", str(right[first][at]), said)


def _row_finding(
    table: str, key: tuple[str, ...], row: tuple[Any, ...], column: str, expected: str, found: str
) -> Finding:
    """A finding at the place that the key of a row has."""
    at = dict(zip(key, row, strict=True))
    scene = at.get("scene")
    rest = [str(at[name]) for name in key if name not in ("episode", "scene", "rx")]
    named = f" ({', '.join(rest)})" if rest and not column else ""
    what = f"catalogue: {table}{column}{named}"
    return Finding(at["episode"], scene, str(at.get("rx", "")), what, expected, found)


def _and_more(keys: list[Any]) -> str:
    return f" (and {len(keys) - 1:,} more)" if len(keys) > 1 else ""


def _same(right: object, value: object) -> bool:
    if isinstance(right, float) and isinstance(value, float):
        # Of an infinite value any tolerance is infinite too.
        if not math.isfinite(value):
            return False
        return abs(right - value) <= TOLERANCE * max(abs(right), abs(value))
    return right == value


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
