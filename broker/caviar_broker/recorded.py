"""What the directory of a run holds of its recording."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path

from caviar_protocol.durability import sync_file
from caviar_protocol.errors import RunError
from caviar_protocol.recording_layout import SEGMENT_PATTERN


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
