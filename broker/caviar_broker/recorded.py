"""What the directory of a run holds of its recording."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path

from caviar_protocol.errors import RunError
from caviar_protocol.files import sync_file
from caviar_protocol.recording.integrity import recorded_until
from caviar_protocol.recording.layout import SEGMENT_PATTERN
from caviar_protocol.scenario import Scenario


def has_recording(directory: Path) -> bool:
    """Whether there is a file of a recording."""
    return any(directory.glob(SEGMENT_PATTERN))


def recorded_frames(directory: Path, scenario: Scenario) -> tuple[tuple[int, int] | None, tuple[str, ...]]:
    """The last recorded episode and how many frames of it there are, and what is damaged, a line each.

    None where no recorder of this machine takes part: how far another got is known to that one alone.
    """
    recorders = [spec for spec in scenario.services.values() if spec.role == "recorder"]
    if not any(not spec.remote for spec in recorders):
        return None, ()
    last, damage = recorded_until(directory)
    return ((0, 0) if last is None else (last[0], last[1] + 1)), damage


def sync_recording(directory: Path) -> None:
    """Put on the disk what a recorder of this machine has handed to the system.

    The recorder closes a segment when it opens the next one, so the last two may have changed since the
    last time. `RunError` naming the directory where that fails.
    """
    try:
        for path in [*sorted(directory.glob(SEGMENT_PATTERN))[-2:], directory]:
            with suppress(FileNotFoundError):
                sync_file(path)
    except OSError as error:
        raise RunError(f"cannot put the recording in {directory} on the disk: {error.strerror}") from error
