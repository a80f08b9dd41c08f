"""Whether a run that came to its end recorded what it was."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from caviar_protocol.errors import RecordingError
from caviar_protocol.recording import Recording
from caviar_protocol.recording.integrity import declared_digest
from caviar_protocol.scenario import Scenario


def with_recording_checked(
    directory: Path, scenario: Scenario, outcome: Mapping[str, Any]
) -> Mapping[str, Any]:
    """How a run ended; with an error where it came to its end and its recording is another run's.

    The digests that the recording has of its products are compared, and no product is read.
    """
    recorders = [spec for spec in scenario.services.values() if spec.role == "recorder" and not spec.remote]
    if outcome["error"] or not outcome["frames"] or not recorders:
        return outcome
    try:
        with warnings.catch_warnings(action="ignore"):  # what is missing shows in the digest
            recording = Recording(directory)
        digest = declared_digest(recording.entry(index) for index in range(len(recording)))
    except RecordingError as error:
        return {**outcome, "error": f"the run came to its end, and its recording cannot be read: {error}"}
    if digest == outcome["digest"]:
        return outcome
    differs = f"the run came to its end, and its recording in {directory} is not that of the run"
    figures = (
        f"{len(recording)} frames, digest {digest}; the run has {outcome['frames']}, {outcome['digest']}"
    )
    return {**outcome, "error": f"{differs}: {figures}"}
