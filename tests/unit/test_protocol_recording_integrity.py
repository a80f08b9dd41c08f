"""Damage of a recording: none is unnoticed, what is readable is read, and what is lost is said."""

from __future__ import annotations

import json
import random
import struct
import tracemalloc
import warnings
import zlib
from pathlib import Path

import pytest
from mcap.writer import CompressionType, Writer
from recording_builders import SCENARIO, frame, link, product, record, recorder

from caviar_protocol.errors import RecordingError
from caviar_protocol.recording import (
    METADATA_NAME,
    PROFILE,
    Recording,
    RecordingWarning,
    integrity,
    read_manifest,
)
from caviar_protocol.recording.integrity import declared_digest, recorded_until
from caviar_protocol.recording.segment import Segment, expand, may_expand
from caviar_protocol.topics import Link

pytestmark = pytest.mark.slow

FLIPS = 500


def read(run: Path) -> tuple[Recording, str]:
    """A damaged recording, and the warning that opening it gives."""
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        recording = Recording(run)
    return recording, " ".join(str(warning.message) for warning in told)


def noticed(run: Path) -> str:
    try:
        return " ".join(read(run)[0].run_digest().damage)
    except RecordingError as error:
        return str(error)


@pytest.mark.parametrize("compression", ["none", "zstd", "lz4"])
def test_no_flipped_bit_of_a_closed_recording_is_unnoticed(tmp_path, compression):
    """Anywhere in segments, manifest and scenery; the file is named."""
    mesh = tmp_path / "wall.ply"
    mesh.write_bytes(b"ply" * 50)
    record(
        tmp_path / "run",
        [frame(number, product("link", "link", link(number), number)) for number in range(3)],
        assets={"scenery/wall.ply": mesh},
        segment_frames=2,
        compression=compression,
    )
    run = tmp_path / "run"
    assert noticed(run) == ""
    files = sorted(file for file in run.rglob("*") if file.is_file())
    assert len(files) == 4
    sizes = [file.stat().st_size for file in files]
    chance = random.Random(5)
    for _ in range(FLIPS if compression == "none" else FLIPS // 5):
        file = chance.choices(files, sizes)[0] if chance.random() < 0.8 else chance.choice(files)
        clean = file.read_bytes()
        damaged, bit = bytearray(clean), chance.randrange(8 * len(clean))
        damaged[bit // 8] ^= 1 << bit % 8
        file.write_bytes(damaged)
        assert file.name in noticed(run), f"bit {bit} of {file.name}"
        file.write_bytes(clean)


def test_no_flipped_bit_of_a_recording_that_was_not_closed_is_unnoticed(tmp_path):
    """As a killed recorder leaves it. What is cut off is said, or a line names the damage."""
    made = recorder(tmp_path)
    for number in range(4):
        made.step(frame(number, product("link", "link", link(number), number)))
    file = tmp_path / "recording-0000.mcap"
    clean = file.read_bytes()
    made.close()
    (tmp_path / "recording.json").unlink()
    chance = random.Random(6)
    for _ in range(FLIPS):
        damaged, bit = bytearray(clean), chance.randrange(8 * len(clean))
        damaged[bit // 8] ^= 1 << bit % 8
        file.write_bytes(damaged)
        text = noticed(tmp_path)
        # The record of the last seal: without it, the last frame was not acknowledged.
        last_seal = len(clean) - 13 <= bit // 8 < len(clean) - 4
        assert file.name in text or (last_seal and len(read(tmp_path)[0]) == 3), f"bit {bit}"


@pytest.mark.parametrize("zeros", [1, 8, 3600, 100_000])
def test_zeros_at_the_end_cost_no_frame_before_them(tmp_path, zeros):
    """As a power loss leaves a file that grew."""
    made = recorder(tmp_path)
    for number in range(4):
        made.step(frame(number))
    file = tmp_path / "recording-0000.mcap"
    left = file.read_bytes() + bytes(zeros)
    made.close()
    (tmp_path / "recording.json").unlink()
    file.write_bytes(left)
    recording, told = read(tmp_path)
    assert [f.payloads("link", Link)["link"] for f in recording.frames()] == [link(k) for k in range(4)]
    assert not recording.complete
    if zeros >= 9:  # else it is a record whose head was not written whole
        assert f"readable up to byte {len(left) - zeros} of {len(left)}: lost are all frames after" in told


def test_a_hole_in_the_middle_ends_what_was_not_closed(tmp_path):
    """A later page came to disk, an earlier one did not."""
    made = recorder(tmp_path)
    for number in range(6):
        made.step(frame(number))
    file = tmp_path / "recording-0000.mcap"
    left = bytearray(file.read_bytes())
    made.close()
    chunk = Segment(file).chunks[3]
    middle = (chunk.start + chunk.stop) // 2
    left[middle : middle + 100] = bytes(100)
    file.write_bytes(left)
    (tmp_path / "recording.json").unlink()
    recording, told = read(tmp_path)
    assert [f.number for f in recording.frames()] == [0, 1, 2]
    assert "lost are all frames after frame 2 of episode 0" in recording.damage[0]
    assert "are not what was written (CRC-32)" in recording.damage[1]
    assert recording.damage[0] in told
    assert recorded_until(tmp_path)[0] == (0, 2)


def test_a_last_segment_that_is_gone_is_missed(tmp_path):
    run = record(tmp_path / "run", frames=6, segment_frames=2)
    (run / "recording-0002.mcap").unlink()
    recording, told = read(run)
    assert not recording.complete
    assert len(recording) == 4
    assert (
        "recording-0002.mcap is missing: lost are all frames after frame 3 of episode 0 up to frame 5" in told
    )
    assert recorded_until(run) == ((0, 3), recording.damage)


def test_a_frame_whose_record_is_damaged_costs_no_other_of_a_closed_segment(tmp_path):
    run = record(tmp_path / "run", frames=5)
    file = run / "recording-0000.mcap"
    chunk = Segment(file).chunks[2]
    data = bytearray(file.read_bytes())
    data[chunk.offset + 4] ^= 0x40  # in its length
    file.write_bytes(data)
    recording, told = read(run)
    assert [f.number for f in recording.frames()] == [0, 1, 3, 4]
    assert f"bytes {chunk.offset} to" in told
    assert any("what was between is lost" in line for line in recording.run_digest().damage)
    assert recorded_until(run)[0] == (0, 1)


def test_a_recording_of_an_earlier_version_is_read(tmp_path):
    """Without seals and manifest, with MCAP's CRC of the data section."""
    run = record(tmp_path / "run", frames=3)
    (old := tmp_path / "old").mkdir()
    metadata = Segment(run / "recording-0000.mcap").metadata
    assert json.loads(metadata["scenario"]) == SCENARIO
    with (old / "recording-0000.mcap").open("wb") as stream:
        writer = Writer(stream, compression=CompressionType.NONE, enable_data_crcs=True)
        writer.start(profile=PROFILE)
        writer.add_metadata(METADATA_NAME, metadata)
        writer.finish()
    recording = Recording(old)
    assert recording.complete
    assert (recording.run_digest().frames, recording.run_digest().damage) == (0, ())
    data = bytearray((old / "recording-0000.mcap").read_bytes())
    data[60] ^= 1
    (old / "recording-0000.mcap").write_bytes(data)
    assert "recording-0000.mcap" in noticed(old)


def test_the_declared_digest_is_that_of_the_products(tmp_path):
    recording = Recording(record(tmp_path, frames=4))
    entries = [recording.entry(index) for index in range(4)]
    assert declared_digest(entries) == recording.run_digest().digest
    assert declared_digest(entries[:3]) != recording.run_digest().digest


def test_a_manifest_that_is_not_what_was_written_is_named(tmp_path):
    run = record(tmp_path, frames=2)
    file = run / "recording.json"
    file.write_bytes(file.read_bytes().replace(b'"frames":2', b'"frames":3'))
    with pytest.raises(RecordingError, match=r"recording\.json.*CRC"):
        read_manifest(run)
    file.write_bytes(b"")
    with pytest.raises(RecordingError, match=r"recording\.json is damaged"):
        read_manifest(run)
    assert "recording.json" in read(run)[1]


# --- sizes that are declared -----------------------------------------------------------------------------


@pytest.mark.parametrize("compression", ["zstd", "lz4"])
def test_a_chunk_that_would_take_all_memory_is_refused(tmp_path, compression):
    """A few hundred kilobytes that expand to a gibibyte, declared and not."""
    bomb = _compressed(compression, 256)
    for declared in (256 << 20, 1 << 20, 1 << 60):
        file = tmp_path / "recording-0000.mcap"
        data = _with_chunk(record(tmp_path / "clean", frames=0), compression, bomb, declared)
        file.write_bytes(data if declared < 1 << 30 else data[:-13])  # with a seal after it, and without
        tracemalloc.start()
        try:
            recording, told = read(file)
            peak = tracemalloc.get_traced_memory()[1]
        finally:
            tracemalloc.stop()
        assert len(recording) == 0
        assert "recording-0000.mcap" in told
        assert peak < 48 << 20
        (tmp_path / "clean" / "recording-0000.mcap").unlink()
        (tmp_path / "clean" / "recording.json").unlink()


@pytest.mark.parametrize("compression", ["zstd", "lz4"])
def test_data_that_expand_to_another_size_than_declared_are_refused(compression):
    data = memoryview(_compressed(compression, 1))
    assert expand(compression, data, 1 << 20) == bytes(1 << 20)
    assert expand(compression, data, 1 << 20, 100) == bytes(100)
    for declared in (100, (1 << 20) - 1, (1 << 20) + 1):
        with pytest.raises(ValueError, match=f"declares {declared} B"):
            expand(compression, data, declared)
    assert may_expand(1000, 64 << 20)
    assert not may_expand(1000, (64 << 20) + 1)


def _compressed(compression: str, mebibytes: int) -> bytes:
    import lz4.frame
    import zstandard

    pack = zstandard.compress if compression == "zstd" else lz4.frame.compress
    return bytes(pack(bytes(mebibytes << 20)))


def _with_chunk(run: Path, compression: str, data: bytes, size: int) -> bytes:
    """The head of an empty recording, and one chunk after it."""
    clean = (run / "recording-0000.mcap").read_bytes()
    head = clean[: clean.index(b"\xca\x04\0\0\0\0\0\0\0") + 13]
    name = compression.encode()
    content = struct.pack("<QQQII", 0, 0, size, 0, len(name)) + name + struct.pack("<Q", len(data)) + data
    chunk = struct.pack("<BQ", 0x06, len(content)) + content
    sealed = head + chunk
    return sealed + struct.pack("<BQI", 0xCA, 4, zlib.crc32(sealed))


def test_a_warning_says_it_once(tmp_path):
    run = record(tmp_path, frames=3)
    (run / "recording.json").write_text("{}")
    with pytest.warns(RecordingWarning, match="the recording is damaged") as told:
        Recording(run)
    assert len(told) == 1


@pytest.mark.parametrize("past_gaps", [False, True])
def test_a_segment_that_its_recorder_removes_meanwhile_is_no_recording(tmp_path, monkeypatch, past_gaps):
    gone = tmp_path / "recording-0000.mcap"
    monkeypatch.setattr(integrity, "_files", lambda _: [gone])
    with pytest.raises(RecordingError, match=r"is missing|no recording any more"):
        integrity.RecordedSegments(tmp_path, past_gaps=past_gaps)
