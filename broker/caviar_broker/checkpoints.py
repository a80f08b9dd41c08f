"""States of services, as files beside the journal (contract, clause 18)."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path
from typing import Any

from caviar_protocol.errors import RunError
from caviar_protocol.files import read_regular, replace_file, sync_file

FOLDER = "checkpoints"


class CheckpointFiles:
    """``checkpoints/NAME-EPISODE-FRAME.bin`` in the directory of a run.

    A file is there as a whole or not at all. Kept of each service are the newest one of a frame that
    is finished, since a broker that resumes goes on behind the last finished frame, and all later ones.

    Parameters
    ----------
    directory
        Of the run.
    durable
        Whether a state has to be on the disk before an older one may go.
    """

    def __init__(self, directory: Path, *, durable: bool = False) -> None:
        self._folder, self._durable = directory / FOLDER, durable
        self.finished = (0, -1)
        """(episode, frame) that was finished last, and will be so for a broker that resumes."""
        self._kept: dict[str, dict[tuple[int, int], Path]] = {}
        """Files of each service by (episode, frame), in that order."""
        self._saved: list[Path] = []
        """Files that are not named by an entry of the journal yet."""
        self._unsynced: list[Path] = []
        """Files that are, and may not be on the disk."""
        self._synced: set[Path] = set()

    def save(self, service: str, episode: int, frame: int, state: Any) -> tuple[str, str]:
        """Write a state; its file's name and SHA-256. `RunError` naming the file where that fails."""
        path, data = self._folder / f"{service}-{episode}-{frame}.bin", memoryview(state)
        try:
            self._folder.mkdir(exist_ok=True)
            replace_file(path, data, durable=False)
        except OSError as error:
            raise RunError(f"cannot write the state of {service!r} to {path}: {error.strerror}") from error
        self._kept.setdefault(service, {})[episode, frame] = path
        self._synced.discard(path)
        self._saved.append(path)
        return path.name, hashlib.sha256(data).hexdigest()

    def entered(self) -> None:
        """The journal names what was saved: remove what nothing needs any more."""
        self._unsynced += self._saved
        self._saved = []
        for kept in self._kept.values():
            safe = [i for i in kept if i <= self.finished and (not self._durable or kept[i] in self._synced)]
            for instant in safe[:-1]:
                path = kept.pop(instant)
                self._synced.discard(path)
                path.unlink(missing_ok=True)

    def sync(self) -> list[Path]:
        """Put on the disk what the journal names; these files. `RunError` where that fails."""
        paths, self._unsynced = self._unsynced, []
        try:
            for path in paths:
                with suppress(FileNotFoundError):  # it was removed meanwhile
                    sync_file(path)
            if paths:
                sync_file(self._folder)
                sync_file(self._folder.parent)
        except OSError as error:
            raise RunError(f"cannot write states to {self._folder}: {error.strerror}") from error
        return paths

    def synced(self, paths: Iterable[Path]) -> None:
        """These files and the entries that name them are on the disk."""
        self._synced.update(paths)

    def known(self, service: str, file: str, digest: str) -> bytes | None:
        """A state that was saved before a restart of the broker; None where it is gone, or is another."""
        path = self._folder / file
        try:
            state = read_regular(path)
        except OSError:
            return None
        if hashlib.sha256(state).hexdigest() != digest:
            return None
        *_, episode, frame = path.stem.rsplit("-", 2)
        self._kept.setdefault(service, {})[int(episode), int(frame)] = path
        self._synced.add(path)
        return state
