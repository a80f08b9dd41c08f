"""The recorder that writes MCAP (https://mcap.dev), readable by any tool that knows the format.

A recording is a run directory with ``recording-0000.mcap``, ``recording-0001.mcap``, … and the scenery in
``assets/``. In a segment:

* One channel a topic and source, MCAP topic ``<topic>/<source>``, schema ``caviar.<topic>/1``,
  message encoding ``caviar-product``: header length (8 bytes, little-endian), header, body, the
  wire bytes as they were. So SHA-256 of a message is the product's digest. ``sequence`` is the
  frame the product was computed for.
* One channel ``frame``, schema ``caviar.frame/1``, message encoding ``msgpack``: a
  `caviar_protocol.recording.FrameEntry` with the provenance of every product, absent ones too. A
  held product is not written again: it stands in the chunk of its own frame.
* ``log_time`` is run time in nanoseconds: ``t_ns`` of the frame in the first episode; a later
  episode begins one sampling period after the end of the one before. ``publish_time`` is the
  same for the instant the product was computed for.
* One chunk a frame, and after it a seal with the CRC-32 of all bytes before it
  (`caviar_protocol.recording.segment`), handed to the operating system before DONE, and on disk as the
  run's ``durability`` says (`segment_writer.Persistence`). MCAP's index and statistics are written when a
  segment is full or the run ends; then the manifest ``recording.json`` lists it as finished.
* Meshes that worlds announce while the run goes on are added to ``assets/`` before the first frame that has
  them; the report of the world in ``caviar.frame/1`` says which those are, and from which frame on.
* Metadata record ``caviar``: `caviar_protocol.recording.RecordingMetadata`, a JSON text a field.

A recorder that is started again goes on in the recording of the process before it: nothing is there twice,
nothing is lost (clause 18).
"""

from __future__ import annotations

import errno
import os
import sys
import time
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

import msgspec
from msgspec.structs import replace as replace_field

from caviar_protocol.arrays import quantity
from caviar_protocol.codec import encode_payload
from caviar_protocol.digest import payload_digest
from caviar_protocol.errors import CaviarError, RecordingError, RunError
from caviar_protocol.files import Durability, sync_file
from caviar_protocol.messages import GrantInput, Report
from caviar_protocol.recording import (
    FrameEntry,
    Manifest,
    RecordingMetadata,
    SegmentRecord,
    frame_name,
)
from caviar_protocol.recording.integrity import RecordedSegments, follows
from caviar_protocol.recording.segment import Segment
from caviar_protocol.run_directory import RunDirectory
from caviar_protocol.scenario.conversion import FILE
from caviar_protocol.topics import topics_of
from caviar_protocol.validation import FIRST_LOOKS, check_digest
from caviar_services.recorder.base import (
    Recorder,
    RunTime,
    StoredProducts,
    copy_assets,
    copy_meshes,
    failure,
    machine,
)
from caviar_services.recorder.provenance import code_digests, installed_versions, used_versions
from caviar_services.recorder.segment_writer import Persistence, SegmentWriter, stored_products
from caviar_services.service import Frame, FrameInput, Preparation, Prepared, RunInfo, StepResult

# Topics that may have no other consumer: a data set needs no agent. All others have one that checks them,
# but for parts that are asked for by the recorder alone.
_LOOKED_INTO = frozenset(topics_of("world", "sensors"))
_SMALL = 1 << 16
"""[B] of a product's body below which its digest is compared in every frame."""


class McapSettings(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Settings of the recorder ``mcap``."""

    segment_mib: Annotated[float, quantity("MiB", "a segment of this size is closed", gt=0)] = 256.0
    segment_frames: Annotated[int, quantity("frame", "a segment with so many frames is closed", ge=1)] = 2000
    """Bounds what a segment's index takes in memory, and what a crash leaves without an index."""
    compression: Literal["none", "lz4", "zstd"] = "none"
    """Of the chunks, a frame each."""
    copy_assets: bool = True
    """Copy the scenery into the run directory."""
    reproducible: bool = False
    """Leave out what differs between equal runs: start, machine, wall times, folders of files, versions of
    packages that no service computes with. Then the recordings of equal runs have equal bytes."""
    only_named: bool = False
    """Write the topics that ``record`` of the run names and no others; where it names none, all that are
    produced. The digest of the recording is then that of these, and no longer the run's."""
    notes: tuple[str, ...] = ()
    """Free text, kept in the metadata."""


class McapRecorder(Recorder[McapSettings]):
    """Writes every product of every frame to MCAP segments in the run directory.

    Args:
        settings: When a segment is closed, compression, and what is copied and noted.
        run: What the recorder knows about the run; it writes into ``run.directory``.

    Example:
        >>> import tempfile
        >>> folder = tempfile.TemporaryDirectory()
        >>> recorder = McapRecorder(McapSettings(), RunInfo(name="recorder", directory=Path(folder.name)))
        >>> note = recorder.prepare(Preparation(demand={})).notes
        >>> recorder.step(Frame(episode=0, number=0, t_ns=0)).products
        {}
        >>> recorder.close()
        >>> sorted(file.name for file in Path(folder.name).iterdir())
        ['recording-0000.mcap', 'recording.json']
        >>> folder.cleanup()
    """

    Settings = McapSettings
    outputs: ClassVar[tuple[str, ...]] = ()
    packages: ClassVar[tuple[str, ...]] = ("mcap", "lz4", "zstandard")
    uses_scenery: ClassVar[bool] = True
    changes_geometry: ClassVar[bool] = True

    def __init__(self, settings: McapSettings, run: RunInfo) -> None:
        super().__init__(settings, run)
        self._metadata = RecordingMetadata()
        self._segment: SegmentWriter | None = None
        self._segments = 0
        self._durability = durability_of(run.scenario)
        self._persistence: Persistence | None = None
        self._failure: RunError | None = None
        self._runtime = RunTime(run.sampling_period_ns)
        self._stored = StoredProducts()
        # Large products by topic and source of which the digest was due to be compared.
        self._compared: Counter[tuple[str, str]] = Counter()
        self._named = frozenset(self.parts) if settings.only_named else frozenset()
        # Whether frames that another process recorded are still to be taken over.
        self._goes_on = False

    def prepare(self, preparation: Preparation) -> Prepared:
        """Copy the scenery and open the first segment.

        Raises:
            RunError: The directory cannot be written to, or holds a recording.
        """
        folder = self.run.directory
        existing = RunDirectory(folder).segments()
        self._goes_on = self.run.again
        if existing and not self.run.again:
            raise RunError(
                f"{existing[0]} is there already: choose another directory with --out, or remove it"
            )
        self.run.progress("copying scenery", 0.0)
        assets = preparation.assets if self.settings.copy_assets else {}
        try:
            folder.mkdir(parents=True, exist_ok=True)
            copied = copy_assets(assets, RunDirectory(folder).assets, sync=self._durability != "none")
        except OSError as error:
            # A copy that fails has the name of the target second.
            raise failure(Path(error.filename2 or error.filename or folder), error) from error
        reproducible = self.settings.reproducible
        self._metadata = RecordingMetadata(
            run=self.run.run,
            seed=self.run.seed,
            sampling_period_ns=self.run.sampling_period_ns,
            frames=self.run.frames,
            scenario=_without_folders(self.run.scenario) if reproducible else dict(self.run.scenario),
            versions=_versions(self.run.scenario, used_only=reproducible),
            machine={} if reproducible else machine(),
            started="" if reproducible else datetime.now(UTC).isoformat(timespec="seconds"),
            assets=copied,
            notes=self.settings.notes,
        )
        # Going on waits for the first frame, which says from where on: it may be one that was recorded, since
        # the broker grants again what was not acknowledged.
        if not self._goes_on:
            self._persistence = self._persisted([])
            self._open_segment()
        return Prepared(notes=(f"recording to {folder}",))

    def use_meshes(self, meshes: Mapping[str, Path]) -> None:
        """Copy meshes that came while the run goes on, before a frame that has them is recorded.

        Args:
            meshes: Files by asset name.

        Raises:
            RunError: A file cannot be written; names path, errno and remedy.
        """
        if not self.settings.copy_assets:
            return
        folder = RunDirectory(self.run.directory).assets
        try:
            copy_meshes(meshes, folder, sync=self._durability != "none")
        except OSError as error:
            raise failure(Path(error.filename or folder), error) from error

    def step(self, frame: Frame) -> StepResult:
        """Write a frame; when this returns, the operating system has it, under ``frame`` the disk.

        Raises:
            RunError: The frame cannot be written; names path, errno and remedy.
            ProductError: A product is not that of its digest, and the recording would be damaged; names the
                producer.
        """
        begin = time.perf_counter_ns()
        if self._failure is not None:
            raise self._failure
        if self._goes_on:
            self._take_over((frame.episode, frame.number))
        segment = self._segment or self._open_segment()
        base_ns = self._runtime.base_of(frame.episode, frame.t_ns)
        self._stored.begin(frame.episode)
        # Sorted: equal runs have equal recordings, whatever came first.
        wanted = [item for item in frame.inputs if not self._named or item.provenance.topic in self._named]
        inputs = sorted(map(_encoded, wanted), key=_canonical)
        entry = FrameEntry(
            episode=frame.episode,
            frame=frame.number,
            t_ns=frame.t_ns,
            seed=frame.seed,
            inputs=tuple(_with_digest(item) for item in inputs),
            reports=_without_times(frame.reports) if self.settings.reproducible else frame.reports,
        )
        # Before the first byte of the frame: a product that is wrong leaves no half of a frame behind.
        new = [item for item in inputs if self._stored.is_new(item.provenance)]
        for item in new:
            # Raise `ProductError` where a product is not that of its digest, or one that may have no
            # other consumer cannot be. Large ones have been hashed by their producer, and are by who reads
            # the recording: a third time would cost as much as all else that is done for a frame.
            if item.provenance.digest and (len(item.body) < _SMALL or self._is_new_source(item.provenance)):
                check_digest(item.provenance, item.header, item.body)
            topic = item.provenance.topic
            if topic in _LOOKED_INTO or self.parts.get(topic):
                item.look()
        try:
            segment.write(entry, new, base_ns)
            self._kept.written(segment)
            # A file that was deleted takes writes without an error, and all of them would be lost.
            if segment.removed:
                raise FileNotFoundError(errno.ENOENT, os.strerror(errno.ENOENT), str(segment.path))
            if (
                segment.size >= self.settings.segment_mib * 2**20
                or segment.frames >= self.settings.segment_frames
            ):
                self._segment = None
                self._kept.finished(segment)
        except OSError as error:
            raise self._failed(segment, error) from error
        return StepResult(measured={"write": time.perf_counter_ns() - begin})

    def _is_new_source(self, entry: GrantInput) -> bool:
        """Count a large product; whether it is one of the first of its source, where wrong hashing shows."""
        key = entry.topic, entry.source
        self._compared[key] += 1
        return self._compared[key] <= FIRST_LOOKS

    def close(self) -> None:
        """Close the recording, so that it is complete.

        Raises:
            RunError: The system refuses; names path and errno.
        """
        if self._goes_on and self._failure is None:
            self._take_over(None)
        segment, self._segment = self._segment, None
        if self._persistence is None or self._failure is not None:
            return
        try:
            if segment is not None:
                self._persistence.finished(segment)
            self._persistence.close()
        except OSError as error:
            raise self._failed(segment, error) from error

    @property
    def _kept(self) -> Persistence:
        if self._persistence is None:
            raise RunError("the recorder was granted a frame before it was prepared")
        return self._persistence

    def _persisted(self, earlier: list[SegmentRecord]) -> Persistence:
        return Persistence(self.run.directory, self._durability, self.run.run, self.run.seed, earlier)

    def _take_over(self, until: tuple[int, int] | None) -> None:
        """Continue after what another process recorded, before the frame ``until``."""
        self._goes_on = False
        folder = self.run.directory
        sync = self._durability != "none"
        before = _Continuation(folder, self._runtime, self._stored, self.settings.compression, sync)
        try:
            records = before.take_over(until)
        except OSError as error:
            raise failure(Path(error.filename or folder), error) from error
        except CaviarError as error:
            self._failure = RunError(str(error))
            raise self._failure from error
        self._segments = len(records)
        self._persistence = self._persisted(records)

    def _open_segment(self) -> SegmentWriter:
        path = RunDirectory(self.run.directory).segment(self._segments)
        metadata = msgspec.structs.replace(self._metadata, segment=self._segments)
        try:
            self._segment = SegmentWriter(path, _as_text(metadata), self.settings.compression)
            if self._durability == "frame":
                sync_file(self.run.directory)  # its name: the frames in it are synced, and found by it
        except OSError as error:
            raise self._failed(None, error) from error
        self._segments += 1
        return self._segment

    def _failed(self, segment: SegmentWriter | None, error: OSError) -> RunError:
        """Give up after an error of the system: what is written stays as it is."""
        if self._persistence is not None:
            self._persistence.abandon()
        if segment is not None:
            segment.abandon()
        self._segment = None
        path = Path(error.filename) if error.filename else segment.path if segment else self.run.directory
        self._failure = failure(path, error)
        return self._failure


@dataclass
class _Continuation:
    """Recording of an earlier process, up to the frame that is granted next.

    Args:
        folder: Directory of the run.
        runtime: Run time, brought to where it was.
        stored: Stored products, brought to where they were.
        compression: Of segments that are written anew.
        sync: Whether segments and manifest are on disk before they take their places.
    """

    folder: Path
    runtime: RunTime
    stored: StoredProducts
    compression: str
    sync: bool

    def take_over(self, until: tuple[int, int] | None) -> list[SegmentRecord]:
        """Keep the frames before ``until`` (episode, frame), or all of them.

        A segment that breaks off, or has later frames, is written anew from its whole records and takes
        its place in one step; one with nothing to keep is removed. The manifest says so first, so that a
        reader who comes in between, or after a loss of power, finds nothing that contradicts it.
        Of finished segments, which the manifest knows, only the last one is opened.

        Returns:
            The segments that are there, all of them finished.

        Raises:
            RunError: Frames before ``until`` are missing; nothing is changed.
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
            self._announce(found.manifest, [*records, *_announced(keep, found)])
        kept = {record.name for record in records} | {segment.path.name for segment, _ in keep}
        # The newest first: what a crash leaves in between is a recording without a gap.
        for file in sorted(files, reverse=True):
            if file.name not in kept:
                file.unlink(missing_ok=True)
        return [*records, *(self._take(segment, frames, found) for segment, frames in keep)]

    def _announce(self, manifest: Manifest, records: list[SegmentRecord]) -> None:
        """Replace the manifest before the segments, where it says more than they will hold."""
        announced = msgspec.structs.replace(manifest, segments=tuple(records), closed=False)
        if announced != manifest:
            announced.save(self.folder, sync=self.sync)

    def _take(self, segment: Segment, frames: list[int], found: RecordedSegments | None) -> SegmentRecord:
        """Take over these frames of a segment; its part of the manifest."""
        known = found.record(segment) if found is not None else None
        mended = segment.path.with_suffix(".mending")
        writer = None
        if not _is_whole(segment, frames):
            mended.unlink(missing_ok=True)  # of a process that died in the middle of this
            writer = SegmentWriter(mended, segment.metadata, self.compression)
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
        if self.sync:
            writer.sync()
        writer.close()
        mended.replace(segment.path)  # in one step: a reader finds the old file or the new one
        if self.sync:
            sync_file(self.folder)
        return msgspec.structs.replace(record, name=segment.path.name)

    def _gap(
        self, last: tuple[int, int] | None, until: tuple[int, int] | None, damage: list[str]
    ) -> RunError:
        ends = f"ends with {frame_name(last)}" if last else "has no frame"
        goes_on = f", and the run continues with {frame_name(until)}" if until else ""
        why = f" ({damage[0]})" if damage else ""
        return RunError(
            f"the recording in {self.folder} {ends}{goes_on}: what is between is lost{why}; nothing was "
            f"changed, and caviar doctor {self.folder} says what can be read; to have all frames, run the "
            "scenario again"
        )


_END = (sys.maxsize, 0)


def _is_whole(segment: Segment, frames: list[int]) -> bool:
    """Return whether a segment can stay as it is, with these of its frames."""
    return segment.finished and not segment.damage and len(frames) == len(segment.chunks)


def _announced(keep: list[tuple[Segment, list[int]]], found: RecordedSegments) -> Iterator[SegmentRecord]:
    """Records in the manifest of segments that are taken over; those to be written anew are open."""
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


def durability_of(scenario: Mapping[str, object]) -> Durability:
    """Durability that a scenario asks for.

    Args:
        scenario: The scenario as resolved.

    Returns:
        ``run.durability``; by default ``periodic``.

    Example:
        >>> durability_of({"run": {"durability": "frame"}}), durability_of({})
        ('frame', 'periodic')
    """
    run = scenario.get("run")
    durability: Durability = run.get("durability", "periodic") if isinstance(run, Mapping) else "periodic"
    return durability


def _without_times(reports: tuple[Report, ...]) -> tuple[Report, ...]:
    """Reports without wall times, in the order of their services."""
    return tuple(replace_field(report, measured={}) for report in sorted(reports, key=lambda r: r.source))


def _versions(scenario: Mapping[str, Any], *, used_only: bool) -> dict[str, str]:
    """Versions for the metadata, and the start of the digest of each code that is not ours."""
    versions = used_versions(scenario) if used_only else installed_versions()
    code = {f"code of {name}": digest[:16] for name, digest in code_digests(scenario).items()}
    return {**versions, **code}


def _without_folders(value: Any) -> Any:
    """Scenario as it was written, with ``file:NAME`` in place of the absolute path of a file or folder."""
    if isinstance(value, str) and value.startswith("/"):
        return f"{FILE}{Path(value).name}"
    if isinstance(value, Mapping):
        return {key: _without_folders(item) for key, item in value.items()}
    return [_without_folders(item) for item in value] if isinstance(value, list | tuple) else value


def _as_text(metadata: RecordingMetadata) -> dict[str, str]:
    fields: dict[str, Any] = {name: getattr(metadata, name) for name in metadata.__struct_fields__}
    return {name: msgspec.json.encode(value).decode() for name, value in fields.items()}


def _canonical(item: FrameInput) -> tuple[str, str, int]:
    return item.provenance.topic, item.provenance.source, item.provenance.frame


def _with_digest(item: FrameInput) -> GrantInput:
    if item.provenance.digest or not item.present:
        return item.provenance
    return msgspec.structs.replace(item.provenance, digest=payload_digest(item.header, item.body))


def _encoded(item: FrameInput) -> FrameInput:
    """The input as it came; in a run without sockets no producer has encoded it yet."""
    if len(item.header) or not item.present:
        return item
    return FrameInput(item.provenance, *encode_payload(item.payload))
