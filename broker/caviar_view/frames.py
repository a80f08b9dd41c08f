"""Frames that a viewer shows: of a recording, of a run as it goes on, or the first scene of a scenario."""

from __future__ import annotations

import contextlib
import json
import os
from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from caviar_protocol.arrays import Payload
from caviar_protocol.errors import RecordingError
from caviar_protocol.messages import GrantInput, Status
from caviar_protocol.recording import FrameEntry
from caviar_protocol.run_directory import RunDirectory
from caviar_protocol.topics import Scene

# The reader loads the arrays of every topic, which a run as it goes on does without.
if TYPE_CHECKING:
    from caviar_protocol.recording import Recording


AnsweredGrants = Mapping[str, Mapping[tuple[int, int], tuple[int, int, int]]]
"""By service, then by episode and frame: when a grant was answered [ns], 1 for a miss, latency [ns]."""


def answered_grants(rows: Iterable[Sequence[int]]) -> dict[tuple[int, int], tuple[int, int, int]]:
    """Make an entry of `AnsweredGrants` of rows of `caviar_broker.statistics.Statistics.answers`."""
    return {(episode, frame): (at, missed, took) for episode, frame, at, missed, took in rows}


class Frames(ABC):
    """Frames by their place: ``first`` to ``end`` − 1, in the order of (episode, frame)."""

    kind: str
    """``recording``, ``run`` or ``scenario``."""
    scenario: Mapping[str, Any]
    """As it was resolved."""
    run: str
    seed: int
    assets: Mapping[str, Path]
    """Files of scenery and meshes by asset name."""
    topics: Mapping[str, Sequence[str]]
    """Topics and their sources."""
    damage: Sequence[str]
    """What cannot be shown, a line each."""
    complete: bool
    radio_map: Path | None = None
    """Arrays of a map of coverage (``caviar plot map``); None: there is none."""
    first: int
    """Place of the oldest frame that is held."""
    end: int
    """Place after the newest frame."""

    @abstractmethod
    def entry(self, place: int) -> FrameEntry:
        """Record of a frame."""

    @abstractmethod
    def payload(self, place: int, item: GrantInput) -> Payload:
        """Payload of one of a frame's inputs that is not absent.

        Raises:
            RecordingError: Its bytes are damaged or missing.
        """

    def answers(self) -> AnsweredGrants:
        """Grants that were answered (`caviar_broker.statistics.Statistics.answers`)."""
        return {}

    def events(self) -> Sequence[Mapping[str, Any]]:
        """Notices of the run that name a culprit, or say that a service came back."""
        return ()


CLOCK_NOTICES = frozenset({"miss", "lost", "away", "back", "restarted", "fault", "skipped"})
"""Kinds of notices that the clock shows."""


def events_of(run: Path, most: int = -1) -> list[Mapping[str, Any]]:
    """Read the notices of a run that the clock shows; a line that is not whole is left out.

    Args:
        run: Directory of the run.
        most: Bytes to read at most, the last ones; −1: all.
    """
    found = []
    try:
        with RunDirectory(run).events.open("rb") as file:
            if most >= 0:
                file.seek(max(0, file.seek(0, os.SEEK_END) - most))
            text = file.read().decode(errors="replace")
    except OSError:
        return []
    for line in text.splitlines():
        with contextlib.suppress(ValueError):
            event = json.loads(line)
            if event.get("kind") in CLOCK_NOTICES:
                found.append(event)
    return found


class RecordedFrames(Frames):
    """The frames of a recording.

    Args:
        recording: The recording.
        assets: Files of its scenery by asset name; None: those in its own directory.

    Raises:
        RecordingError: It has no frame.
    """

    kind = "recording"
    first = 0

    def __init__(self, recording: Recording, assets: Mapping[str, Path] | None = None) -> None:
        self._recording = recording
        if not len(recording):
            raise RecordingError(f"{recording.path} has no frame to show")
        metadata = recording.metadata
        self.scenario, self.run, self.seed = metadata.scenario, metadata.run, metadata.seed
        self.assets, self.topics = recording.assets if assets is None else assets, recording.topics
        self.damage, self.complete = recording.damage, recording.complete
        self.end = len(recording)
        found = recording.directory / "radio-map.npz"
        self.radio_map = found if found.is_file() else None

    def entry(self, place: int) -> FrameEntry:
        """Record of a frame."""
        return self._recording.entry(place)

    def payload(self, place: int, item: GrantInput) -> Payload:
        """Payload of one of a frame's inputs, of which the digest is checked."""
        return self._recording.recorded_product(place, item).payload

    def answers(self) -> AnsweredGrants:
        """Of ``latency.npz``; none where the run did not end, or an earlier version wrote it."""
        return self._answers

    @cached_property
    def _answers(self) -> AnsweredGrants:
        try:
            with np.load(RunDirectory(self._recording.directory).latencies) as found:
                return {
                    name.removeprefix("answers/"): answered_grants(found[name].tolist())
                    for name in found
                    if name.startswith("answers/")
                }
        except (OSError, ValueError):
            return {}

    def events(self) -> Sequence[Mapping[str, Any]]:
        """Of ``events.jsonl``."""
        return self._events

    @cached_property
    def _events(self) -> Sequence[Mapping[str, Any]]:
        return events_of(self._recording.directory)


class FirstScene(Frames):
    """The scene that a scenario begins with, as its only frame.

    Args:
        scenario: As it was resolved.
        scene: The scene.
        assets: Files of scenery and meshes by asset name.
        seed: Of the run that would be.
    """

    kind, run, complete = "scenario", "", True
    first, end = 0, 1
    damage = ()

    def __init__(
        self, scenario: Mapping[str, Any], scene: Scene, assets: Mapping[str, Path], seed: int
    ) -> None:
        self.scenario, self._scene, self.assets, self.seed = scenario, scene, assets, seed
        self.topics = {"scene": ("world",)}

    def entry(self, place: int) -> FrameEntry:
        """Record of the frame."""
        item = GrantInput(topic="scene", source="world", status=Status.FRESH)
        return FrameEntry(episode=0, frame=0, t_ns=0, seed=self.seed, inputs=(item,))

    def payload(self, place: int, item: GrantInput) -> Payload:
        """The scene."""
        return self._scene
