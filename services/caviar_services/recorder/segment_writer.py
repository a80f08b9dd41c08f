"""Segments of a recording: MCAP files that grow by a chunk a frame, and when they are on disk.

Every byte of a segment is covered by a checksum. `Persistence` implements the run's ``durability``: under
``none`` the operating system decides; under ``periodic`` a thread syncs everything twice in
`SYNC_PERIOD_S`; under ``frame`` a frame is on disk before it is acknowledged. A process that is killed
loses nothing under any of them, for every frame is in the hands of the operating system.
"""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import BinaryIO

import msgspec
from isal.isal_zlib import crc32

from caviar_protocol.files import SYNC_PERIOD_S, Durability, sync_file
from caviar_protocol.messages import Status
from caviar_protocol.recording import (
    FRAME_TOPIC,
    METADATA_NAME,
    PROFILE,
    FrameEntry,
    Manifest,
    SegmentRecord,
)
from caviar_protocol.recording.segment import Channel, Segment, seal
from caviar_services.recorder.mcap_file import McapFile
from caviar_services.service import FrameInput

_SCHEMA_ENCODING = "x-caviar-text"
_PRODUCT_SCHEMA = (
    "Topic {topic!r} of the CAVIAR protocol, version 1: 8 bytes little-endian with the length of the header, "
    "the header (a msgpack map), the body (the arrays that the header refers to by dtype, shape and offset)."
)
_FRAME_SCHEMA = (
    "msgpack map: episode, frame, t_ns [ns], seed, inputs, reports; what is left out is 0 or "
    "empty; inputs lists the provenance of every product of "
    "the frame, sorted by (topic, source, frame): topic, source, status (fresh, held, absent, late), "
    "frame and t_ns it was computed for, age [frames], fidelity, digest (SHA-256), cause; reports lists what "
    "services said beside their products: source, decisions, measured [ns], counts."
)


class _ChecksummedStream:
    """Stream to which `McapFile` writes; nothing reaches the system before `hand_over`."""

    def __init__(self, stream: BinaryIO) -> None:
        self._stream = stream
        self.crc = 0
        """CRC-32 of all bytes so far."""

    def write(self, data: bytes | memoryview) -> int:
        self.crc = crc32(data, self.crc)
        return self._stream.write(data)

    def tell(self) -> int:
        return self._stream.tell()

    def hand_over(self) -> None:
        """Write what is buffered, so that a killed process does not take it along."""
        self._stream.flush()


class SegmentWriter:
    """A segment that is being written. All methods raise `OSError` where the operating system refuses.

    Args:
        path: The file; there must be none yet.
        metadata: Texts of the metadata record.
        compression: ``none``, ``lz4`` or ``zstd``.
    """

    def __init__(self, path: Path, metadata: dict[str, str], compression: str) -> None:
        self.path = path
        self.frames = 0
        self.first: tuple[int, int] | None = None
        self.last: tuple[int, int] | None = None
        """(episode, frame) of the first and the last frame; None: there is none yet."""
        self._channels: dict[tuple[str, str], int] = {}
        self._schemas: dict[str, int] = {}
        self._encode = msgspec.msgpack.Encoder().encode
        self._file = path.open("xb")
        self._stream = _ChecksummedStream(self._file)
        try:
            # The seals take the place of MCAP's CRC of the data section, which can be checked only in a file
            # that was finished.
            self._mcap = McapFile(self._stream, PROFILE, compression)
            self._mcap.add_metadata(METADATA_NAME, metadata)
            self._seal()
        except OSError:
            self.abandon()
            raise

    @property
    def size(self) -> int:
        """Bytes written so far."""
        return self._file.tell()

    @property
    def removed(self) -> bool:
        """True if the file has no name any more: what is written to it is lost."""
        # Of the descriptor, not the path: another file may stand under that name by now.
        return os.fstat(self._file.fileno()).st_nlink == 0

    def write(self, entry: FrameEntry, products: list[FrameInput], base_ns: int) -> None:
        """Write one frame and hand it to the operating system.

        Args:
            entry: The frame, with the provenance of all its products.
            products: Those of them whose bytes are new.
            base_ns: Run time of the episode's zero [ns].
        """
        frame_channel = self._channel(FRAME_TOPIC, "")
        keyed = [(self._channel(p.provenance.topic, p.provenance.source), p) for p in products]
        # One log time for all that a frame brought, also for what was computed for an earlier one: a reader
        # that seeks by time finds the whole frame.
        log_time = base_ns + entry.t_ns
        add = self._mcap.add_message
        add(frame_channel, entry.frame, log_time, log_time, self._encode(entry))
        for channel, product in keyed:
            length, made = len(product.header).to_bytes(8, "little"), product.provenance
            add(channel, made.frame, log_time, base_ns + made.t_ns, length, product.header, product.body)
        self._mcap.end_chunk()
        self._seal()
        self.frames += 1
        self.last = entry.episode, entry.frame
        self.first = self.first or self.last

    def finish(self) -> SegmentRecord:
        """Write index and summary, for `close` to follow; what the manifest says about the segment."""
        self._mcap.finish()
        self._stream.hand_over()
        del self._mcap  # and its index: until the segment is closed it may wait for the disk
        return SegmentRecord(
            name=self.path.name,
            first=self.first,
            last=self.last,
            frames=self.frames,
            finished=True,
            size=self.size,
            crc=self._stream.crc,
        )

    def sync(self) -> None:
        """Bring what was handed to the operating system to disk."""
        os.fdatasync(self._file.fileno())

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def abandon(self) -> None:
        """Close after a failed write: what is buffered would fail again."""
        # The raw file: closing the buffered one writes first.
        self._file.raw.close()

    def _seal(self) -> None:
        self._stream.write(seal(self._stream.crc))
        self._stream.hand_over()

    def _channel(self, topic: str, source: str) -> int:
        # When it is first written to: what a run produces is known frame by frame only.
        channel = self._channels.get((topic, source))
        if channel is None:
            product = bool(source)
            text = _PRODUCT_SCHEMA if product else _FRAME_SCHEMA
            if topic not in self._schemas:
                self._schemas[topic] = self._mcap.add_schema(
                    f"caviar.{topic}/1", _SCHEMA_ENCODING, text.format(topic=topic).encode()
                )
            channel = self._channels[topic, source] = self._mcap.add_channel(
                f"{topic}/{source}" if product else topic,
                "caviar-product" if product else "msgpack",
                self._schemas[topic],
                {"topic": topic, "source": source},
            )
        return channel


def stored_products(segment: Segment, index: int) -> Iterator[FrameInput]:
    """Read the stored products of a frame back, under the provenance that they were stored with.

    Args:
        segment: A segment that another process wrote.
        index: Number of the frame in it.
    """
    entry, chunk = segment.entries[index], segment.chunks[index]
    provenance = {
        (Channel(item.topic, item.source), item.frame): item
        for item in entry.inputs
        if item.status is not Status.ABSENT
    }
    for channel, frame, data in segment.messages(chunk):
        length = int.from_bytes(data[:8], "little")
        yield FrameInput(provenance[channel, frame], data[8 : 8 + length], data[8 + length :])


# [s] between two syncs under ``periodic``, so that one that takes a while is done within the period.
_PAUSE_S = SYNC_PERIOD_S / 2


class Persistence:
    """Keeps the manifest, and brings segments and manifest to disk.

    All methods raise `OSError` where the operating system refuses, under ``periodic`` with the frame that
    follows.

    Args:
        folder: Directory of the run.
        durability: When what is written has to be on disk.
        run: Identity of the run, for the manifest.
        seed: Seed of the run, for the manifest.
        earlier: Segments that are there already, all of them finished.
    """

    def __init__(
        self, folder: Path, durability: Durability, run: str, seed: int, earlier: list[SegmentRecord]
    ) -> None:
        self._folder, self._run, self._seed = folder, run, seed
        self._durability = durability
        # Under ``periodic`` the thread lists finished segments while the recorder lists new ones.
        self._lock = threading.Lock()
        self._records = {record.name: record for record in earlier}
        self._periodic = _PeriodicSync(folder, self._list) if durability == "periodic" else None

    def written(self, segment: SegmentWriter) -> None:
        """Note that a frame was written to a segment. Under ``frame`` it is on disk when this returns.

        Args:
            segment: The segment.
        """
        if self._durability == "frame":
            segment.sync()
        # With its first frame, not before: a segment that the manifest names holds something.
        if segment.frames == 1:
            self._list(SegmentRecord(name=segment.path.name, first=segment.first))
        if self._periodic is not None:
            self._periodic.note(segment)

    def finished(self, segment: SegmentWriter) -> None:
        """Finish and close a segment, and say so in the manifest once it is on disk.

        Args:
            segment: The segment, to which nothing is written any more.
        """
        record = segment.finish()
        if self._periodic is not None:
            self._periodic.note(segment, record)
            return
        if self._durability == "frame":
            segment.sync()
        segment.close()
        self._list(record)

    def close(self) -> None:
        """Stop, with the recording on disk unless ``durability`` is none; the manifest says it is whole."""
        if self._periodic is not None:
            self._periodic.stop()
            self._periodic.sync()
        with self._lock:
            self._save(closed=True, durable=self._durability != "none")

    def abandon(self) -> None:
        """Stop, after a failure; what is not on disk yet is left to the operating system."""
        if self._periodic is not None:
            self._periodic.abandon()

    def _list(self, record: SegmentRecord) -> None:
        with self._lock:
            self._records[record.name] = record
            self._save(closed=False, durable=self._durability == "frame")

    def _save(self, *, closed: bool, durable: bool) -> None:
        listed = tuple(self._records.values())
        manifest = Manifest(run=self._run, seed=self._seed, segments=listed, closed=closed)
        manifest.save(self._folder, sync=durable)


class _PeriodicSync:
    """A thread that brings to disk what was written since it last did."""

    def __init__(self, folder: Path, synced: Callable[[SegmentRecord], None]) -> None:
        self._folder, self._synced = folder, synced
        self._lock = threading.Lock()
        # Segments with what is not on disk yet; those with a record are finished.
        self._dirty: dict[SegmentWriter, SegmentRecord | None] = {}
        self._failure: OSError | None = None
        self._end = threading.Event()
        self._thread = threading.Thread(target=self._run, name="recording-sync", daemon=True)
        self._thread.start()

    def note(self, segment: SegmentWriter, record: SegmentRecord | None = None) -> None:
        """A segment was written to, and with a ``record`` finished. Raises what failed since."""
        with self._lock:
            self._dirty[segment] = record
            failure = self._failure
        # In the recorder's thread, where the run ends with it; an exception of the other one ends that alone.
        if failure is not None:
            raise failure

    def sync(self) -> None:
        """Bring everything to disk, and close what is finished."""
        with self._lock:
            dirty, self._dirty = self._dirty, {}
        # Outside the lock: a sync may take as long as the disk likes, and `note` is called in each frame.
        if dirty:
            sync_file(self._folder)  # the names of new segments
        for segment, record in dirty.items():
            segment.sync()
            if record is not None:
                segment.close()
                self._synced(record)

    def stop(self) -> None:
        """End the thread."""
        self._end.set()
        self._thread.join()

    def abandon(self) -> None:
        """End the thread, and close what is finished as it is."""
        self.stop()
        for segment, record in self._dirty.items():
            if record is not None:
                segment.close()

    def _run(self) -> None:
        pause = _PAUSE_S
        while not self._end.wait(pause):
            began = time.monotonic()
            try:
                self.sync()
            except OSError as error:
                with self._lock:
                    self._failure = error
                return
            pause = max(0.0, _PAUSE_S - (time.monotonic() - began))
