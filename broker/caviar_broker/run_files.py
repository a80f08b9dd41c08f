"""What has to hold of the files in a run's directory before a broker goes on with it."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path

from caviar_broker.journal_format import run_of_journal
from caviar_protocol.errors import RecordingError, RunError
from caviar_protocol.files import PUT_BACK, refuse_other_kinds
from caviar_protocol.recording.integrity import metadata_of
from caviar_protocol.recording.layout import MANIFEST_NAME, SEGMENT_PATTERN, read_manifest
from caviar_protocol.recording.segment import Segment


def check_run_files(directory: Path, journal: Path, run: str) -> None:
    """Check that journal and recording are files, and those of this run.

    Parameters
    ----------
    directory
        Of the run.
    journal
        In it.
    run
        Id of the run, as ``run.json`` has it.

    Raises `RunError` naming what is another run's, or no file; `RecordingError` where the journal is none.
    What is damaged is not looked at here.
    """
    segments = sorted(directory.glob(SEGMENT_PATTERN))
    for path in (journal, directory / MANIFEST_NAME, *segments):
        try:
            refuse_other_kinds(path, PUT_BACK)
        except OSError as error:
            raise RunError(f"cannot go on with {directory}: {path}: {error.strerror}") from error
    runs = {journal.name: run_of_journal(journal)}
    with suppress(RecordingError):
        manifest = read_manifest(directory)
        runs[MANIFEST_NAME] = manifest.run if manifest else ""
    with suppress(RecordingError):
        runs |= {path.name: metadata_of(Segment(path)).run for path in segments[:1]}
    strange = [f"{name} is of run {other!r}" for name, other in runs.items() if other not in ("", run)]
    if strange:
        raise RunError(
            f"cannot go on with {directory}: run.json is of run {run!r}, but {' and '.join(strange)}; "
            "put the files of one run together"
        )
