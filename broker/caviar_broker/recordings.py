"""What the recording of a run tells a broker: how far it goes, whose it is, what a replay repeats.

Readers of recordings are imported by the functions that read: a broker that begins a run reads none, and they
take an eighth of its start.
"""

from __future__ import annotations

from collections.abc import Collection
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from caviar_broker.core.plan import RunPlan
from caviar_broker.journal_format import run_of_journal
from caviar_protocol.errors import RecordingError, RunError
from caviar_protocol.files import PUT_BACK, RunDirectory, refuse_other_kinds, sync_file
from caviar_protocol.messages import GrantInput, Status
from caviar_protocol.scenario import ReplaySpec, Scenario

if TYPE_CHECKING:
    from caviar_protocol.recording import Recording


def has_recording(directory: Path) -> bool:
    """Whether there is a file of a recording."""
    return bool(RunDirectory(directory).segments())


def recorded_frames(directory: Path, scenario: Scenario) -> tuple[tuple[int, int] | None, tuple[str, ...]]:
    """The last recorded episode and how many frames of it there are, and what is damaged, a line each.

    None where no recorder of this machine takes part: how far another got is known to that one alone.

    Args:
        directory: Of the run.
        scenario: Of the run.
    """
    recorders = [spec for spec in scenario.services.values() if spec.role == "recorder"]
    # A recording on another machine cannot be looked at: its recorder says what it lacks when it is granted.
    if not any(not spec.remote for spec in recorders):
        return None, ()
    from caviar_protocol.recording.integrity import recorded_until

    last, damage = recorded_until(directory)
    return ((0, 0) if last is None else (last[0], last[1] + 1)), damage


def sync_recording(directory: Path) -> None:
    """Put on the disk what a recorder of this machine has handed to the system.

    The recorder closes a segment when it opens the next one, so the last two may have changed since the
    last time. `RunError` naming the directory where that fails.
    """
    try:
        # The directory too, or a segment that is new could be lost with its name.
        for path in [*RunDirectory(directory).segments()[-2:], directory]:
            # A recorder that goes on writes its last segment anew, so that the file may be gone for a moment.
            with suppress(FileNotFoundError):
                sync_file(path)
    except OSError as error:
        raise RunError(f"cannot put the recording in {directory} on the disk: {error.strerror}") from error


def check_run_files(directory: Path, journal: Path, run: str) -> None:
    """Check that journal and recording are files, and those of this run.

    Args:
        directory: Of the run.
        journal: In it.
        run: Id of the run, as ``run.json`` has it.

    Raises:
        RunError: A file is another run's, or no regular file.
        RecordingError: The journal is none. What is damaged is not looked at here.
    """
    from caviar_protocol.recording import read_manifest
    from caviar_protocol.recording.integrity import metadata_of
    from caviar_protocol.recording.segment import Segment

    files = RunDirectory(directory)
    segments = files.segments()
    for path in (journal, files.manifest, *segments):
        try:
            refuse_other_kinds(path, PUT_BACK)
        except OSError as error:
            raise RunError(f"cannot resume {directory}: {path}: {error.strerror}") from error
    # Each file says by itself which run it is of; copies of a directory keep that.
    runs = {journal.name: run_of_journal(journal)}
    # What is damaged is mended or reported by the reader of the recording; here it only must not be
    # another's.
    with suppress(RecordingError):
        manifest = read_manifest(directory)
        runs[files.manifest.name] = manifest.run if manifest else ""
    with suppress(RecordingError):
        runs |= {path.name: metadata_of(Segment(path)).run for path in segments[:1]}
    strange = [f"{name} is of run {other!r}" for name, other in runs.items() if other not in ("", run)]
    if strange:
        raise RunError(
            f"cannot resume {directory}: run.json is of run {run!r}, but {' and '.join(strange)}; "
            "put the files of one run together"
        )


def with_replay(plan: RunPlan, spec: ReplaySpec | None) -> RunPlan:
    """The plan with the recorded decisions and misses of a run that is repeated.

    Args:
        plan: Of the run that repeats.
        spec: What it repeats; None: nothing.

    Raises:
        RecordingError: There is no such recording.
    """
    if spec is None:
        return plan
    from caviar_protocol.recording import Recording
    from caviar_protocol.recording.reader import recorded_decisions

    recording = Recording(spec.recording)
    decisions = recorded_decisions(recording)
    return replace(
        plan,
        imposed={key: taken for key, taken in decisions.items() if key[0] in spec.imposed},
        recorded=recorded_misses(recording, spec.served),
    )


def recorded_misses(
    recording: Recording, services: Collection[str]
) -> dict[tuple[str, int, int], tuple[GrantInput, ...]]:
    """Provenance of the products of a frame, by (service, episode, frame), where not all were fresh."""
    found: dict[tuple[str, int, int], list[GrantInput]] = {}
    for index in range(len(recording)):
        entry = recording.entry(index)
        for item in entry.inputs:
            if item.source in services and item.status is not Status.LATE:
                found.setdefault((item.source, entry.episode, entry.frame), []).append(item)
    return {
        key: tuple(items)
        for key, items in found.items()
        if any(item.status is not Status.FRESH for item in items)
    }
