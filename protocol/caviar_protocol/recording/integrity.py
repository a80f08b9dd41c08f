"""The segments of a recording: which are there, how far they can be read, what is damaged."""

from __future__ import annotations

import hashlib
import sys
from collections.abc import Iterable
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path

import msgspec

from caviar_protocol.assets import digest_in, recorded_meshes
from caviar_protocol.digest import RunDigest, file_digest
from caviar_protocol.errors import RecordingError
from caviar_protocol.messages import Status
from caviar_protocol.recording import (
    FORMAT,
    FrameEntry,
    Manifest,
    RecordingMetadata,
    SegmentRecord,
    frame_name,
    read_manifest,
)
from caviar_protocol.recording.segment import Channel, Chunk, Segment
from caviar_protocol.run_directory import SEGMENT_PATTERN, RunDirectory, runs_below

# A recorder replaces the manifest a few times while it continues a recording, then once a segment.
_READINGS = 8


@dataclass
class RecordedSegments:
    """A recording up to the first segment that is missing or broken.

    A recorder that continues it meanwhile replaces manifest and segments: where they contradict each other
    and the manifest is another one by then, everything is read again.

    Raises:
        RecordingError: There is no recording, or nothing of it can be read.

    Example:
        >>> found = RecordedSegments(Path("runs/smoke-20261122-101500"))
        >>> found.closed, found.damage, len(found.instants)
        (True, [], 100)
    """

    path: Path
    """The run directory, or one ``.mcap`` file of it."""
    trusted_before: tuple[int, int] | None = None
    """Finished segments all of whose frames are before this (episode, frame), and whose size is that of the
    manifest, are not opened, the last one excepted; None: all are opened."""
    past_gaps: bool = False
    """Whether segments after one that is missing, broken or of another run are read too."""
    trusted: list[SegmentRecord] = field(default_factory=list)
    """Those before `segments`."""
    manifest: Manifest | None = None
    """None where there is none, or it is damaged."""
    segments: list[Segment] = field(default_factory=list)
    damage: list[str] = field(default_factory=list)
    """What is missing or cannot be read, as far as it shows without reading products: a line each."""
    closed: bool = False
    """Whether the recorder closed the recording, and all of it is there."""
    # What the manifest says, by file name.
    _listed: dict[str, SegmentRecord] = field(default_factory=dict, init=False)
    # The manifest as it was read, also where it is of another run.
    _on_disk: Manifest | None = field(default=None, init=False)

    def __post_init__(self) -> None:
        # A recorder that goes on replaces files meanwhile: only a manifest that stayed the same counts.
        for _ in range(_READINGS - 1):
            try:
                self._read()
            except RecordingError:
                if not self._has_changed():
                    raise
            else:
                if not self.damage or not self._has_changed():
                    return
        self._read()

    def _read(self) -> None:
        self.trusted, self.segments, self.damage, self.manifest = [], [], [], None
        alone = self.path.is_file()
        files = [self.path] if alone else _files(self.path)
        try:
            self.manifest = self._on_disk = read_manifest(self._folder)
        except RecordingError as error:
            self.damage.append(str(error))
        self._listed = {record.name: record for record in self.manifest.segments} if self.manifest else {}
        # The manifest knows of segments that were removed; the folder of those begun after its last save.
        expected = files if alone else _expected(self._folder, files, self._listed)
        if self.trusted_before is not None:
            self._trust_finished(expected, self._listed, self.trusted_before)
        for number, file in enumerate(expected):
            if number < len(self.trusted):
                continue
            record = self._listed.get(file.name)
            if not self._open(file, record, expected[number + 1 :]) and not self.past_gaps:
                break
        if not self.segments and not self.trusted:
            raise RecordingError(
                self.damage[0] if self.damage else f"{self.path} holds no recording any more"
            )
        # Closed means that nothing can come any more: all segments, the last one finished, no damage.
        there = len(self.trusted) + len(self.segments)
        self.closed = there == len(expected) and self.segments[-1].finished and not self.damage
        if self.manifest is not None and not alone:
            self.closed &= self.manifest.closed

    @property
    def _folder(self) -> Path:
        return self.path.parent if self.path.is_file() else self.path

    def _has_changed(self) -> bool:
        """Whether the manifest is another one than when it was read."""
        try:
            return read_manifest(self._folder) != self._on_disk
        except RecordingError:
            return False

    @property
    def instants(self) -> list[tuple[int, int]]:
        """(episode, frame) of every frame in `segments`."""
        return [(entry.episode, entry.frame) for segment in self.segments for entry in segment.entries]

    def record(self, segment: Segment) -> SegmentRecord | None:
        """Record of a segment in the manifest, where it was finished."""
        records = self.manifest.segments if self.manifest else ()
        found = next((record for record in records if record.name == segment.path.name), None)
        return found if found is not None and found.finished else None

    def _trust_finished(
        self, files: list[Path], known: dict[str, SegmentRecord], before: tuple[int, int]
    ) -> None:
        for file, later in pairwise(files):
            record = known.get(file.name)
            if record is None or record.last is None or record.last >= before or not later.exists():
                return
            # Size alone: CRCs would read all of a recording before each resumption.
            if not file.exists() or file.stat().st_size != record.size:
                return
            self.trusted.append(record)

    def _open(self, file: Path, record: SegmentRecord | None, later: list[Path]) -> bool:
        """Add a segment; whether the next one may follow it."""
        if not file.exists():
            if self._has_nothing and not self.past_gaps:
                raise RecordingError(f"{file} is missing, although {_first_there(later)} is there")
            if record is None and not any(path.exists() for path in later):
                return False  # only the manifest of another run has it, or its recorder removed it just now
            self._report_loss(f"{file} is missing", record, later)
            return False
        try:
            segment = _opened(file)
            if strange := self._other_run(segment):
                self._report_loss(strange, record, later)
                return False
        except RecordingError as error:
            if self._has_nothing and not self.past_gaps:
                raise
            if record is not None or later:  # else it was killed while it opened this segment
                self._report_loss(str(error), record, later)
            return False
        record = self._listed.get(file.name)
        self.segments.append(segment)
        self.damage += [f"{file}: {line}" for line in segment.damage]
        if record is not None and record.finished and len(segment) != record.size:
            what = f"{file} has {len(segment)} B of {record.size} B"
        elif record is not None and record.finished and not segment.finished:
            what = f"{file} breaks off at byte {segment.readable}"
        else:
            what = ""
        # The summary at the end is an index that MCAP tools use; frames are found without it.
        if what and record is not None and self.instants[-1:] == [record.last]:
            self.damage.append(f"{what}: its index is damaged, and no frame is lost")
            return True
        if what:
            self._report_loss(what, record, later)
            return False
        if not segment.finished and later:
            self._report_loss(f"{file} breaks off at byte {segment.readable}", record, later)
            return False
        if not segment.finished and segment.damage:
            self._report_loss(
                f"{file} is readable up to byte {segment.readable} of {len(segment)}", record, later
            )
        return True

    @property
    def _has_nothing(self) -> bool:
        return not self.segments and not self.trusted

    def _other_run(self, segment: Segment) -> str:
        """Message about a segment of another run than those before it; empty where it is of the same.

        The recording is of the run of its first segment. A manifest of another run is left aside.
        """
        # The metadata of one segment are read here; comparing all is the reader's.
        if self.segments and not self.past_gaps:
            return ""  # where several runs are mixed, `Recording` refuses them all
        run = metadata_of(segment).run
        listed = self.manifest.run if self.manifest else ""
        own = metadata_of(self.segments[0]).run if self.segments else listed if self.trusted else run
        if own != run:
            return f"{segment.path} is of run {run!r}, and what is before it of run {own!r}"
        if listed not in ("", own):
            other = f"{RunDirectory(segment.path.parent).manifest} is of run {listed!r}"
            self.damage.append(f"{other}, and {segment.path.name} of run {own!r}: it is left aside")
            self.manifest, self._listed = None, {}
        return ""

    def _report_loss(self, what: str, record: SegmentRecord | None, later: list[Path]) -> None:
        """Say what is lost, and from which frame."""
        if self.past_gaps and any(path.exists() for path in later):
            extent = f", {record.extent}" if record is not None else ""
            self.damage.insert(0, f"{what}: its frames are lost{extent}")
            return
        instants = self.instants or [record.last for record in self.trusted[-1:] if record.last]
        since = f"all frames after {frame_name(instants[-1])}" if instants else "every frame"
        until = f" up to {frame_name(record.last)}" if record is not None and record.last else ""
        if later:
            until += f", and those of {later[0].name}" + (" and later segments" if len(later) > 1 else "")
        self.damage.insert(0, f"{what}: lost are {since}{until}")


def recorded_until(path: Path) -> tuple[tuple[int, int] | None, tuple[str, ...]]:
    """Place up to which a recording has no gap.

    Returns:
        last: (episode, frame) of the last frame before anything is missing; None: there is no frame.
        damage: What is missing or cannot be read: a line each.
    """
    try:
        found = RecordedSegments(path, trusted_before=(sys.maxsize, 0))
    except RecordingError as error:
        return None, (str(error),)
    # Trusted segments have no gap: the manifest lists them as finished, one after the other.
    last = found.trusted[-1].last if found.trusted else None
    for instant in found.instants:
        if last is not None and not follows(last, instant):
            break
        last = instant
    return last, tuple(found.damage)


def metadata_of(segment: Segment) -> RecordingMetadata:
    """The metadata of a segment.

    Raises:
        RecordingError: They cannot be read; the text names the file.
    """
    try:
        raw = {key: msgspec.json.decode(text) for key, text in segment.metadata.items()}
        metadata = msgspec.convert(raw, RecordingMetadata)
    except (msgspec.MsgspecError, RecursionError) as error:
        raise RecordingError(f"{segment.path}: the metadata are damaged: {error}") from error
    if metadata.format != FORMAT:
        raise RecordingError(
            f"{segment.path} has format {metadata.format}, this version reads format {FORMAT}"
        )
    return metadata


def _opened(file: Path) -> Segment:
    segment = Segment(file)
    if not segment.metadata:
        raise RecordingError(f"{file} breaks off at {len(segment)} B, before its metadata")
    return segment


def follows(earlier: tuple[int, int], later: tuple[int, int]) -> bool:
    """Whether no frame is between two (episode, frame), by their numbers: episodes may end early."""
    return later in ((earlier[0], earlier[1] + 1), (earlier[0] + 1, 0))


def _files(folder: Path) -> list[Path]:
    if not folder.is_dir():
        raise RecordingError(f"{folder} does not exist: give a run directory or a {SEGMENT_PATTERN} file")
    try:
        files = RunDirectory(folder).segments()
    except OSError as error:
        raise RecordingError(
            f"cannot read the folder {folder}: {error.strerror}; check its file system (fsck)"
        ) from error
    if not files:
        missing = f"{folder} holds no recording: there is no {SEGMENT_PATTERN} in it"
        raise RecordingError(f"{missing}{runs_below(folder)}")
    return files


def _expected(folder: Path, files: list[Path], known: dict[str, SegmentRecord]) -> list[Path]:
    """The segments by number, up to the last one that is there or that the manifest lists."""
    names = {file.name for file in files} | set(known)
    numbered = [RunDirectory(folder).segment(number) for number in range(2 * len(names) + 1)]
    last = max((number for number, file in enumerate(numbered) if file.name in names), default=-1)
    return numbered[: last + 1]


def _first_there(files: list[Path]) -> str:
    return next((file.name for file in files if file.exists()), "another one")


class RunDigestReport(msgspec.Struct, frozen=True, kw_only=True):
    """A run's digest as its recorded bytes give it, and what in them is damaged."""

    digest: str
    frames: int
    damage: tuple[str, ...] = ()
    """Each names file, frame, topic and source; empty: every byte is as it was written."""


def recorded_digest(recorded: RecordedSegments) -> RunDigestReport:
    """Compute the digest of a recording from its bytes, and look at every byte for damage.

    Args:
        recorded: The segments of the recording.
    """
    chain, damage = RunDigest(), list(recorded.damage)
    earlier: FrameEntry | None = None
    for segment in recorded.segments:
        places: list[tuple[int, int]] = []
        # Bytes whose damage is reported frame by frame.
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
        # Ranges of a segment that are not as they were written, other than those of ``reported`` damage.
        record = recorded.record(segment)
        found = segment.altered(record.crc if record is not None and len(segment) == record.size else None)
        damage += [
            f"{segment.path}: bytes {start} to {stop} are not what was written (CRC-32)"
            for start, stop in found
            if not any(start < end and begin < stop for begin, end in places)
        ]
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
        file = RunDirectory(recorded.path).assets / asset.name
        try:
            digest = file_digest(file)
        except OSError as error:
            found.append(f"{file} cannot be read: {error.strerror}")
            continue
        if digest != asset.digest:
            found.append(f"{file}: its digest is {digest}, was {asset.digest}")
    return found + _damaged_meshes(recorded)


def _damaged_meshes(recorded: RecordedSegments) -> list[str]:
    """Meshes that came while the run went on and are missing or altered: a line each."""
    metadata = metadata_of(recorded.segments[0])
    # A recorder that copies no scenery copies no meshes.
    folder = RunDirectory(recorded.path).assets
    there = recorded_meshes(folder)
    reports = (r for segment in recorded.segments for entry in segment.entries for r in entry.reports)
    named = {a.name for report in reports if report.geometry is not None for a in report.geometry.assets}
    copied = bool(metadata.assets) or bool(there)
    found = [f"{folder / name} is missing" for name in sorted(named - there.keys()) if copied]
    for name, file in there.items():
        try:
            digest = file_digest(file)
        except OSError as error:
            found.append(f"{file} cannot be read: {error.strerror}")
            continue
        if digest != digest_in(name):
            found.append(f"{file}: its digest is {digest}, was {digest_in(name)}")
    return found


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
        # Only these are stored with the frame; a held product is checked in the frame it is of.
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
