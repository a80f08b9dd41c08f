"""What a recorded run tells the core about a run that repeats it."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import replace

from caviar_broker.core.plan import RunPlan
from caviar_protocol.messages import GrantInput, Status
from caviar_protocol.recording import Recording
from caviar_protocol.recording.reader import recorded_decisions
from caviar_protocol.scenario import ReplaySpec


def with_replay(plan: RunPlan, spec: ReplaySpec | None) -> RunPlan:
    """The plan with the recorded decisions and misses of a run that is repeated.

    Raises `RecordingError` where there is no such recording.
    """
    if spec is None:
        return plan
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
