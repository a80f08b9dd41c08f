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
* One chunk a frame, and behind it a seal with the CRC-32 of all bytes before it
  (`caviar_protocol.recording.segment`), handed to the operating system before DONE, and on disk as the
  run's ``durability`` says (`persistence`). MCAP's index and statistics are written when a segment is full
  or the run ends; then the manifest ``recording.json`` lists it as finished
  (`caviar_protocol.recording`).
* Metadata record ``caviar``: `caviar_protocol.recording.RecordingMetadata`, a JSON text a field.
"""

from __future__ import annotations

import errno
import os
import time
from collections.abc import Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

import msgspec

from caviar_protocol.arrays import quantity
from caviar_protocol.codec import encode_payload
from caviar_protocol.digest import payload_digest
from caviar_protocol.errors import CaviarError, RunError
from caviar_protocol.files import Durability, RunDirectory, sync_file
from caviar_protocol.messages import GrantInput
from caviar_protocol.recording import (
    FrameEntry,
    RecordingMetadata,
    SegmentRecord,
)
from caviar_protocol.recording.segment import Segment
from caviar_protocol.validation import check_digest
from caviar_services.recorder.base import Recorder, copy_assets, failure, machine, versions
from caviar_services.recorder.continuation import Continuation, RunTime, Stored
from caviar_services.recorder.segment_writer import Persistence, SegmentWriter
from caviar_services.service import Frame, FrameInput, Preparation, Prepared, RunInfo, StepResult

# Topics that may have no other consumer: a data set needs no agent. All others have one that checks them,
# but for parts that are asked for by the recorder alone.
_LOOKED_INTO = frozenset({"scene", "lidar", "camera", "depth", "segmentation"})


class McapSettings(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Settings of the recorder."""

    segment_mib: Annotated[float, quantity("MiB", "a segment of this size is closed", gt=0)] = 256.0
    segment_frames: Annotated[int, quantity("frame", "a segment with so many frames is closed", ge=1)] = 2000
    """Bounds what a segment's index takes in memory, and what a crash leaves without an index."""
    compression: Literal["none", "lz4", "zstd"] = "none"
    """Of the chunks, a frame each."""
    copy_assets: bool = True
    """Copy the scenery into the run directory."""
    notes: tuple[str, ...] = ()
    """Free text, kept in the metadata."""


class McapRecorder(Recorder[McapSettings]):
    """Writes every product of every frame to MCAP segments in the run directory."""

    Settings = McapSettings
    outputs: ClassVar[tuple[str, ...]] = ()
    uses_scenery: ClassVar[bool] = True

    def __init__(self, settings: McapSettings, run: RunInfo) -> None:
        super().__init__(settings, run)
        self._metadata = RecordingMetadata()
        self._segment: SegmentWriter | None = None
        self._segments = 0
        self._durability = durability_of(run.scenario)
        self._persistence: Persistence | None = None
        self._failure: RunError | None = None
        self._runtime = RunTime(run.sampling_period_ns)
        self._stored = Stored()
        # Whether frames that another process recorded are still to be taken over.
        self._goes_on = False

    def prepare(self, preparation: Preparation) -> Prepared:
        """Open the first segment. `RunError` where the directory is not writable or holds a run."""
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
            raise failure(Path(error.filename or folder), error) from error
        self._metadata = RecordingMetadata(
            run=self.run.run,
            seed=self.run.seed,
            sampling_period_ns=self.run.sampling_period_ns,
            frames=self.run.frames,
            scenario=dict(self.run.scenario),
            versions=versions(),
            machine=machine(),
            started=datetime.now(UTC).isoformat(timespec="seconds"),
            assets=copied,
            notes=self.settings.notes,
        )
        if not self._goes_on:
            self._persistence = self._persisted([])
            self._open_segment()
        return Prepared(notes=(f"recording to {folder}",))

    def step(self, frame: Frame) -> StepResult:
        """Write a frame; when this returns, the operating system has it, under ``frame`` the disk.

        Raises `RunError` naming path, errno and remedy where it cannot be written, `ProductError` naming the
        producer of a product that is not that of its digest: the recording would be damaged.
        """
        begin = time.perf_counter_ns()
        if self._failure is not None:
            raise self._failure
        if self._goes_on:
            self._take_over((frame.episode, frame.number))
        segment = self._segment or self._open_segment()
        base_ns = self._runtime.base_of(frame.episode, frame.t_ns)
        self._stored.begin(frame.episode)
        inputs = sorted(map(_encoded, frame.inputs), key=_canonical)
        entry = FrameEntry(
            episode=frame.episode,
            frame=frame.number,
            t_ns=frame.t_ns,
            seed=frame.seed,
            inputs=tuple(_with_digest(item) for item in inputs),
            reports=frame.reports,
        )
        new = [item for item in inputs if self._stored.is_new(item.provenance)]
        for item in new:
            self._look_at(item)
        try:
            segment.write(entry, new, base_ns)
            self._kept.written(segment)
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

    def close(self) -> None:
        """Close the recording, so that it is complete. `RunError` naming path and errno where that fails."""
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

    def _look_at(self, item: FrameInput) -> None:
        """Raise `ProductError` where a product is not that of its digest, or one that may have no other
        consumer cannot be."""
        if item.provenance.digest:
            check_digest(item.provenance, item.header, item.body)
        topic = item.provenance.topic
        if topic in _LOOKED_INTO or self.parts.get(topic):
            item.look()

    @property
    def _kept(self) -> Persistence:
        if self._persistence is None:
            raise RunError("the recorder was granted a frame before it was prepared")
        return self._persistence

    def _persisted(self, earlier: list[SegmentRecord]) -> Persistence:
        return Persistence(self.run.directory, self._durability, self.run.run, self.run.seed, earlier)

    def _take_over(self, until: tuple[int, int] | None) -> None:
        """Go on behind what another process recorded, before the frame ``until``."""
        self._goes_on = False
        folder, compression = self.run.directory, self.settings.compression
        before = Continuation(folder, self._runtime, self._stored)

        def rewrite(path: Path, segment: Segment) -> SegmentWriter:
            path.unlink(missing_ok=True)
            return SegmentWriter(path, segment.metadata, compression)

        try:
            before.take_over(until, rewrite, sync=self._durability != "none")
        except OSError as error:
            raise failure(Path(error.filename or folder), error) from error
        except CaviarError as error:
            self._failure = RunError(str(error))
            raise self._failure from error
        self._segments = len(before.records)
        self._persistence = self._persisted(before.records)

    def _open_segment(self) -> SegmentWriter:
        path = RunDirectory(self.run.directory).segment(self._segments)
        metadata = msgspec.structs.replace(self._metadata, segment=self._segments)
        try:
            self._segment = SegmentWriter(path, _as_text(metadata), self.settings.compression)
            if self._durability == "frame":
                sync_file(self.run.directory)
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


def durability_of(scenario: Mapping[str, object]) -> Durability:
    """``run.durability`` of a scenario as resolved; by default ``periodic``."""
    run = scenario.get("run")
    durability: Durability = run.get("durability", "periodic") if isinstance(run, Mapping) else "periodic"
    return durability


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
