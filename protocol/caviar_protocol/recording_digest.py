"""A run's digest from its recorded bytes, and the damage that shows in it."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from pathlib import Path

import msgspec

from caviar_protocol.digest import RunDigest
from caviar_protocol.messages import Status
from caviar_protocol.recording_layout import FrameEntry
from caviar_protocol.segment import Channel, Chunk, Segment


class RunDigestReport(msgspec.Struct, frozen=True, kw_only=True):
    """A run's digest as its recorded bytes give it, and what in them is damaged."""

    digest: str
    frames: int
    damage: tuple[str, ...] = ()
    """Each names file, frame, topic and source; empty: every byte is as it was written."""


def recorded_digest(path: Path, segments: Sequence[Segment]) -> RunDigestReport:
    """The digest of the recording at ``path`` (`caviar_protocol.recording.Recording.run_digest`)."""
    chain, damage = RunDigest(), list[str]()
    earlier: FrameEntry | None = None
    for segment in segments:
        for entry, chunk in zip(segment.entries, segment.chunks, strict=True):
            at = (
                f"{path}: episode {entry.episode}, frame {entry.frame} "
                f"({segment.path.name}, offset {chunk.offset})"
            )
            fresh, faults = _rehash(entry, segment, chunk)
            if segment.damaged(chunk):
                faults.append("the CRC-32 of its chunk differs")
            if earlier is not None and (gap := _gap(earlier, entry)):
                faults.append(gap)
            earlier = entry
            damage += [f"{at}: {fault}" for fault in faults]
            chain.add_frame(entry.episode, entry.frame, fresh)
    for segment in segments:
        if segment.altered and not any(segment.path.name in place for place in damage):
            damage.append(f"{segment.path}: the CRC-32 of the file differs, outside of the products")
    frames = sum(len(segment.entries) for segment in segments)
    return RunDigestReport(digest=chain.hexdigest(), frames=frames, damage=tuple(damage))


def _rehash(
    entry: FrameEntry, segment: Segment, chunk: Chunk
) -> tuple[list[tuple[str, str, str]], list[str]]:
    """(topic, source, digest) of the fresh products of a frame as stored, and what is wrong there."""
    stored = {(message.channel, message.frame): message.data for message in segment.messages(chunk)}
    fresh, faults = [], []
    for item in entry.inputs:
        if item.status not in (Status.FRESH, Status.LATE):
            continue
        data = stored.get((Channel(item.topic, item.source), item.frame))
        if data is None:
            faults.append(f"{item.topic} of {item.source!r}: its bytes are missing")
            continue
        digest = hashlib.sha256(data).hexdigest()
        if digest != item.digest:
            faults.append(f"{item.topic} of {item.source!r}: its digest is {digest}, was {item.digest}")
        if item.status is Status.FRESH:
            fresh.append((item.topic, item.source, digest))
    return fresh, faults


def _gap(earlier: FrameEntry, later: FrameEntry) -> str:
    if later.episode != earlier.episode or later.frame == earlier.frame + 1:
        return ""
    return f"it follows frame {earlier.frame}: what was between is lost"
