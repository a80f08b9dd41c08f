"""What a replay needs of a recorded run."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TypeAlias

from caviar_protocol.recording import Recording

Imposed: TypeAlias = Mapping[tuple[str, int, int], Mapping[str, str]]
"""Decisions to impose, by (service, episode, frame) (contract, clause 6)."""


def recorded_decisions(recording: Recording) -> Imposed:
    """All decisions that services took in a recorded run."""
    return {
        (report.source, frame.episode, frame.number): report.decisions
        for frame in recording.frames()
        for report in frame.reports
        if report.decisions
    }
