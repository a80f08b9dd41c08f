"""Checks of a catalogue: values that cannot be, and rows that do not follow from the recordings.

`impossible_values` looks at the database alone: a catalogue comes from anywhere, and SQLite keeps an infinite
number, or a text in a column of numbers, where another program wrote it. The others compare its tables with
one another and with the rows of a recording.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from types import UnionType
from typing import Any, get_args, get_type_hints

from caviar_clients.datasets.catalogue import MEASURED_TABLES, TABLES, Catalogue, columns_of
from caviar_clients.datasets.rows import EpisodeRows
from caviar_clients.datasets.verification import Finding, gaps, listed, runs
from caviar_protocol.arrays import MAX_COORDINATE_M
from caviar_protocol.errors import RecordingError

TOLERANCE = 1e-12
"""Of figures of the catalogue that are computed anew, relative: they are the same arithmetic."""

_PLACES = ("x_m", "y_m", "z_m")
_SIGNED = (*_PLACES, "gain_db", "snr_db")


def impossible_values(catalogue: Catalogue, tables: tuple[str, ...]) -> Iterator[Finding]:
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
    for one in impossible_values(catalogue, (*TABLES, *MEASURED_TABLES)):
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
    optional = {}
    if table in TABLES:
        hints = get_type_hints(TABLES[table][0])
        optional = {name: isinstance(hint, UnionType) for name, hint in hints.items()}
        flags = {name for name, hint in hints.items() if bool in (hint, *get_args(hint))}
    else:
        flags = set()
    for name, kind in columns_of(table).items():
        if kind == "TEXT":
            words, right = "a text", f"typeof({name}) = 'text'"
        elif name in flags:
            words, right = "0 or 1", f"typeof({name}) = 'integer' AND {name} IN (0, 1)"
        elif kind == "INTEGER":
            words, right = "a whole number from 0 on", f"typeof({name}) = 'integer' AND {name} >= 0"
        else:
            limit = MAX_COORDINATE_M if name in _PLACES else 1e30
            words, low = (
                (f"a number within ±{limit:g}", -limit) if name in _SIGNED else ("a number from 0 on", 0)
            )
            right = f"typeof({name}) IN ('real', 'integer') AND {name} BETWEEN {low:g} AND {limit:g}"
        if optional.get(name, table not in TABLES):
            words, right = f"{words}, or none", f"({name} IS NULL OR {right})"
        found[name] = words, f"NOT ({right})"
    return found


def missing_episodes(catalogue: Catalogue, known: list[int]) -> Iterator[Finding]:
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


def orphans(catalogue: Catalogue) -> Iterator[Finding]:
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


def against_recording(catalogue: Catalogue, rows: EpisodeRows, number: int) -> Iterator[Finding]:
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
