"""Bytes of an MCAP file (https://mcap.dev/spec) that grows by a chunk a frame.

They are those that `mcap.writer.Writer` makes. That library looks at each field of each record by itself,
which took three fifths of a small recorder's time; here the records of a frame are packed as a whole, and the
library writes what stands once in a file: metadata, schemas, channels and the summary.
"""

from __future__ import annotations

import struct
from collections import Counter
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any, Protocol

from isal.isal_zlib import crc32

if TYPE_CHECKING:
    from mcap.records import McapRecord

_MESSAGE = struct.Struct("<BQHIQQ")
"""Opcode, length of the rest, channel, sequence, log time, publish time; the data follow."""
_MESSAGE_FIELDS = 2 + 4 + 8 + 8
_CHUNK = struct.Struct("<BQQQQI")
"""Opcode, length of the rest, first and last log time, size and CRC-32 of what is not compressed."""
_CHUNK_FIELDS = 8 + 8 + 8 + 4 + 4 + 8
_INDEX = struct.Struct("<BQHI")
"""Opcode, length of the rest, channel, length of the entries."""
_ENTRY = struct.Struct("<QQ")
"""Log time of a message, and its place in the chunk."""
_OPCODE_MESSAGE, _OPCODE_CHUNK, _OPCODE_INDEX = 5, 6, 7


class Stream(Protocol):
    """Stream to which the file is written."""

    def write(self, data: bytes | memoryview, /) -> int:
        """Write all of it."""

    def tell(self) -> int:
        """Bytes written so far."""


class McapFile:
    """An MCAP file that is being written, chunk by chunk.

    Nothing of a chunk is written before `end_chunk`. What the stream raises comes out as it is.

    Args:
        stream: Takes the bytes, from the first one of the file on.
        profile: Of the file.
        compression: Of the chunks: ``none``, ``lz4`` or ``zstd``.

    Example:
        >>> import io
        >>> from mcap.reader import make_reader
        >>> stream = io.BytesIO()
        >>> file = McapFile(stream, "example", "none")
        >>> channel = file.add_channel("speed", "text", file.add_schema("speed", "text", b"m/s"), {})
        >>> file.add_message(channel, 7, 100, 100, b"3.5")
        >>> file.end_chunk()
        >>> file.finish()
        >>> _ = stream.seek(0)
        >>> [message.data for _, _, message in make_reader(stream).iter_messages()]
        [b'3.5']
    """

    def __init__(self, stream: Stream, profile: str, compression: str) -> None:
        from mcap.records import Header
        from mcap.writer import LIBRARY_IDENTIFIER, MCAP0_MAGIC

        self._stream = stream
        self._compression = b"" if compression == "none" else compression.encode()
        self._compress = _compressor(compression)
        # Records of the chunk that is begun, in pieces, and their length.
        self._pieces: list[bytes | memoryview] = []
        self._length = 0
        # By channel, log time and place of the messages in that chunk.
        self._entries: dict[int, list[tuple[int, int]]] = {}
        self._counts: Counter[int] = Counter()
        self._schemas: list[McapRecord] = []
        self._channels: list[McapRecord] = []
        # Fields of `mcap.records.ChunkIndex`.
        self._chunks: list[dict[str, Any]] = []
        self._metadata: list[McapRecord] = []
        stream.write(MCAP0_MAGIC)
        stream.write(_packed(Header(profile, LIBRARY_IDENTIFIER)))

    def add_metadata(self, name: str, texts: Mapping[str, str]) -> None:
        """Write a metadata record.

        Args:
            name: Of the record.
            texts: By key.
        """
        from mcap.records import Metadata, MetadataIndex

        offset = self._stream.tell()
        packed = _packed(Metadata(name=name, metadata=dict(texts)))
        self._stream.write(packed)
        self._metadata.append(MetadataIndex(offset=offset, length=len(packed), name=name))

    def add_schema(self, name: str, encoding: str, data: bytes) -> int:
        """Add a schema to the chunk; its id.

        Args:
            name: Of the schema.
            encoding: Of its text.
            data: The text.
        """
        from mcap.records import Schema

        schema = Schema(id=len(self._schemas) + 1, data=data, encoding=encoding, name=name)
        self._schemas.append(schema)
        self._add(_packed(schema))
        return len(self._schemas)

    def add_channel(self, topic: str, encoding: str, schema: int, metadata: Mapping[str, str]) -> int:
        """Add a channel to the chunk; its id.

        Args:
            topic: Of its messages.
            encoding: Of its messages.
            schema: Id of its schema.
            metadata: Texts by key.
        """
        from mcap.records import Channel

        number = len(self._channels) + 1
        channel = Channel(
            id=number, topic=topic, message_encoding=encoding, schema_id=schema, metadata=dict(metadata)
        )
        self._channels.append(channel)
        self._add(_packed(channel))
        return number

    def add_message(
        self, channel: int, sequence: int, log_time: int, publish_time: int, *data: bytes | memoryview
    ) -> None:
        """Add a message to the chunk.

        Args:
            channel: Its id.
            sequence: Number of the message.
            log_time: When it was recorded [ns].
            publish_time: When it was made [ns].
            data: Pieces of the message, of bytes each.
        """
        self._entries.setdefault(channel, []).append((log_time, self._length))
        length = _MESSAGE_FIELDS + sum(map(len, data))
        self._add(_MESSAGE.pack(_OPCODE_MESSAGE, length, channel, sequence, log_time, publish_time))
        self._pieces += data
        self._length += length - _MESSAGE_FIELDS

    def end_chunk(self) -> None:
        """Write the chunk and its index; nothing where it has no message."""
        if not self._entries:
            return
        pieces, crc = self._pieces, 0
        for piece in pieces:
            crc = crc32(piece, crc)
        if self._compression:
            pieces = [self._compress(b"".join(pieces))]
        stored = sum(map(len, pieces))
        times = [time for entries in self._entries.values() for time, _ in entries]
        first, last, start = min(times), max(times), self._stream.tell()
        name = self._compression
        length = _CHUNK_FIELDS + len(name) + stored
        head = _CHUNK.pack(_OPCODE_CHUNK, length, first, last, self._length, crc)
        self._stream.write(
            b"".join((head, len(name).to_bytes(4, "little"), name, stored.to_bytes(8, "little")))
        )
        for piece in pieces:  # not joined first: a frame has megabytes
            self._stream.write(piece)
        begin = self._stream.tell()
        offsets, index = self._packed_index(begin)
        self._stream.write(index)
        self._chunks.append(
            {
                "message_start_time": first,
                "message_end_time": last,
                "chunk_start_offset": start,
                "chunk_length": begin - start,
                "message_index_offsets": offsets,
                "message_index_length": len(index),
                "compression": name.decode(),
                "compressed_size": stored,
                "uncompressed_size": self._length,
            }
        )
        self._pieces, self._length, self._entries = [], 0, {}

    def finish(self) -> None:
        """Write the chunk that is begun, the summary and the end of the file."""
        from mcap.data_stream import RecordBuilder
        from mcap.opcode import Opcode
        from mcap.records import ChunkIndex, DataEnd, Footer, SummaryOffset
        from mcap.writer import MCAP0_MAGIC

        self.end_chunk()
        self._stream.write(_packed(DataEnd(0)))
        start, summary = self._stream.tell(), RecordBuilder()
        groups: list[tuple[Opcode, list[McapRecord]]] = [
            (Opcode.SCHEMA, self._schemas),
            (Opcode.CHANNEL, self._channels),
            (Opcode.STATISTICS, [self._statistics()]),
            (Opcode.CHUNK_INDEX, [ChunkIndex(**chunk) for chunk in self._chunks]),
            (Opcode.ATTACHMENT_INDEX, []),
            (Opcode.METADATA_INDEX, self._metadata),
        ]
        offsets = []
        for opcode, records in groups:
            begin = summary.count
            for record in records:
                record.write(summary)
            length = summary.count - begin
            offsets.append(SummaryOffset(group_opcode=opcode, group_start=start + begin, group_length=length))
        offset_start = start + summary.count
        for offset in offsets:
            offset.write(summary)
        packed = summary.end()
        # The CRC covers the footer up to its own place.
        crc = crc32(struct.pack("<BQQQ", Opcode.FOOTER, 20, start, offset_start), crc32(packed))
        footer = Footer(summary_start=start, summary_offset_start=offset_start, summary_crc=crc)
        self._stream.write(packed + _packed(footer) + MCAP0_MAGIC)

    def _add(self, record: bytes) -> None:
        self._pieces.append(record)
        self._length += len(record)

    def _packed_index(self, begin: int) -> tuple[dict[int, int], bytes]:
        """By channel the place of its index in the file, which begin at ``begin``; and the indices."""
        offsets, packed = dict[int, int](), list[bytes]()
        for channel, entries in self._entries.items():
            offsets[channel] = begin
            length = _ENTRY.size * len(entries)
            packed.append(_INDEX.pack(_OPCODE_INDEX, 6 + length, channel, length))
            packed += [_ENTRY.pack(*entry) for entry in entries]
            begin += _INDEX.size + length
            self._counts[channel] += len(entries)
        return offsets, b"".join(packed)

    def _statistics(self) -> McapRecord:
        from mcap.records import Statistics

        return Statistics(
            attachment_count=0,
            channel_count=len(self._channels),
            channel_message_counts=dict(self._counts),
            chunk_count=len(self._chunks),
            message_count=self._counts.total(),
            metadata_count=len(self._metadata),
            message_start_time=min((chunk["message_start_time"] for chunk in self._chunks), default=0),
            message_end_time=max((chunk["message_end_time"] for chunk in self._chunks), default=0),
            schema_count=len(self._schemas),
        )


def _packed(record: McapRecord) -> bytes:
    from mcap.data_stream import RecordBuilder

    builder = RecordBuilder()
    record.write(builder)
    packed: bytes = builder.end()
    return packed


def _compressor(compression: str) -> Callable[[bytes], bytes]:
    if compression == "lz4":
        import lz4.frame

        compress: Callable[[bytes], bytes] = lz4.frame.compress
        return compress
    if compression == "zstd":
        import zstandard

        return zstandard.compress
    return lambda content: content
