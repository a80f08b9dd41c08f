"""Files of `McapFile` are those of the MCAP library, byte for byte."""

from __future__ import annotations

import io
import sys

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer

from caviar_services.recorder.mcap_file import McapFile

FRAMES = 5


def of_library(compression: str, messages: list[list[tuple[int, int, int, int, bytes]]]) -> bytes:
    stream = io.BytesIO()
    writer = Writer(stream, sys.maxsize, CompressionType[compression.upper()])
    writer.start(profile="caviar")
    writer.add_metadata("caviar", {"run": "1", "notes": "äö"})
    for frame, entries in enumerate(messages):
        if frame in (0, 2):
            schema = writer.register_schema(f"schema {frame}", "text", b"of the library")
            writer.register_channel(f"channel {frame}", "raw", schema, {"topic": "link"})
        for channel, sequence, log_time, publish_time, data in entries:
            writer.add_message(channel, log_time, data, publish_time, sequence)
        writer.flush()
    writer.finish()
    return stream.getvalue()


def of_ours(compression: str, messages: list[list[tuple[int, int, int, int, bytes]]]) -> bytes:
    stream = io.BytesIO()
    file = McapFile(stream, "caviar", compression)
    file.add_metadata("caviar", {"run": "1", "notes": "äö"})
    for frame, entries in enumerate(messages):
        if frame in (0, 2):
            schema = file.add_schema(f"schema {frame}", "text", b"of the library")
            file.add_channel(f"channel {frame}", "raw", schema, {"topic": "link"})
        for channel, sequence, log_time, publish_time, data in entries:
            file.add_message(channel, sequence, log_time, publish_time, data[:3], memoryview(data)[3:])
        file.end_chunk()
    file.finish()
    return stream.getvalue()


@pytest.mark.parametrize("compression", ["none", "lz4", "zstd"])
def test_the_bytes_are_those_of_the_library(compression: str) -> None:
    """Frames with one message, several of one channel, out of the order of time, and with none."""
    rng = np.random.default_rng(4)
    messages = [[(1, frame, 100 * frame, 7 * frame, rng.bytes(40))] for frame in range(FRAMES)]
    messages[2] += [(2, 9, 150, 150, b""), (1, 8, 90, 80, rng.bytes(3000)), (2, 10, 260, 150, b"abc" * 900)]
    messages[3] = []
    ours = of_ours(compression, messages)
    assert ours == of_library(compression, messages)
    found = [
        message.data for _, _, message in make_reader(io.BytesIO(ours)).iter_messages(log_time_order=False)
    ]
    assert sorted(found) == sorted(entry[4] for entries in messages for entry in entries)


def test_a_file_without_messages_is_that_of_the_library() -> None:
    assert of_ours("none", []) == of_library("none", [])
