"""Scenes that all settings are measured on: spread over an episode, and a block of consecutive ones."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import TypeVar

import numpy as np

from caviar_clients.session.prepared import PreparedScenario, prepare
from caviar_clients.session.scenes import (
    Instant,
    Scenes,
    is_recording,
    recorded_instants,
    recorded_scenes,
    simulated_scenes,
)
from caviar_protocol.errors import RecordingError, RunError, ScenarioError
from caviar_protocol.recording import Recording
from caviar_protocol.space.scene import pairs_of

T = TypeVar("T")

CONSECUTIVE = 21
"""Consecutive frames that keyframes are measured on: two intervals of ten, and the frame before."""


def scenes_of(path: Path, frames: int, prepared: PreparedScenario | None = None) -> Scenes:
    """Take scenes, spread evenly over the first episode of a scenario or a recording.

    Args:
        path: Scenario file, run directory or segment.
        frames: Number of scenes, about: those without a transmitter or a receiver are left out.
        prepared: The scenario of that file; None: it is prepared here.

    Raises:
        ScenarioError: The scenario is wrong, or has no carrier.
        RecordingError: The recording is wrong, or holds no scene.
        RunError: The worlds fail, or no scene has both a transmitter and a receiver.

    Example:
        >>> scenes = scenes_of(Path("runs/smoke-20261122-101500"), 2)
        >>> len(scenes.instants), scenes.carriers[0].name
        (2, 'mmwave')
    """
    block: Sequence[Instant]
    if is_recording(path):
        recording = Recording(path)
        first = recording.entry(0).episode if len(recording) else 0
        # Of the first episode alone, as of a scenario: another one has other objects of the same names.
        kept = [frame for frame in recording.frames() if frame.episode == first]
        instants = recorded_instants(_spread(kept, frames))
        if not instants:
            raise RecordingError(
                f'{path} holds no scene; record the topic: record = ["scene", …] in the table [run]'
            )
        found, block = recorded_scenes(recording, instants), recorded_instants(_middle(kept))
    else:
        found = simulated_scenes(path, prepared or prepare(path))
        block = _middle(found.instants)
        found = found.with_instants(tuple(_spread(found.instants, frames)))
    if not found.carriers:
        raise ScenarioError(
            "a channel needs at least one carrier; add [[carriers]] with name and frequency_hz",
            key="carriers",
        )
    # A scene without a pair has no channel: it would count as one that costs nothing.
    served = tuple(instant for instant in found.instants if pairs_of(instant.scene))
    if not served:
        raise RunError(
            f"none of the {len(found.instants)} scenes of {found.origin} has a transmitter and a receiver; "
            "there is no channel to compare"
        )
    return dataclasses.replace(found, instants=served, consecutive=_longest_run(block))


def _spread(entries: Sequence[T], count: int) -> list[T]:
    """Take ``count`` entries, evenly spread, the first and the last among them; all where there are fewer."""
    if len(entries) <= count:
        return list(entries)
    # Rounding may hit an entry twice where there are few.
    return [entries[i] for i in np.unique(np.linspace(0, len(entries) - 1, count).round().astype(int))]


def _middle(entries: Sequence[T]) -> list[T]:
    """Take `CONSECUTIVE` entries from the middle; all where there are fewer."""
    first = max(0, (len(entries) - CONSECUTIVE) // 2)
    return list(entries[first : first + CONSECUTIVE])


def _longest_run(instants: Sequence[Instant]) -> tuple[Instant, ...]:
    """Find the longest run of frames with successive numbers that have a transmitter and a receiver."""
    runs: list[list[Instant]] = [[]]
    for instant in instants:
        if runs[-1] and instant.frame != runs[-1][-1].frame + 1:
            runs.append([])
        if pairs_of(instant.scene):
            runs[-1].append(instant)
        elif runs[-1]:
            runs.append([])
    # Of several equal ones the first, so that two comparisons take the same frames.
    longest: list[Instant] = max(runs, key=lambda run: len(run))
    return tuple(longest)
