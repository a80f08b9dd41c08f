"""One file of a recording, read where it lies.

A segment is an MCAP file with one chunk a frame. It is mapped into memory, not read: walking
over it touches a few pages a frame, and payloads are views into the map. The framing is read
here, and not by the ``mcap`` package, because a recording must be readable up to where a
killed process left it, and what is damaged must be named with its place.
"""

from __future__ import annotations

import mmap
import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from importlib import import_module
from io import BytesIO
from pathlib import Path
from typing import Any, NamedTuple

import msgspec

from caviar_protocol.errors import RecordingError
from caviar_protocol.recording_layout import FRAME_TOPIC, METADATA_NAME, PROFILE, FrameEntry

MAGIC = b"\x89MCAP0\r\n"
_RECORD = struct.Struct("<BQ")
_CHUNK = struct.Struct("<QQQII")
_MESSAGE = struct.Struct("<HIQQ")
_HEADER, _FOOTER, _CHANNEL, _MESSAGE_OPCODE, _CHUNK_OPCODE, _METADATA = 0x01, 0x02, 0x04, 0x05, 0x06, 0x0C
_DATA_END, _LAST_OPCODE, _FIRST_PRIVATE_OPCODE = 0x0F, 0x0F, 0x80


class Channel(NamedTuple):
    """Topic and source of an MCAP channel."""

    topic: str
    source: str


@dataclass(frozen=True, slots=True)
class Chunk:
    """The place of one frame in a segment, and what is needed to read it."""

    offset: int
    """Of the chunk record in the file [B]."""
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

    Raises `RecordingError` naming file and offset unless ``path`` is a segment, possibly one that
    breaks off. ``finished`` says whether it was closed; one that was not ends with the last
    whole record. Frame entries come in the order of `chunks`.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.metadata: dict[str, str] = {}
        self.channels: dict[int, Channel] = {}
        self.chunks: list[Chunk] = []
        self.entries: list[FrameEntry] = []
        self.finished = False
        self._data_end = (0, 0)
        self._data = _mapped(path)
        self._scan()

    def __len__(self) -> int:
        return len(self._data)

    def damaged(self, chunk: Chunk) -> bool:
        """Whether the chunk's CRC-32 differs from the one recorded with it."""
        return bool(chunk.crc) and zlib.crc32(self._content(chunk)) != chunk.crc

    @property
    def altered(self) -> bool:
        """Whether a byte before the index differs from what was written; false where it breaks off."""
        end, crc = self._data_end
        return bool(crc) and zlib.crc32(self._data[:end]) != crc

    def messages(self, chunk: Chunk) -> Iterator[Message]:
        """The products of a chunk, in the order they were written. Does not check the CRC."""
        for channel_id, frame, data in self._walk(chunk):
            channel = self._channel(channel_id, chunk)
            if channel.topic != FRAME_TOPIC:
                yield Message(channel, frame, data)

    def _scan(self) -> None:
        data, position = self._data, len(MAGIC)
        if data[: len(MAGIC)] != MAGIC[: len(data)]:
            raise RecordingError(f"{self.path} does not begin as an MCAP file: it is not a recording")
        while position + _RECORD.size <= len(data):
            opcode, length = _RECORD.unpack_from(data, position)
            start = position + _RECORD.size
            if start + length > len(data):
                break
            self._take(opcode, start, start + length)
            position = start + length
            if opcode == _FOOTER:
                self.finished = data[position : position + len(MAGIC)] == MAGIC
                break
        if not self.finished and len(data) > len(MAGIC) and data[-len(MAGIC) :] == MAGIC:
            raise RecordingError(
                f"{self.path}: the record at offset {position} does not fit the file, whose end is in "
                "place: the file is damaged"
            )

    def _take(self, opcode: int, start: int, stop: int) -> None:
        if opcode == _CHUNK_OPCODE:
            self._take_chunk(start, stop)
        elif opcode == _HEADER:
            profile = _library_record("Header", self._data[start:stop], self.path, start).profile
            if profile != PROFILE:
                raise RecordingError(
                    f"{self.path} is an MCAP file of profile {profile!r}, not a recording of CAVIAR"
                )
        elif opcode == _DATA_END and stop - start >= 4:
            self._data_end = (start - _RECORD.size, int.from_bytes(self._data[start : start + 4], "little"))
        elif not 0 < opcode <= _LAST_OPCODE and opcode < _FIRST_PRIVATE_OPCODE:
            raise RecordingError(
                f"{self.path}: the record at offset {start - _RECORD.size} is of unknown kind {opcode:#04x}: "
                "the file is damaged"
            )
        elif opcode == _METADATA:
            record = _library_record("Metadata", self._data[start:stop], self.path, start)
            if record.name == METADATA_NAME:
                self.metadata = record.metadata

    def _take_chunk(self, start: int, stop: int) -> None:
        offset = start - _RECORD.size
        try:
            _, _, size, crc, name_length = _CHUNK.unpack_from(self._data, start)
            at = start + _CHUNK.size
            compression = bytes(self._data[at : at + name_length]).decode()
            (length,) = struct.unpack_from("<Q", self._data, at + name_length)
        except (struct.error, UnicodeDecodeError) as error:
            raise self._damage(offset, f"its head cannot be read ({error})") from error
        at += name_length + 8
        if at + length > stop or (not compression and size != length):
            raise self._damage(offset, f"its data of {length} B do not fit it")
        chunk = Chunk(offset, at, at + length, size, crc, compression)
        self.chunks.append(chunk)
        self.entries.append(self._entry(chunk))

    def _entry(self, chunk: Chunk) -> FrameEntry:
        first = next(self._walk(chunk, register=True), None)
        if first is None or self._channel(first[0], chunk).topic != FRAME_TOPIC:
            raise self._damage(chunk.offset, "it does not begin with a frame record")
        try:
            return _entry_decoder.decode(first[2])
        except msgspec.MsgspecError as error:
            raise self._damage(chunk.offset, f"its frame record cannot be decoded ({error})") from error

    def _walk(self, chunk: Chunk, register: bool = False) -> Iterator[tuple[int, int, memoryview]]:
        content, position = self._content(chunk), 0
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
            elif opcode == _CHANNEL and register:
                record = _library_record("Channel", content[start:stop], self.path, chunk.offset)
                self.channels[record.id] = Channel(
                    record.metadata.get("topic", record.topic), record.metadata.get("source", "")
                )
            position = stop

    def _channel(self, channel_id: int, chunk: Chunk) -> Channel:
        channel = self.channels.get(channel_id)
        if channel is None:
            raise self._damage(chunk.offset, f"a message in it names channel {channel_id}, which is unknown")
        return channel

    def _content(self, chunk: Chunk) -> memoryview:
        raw = self._data[chunk.start : chunk.stop]
        if not chunk.compression:
            return raw
        try:
            return memoryview(_decompressed(chunk, raw))
        except (RuntimeError, ValueError) as error:  # what lz4 and we raise
            raise self._damage(chunk.offset, f"it cannot be decompressed ({error})") from error

    def _damage(self, offset: int, what: str) -> RecordingError:
        return RecordingError(f"{self.path}: the chunk at offset {offset} is damaged: {what}")


def _mapped(path: Path) -> memoryview:
    try:
        with path.open("rb") as stream:
            stream.seek(0, 2)
            if stream.tell() == 0:
                return memoryview(b"")
            return memoryview(mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ))
    except OSError as error:
        raise RecordingError(f"{path} cannot be read: {error.strerror} (errno {error.errno})") from error


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


def _decompressed(chunk: Chunk, raw: memoryview) -> bytes:
    if chunk.compression == "zstd":
        import zstandard

        try:
            return zstandard.decompress(raw, chunk.size)
        except zstandard.ZstdError as error:
            raise ValueError(str(error)) from error
    if chunk.compression == "lz4":
        content: bytes = import_module("lz4.frame").decompress(raw)
        return content
    raise ValueError(f"compression {chunk.compression!r} is unknown; known: zstd, lz4")
