"""The recorder that writes MCAP (https://mcap.dev), readable by any tool that knows the format.

A recording is a run directory with ``recording-0000.mcap``, ``recording-0001.mcap``, … and the
scenery in ``assets/``. In a segment:

* One channel a topic and source, MCAP topic ``<topic>/<source>``, schema ``caviar.<topic>/1``,
  message encoding ``caviar-product``: header length (8 bytes, little-endian), header, body, the
  wire bytes as they were. So SHA-256 of a message is the product's digest. ``sequence`` is the
  frame the product was computed for.
* One channel ``frame``, schema ``caviar.frame/1``, message encoding ``msgpack``: a
  `caviar_protocol.recording_layout.FrameEntry` with the provenance of every product, absent ones too. A
  held product is not written again: it stands in the chunk of its own frame.
* ``log_time`` is run time in nanoseconds: ``t_ns`` of the frame in the first episode; a later
  episode begins one sampling period after the end of the one before. ``publish_time`` is the
  same for the instant the product was computed for.
* One chunk a frame, handed to the operating system before DONE. MCAP's indexes, statistics and
  CRCs of the whole are written when a segment is full or the run ends.
* Metadata record ``caviar``: `caviar_protocol.recording_layout.RecordingMetadata`, a JSON text a field.
"""

from __future__ import annotations

import sys
import time
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

import msgspec

from caviar_protocol.arrays import quantity
from caviar_protocol.codec import encode_payload
from caviar_protocol.digest import payload_digest
from caviar_protocol.errors import RunError
from caviar_protocol.messages import GrantInput
from caviar_protocol.recording_layout import (
    ASSET_FOLDER,
    FRAME_TOPIC,
    METADATA_NAME,
    PROFILE,
    SEGMENT_PATTERN,
    FrameEntry,
    RecordingMetadata,
    segment_name,
)
from caviar_protocol.segment import Segment
from caviar_services.recorder.base import Recorder, copy_assets, failure, machine, versions
from caviar_services.recorder.continuing import Continuation, RunTime, Stored
from caviar_services.service import Frame, FrameInput, Preparation, Prepared, RunInfo, StepResult

_SCHEMA_ENCODING = "x-caviar-text"
_PRODUCT_SCHEMA = (
    "Topic {topic!r} of the CAVIAR protocol, version 1: 8 bytes little-endian with the length of the header, "
    "the header (a msgpack map), the body (the arrays that the header refers to by dtype, shape and offset)."
)
_FRAME_SCHEMA = (
    "msgpack map: episode, frame, t_ns [ns], seed, inputs; inputs lists the provenance of every product of "
    "the frame, sorted by (topic, source, frame): topic, source, status (fresh, held, absent, late), "
    "frame and t_ns it was computed for, age [frames], fidelity, digest (SHA-256), cause."
)


class McapSettings(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Settings of the recorder."""

    segment_mib: Annotated[float, quantity("MiB", "a segment of this size is closed", gt=0)] = 256.0
    segment_frames: Annotated[int, quantity("frame", "a segment with so many frames is closed", ge=1)] = 2000
    """Bounds what a segment's index takes in memory, and what a crash leaves without an index."""
    compression: Literal["none", "lz4", "zstd"] = "none"
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
        self._segment: _SegmentWriter | None = None
        self._segments = 0
        self._failure: RunError | None = None
        self._runtime = RunTime(run.sampling_period_ns)
        self._stored = Stored()
        self._goes_on = False
        """Whether frames that another process recorded are still to be taken over."""

    def prepare(self, preparation: Preparation) -> Prepared:
        """Open the first segment. `RunError` where the directory is not writable or holds a run."""
        folder = self.run.directory
        existing = sorted(folder.glob(SEGMENT_PATTERN))
        self._goes_on = bool(existing) and self.run.again
        if existing and not self.run.again:
            raise RunError(
                f"{existing[0]} is there already: choose another directory with --out, or remove it"
            )
        self.run.progress("copying scenery", 0.0)
        assets = preparation.assets if self.settings.copy_assets else {}
        try:
            folder.mkdir(parents=True, exist_ok=True)
            copied = copy_assets(assets, folder / ASSET_FOLDER)
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
            self._open_segment()
        return Prepared(notes=(f"recording to {folder}",))

    def step(self, frame: Frame) -> StepResult:
        """Write a frame; when this returns, the operating system has it.

        Raises `RunError` naming path and errno where it cannot be written.
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
        try:
            segment.write(entry, [i for i in inputs if self._stored.is_new(i.provenance)], base_ns)
            if (
                segment.size >= self.settings.segment_mib * 2**20
                or segment.frames >= self.settings.segment_frames
            ):
                self._segment = None
                segment.finish()
        except OSError as error:
            raise self._failed(segment, error) from error
        return StepResult(measured={"write": time.perf_counter_ns() - begin})

    def close(self) -> None:
        """Write the index of the open segment. `RunError` naming path and errno where that fails."""
        if self._goes_on:
            self._take_over(None)
        segment, self._segment = self._segment, None
        if segment is not None:
            try:
                segment.finish()
            except OSError as error:
                raise self._failed(segment, error) from error

    def _take_over(self, until: tuple[int, int] | None) -> None:
        """Go on behind what another process recorded, before the frame ``until``."""
        self._goes_on = False
        folder, compression = self.run.directory, self.settings.compression
        before = Continuation(folder, self._runtime, self._stored)

        def rewrite(path: Path, segment: Segment) -> _SegmentWriter:
            path.unlink(missing_ok=True)
            return _SegmentWriter(path, segment.metadata, compression)

        try:
            before.take_over(until, rewrite)
        except OSError as error:
            raise failure(Path(error.filename or folder), error) from error
        self._segments = before.segments

    def _open_segment(self) -> _SegmentWriter:
        path = self.run.directory / segment_name(self._segments)
        metadata = msgspec.structs.replace(self._metadata, segment=self._segments)
        try:
            self._segment = _SegmentWriter(path, _as_text(metadata), self.settings.compression)
        except OSError as error:
            raise failure(path, error) from error
        self._segments += 1
        return self._segment

    def _failed(self, segment: _SegmentWriter, error: OSError) -> RunError:
        segment.abandon()
        self._segment = None
        self._failure = failure(segment.path, error)
        return self._failure


class _SegmentWriter:
    """One MCAP file that grows by a chunk a frame."""

    def __init__(self, path: Path, metadata: dict[str, str], compression: str) -> None:
        from mcap.writer import CompressionType, Writer

        self.path = path
        self.frames = 0
        self._channels: dict[tuple[str, str], int] = {}
        self._schemas: dict[str, int] = {}
        self._stream = path.open("xb")
        # A chunk ends where we flush, after each frame, and never by its size.
        self._writer = Writer(
            self._stream,
            chunk_size=sys.maxsize,
            compression=CompressionType[compression.upper()],
            enable_data_crcs=True,
        )
        try:
            self._writer.start(profile=PROFILE)
            self._writer.add_metadata(METADATA_NAME, metadata)
            self._writer.flush()
        except OSError:
            self.abandon()
            raise

    @property
    def size(self) -> int:
        """Bytes written so far."""
        return self._stream.tell()

    def write(self, entry: FrameEntry, products: list[FrameInput], base_ns: int) -> None:
        """Write one frame and hand it to the operating system."""
        frame_channel = self._channel(FRAME_TOPIC, "")
        keyed = [(self._channel(p.provenance.topic, p.provenance.source), p) for p in products]
        log_time = base_ns + entry.t_ns

        def add(channel: int, sequence: int, t_ns: int, data: bytes) -> None:
            self._writer.add_message(
                channel, log_time=log_time, data=data, publish_time=base_ns + t_ns, sequence=sequence
            )

        add(frame_channel, entry.frame, entry.t_ns, msgspec.msgpack.encode(entry))
        for channel, product in keyed:
            length = len(product.header).to_bytes(8, "little")
            data = b"".join((length, product.header, product.body))
            add(channel, product.provenance.frame, product.provenance.t_ns, data)
        self._writer.flush()
        self.frames += 1

    def finish(self) -> None:
        """Write index and summary, and close."""
        self._writer.finish()
        self._stream.close()

    def abandon(self) -> None:
        """Close after a failed write: what is buffered would fail again."""
        self._stream.raw.close()

    def _channel(self, topic: str, source: str) -> int:
        channel = self._channels.get((topic, source))
        if channel is None:
            product = bool(source)
            channel = self._channels[topic, source] = self._writer.register_channel(
                topic=f"{topic}/{source}" if product else topic,
                message_encoding="caviar-product" if product else "msgpack",
                schema_id=self._schema(topic, _PRODUCT_SCHEMA if product else _FRAME_SCHEMA),
                metadata={"topic": topic, "source": source},
            )
        return channel

    def _schema(self, topic: str, text: str) -> int:
        if topic not in self._schemas:
            self._schemas[topic] = self._writer.register_schema(
                name=f"caviar.{topic}/1", encoding=_SCHEMA_ENCODING, data=text.format(topic=topic).encode()
            )
        return self._schemas[topic]


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
    """The input as it came; in a run without sockets nobody has encoded it yet."""
    if len(item.header) or not item.present:
        return item
    return FrameInput(item.provenance, *encode_payload(item.payload))
