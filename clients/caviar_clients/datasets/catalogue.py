"""The catalogue of a dataset: a SQLite database of what there is, which is the ledger of what is to do too.

One process writes it, the command that generates. Tables `episodes`, `scenes`, `users` and `products` depend
on the scenario, the seed and the versions alone, in the order of their keys; `timings` and `failures` do not,
and stand apart for that reason. Its schema is in docs/reference/datasets.md.
"""

from __future__ import annotations

import os
import sqlite3
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager, suppress
from dataclasses import fields
from pathlib import Path
from typing import Any
from urllib.parse import quote

import msgspec

from caviar_clients.datasets.rows import Episode, EpisodeRows, ProductRow, SceneRow, UserRow, column_types
from caviar_clients.datasets.settings import FORMAT, check_settings
from caviar_protocol.errors import RecordingError

REBUILT = "move it away, and the same caviar dataset generate command makes it anew from the recordings"
"""What to do with a catalogue that cannot be read."""

_REMEDIES = {
    sqlite3.SQLITE_FULL: "free space there: the same command then goes on",
    sqlite3.SQLITE_NOTADB: REBUILT,
    sqlite3.SQLITE_CORRUPT: REBUILT,
    sqlite3.SQLITE_READONLY: "allow writing it and its folder, or give a copy where that is allowed",
    # SQLite opens FILE-wal too, where a killed command left changes, and makes FILE-shm beside it.
    sqlite3.SQLITE_CANTOPEN: "allow reading it and what is named like it, and writing in its folder, or give "
    "a copy",
    sqlite3.SQLITE_PERM: "allow reading and writing it, or give a copy",
    sqlite3.SQLITE_AUTH: "allow reading and writing it, or give a copy",
    sqlite3.SQLITE_IOERR: "check the disk (dmesg names its errors), then run the same command again",
}
_LOCKED = (sqlite3.SQLITE_BUSY, sqlite3.SQLITE_LOCKED, sqlite3.SQLITE_PROTOCOL)
_TYPES_DIFFER = "has columns of other types, or another key"
LOCKED_S = 5.0
"""[s] for which the lock of another process is waited for."""

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
CREATE TABLE dataset (key TEXT PRIMARY KEY, value TEXT NOT NULL) STRICT, WITHOUT ROWID;
CREATE TABLE timings (
    episode INTEGER PRIMARY KEY, started TEXT, host TEXT, pid INTEGER, wall_s REAL, cpu_s REAL, detail TEXT
) STRICT;
CREATE TABLE failures (
    episode INTEGER NOT NULL, failed TEXT NOT NULL, error TEXT NOT NULL, host TEXT
) STRICT;
"""


class Catalogue:
    """The catalogue of a dataset.

    Its tables, their columns, the settings and the numbers of episodes are checked when it is opened, so that
    what reads it meets nothing else.

    Args:
        path: Of the database.
        writable: Whether it is made where it is not there, and may be written.
        name: As errors call it, where that is not its path: its address.

    Raises:
        RecordingError: It is not a catalogue, one of another version, or cannot be read; the text says what
            to do.

    Example:
        >>> catalogue = Catalogue(Path("d/catalogue.sqlite"))  # doctest: +SKIP
        >>> catalogue.episodes()  # doctest: +SKIP
        [0, 1, 2]
    """

    def __init__(self, path: Path, *, writable: bool = False, name: str = "") -> None:
        self.path, self._is_writable, self._name = path, writable, name or str(path)
        if not writable and not path.is_file():
            raise RecordingError(
                f"{path.parent} is no dataset, it has no {path.name}; make one with: "
                f"caviar dataset generate SCENARIO --out {path.parent}"
            )
        with self._errors():
            mode = "rwc" if writable else "ro"
            self._connection = sqlite3.connect(
                f"file:{quote(os.fsencode(path))}?mode={mode}", uri=True, timeout=LOCKED_S
            )
        try:
            self._open()
        except BaseException:
            self._connection.close()
            raise

    def _open(self) -> None:
        """Make the tables of a new database; check those of any other, before anything is changed."""
        with self._errors():
            is_new = not self._connection.execute("SELECT count(*) FROM sqlite_schema").fetchone()[0]
        if not is_new or not self._is_writable:
            self._check()
        if not self._is_writable:
            return
        with self._errors():
            self._connection.execute("PRAGMA journal_mode = WAL")
            self._connection.execute("PRAGMA synchronous = NORMAL")
            self._connection.execute("PRAGMA wal_autocheckpoint = 100")  # pages of 4 KiB beside the database
            if is_new:  # all tables or none, wherever a kill comes
                self._connection.executescript(f"BEGIN;{_schema()}COMMIT;")

    def _check(self) -> None:
        """Raise `RecordingError` where this is no catalogue of this version.

        One whose columns have other types may be read, since `verify` looks at the values, but not written.
        """
        with self._errors(), closing(sqlite3.connect(":memory:")) as model:
            model.executescript(_schema())
            expected = {name: _described(model, name) for name in ("dataset", *TABLES, *MEASURED_TABLES)}
            found = {name: _described(self._connection, name) for name in expected}
        if found["dataset"] == expected["dataset"]:  # its format says more than a table of another version
            _, _ = self.settings, self.planned
        for table in expected:
            wrong = _difference(found[table], expected[table])
            if wrong and (self._is_writable or wrong != _TYPES_DIFFER):
                raise self._no_catalogue(f"table {table} {wrong}")
        for table in (*TABLES, *MEASURED_TABLES):
            (least,) = self._rows(f"SELECT min(episode) FROM {table}")[0]  # noqa: S608 - names of our own
            if least is not None and least < 0:
                raise self._no_catalogue(f"table {table} has an episode {least}, and they count from 0")

    def _no_catalogue(self, why: str, remedy: str = REBUILT) -> RecordingError:
        return RecordingError(f"{self._name} is no catalogue that can be used: {why}; {remedy}")

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
        """Settings of the dataset (`plan.DatasetPlan.settings`); empty where none were kept.

        Raises:
            RecordingError: They are not what a dataset of this version has.
        """
        text = self._note("settings")
        if not text:
            return {}
        try:
            settings: dict[str, Any] = msgspec.json.decode(text, type=dict[str, Any])
            made_as = settings.get("format", FORMAT)
            if made_as != FORMAT and isinstance(made_as, int):
                remedy = (
                    "read it with that version of CAVIAR, or generate it anew with another --out"
                    if made_as < FORMAT
                    else "install a newer version of CAVIAR"
                )
                raise self._no_catalogue(f"it has format {made_as}, and this version reads {FORMAT}", remedy)
            check_settings(settings)
        except (msgspec.MsgspecError, RecursionError, UnicodeError) as error:
            raise self._no_catalogue(f"the settings in table dataset are damaged: {error}") from error
        return settings

    @property
    def planned(self) -> int:
        """Episodes that the dataset shall have.

        Raises:
            RecordingError: It is no number of episodes.
        """
        text = self._note("episodes") or "0"
        # SQLite's integers, which number the episodes, end below 2^63.
        if not (text.isascii() and text.isdecimal()) or len(text) > 18:
            raise self._no_catalogue(f"the number of episodes in table dataset is {text[:40]!r}")
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

    def sizes(self) -> dict[int, int]:
        """Size of the recording of each episode [B], by its number, in order."""
        return dict(self._rows("SELECT episode, bytes FROM episodes ORDER BY episode"))

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
            if cursor.description is None:
                raise RecordingError(f"{self._name}: {sql!r} asks for no columns; write a SELECT")
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
        """Raise errors of SQLite as `RecordingError`, with the remedy."""
        try:
            yield
        except sqlite3.Error as error:
            # The low byte is the kind, the others say more of it; errors of the module itself have none.
            kind = getattr(error, "sqlite_errorcode", 0) & 0xFF
            remedy = _REMEDIES.get(kind, "")
            if kind in _LOCKED:
                holders = ", ".join(_holders_of(self.path)) or "another process"
                remedy = f"{holders} writes it: wait until that ends, then run the same command again"
            raise RecordingError(f"{self._name}: {error}{'; ' if remedy else ''}{remedy}") from error


def _holders_of(path: Path) -> list[str]:
    """Name the other processes of this machine that hold a lock on a database, its ``-wal`` or ``-shm``.

    Returns:
        ``process 4711 (sqlite3)``, …; empty where none is found, or the system does not tell.
    """
    files = (path, *(path.with_name(path.name + end) for end in ("-wal", "-shm")))
    inodes = {str(file.stat().st_ino) for file in files if file.exists()}
    found = dict[str, None]()
    with suppress(OSError, ValueError, IndexError):  # no such system, or a line of another form
        for line in Path("/proc/locks").read_text().splitlines():
            # «1: POSIX ADVISORY WRITE 4711 08:01:123456 0 EOF»; one that waits has «->» before its class.
            words = line.split()
            if "->" in words or words[5].rpartition(":")[2] not in inodes or int(words[4]) == os.getpid():
                continue
            command = Path(f"/proc/{words[4]}/comm")
            of = f" ({command.read_text().strip()})" if command.exists() else ""
            found[f"process {words[4]}{of}"] = None
    return list(found)


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
    with closing(sqlite3.connect(":memory:")) as connection:
        connection.executescript(_MEASURED)
        return {name: kind for name, kind, *_ in _described(connection, table)}


def _described(connection: sqlite3.Connection, table: str) -> list[tuple[Any, ...]]:
    """Name, type, whether NULL is refused, and place in the key of each column; empty where no table is.

    A table whose types bind nothing (not ``STRICT``), or that is a view, has columns of the kind ``ANY``.
    """
    about = connection.execute("SELECT type, strict FROM pragma_table_list(?)", (table,)).fetchall()
    columns = connection.execute('SELECT name, type, "notnull", pk FROM pragma_table_info(?)', (table,))
    return [
        (name, kind if about == [("table", 1)] else "ANY", *others)
        for name, kind, *others in columns.fetchall()
    ]


def _difference(found: Sequence[tuple[Any, ...]], expected: Sequence[tuple[Any, ...]]) -> str:
    """Fault of a table, by the descriptions of its columns; empty where there is none."""
    if not found:
        return "is missing"
    names, right = [column[0] for column in found], [column[0] for column in expected]
    if lacking := [name for name in right if name not in names]:
        return f"has no column {lacking[0]}"
    if strange := [name for name in names if name not in right]:
        return f"has a column {strange[0]} too many"
    if names != right:
        return f"has its columns in the order {', '.join(names)}"
    return "" if found == expected else _TYPES_DIFFER


def _schema() -> str:
    return _MEASURED + "".join(
        f"CREATE TABLE {name} ({', '.join(_columns(cls))}, PRIMARY KEY ({', '.join(key)})) "
        "STRICT, WITHOUT ROWID;\n"
        for name, (cls, key) in TABLES.items()
    )


def _columns(cls: type[Any]) -> Iterator[str]:
    for name, (kind, optional) in column_types(cls).items():
        yield f"{name} {_SQL_TYPES[kind]}{'' if optional else ' NOT NULL'}"
