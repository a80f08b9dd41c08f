"""States of services, as files beside the journal (contract, clause 18)."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from caviar_protocol.errors import RecordingError, RunError

FOLDER = "checkpoints"


class CheckpointFiles:
    """``checkpoints/NAME-EPISODE-FRAME.bin`` in the directory of a run.

    A file is there as a whole or not at all. Kept of each service are the newest one of a frame that
    is finished, since a broker that resumes goes on behind the last finished frame, and all later ones.
    """

    def __init__(self, directory: Path) -> None:
        self._folder = directory / FOLDER
        self.finished = (0, -1)
        """(episode, frame) that was finished last."""
        self._kept: dict[str, dict[tuple[int, int], Path]] = {}
        """Files of each service by (episode, frame), in that order."""

    def save(self, service: str, episode: int, frame: int, state: Any) -> str:
        """Write a state; the name of its file. `RunError` naming the file where that fails."""
        path = self._folder / f"{service}-{episode}-{frame}.bin"
        partial = path.with_suffix(".partial")
        try:
            self._folder.mkdir(exist_ok=True)
            partial.write_bytes(memoryview(state))
            partial.replace(path)
        except OSError as error:
            raise RunError(f"cannot write the state of {service!r} to {path}: {error.strerror}") from error
        self._kept.setdefault(service, {})[episode, frame] = path
        return path.name

    def prune(self) -> None:
        """Remove what nothing needs any more, now that the journal tells of what came since."""
        for kept in self._kept.values():
            safe = [instant for instant in kept if instant <= self.finished]
            for instant in safe[:-1]:
                kept.pop(instant).unlink(missing_ok=True)

    def known(self, service: str, episode: int, frame: int) -> bytes:
        """A state that was saved before a restart of the broker; it is kept like a new one.

        `RecordingError` naming the file where it cannot be read.
        """
        path = self._folder / f"{service}-{episode}-{frame}.bin"
        try:
            state = path.read_bytes()
        except OSError as error:
            raise RecordingError(
                f"cannot read the state of {service!r} from {path}: {error.strerror}"
            ) from error
        self._kept.setdefault(service, {})[episode, frame] = path
        return state
