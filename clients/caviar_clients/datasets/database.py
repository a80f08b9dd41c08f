"""Errors of SQLite as errors of CAVIAR: file, what SQLite says, and what to do."""

from __future__ import annotations

import os
import sqlite3
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

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


@contextmanager
def database_errors(path: Path, name: str) -> Iterator[None]:
    """Raise errors of SQLite as `RecordingError`, with the remedy.

    Args:
        path: Of the database.
        name: As the user knows it: its path, or its address.

    Raises:
        RecordingError: SQLite refuses.

    Example:
        >>> with database_errors(Path("catalogue.sqlite"), "catalogue.sqlite"):
        ...     sqlite3.connect(":memory:").execute("SELECT gain FROM users")
        Traceback (most recent call last):
        caviar_protocol.errors.RecordingError: catalogue.sqlite: no such table: users
    """
    try:
        yield
    except sqlite3.Error as error:
        # The low byte is the kind, the others say more of it; errors of the module itself have none.
        kind = getattr(error, "sqlite_errorcode", 0) & 0xFF
        remedy = _REMEDIES.get(kind, "")
        if kind in _LOCKED:
            holders = ", ".join(holders_of(path)) or "another process"
            remedy = f"{holders} writes it: wait until that ends, then run the same command again"
        raise RecordingError(f"{name}: {error}{'; ' if remedy else ''}{remedy}") from error


def holders_of(path: Path) -> list[str]:
    """The other processes of this machine that hold a lock on a database, for an error.

    Args:
        path: Of the database; its ``-wal`` and ``-shm`` count too.

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
