"""What a recording consists of: names and records that its writer and its reader share."""

from __future__ import annotations

from typing import Annotated, Any

import msgspec

from caviar_protocol.arrays import quantity
from caviar_protocol.messages import Asset, GrantInput, Report

FORMAT = 1
"""Version of the layout of a recording; a reader refuses any other."""

ASSET_FOLDER = "assets"
"""Folder of the run directory that holds the scenery, files at their asset names."""

SEGMENT_PATTERN = "recording-*.mcap"


def segment_name(index: int) -> str:
    """File name of a segment."""
    return f"recording-{index:04d}.mcap"


PROFILE = "caviar"
"""MCAP profile of a segment."""

FRAME_TOPIC = "frame"
"""MCAP topic of the `FrameEntry` of each frame, the first message of its chunk."""

METADATA_NAME = "caviar"
"""Name of the MCAP metadata record that holds `RecordingMetadata`, a JSON text a field."""


class RecordingMetadata(msgspec.Struct, frozen=True, kw_only=True):
    """What stands once in every segment: how the run was made."""

    format: int = FORMAT
    segment: int = 0
    """Number of the segment, from 0."""
    run: str = ""
    seed: int = 0
    sampling_period_ns: Annotated[int, quantity("ns", "T_sam")] = 0
    frames: Annotated[int, quantity("frame", "of an episode, as planned")] = 0
    scenario: dict[str, Any] = {}
    """The scenario as resolved: every default in its place."""
    versions: dict[str, str] = {}
    """Version of Python and of each installed package that the run may use."""
    machine: dict[str, str] = {}
    """``platform``, ``cpu``, ``cpu_count``, ``gpu`` where there is one."""
    started: str = ""
    """Start of the recording, ISO 8601, UTC."""
    assets: tuple[Asset, ...] = ()
    notes: tuple[str, ...] = ()

    @property
    def name(self) -> str:
        """Name of the scenario."""
        run = self.scenario.get("run")
        return str(run.get("name", "")) if isinstance(run, dict) else ""


class FrameEntry(msgspec.Struct, frozen=True, kw_only=True, omit_defaults=True):
    """What a recording says about one frame beside its products; msgpack on the wire."""

    episode: Annotated[int, quantity("1", "episode number, from 0", ge=0)]
    frame: Annotated[int, quantity("1", "frame number in the episode, from 0", ge=0)]
    t_ns: Annotated[int, quantity("ns", "simulated time of the frame in the episode")]
    seed: Annotated[int, quantity("1", "seed of the episode")] = 0
    inputs: tuple[GrantInput, ...] = ()
    """Provenance of every product, sorted by (topic, source, frame). Fresh and late products
    stand in the frame's chunk, a held one in the chunk of the frame it was computed for."""
    reports: tuple[Report, ...] = ()
    """What services reported beside their products: decisions that a replay imposes, counts of what
    was dropped, and wall times, which no digest covers."""
