"""Child processes of `caviar run`: start a service, end several, and lend them a key for the run."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import tempfile
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from caviar_protocol.files import open_to_append
from caviar_protocol.keys import BROKER, BROKER_KEY_VARIABLE, KEY_VARIABLE, Pair, write_pair

KILLED_S = 2.0
"""[s] within which a process ends that is killed, unless it waits for a disk."""
TAIL = 1 << 16
"""[B] of a log that are looked at for its last line."""


@dataclass
class Child:
    """The process of one service."""

    name: str
    process: subprocess.Popen[bytes]
    log: Path
    pidfd: int
    """Readable once the process is dead."""

    @classmethod
    def start(cls, name: str, command: Sequence[str], log: Path, environment: Mapping[str, str]) -> Child:
        """Start it; its log goes on where one before it ended."""
        with open_to_append(log) as file:
            process = subprocess.Popen(  # noqa: S603  # our own module with checked arguments
                command,
                stdin=subprocess.DEVNULL,
                stdout=file,
                stderr=file,
                start_new_session=True,
                env=environment,
            )
        return cls(name, process, log, os.pidfd_open(process.pid))

    def last_line(self) -> str:
        """The last line it printed; empty if it printed nothing."""
        with self.log.open("rb") as file:
            file.seek(max(0, file.seek(0, os.SEEK_END) - TAIL))
            lines = file.read().decode(errors="replace").strip().splitlines()
        return lines[-1] if lines else ""


def end(processes: Sequence[subprocess.Popen[bytes]], seconds: float) -> list[int]:
    """End all: SIGTERM, and after so long [s] SIGKILL; who waits for a disk and cannot be ended before."""
    for process in processes:
        if process.poll() is None:
            process.send_signal(signal.SIGTERM)
    wait(processes, seconds)
    for process in processes:
        if process.poll() is None:
            process.kill()
    wait(processes, KILLED_S)
    return [process.pid for process in processes if process.poll() is None]


def wait(processes: Sequence[subprocess.Popen[bytes]], seconds: float) -> None:
    """Wait until all have ended, but no longer than that [s]."""
    until = time.monotonic() + seconds
    for process in processes:
        try:
            process.wait(max(0.0, until - time.monotonic()))
        except subprocess.TimeoutExpired:
            continue


class BorrowedKey:
    """A key pair in a folder that only this user can read, removed by `close`.

    Args:
        keys: Keys directory of the broker; None: a run without keys, which needs none.
    """

    def __init__(self, keys: Path | None) -> None:
        self._keys = keys
        self._folder: Path | None = None
        self.public = ""
        """Public key of the lent pair, which the broker gets as ``--local-key``; "" before it is made."""

    def environment(self) -> Mapping[str, str]:
        """Environment of a service that is started here."""
        if self._keys is None:
            return os.environ
        if self._folder is None:
            self._make()
        broker = (self._keys / f"{BROKER}.pub").resolve()
        return {**os.environ, KEY_VARIABLE: str(self._key), BROKER_KEY_VARIABLE: str(broker)}

    def options(self) -> list[str]:
        """What the broker is started with."""
        if self._keys is None:
            return []
        if self._folder is None:
            self._make()
        return ["--keys", str(self._keys), f"--local-key={self.public}"]

    def close(self) -> None:
        """Remove the key."""
        if self._folder is not None:
            shutil.rmtree(self._folder, ignore_errors=True)
            self._folder = None

    def _make(self) -> None:
        self._folder = Path(tempfile.mkdtemp(prefix="caviar-"))
        pair = Pair.new()
        self.public = pair.public
        self._key, _ = write_pair(self._folder, "run", pair)
