"""Locks of what is trained: one process at a time, until it ends, however it ends."""

from __future__ import annotations

import fcntl
import os
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO

from caviar_clients.files import writing
from caviar_protocol.errors import RunError


@contextmanager
def locked(file: Path, what: str, patience_s: float = 0.0) -> Iterator[None]:
    """Keep other processes from training the same; the lock ends with the process, however it ends.

    Args:
        file: Of the lock; it is made, with the folders to it.
        what: Is trained, as the error's subject.
        patience_s: How long the process before may take to its end.

    Raises:
        RunError: Another process trains it, or the disk refuses.
    """
    while True:
        with writing(file):
            stream = file.open("a+")
        with stream:
            _lock(stream, what, patience_s)
            if not _is_still_at(file, stream):  # the process before has removed the folder that it had made
                continue
            stream.truncate(0)
            stream.write(str(os.getpid()))
            stream.flush()
            yield
            return


def _is_still_at(file: Path, stream: IO[str]) -> bool:
    try:
        return os.path.samestat(file.stat(), os.fstat(stream.fileno()))
    except FileNotFoundError:
        return False


def _lock(stream: IO[str], what: str, patience_s: float) -> None:
    until = time.monotonic() + patience_s
    while True:
        try:
            fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            # A child whose parent was killed ends at its next report.
            if time.monotonic() > until:
                stream.seek(0)
                holder = stream.read() or "that has just begun"
                raise RunError(
                    f"{what} is being trained by process {holder}; wait for it, or end it"
                ) from None
            time.sleep(0.05)
        else:
            return
