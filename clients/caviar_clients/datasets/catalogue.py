"""The catalogue of a dataset: a SQLite database of what there is, which is the ledger of what is to do too.

One process writes it, the command that generates. Tables `episodes`, `scenes`, `users` and `products` depend
on the scenario, the seed and the versions alone, in the order of their keys; `timings` and `failures` do not,
and stand apart for that reason. Its schema is in docs/reference/datasets.md.
"""

from __future__ import annotations

import hashlib
import sqlite3
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import fields
from pathlib import Path
from types import UnionType
from typing import Any, get_args, get_type_hints

import msgspec

from caviar_clients.datasets.rows import Episode, EpisodeRows, ProductRow, SceneRow, UserRow
from caviar_protocol.errors import RecordingError

TABLES: dict[str, tuple[type[Any], tuple[str, ...]]] = {
    "episodes": (Episode, ("episode",)),
    "scenes": (SceneRow, ("episode", "scene")),
    "users": (UserRow, ("episode", "scene", "carrier", "tx", "rx")),
    "products": (ProductRow, ("episode", "scene", "topic", "source")),
}
"""Tables that depend on the dataset alone: the class whose fields are their columns, and their key."""

MEASURED_TABLES = ("timings", "failures")
"""Tables that differ from one generation of a dataset to the next."""

_SQL_TYPES = {int: "INTEGER", float: "REAL", str: "TEXT", bool: "INTEGER"}
_MEASURED = """
CREATE TABLE IF NOT EXISTS dataset (key TEXT PRIMARY KEY, value TEXT NOT NULL) STRICT, WITHOUT ROWID;
CREATE TABLE IF NOT EXISTS timings (
    episode INTEGER PRIMARY KEY, started TEXT, host TEXT, pid INTEGER, wall_s REAL, cpu_s REAL, detail TEXT
) STRICT;
CREATE TABLE IF NOT EXISTS failures (
    episode INTEGER NOT NULL, failed TEXT NOT NULL, error TEXT NOT NULL, host TEXT
) STRICT;
"""


class Catalogue:
    """The catalogue of a dataset.

    Args:
        path: Of the database.
        writable: Whether it is made where it is not there, and may be written.

    Raises:
        RecordingError: It is not a catalogue, or cannot be read.

    Example:
        >>> catalogue = Catalogue(Path("d/catalogue.sqlite"))  # doctest: +SKIP
        >>> catalogue.episodes()  # doctest: +SKIP
        [0, 1, 2]
    """

    def __init__(self, path: Path, *, writable: bool = False) -> None:
        self.path, self._is_writable = path, writable
        if not writable and not path.is_file():
            raise RecordingError(
                f"{path.parent} is no dataset, it has no {path.name}; make one with: "
                f"caviar generate SCENARIO --out {path.parent}"
            )
        with self._errors():
            mode = "rwc" if writable else "ro"
            self._connection = sqlite3.connect(f"file:{_quoted(path)}?mode={mode}", uri=True)
            if writable:
                self._connection.execute("PRAGMA journal_mode = WAL")
                self._connection.execute("PRAGMA synchronous = NORMAL")
                self._connection.execute(
                    "PRAGMA wal_autocheckpoint = 100"
                )  # pages of 4 KiB beside the database
                self._connection.executescript(_schema())
            else:
                self._connection.execute("SELECT count(*) FROM dataset").fetchone()

    def close(self) -> None:
        """Close the database; what was added stays."""
        with self._errors():
            if self._is_writable:  # one file, which can be read where nothing can be written
                self._connection.execute("PRAGMA journal_mode = DELETE")
            self._connection.close()

    def copy_to(self, file: Path) -> None:
        """Write the catalogue as it is now to another file, which is not there.

        Args:
            file: Of the copy.
        """
        with self._errors():
            self._connection.execute("VACUUM INTO ?", (str(file),))

    @property
    def settings(self) -> dict[str, Any]:
        """Settings of the dataset (`plan.DatasetPlan.settings`); empty where none were kept."""
        text = self._note("settings")
        try:
            return msgspec.json.decode(text, type=dict[str, Any]) if text else {}
        except (msgspec.MsgspecError, RecursionError, UnicodeError) as error:
            raise RecordingError(
                f"{self.path}: settings in table dataset are not those of a dataset: {error}"
            ) from error

    @property
    def planned(self) -> int:
        """Episodes that the dataset shall have."""
        text = self._note("episodes") or "0"
        # Python refuses to read thousands of digits with an error of its own.
        if not (text.isascii() and text.isdecimal() and len(text) < 20):
            raise RecordingError(
                f"{self.path}: episodes in table dataset is {text!r:.80}: a number is needed"
            )
        return int(text)

    def plan(self, settings: Mapping[str, Any], episodes: int) -> None:
        """Keep the settings of the dataset, and how many episodes it shall have.

        Args:
            settings: Of `plan.DatasetPlan.settings`.
            episodes: Their number.
        """
        text = msgspec.json.encode(settings, order="sorted").decode()
        with self._errors(), self._connection:
            self._connection.executemany(
                "INSERT OR REPLACE INTO dataset VALUES (?, ?)",
                [("settings", text), ("episodes", str(episodes))],
            )

    def episodes(self) -> list[int]:
        """Numbers of the episodes that are there, in order."""
        return [number for (number,) in self._rows("SELECT episode FROM episodes ORDER BY episode")]

    def add(self, rows: EpisodeRows, measured: Mapping[str, Any]) -> None:
        """Add an episode in one transaction; one that is there is replaced.

        Args:
            rows: Of its recording.
            measured: Times, host and start; empty where they are not known.
        """
        episode = rows.episode[0]
        tables = ("episodes", (rows.episode,)), ("scenes", rows.scenes), ("users", rows.users)
        with self._errors(), self._connection:
            for table in TABLES:
                self._connection.execute(f"DELETE FROM {table} WHERE episode = ?", (episode,))  # noqa: S608
            for table, content in (*tables, ("products", rows.products)):
                self._insert(table, content)
            self._connection.execute("DELETE FROM failures WHERE episode = ?", (episode,))
            if measured:
                known = ("started", "host", "pid", "wall_s", "cpu_s")
                detail = {key: value for key, value in measured.items() if key not in known}
                values = (episode, *map(measured.get, known), msgspec.json.encode(detail).decode())
                self._connection.execute(
                    "INSERT OR REPLACE INTO timings VALUES (?, ?, ?, ?, ?, ?, ?)", values
                )

    def add_failure(self, episode: int, failed: str, error: str, host: str) -> None:
        """Note that an episode failed.

        Args:
            episode: Its number.
            failed: When, ISO 8601.
            error: Why.
            host: Where.
        """
        with self._errors(), self._connection:
            self._connection.execute(
                "INSERT INTO failures VALUES (?, ?, ?, ?)", (episode, failed, error, host)
            )

    def forget(self, episodes: Iterable[int]) -> None:
        """Remove episodes whose recordings are not there any more."""
        with self._errors(), self._connection:
            for table in (*TABLES, "timings"):
                self._connection.executemany(
                    f"DELETE FROM {table} WHERE episode = ?",  # noqa: S608 - names of our own
                    [(number,) for number in episodes],
                )

    def failures(self) -> list[tuple[int, str]]:
        """Episodes that failed last and are not there, each with its last error."""
        return self._rows(
            "SELECT episode, error FROM failures WHERE rowid IN (SELECT max(rowid) FROM failures GROUP BY "
            "episode) ORDER BY episode"
        )

    def query(self, sql: str, parameters: Sequence[Any] = ()) -> tuple[tuple[str, ...], list[Any]]:
        """Ask the database.

        Args:
            sql: A ``SELECT``.
            parameters: What its question marks stand for.

        Returns:
            Names of the columns, and the rows.

        Raises:
            RecordingError: SQLite refuses; has its words.
        """
        with self._errors():
            cursor = self._connection.execute(sql, parameters)
            return tuple(column[0] for column in cursor.description), cursor.fetchall()

    def table(self, name: str) -> tuple[tuple[str, ...], list[Any]]:
        """Columns and rows of a table, in the order of its key.

        Args:
            name: One of `TABLES` and `MEASURED_TABLES`.
        """
        order = ", ".join(TABLES[name][1]) if name in TABLES else "episode"
        return self.query(f"SELECT * FROM {name} ORDER BY {order}")  # noqa: S608 - names of our own

    def _note(self, key: str) -> str:
        rows = self._rows("SELECT value FROM dataset WHERE key = ?", key)
        return str(rows[0][0]) if rows else ""

    def _rows(self, sql: str, *parameters: Any) -> list[Any]:
        with self._errors():
            return self._connection.execute(sql, parameters).fetchall()

    def _insert(self, table: str, rows: Sequence[tuple[Any, ...]]) -> None:
        marks = ", ".join("?" * len(fields(TABLES[table][0])))
        self._connection.executemany(f"INSERT INTO {table} VALUES ({marks})", rows)  # noqa: S608

    @contextmanager
    def _errors(self) -> Iterator[None]:
        try:
            yield
        except sqlite3.Error as error:
            is_full = getattr(error, "sqlite_errorcode", 0) == sqlite3.SQLITE_FULL
            remedy = "; free space there: the same command then goes on" if is_full else ""
            raise RecordingError(f"{self.path}: {error}{remedy}") from error


def _quoted(path: Path) -> str:
    """A path in the form of a URI, in which these three have meanings."""
    return str(path).replace("%", "%25").replace("?", "%3f").replace("#", "%23")


def columns_of(table: str) -> dict[str, str]:
    """SQL type of each column of a table, by name.

    Args:
        table: One of `TABLES` and `MEASURED_TABLES`.

    Example:
        >>> columns_of("scenes")["t_s"]
        'REAL'
    """
    if table in TABLES:
        return {column.split()[0]: column.split()[1] for column in _columns(TABLES[table][0])}
    with sqlite3.connect(":memory:") as connection:
        connection.executescript(_MEASURED)
        return {name: kind for _, name, kind, *_ in connection.execute(f"PRAGMA table_info({table})")}


def _schema() -> str:
    return _MEASURED + "".join(
        f"CREATE TABLE IF NOT EXISTS {name} ({', '.join(_columns(cls))}, PRIMARY KEY ({', '.join(key)})) "
        "STRICT, WITHOUT ROWID;\n"
        for name, (cls, key) in TABLES.items()
    )


def _columns(cls: type[Any]) -> Iterator[str]:
    for name, hint in get_type_hints(cls).items():
        optional = isinstance(hint, UnionType)
        kind = get_args(hint)[0] if optional else hint
        yield f"{name} {_SQL_TYPES[kind]}{'' if optional else ' NOT NULL'}"


def fingerprint(settings: Mapping[str, Any]) -> str:
    """Digest of the settings of a dataset; the number of its episodes is none of them.

    Args:
        settings: Of `plan.DatasetPlan.settings`.

    Example:
        >>> fingerprint({"device": "llvm"}) == fingerprint({"device": "cuda"})
        False
    """
    return hashlib.sha256(msgspec.json.encode(settings, order="sorted")).hexdigest()
