"""Reader of one segment of a recording.

A segment is an MCAP file with one chunk a frame. It is mapped into memory, not read: walking
over it touches a few pages a frame, and payloads are views into the map. The framing is read
here, and not by the ``mcap`` package, because a recording must be readable up to where a
killed process or a power loss left it, and what is damaged must be named with its place.

After the metadata, and after the chunk and the index of every frame, stands a *seal*: a private MCAP record
(opcode `SEAL_OPCODE`, which other MCAP readers skip) with the CRC-32 of all bytes of the file before it. So
every byte up to the last seal is covered. The summary after it is covered by MCAP's own CRC, and by
the manifest (`caviar_protocol.recording`), which has the CRC-32 of every finished segment.
A segment that was not finished is checked as it is opened, and is read up to its last good seal.
Segments of earlier versions have no seals, but MCAP's CRC of the data section.
"""

from __future__ import annotations

import mmap
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from importlib import import_module
from io import BytesIO
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
from isal.isal_zlib import crc32  # ten times as fast as zlib's

from caviar_protocol.errors import RecordingError
from caviar_protocol.files import map_regular
from caviar_protocol.recording import FRAME_TOPIC, METADATA_NAME, PROFILE, FrameEntry, SegmentRecord

MAGIC = b"\x89MCAP0\r\n"
SEAL_OPCODE = 0xCA
"""Of the private record that covers the bytes before it."""
_RECORD = struct.Struct("<BQ")
_SEAL = struct.Struct("<BQI")
_SEAL_HEAD = _RECORD.pack(SEAL_OPCODE, _SEAL.size - _RECORD.size)
_CHUNK = struct.Struct("<QQQII")
_MESSAGE = struct.Struct("<HIQQ")
_FOOTER_CONTENT = struct.Struct("<QQI")
_HEADER, _FOOTER, _SCHEMA, _CHANNEL, _MESSAGE_OPCODE, _CHUNK_OPCODE = range(1, 7)
_METADATA = 0x0C
_DATA_END, _LAST_OPCODE, _FIRST_PRIVATE_OPCODE = 0x0F, 0x0F, 0x80
# [B] of a chunk in which its frame record is looked for, first and at most.
_FIRST_LOOK, _LAST_LOOK = 1 << 16, 1 << 24


def seal(crc: int) -> bytes:
    """The record that covers all bytes before it, whose CRC-32 is ``crc``."""
    return _SEAL.pack(SEAL_OPCODE, _SEAL.size - _RECORD.size, crc)


_KNOWN_OPCODES = range(1, _LAST_OPCODE + 1)


class Channel(NamedTuple):
    """Topic and source of an MCAP channel."""

    topic: str
    source: str


@dataclass(frozen=True, slots=True)
class Chunk:
    """The place of one frame in a segment, and what is needed to read it."""

    offset: int
    """Of the chunk record in the file [B]."""
    log_time: int
    """Run time of the frame [ns]."""
    start: int
    """Of the chunk's data in the file [B]."""
    stop: int
    size: int
    """Uncompressed [B]."""
    crc: int
    """CRC-32 of the uncompressed data; 0: none."""
    compression: str


class Message(NamedTuple):
    """One stored product: header length (8 bytes, little-endian), header, body."""

    channel: Channel
    frame: int
    data: memoryview


_entry_decoder = msgspec.msgpack.Decoder(FrameEntry)


class Segment:
    """A segment file: its metadata, channels and chunks.

    One that breaks off ends with the last whole frame, and one that is damaged lacks the frames that are:
    `damage` says which. Frame entries come in the order of `chunks`.

    Args:
        path: The file.

    Raises:
        RecordingError: The file does not begin as a segment; the text names file and offset.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.metadata: dict[str, str] = {}
        self.channels: dict[int, Channel] = {}
        self.chunks: list[Chunk] = []
        self.entries: list[FrameEntry] = []
        self.finished = False
        """Whether the recorder closed it."""
        self.readable = 0
        """Bytes up to the end of what can be read."""
        self.damage: list[str] = []
        """What of it cannot be read, other than an end that was not written: a line each, with its place."""
        # Place and CRC-32 of each seal.
        self._seals: list[tuple[int, int]] = []
        self._data_end = (0, 0)
        try:
            self._data = map_regular(path)
        except OSError as error:
            raise RecordingError(f"{path} cannot be read: {error.strerror} (errno {error.errno})") from error
        self._scan()
        if not self.finished and self._seals:
            # Keep what is sealed of a segment that was not closed: after a power loss, pages in the middle
            # may be zero while later ones are there, and CRCs find them.
            good, crc = 0, 0
            for place, recorded in self._seals:
                if crc32(self._data[good:place], crc) != recorded:
                    self.damage.append(f"bytes {good} to {place} are not what was written (CRC-32)")
                    break
                good, crc = place + _SEAL.size, crc32(seal(recorded), recorded)
            self.readable = good
            self.chunks = [chunk for chunk in self.chunks if chunk.stop <= good]
            # Not even the metadata are sealed: the segment counts as one without any.
            if not self.chunks and not good:
                self.metadata = {}
        self._read_entries()

    def __len__(self) -> int:
        return len(self._data)

    def base_of(self, index: int) -> int:
        """Run time of the zero of a frame's episode [ns]."""
        return self.chunks[index].log_time - self.entries[index].t_ns

    def record(self) -> SegmentRecord:
        """Record of a finished segment for the manifest; reads all of it."""
        instants = [(entry.episode, entry.frame) for entry in self.entries]
        return SegmentRecord(
            name=self.path.name,
            first=instants[0] if instants else None,
            last=instants[-1] if instants else None,
            frames=len(instants),
            finished=True,
            size=len(self),
            crc=crc32(self._data),
        )

    def damaged(self, chunk: Chunk) -> bool:
        """Return whether the chunk's CRC-32 differs from the one recorded with it."""
        return bool(chunk.crc) and crc32(self._content(chunk)) != chunk.crc

    def altered(self, expected: int | None = None) -> list[tuple[int, int]]:
        """Ranges of bytes of a finished segment that differ from what was written; reads all of it.

        Args:
            expected: CRC-32 of the file, where the manifest says it.
        """
        found, start, crc = [], 0, 0
        # Each seal goes on from the one before, so that a change is placed between two of them.
        for place, recorded in self._seals:
            if crc32(self._data[start:place], crc) != recorded:
                found.append((start, place))
            start, crc = place + _SEAL.size, crc32(seal(recorded), recorded)
        end, data_crc = self._data_end
        if data_crc and crc32(self._data[:end]) != data_crc:
            found.append((0, end))
        # A seal that differs has named the place already; the CRC of the file would name all of it again.
        if not found and expected is not None and crc32(self._data[start:], crc) != expected:
            found.append((start, len(self)))
        if not found and self.finished and not self._summary_is_whole(end):
            found.append((end, len(self)))
        return found

    def messages(self, chunk: Chunk) -> Iterator[Message]:
        """The products of a chunk, in the order they were written. Does not check the CRC."""
        for channel_id, frame, data in self._walk(chunk, self._content(chunk)):
            channel = self._channel(channel_id, chunk)
            if channel.topic != FRAME_TOPIC:
                yield Message(channel, frame, data)

    def _scan(self) -> None:
        """Find chunks, seals and the end; after a record that does not fit, go on after the next seal."""
        data, position = self._data, len(MAGIC)
        if data[: len(MAGIC)] != MAGIC[: len(data)]:
            remedy = "; give the directory of a run"
            if self.path.suffix == ".toml":
                remedy = f", but a scenario: caviar run {self.path} makes a run of it"
            raise RecordingError(f"{self.path} does not begin as an MCAP file: it is not a recording{remedy}")
        while position + _RECORD.size <= len(data) and not self.finished:
            opcode, length = _RECORD.unpack_from(data, position)
            start = position + _RECORD.size
            is_cut = start + length > len(data)
            fault = "does not fit" if is_cut else ""
            try:
                fault = fault or self._read_record(opcode, start, start + length)
            except RecordingError as error:
                if not self.metadata:
                    raise
                fault = str(error)
            if not fault:
                position = start + length
                self.readable = position + (len(MAGIC) if self.finished else 0)
                continue
            # A seal is the next place whose bytes vouch for what precedes: after it records fit again.
            following = _find(data, _SEAL_HEAD, position + 1)
            if following < 0:
                # A record that is cut at the end of a file without an end is what a kill leaves, no damage.
                if not is_cut or self._end_is_in_place() or data[position] not in _KNOWN_OPCODES:
                    self.damage.append(f"the record at byte {position} {fault}")
                break
            self.damage.append(f"bytes {position} to {following}: the record {fault}")
            position = following
        if self.finished and self.readable != len(data):
            self.damage.append(f"{len(data) - self.readable} bytes past its end")

    def _end_is_in_place(self) -> bool:
        return len(self) > len(MAGIC) and self._data[-len(MAGIC) :] == MAGIC

    def _read_record(self, opcode: int, start: int, stop: int) -> str:
        """Read one record into `metadata`, `channels`, `chunks` or the seals; what is wrong with it."""
        if opcode == _CHUNK_OPCODE:
            return self._read_chunk(start, stop)
        if opcode == _HEADER:
            profile = _library_record("Header", self._data[start:stop], self.path, start).profile
            if profile != PROFILE:
                raise RecordingError(
                    f"{self.path} is an MCAP file of profile {profile!r}, not a recording of CAVIAR"
                )
        elif opcode == SEAL_OPCODE and stop - start == _SEAL.size - _RECORD.size:
            self._seals.append((start - _RECORD.size, int.from_bytes(self._data[start:stop], "little")))
        elif opcode == _DATA_END and stop - start >= 4:
            self._data_end = (start - _RECORD.size, int.from_bytes(self._data[start : start + 4], "little"))
        elif opcode == _CHANNEL:
            self._register(self._data[start:stop], start)
        elif opcode == _FOOTER:
            self.finished = self._data[stop : stop + len(MAGIC)] == MAGIC
        elif opcode not in _KNOWN_OPCODES and opcode < _FIRST_PRIVATE_OPCODE:
            return f"is of unknown kind {opcode:#04x}"
        elif opcode == _METADATA:
            record = _library_record("Metadata", self._data[start:stop], self.path, start)
            if record.name == METADATA_NAME:
                self.metadata = record.metadata
        return ""

    def _summary_is_whole(self, data_end: int) -> bool:
        """Return whether the summary begins after the data and has the CRC-32 that the footer says."""
        footer = len(self) - len(MAGIC) - _FOOTER_CONTENT.size
        if footer < data_end:
            return False
        start, _, crc = _FOOTER_CONTENT.unpack_from(self._data, footer)
        covered = self._data[start : footer + _FOOTER_CONTENT.size - 4]
        return start == data_end + _RECORD.size + 4 and (not crc or crc32(covered) == crc)

    def _read_chunk(self, start: int, stop: int) -> str:
        offset = start - _RECORD.size
        try:
            log_time, _, size, crc, name_length = _CHUNK.unpack_from(self._data, start)
            at = start + _CHUNK.size
            compression = bytes(self._data[at : at + name_length]).decode()
            (length,) = struct.unpack_from("<Q", self._data, at + name_length)
        except (struct.error, UnicodeDecodeError) as error:
            return f"is a chunk whose head cannot be read ({error})"
        at += name_length + 8
        if at + length != stop or (not compression and size != length):
            return f"is a chunk that its data of {length} B do not fit"
        # A few bytes may claim to be a terabyte, which is asked for before the first of it is seen.
        if not may_expand(length, size):
            return f"is a chunk of {length} B that would take {size} B in memory, which no recorder writes"
        self.chunks.append(Chunk(offset, log_time, at, at + length, size, crc, compression))
        return ""

    def _read_entries(self) -> None:
        """The frame record of each chunk; one that has none is left out."""
        chunks, self.chunks = self.chunks, []
        for chunk in chunks:
            try:
                entry = self._entry(chunk)
            except RecordingError as error:
                self.damage.append(str(error).removeprefix(f"{self.path}: "))
                continue
            self.chunks.append(chunk)
            self.entries.append(entry)

    def _entry(self, chunk: Chunk) -> FrameEntry:
        first = self._first_message(chunk)
        if first is None or self._channel(first[0], chunk).topic != FRAME_TOPIC:
            raise self._damage(chunk.offset, "it does not begin with a frame record")
        try:
            return _entry_decoder.decode(first[2])
        except (msgspec.MsgspecError, RecursionError, UnicodeDecodeError) as error:
            raise self._damage(chunk.offset, f"its frame record cannot be decoded ({error})") from error

    def _first_message(self, chunk: Chunk) -> tuple[int, int, memoryview] | None:
        """The first message of a chunk, of which no more is looked at than that takes."""
        size = _FIRST_LOOK
        # A chunk may have hundreds of megabytes, of which the frame record is the first kilobytes.
        while size < min(chunk.size, _LAST_LOOK):
            try:
                return next(self._walk(chunk, self._content(chunk, size)), None)
            except RecordingError:
                size *= 4  # it may go on after these bytes
        return next(self._walk(chunk, self._content(chunk, _LAST_LOOK)), None)

    def _walk(self, chunk: Chunk, content: memoryview) -> Iterator[tuple[int, int, memoryview]]:
        position = 0
        while position < len(content):
            try:
                opcode, length = _RECORD.unpack_from(content, position)
            except struct.error as error:
                raise self._damage(chunk.offset, f"its content breaks off at {position}") from error
            start, stop = position + _RECORD.size, position + _RECORD.size + length
            if stop > len(content):
                raise self._damage(chunk.offset, f"the record at {position} in it does not fit")
            if opcode == _MESSAGE_OPCODE:
                if length < _MESSAGE.size:
                    raise self._damage(chunk.offset, f"the message at {position} in it is too short")
                channel_id, sequence, _, _ = _MESSAGE.unpack_from(content, start)
                yield channel_id, sequence, content[start + _MESSAGE.size : stop]
            elif opcode == _CHANNEL:
                self._register(content[start:stop], chunk.offset)
            elif opcode != _SCHEMA:
                raise self._damage(chunk.offset, f"the record at {position} in it is of kind {opcode:#04x}")
            position = stop

    def _register(self, content: memoryview, offset: int) -> None:
        # Chunks and the summary repeat the channels, each with its id in front.
        if len(content) > 2 and int.from_bytes(content[:2], "little") in self.channels:
            return
        record = _library_record("Channel", content, self.path, offset)
        topic, source = record.metadata.get("topic", record.topic), record.metadata.get("source", "")
        self.channels.setdefault(record.id, Channel(topic, source))

    def _channel(self, channel_id: int, chunk: Chunk) -> Channel:
        channel = self.channels.get(channel_id)
        if channel is None:
            raise self._damage(chunk.offset, f"a message in it names channel {channel_id}, which is unknown")
        return channel

    def _content(self, chunk: Chunk, limit: int = 0) -> memoryview:
        """The uncompressed data of a chunk, or no more of them than ``limit`` bytes."""
        raw = self._data[chunk.start : chunk.stop]
        if not chunk.compression:
            return raw[:limit] if limit else raw
        try:
            return memoryview(expand(chunk.compression, raw, chunk.size, limit))
        except (RuntimeError, ValueError) as error:  # what lz4 and we raise
            raise self._damage(chunk.offset, f"it cannot be decompressed ({error})") from error

    def _damage(self, offset: int, what: str) -> RecordingError:
        return RecordingError(f"{self.path}: the chunk at offset {offset} is damaged: {what}")


def _find(data: memoryview, pattern: bytes, start: int) -> int:
    # A memoryview has no `find`, the map behind it does, without a copy.
    source = data.obj
    return source.find(pattern, start) if isinstance(source, mmap.mmap) else -1


def _library_record(kind: str, content: memoryview, path: Path, offset: int) -> Any:
    from mcap import records
    from mcap.data_stream import ReadDataStream
    from mcap.exceptions import McapError

    try:
        return getattr(records, kind).read(ReadDataStream(BytesIO(content)))
    except (McapError, struct.error, UnicodeDecodeError) as error:
        raise RecordingError(
            f"{path}: the {kind.lower()} record at offset {offset} is damaged: {error!r}"
        ) from error


FREE_SIZE = 64 << 20
"""[B] that compressed data may always expand to."""
EXPANSION = 1000
"""Above, how much larger than the compressed data the result may be."""


def may_expand(size: int, expanded: int) -> bool:
    """Return whether data of ``size`` bytes may declare that they expand to ``expanded`` bytes."""
    return expanded <= max(FREE_SIZE, EXPANSION * size)


def expand(compression: str, data: memoryview, size: int, limit: int = 0) -> bytes:
    """Decompress, without ever holding more than was declared.

    Args:
        compression: ``zstd`` or ``lz4``, as MCAP names them.
        data: The compressed bytes.
        size: The size that they declare [B], to be checked with `may_expand` before.
        limit: Only so many bytes from the beginning; 0: all.

    Raises:
        ValueError: They cannot be decompressed, or not to the declared size.
    """
    wanted = min(limit, size) if limit else size + 1  # one more shows that there are more
    if compression == "zstd":
        found = _zstd(data, wanted)
    elif compression == "lz4":
        found = _lz4(data, wanted)
    else:
        raise ValueError(f"compression {compression!r} is unknown; known: zstd, lz4")
    if len(found) != (min(limit, size) if limit else size):
        raise ValueError(f"it has {len(found)} B or more, and declares {size} B")
    return found


def _zstd(data: memoryview, wanted: int) -> bytes:
    import zstandard

    try:
        # A stream, since the one-shot function allocates what the data claim.
        with zstandard.ZstdDecompressor().stream_reader(data, read_across_frames=False) as stream:
            return stream.read(wanted)
    except zstandard.ZstdError as error:
        raise ValueError(str(error)) from error


def _lz4(data: memoryview, wanted: int) -> bytes:
    try:
        found: bytes = import_module("lz4.frame").LZ4FrameDecompressor().decompress(data, max_length=wanted)
    except RuntimeError as error:
        raise ValueError(str(error)) from error
    return found
