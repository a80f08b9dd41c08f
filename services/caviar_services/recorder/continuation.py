"""Going on with a recording that another process began: nothing twice, nothing lost (clause 18)."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import TypeAlias

import msgspec

from caviar_protocol.errors import RecordingError, RunError
from caviar_protocol.files import RunDirectory, sync_file
from caviar_protocol.messages import GrantInput, Status
from caviar_protocol.recording import Manifest, SegmentRecord, frame_name
from caviar_protocol.recording.integrity import RecordedSegments, follows
from caviar_protocol.recording.segment import Channel, Segment
from caviar_services.recorder.segment_writer import SegmentWriter
from caviar_services.service import FrameInput

Rewrite: TypeAlias = Callable[[Path, Segment], SegmentWriter]
"""Opens a file that takes the place of a segment."""


class RunTime:
    """Run time of frames: a later episode begins one sampling period after the end of the one before."""

    def __init__(self, sampling_period_ns: int) -> None:
        self._period = sampling_period_ns
        self._episode = -1
        self._base_ns, self._last_ns = 0, 0

    def continue_from(self, episode: int, base_ns: int, t_ns: int) -> None:
        """A frame was recorded already."""
        self._episode, self._base_ns, self._last_ns = episode, base_ns, base_ns + t_ns

    def base_of(self, episode: int, t_ns: int) -> int:
        """Run time of the episode's zero, for its next frame [ns]."""
        if self._episode >= 0 and episode != self._episode:
            self._base_ns = self._last_ns + self._period - t_ns
        self._episode, self._last_ns = episode, self._base_ns + t_ns
        return self._base_ns


class Stored:
    """Which products of the episode are in the recording already. A late product may be held later."""

    def __init__(self) -> None:
        self._newest: dict[tuple[str, str], int] = {}
        self._episode = -1

    def begin(self, episode: int) -> None:
        """What comes is of this episode."""
        if episode != self._episode:
            self._newest.clear()
            self._episode = episode

    def is_new(self, entry: GrantInput) -> bool:
        """Whether the bytes of a product have to be stored."""
        if entry.status is Status.ABSENT:
            return False
        key = (entry.topic, entry.source)
        newest = self._newest.get(key, -1)
        if entry.status is Status.HELD and newest == entry.frame:
            return False
        self._newest[key] = max(newest, entry.frame)
        return True


@dataclass
class Continuation:
    """What an earlier process recorded, up to the frame that is granted next.

    Args:
        folder: Directory of the run.
        runtime, stored: Brought to where they were.
    """

    folder: Path
    runtime: RunTime
    stored: Stored
    records: list[SegmentRecord] = field(default_factory=list)
    """The segments that are there, all of them finished."""

    def take_over(self, until: tuple[int, int] | None, rewrite: Rewrite, *, sync: bool) -> None:
        """Keep the frames before ``until`` (episode, frame), or all of them.

        A segment that breaks off, or has later frames, is written anew from its whole records and takes
        its place in one step; one with nothing to keep is removed. The manifest says so first, so that a
        reader who comes in between, or after a loss of power, finds nothing that contradicts it.
        Of finished segments, which the manifest knows, only the last one is opened.

        Raises `RunError` where frames before ``until`` are missing; then nothing is changed.
        """
        files, damage = RunDirectory(self.folder).segments(), list[str]()
        try:
            found = RecordedSegments(self.folder, trusted_before=until or _END) if files else None
        except RecordingError as error:
            found, damage = None, [str(error)]  # it may have died before it wrote anything
        records = found.trusted if found is not None else []
        last = records[-1].last if records else None
        keep: list[tuple[Segment, list[int]]] = []
        for segment in found.segments if found is not None else ():
            frames, last = _frames_to_keep(segment, last, until)
            keep += [(segment, frames)] if frames else []
        damage += found.damage if found is not None else []
        if until is None and damage:
            raise self._gap(last, None, damage)
        if until is not None and until != (0, 0) and (last is None or not follows(last, until)):
            raise self._gap(last, until, damage)
        if found is not None and found.manifest is not None:
            self._announce(found.manifest, [*records, *_announced(keep, found)], sync=sync)
        kept = {record.name for record in records} | {segment.path.name for segment, _ in keep}
        for file in sorted(files, reverse=True):
            if file.name not in kept:
                file.unlink(missing_ok=True)
        self.records = [*records]
        for segment, frames in keep:
            self.records.append(self._take(segment, frames, rewrite, found, sync=sync))

    def _announce(self, manifest: Manifest, records: list[SegmentRecord], *, sync: bool) -> None:
        """Replace the manifest before the segments, where it says more than they will hold."""
        announced = msgspec.structs.replace(manifest, segments=tuple(records), closed=False)
        if announced != manifest:
            announced.save(self.folder, sync=sync)

    def _take(
        self,
        segment: Segment,
        frames: list[int],
        rewrite: Rewrite,
        found: RecordedSegments | None,
        *,
        sync: bool,
    ) -> SegmentRecord:
        """Take over these frames of a segment; its part of the manifest."""
        known = found.record(segment) if found is not None else None
        whole = _is_whole(segment, frames)
        mended = segment.path.with_suffix(".mending")
        writer = None if whole else rewrite(mended, segment)
        for index in frames:
            entry, base_ns = segment.entries[index], segment.base_of(index)
            self.runtime.continue_from(entry.episode, base_ns, entry.t_ns)
            self.stored.begin(entry.episode)
            for item in entry.inputs:
                self.stored.is_new(item)
            if writer is not None:
                writer.write(entry, list(stored_products(segment, index)), base_ns)
        if writer is None:
            return known or segment.record()
        record = writer.finish()
        if sync:
            writer.sync()
        writer.close()
        mended.replace(segment.path)
        if sync:
            sync_file(self.folder)
        return msgspec.structs.replace(record, name=segment.path.name)

    def _gap(
        self, last: tuple[int, int] | None, until: tuple[int, int] | None, damage: list[str]
    ) -> RunError:
        ends = f"ends with {frame_name(last)}" if last else "has no frame"
        goes_on = f", and the run goes on with {frame_name(until)}" if until else ""
        why = f" ({damage[0]})" if damage else ""
        return RunError(
            f"the recording in {self.folder} {ends}{goes_on}: what is between is lost{why}; nothing was "
            f"changed, and caviar doctor {self.folder} says what can be read; to have all frames, run the "
            "scenario again"
        )


_END = (sys.maxsize, 0)


def _is_whole(segment: Segment, frames: list[int]) -> bool:
    """Whether a segment can stay as it is, with these of its frames."""
    return segment.finished and not segment.damage and len(frames) == len(segment.chunks)


def _announced(keep: list[tuple[Segment, list[int]]], found: RecordedSegments) -> Iterator[SegmentRecord]:
    """What the manifest says of segments that are taken over; those to be written anew are open."""
    for segment, frames in keep:
        known = found.record(segment) if _is_whole(segment, frames) else None
        entry = segment.entries[frames[0]]
        yield known or SegmentRecord(name=segment.path.name, first=(entry.episode, entry.frame))


def _frames_to_keep(
    segment: Segment, last: tuple[int, int] | None, until: tuple[int, int] | None
) -> tuple[list[int], tuple[int, int] | None]:
    """Frames of a segment that are before ``until`` and follow ``last`` without a gap; the last one then."""
    frames = []
    for index, entry in enumerate(segment.entries):
        instant = (entry.episode, entry.frame)
        if (until is not None and instant >= until) or (last is not None and not follows(last, instant)):
            break
        frames.append(index)
        last = instant
    return frames, last


def stored_products(segment: Segment, index: int) -> Iterator[FrameInput]:
    """The stored products of a frame, under the provenance that they were stored with."""
    entry, chunk = segment.entries[index], segment.chunks[index]
    told = {
        (Channel(item.topic, item.source), item.frame): item
        for item in entry.inputs
        if item.status is not Status.ABSENT
    }
    for channel, frame, data in segment.messages(chunk):
        length = int.from_bytes(data[:8], "little")
        yield FrameInput(told[channel, frame], data[8 : 8 + length], data[8 + length :])
