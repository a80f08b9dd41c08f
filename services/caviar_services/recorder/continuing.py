"""Going on with a recording that another process began: nothing twice, nothing lost (clause 18)."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from caviar_protocol.errors import RecordingError
from caviar_protocol.messages import GrantInput, Status
from caviar_protocol.recording_layout import FrameEntry, segment_files
from caviar_protocol.segment import Channel, Segment
from caviar_services.service import FrameInput


class RunTime:
    """Run time of frames: a later episode begins one sampling period after the end of the one before."""

    def __init__(self, sampling_period_ns: int) -> None:
        self._period = sampling_period_ns
        self._episode = -1
        self._base_ns, self._last_ns = 0, 0

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


class Writer(Protocol):
    """What writes one segment."""

    def write(self, entry: FrameEntry, products: list[FrameInput], base_ns: int) -> None:
        """Write one frame."""

    def finish(self) -> None:
        """Write index and summary, and close."""


@dataclass
class Continuation:
    """What an earlier process recorded, up to the frame that is granted next.

    Parameters
    ----------
    folder
        Directory of the run.
    runtime, stored
        Brought to where they were.
    """

    folder: Path
    runtime: RunTime
    stored: Stored
    segments: int = 0
    """That are there, all of them finished."""

    def take_over(self, until: tuple[int, int] | None, rewrite: Callable[[Path, Segment], Writer]) -> None:
        """Keep the frames before ``until`` (episode, frame), or all of them.

        A segment that breaks off, or has later frames, is written anew from its whole records and takes
        its place in one step; one with nothing to keep is removed.
        """
        for path in _files(self.folder):
            segment = Segment(path)
            keep = [i for i, e in enumerate(segment.entries) if until is None or (e.episode, e.frame) < until]
            if not segment.metadata or not keep:
                path.unlink()
                continue
            whole = segment.finished and len(keep) == len(segment.chunks)
            mended = path.with_suffix(".mending")
            writer = None if whole else rewrite(mended, segment)
            for index in keep:
                entry = segment.entries[index]
                self.stored.begin(entry.episode)
                for item in entry.inputs:
                    self.stored.is_new(item)
                base_ns = self.runtime.base_of(entry.episode, entry.t_ns)
                if writer is not None:
                    writer.write(entry, list(_products(segment, index)), base_ns)
            if writer is not None:
                writer.finish()
                mended.replace(path)
            self.segments += 1


def _files(folder: Path) -> list[Path]:
    try:
        return segment_files(folder)
    except RecordingError:
        return []  # it died before it wrote anything


def _products(segment: Segment, index: int) -> Iterator[FrameInput]:
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
