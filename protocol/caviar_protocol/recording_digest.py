"""A run's digest from its recorded bytes, and the damage that shows in it."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable

import msgspec

from caviar_protocol.digest import RunDigest
from caviar_protocol.errors import RecordingError
from caviar_protocol.messages import Status
from caviar_protocol.recording_layout import ASSET_FOLDER, FrameEntry
from caviar_protocol.recording_segments import RecordedSegments, metadata_of
from caviar_protocol.regular_file import open_regular
from caviar_protocol.segment import Channel, Chunk, Segment


class RunDigestReport(msgspec.Struct, frozen=True, kw_only=True):
    """A run's digest as its recorded bytes give it, and what in them is damaged."""

    digest: str
    frames: int
    damage: tuple[str, ...] = ()
    """Each names file, frame, topic and source; empty: every byte is as it was written."""


def recorded_digest(recorded: RecordedSegments) -> RunDigestReport:
    """The digest of a recording (`caviar_protocol.recording.Recording.run_digest`)."""
    chain, damage = RunDigest(), list(recorded.damage)
    earlier: FrameEntry | None = None
    for segment in recorded.segments:
        places: list[tuple[int, int]] = []
        """Bytes of which damage is told frame by frame."""
        for entry, chunk in zip(segment.entries, segment.chunks, strict=True):
            at = (
                f"{recorded.path}: episode {entry.episode}, frame {entry.frame} "
                f"({segment.path.name}, offset {chunk.offset})"
            )
            fresh, faults = _faults(entry, segment, chunk)
            if faults:
                places.append((chunk.offset, chunk.stop))
            if earlier is not None and (gap := _gap(earlier, entry)):
                faults.append(gap)
            earlier = entry
            damage += [f"{at}: {fault}" for fault in faults]
            chain.add_frame(entry.episode, entry.frame, fresh)
        damage += _altered(segment, recorded, places)
    damage += damaged_assets(recorded)
    frames = sum(len(segment.entries) for segment in recorded.segments)
    return RunDigestReport(digest=chain.hexdigest(), frames=frames, damage=tuple(damage))


def declared_digest(entries: Iterable[FrameEntry]) -> str:
    """The digest of frames by the digests that stand in their records; no product is read."""
    chain = RunDigest()
    for entry in entries:
        fresh = [(i.topic, i.source, i.digest) for i in entry.inputs if i.status is Status.FRESH]
        chain.add_frame(entry.episode, entry.frame, fresh)
    return chain.hexdigest()


def damaged_assets(recorded: RecordedSegments) -> list[str]:
    """Files of the recorded scenery that are missing or altered: a line each."""
    if not recorded.segments or recorded.path.is_file():
        return []
    found = []
    for asset in metadata_of(recorded.segments[0]).assets:
        file = recorded.path / ASSET_FOLDER / asset.name
        try:
            with open_regular(file) as stream:
                digest = hashlib.file_digest(stream, "sha256").hexdigest()
        except OSError as error:
            found.append(f"{file} cannot be read: {error.strerror}")
            continue
        if digest != asset.digest:
            found.append(f"{file}: its digest is {digest}, was {asset.digest}")
    return found


def _altered(segment: Segment, recorded: RecordedSegments, told: list[tuple[int, int]]) -> list[str]:
    """Ranges of a segment that are not as they were written, other than those of damage ``told`` already."""
    record = recorded.record(segment)
    found = segment.altered(record.crc if record is not None and len(segment) == record.size else None)
    return [
        f"{segment.path}: bytes {start} to {stop} are not what was written (CRC-32)"
        for start, stop in found
        if not any(start < end and begin < stop for begin, end in told)
    ]


def _faults(
    entry: FrameEntry, segment: Segment, chunk: Chunk
) -> tuple[list[tuple[str, str, str]], list[str]]:
    """(topic, source, digest) of the fresh products of a frame as stored, and what is wrong there."""
    try:
        fresh, faults = _rehash(entry, segment, chunk)
        if segment.damaged(chunk):
            faults.append("the CRC-32 of its chunk differs")
    except RecordingError as error:
        return [], [str(error)]
    return fresh, faults


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
