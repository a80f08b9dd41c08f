"""The recording reader: whole, cut, damaged, incomplete and empty recordings."""

from __future__ import annotations

import copy
import os
import pickle
import shutil
import warnings
from pathlib import Path

import numpy as np
import pytest
from mcap.writer import CompressionType, Writer
from recording_builders import absent, frame, link, product, record, recorder, scene

from caviar_protocol.digest import RunDigest
from caviar_protocol.errors import RecordingError
from caviar_protocol.messages import Status
from caviar_protocol.recording import Recording, RecordingWarning, newest_run
from caviar_protocol.recording.segment import Segment
from caviar_protocol.topics import Link, Scene

pytestmark = pytest.mark.slow

SEAL = b"\xca\x04\0\0\0\0\0\0\0"
"""Of the private record with a CRC-32, without that."""


@pytest.fixture
def run(tmp_path: Path) -> Path:
    return record(tmp_path / "run", frames=6, segment_frames=2)


def only_segment(folder: Path) -> Path:
    return record(folder, frames=4) / "recording-0000.mcap"


def flip(file: Path, offset: int) -> None:
    data = bytearray(file.read_bytes())
    data[offset] ^= 0x10
    file.write_bytes(data)


def test_it_gives_metadata_topics_and_typed_frames(run):
    recording = Recording(run)
    assert recording.complete
    assert (recording.metadata.run, recording.metadata.seed, recording.metadata.name) == (
        "sample-1",
        7,
        "sample",
    )
    assert recording.topics == {"link": ("link",), "scene": ("world",)}
    assert len(recording) == 6
    for number, stored in enumerate(recording.frames()):
        assert (stored.episode, stored.number, stored.t_ns) == (0, number, number * 100_000_000)
        assert stored.payloads("link", Link) == {"link": link(number)}
        assert stored.scene() == scene(number)
        assert [entry.status for entry in stored.inputs] == [Status.FRESH] * 2


@pytest.mark.parametrize("copied", [copy.deepcopy, lambda given: pickle.loads(pickle.dumps(given))])  # noqa: S301
def test_a_recording_and_its_topics_are_copied_and_pickled_as_their_files(run, monkeypatch, copied):
    monkeypatch.chdir(run.parent)
    recording = Recording(run.name)
    other, topic, stored = copied((recording, recording["link"][2:4], recording.frame(0, 5)))
    monkeypatch.chdir("/")
    assert (other.run_digest(), len(other)) == (Recording(run).run_digest(), 6)
    assert np.array_equal(topic.abs_y, Recording(run)["link"].abs_y[2:4])
    assert stored.payloads("link", Link) == {"link": link(5)}


def test_products_are_found_by_frame_and_by_topic(run):
    recording = Recording(run)
    assert recording.product(0, 3, "scene", "world") == scene(3)
    assert [p.payload for _, p in recording.products("link")] == [link(k) for k in range(6)]
    assert [frame.number for frame in recording] == [frame.number for frame in recording.frames()]
    with pytest.raises(RecordingError, match=r"recording\[3\].*recording\.frame\(episode=0"):
        recording[3]
    assert isinstance(recording.product(0, 0, "scene", "world"), Scene)
    with pytest.raises(RecordingError, match=r"frame 1 has no lidar of 'top'"):
        recording.product(0, 1, "lidar", "top")
    with pytest.raises(RecordingError, match=r"frame 9 of episode 0.*\(0, 5\)"):
        recording.frame(0, 9)


def test_one_segment_can_be_read_alone(run):
    recording = Recording(run / "recording-0001.mcap")
    assert [f.number for f in recording.frames()] == [2, 3]
    assert recording.metadata.segment == 1
    assert recording.directory == run


def test_the_digest_is_the_chain_over_fresh_products_of_the_bytes(tmp_path):
    chain = RunDigest()
    late = product("link", "link", link(0), 0, Status.LATE, used_in=1)
    steps = [
        [product("scene", "world", scene(0), 0), absent("link", "link", "late")],
        [product("scene", "world", scene(1), 1), product("link", "link", link(1), 1), late],
        [product("scene", "world", scene(1), 1, Status.HELD, used_in=2), product("link", "link", link(2), 2)],
    ]
    record(tmp_path, [frame(number, *inputs) for number, inputs in enumerate(steps)])
    for number, inputs in enumerate(steps):
        fresh = [i.provenance for i in inputs if i.provenance.status is Status.FRESH]
        chain.add_frame(0, number, [(p.topic, p.source, p.digest) for p in fresh])
    report = Recording(tmp_path).run_digest()
    assert (report.digest, report.frames, report.damage) == (chain.hexdigest(), 3, ())


def test_equal_content_gives_equal_digests_however_it_is_segmented(run, tmp_path):
    other = record(tmp_path / "other", frames=6, segment_mib=100.0, compression="zstd")
    assert Recording(run).run_digest().digest == Recording(other).run_digest().digest
    fewer = record(tmp_path / "fewer", frames=5)
    assert Recording(run).run_digest().digest != Recording(fewer).run_digest().digest


def test_a_changed_payload_byte_gives_another_digest_and_is_named(tmp_path):
    file = only_segment(tmp_path / "run")
    before = Recording(file.parent).run_digest()
    stored = next(p for p in Recording(file.parent).frame(0, 2).products if p.provenance.topic == "link")
    flip(file, file.read_bytes().index(bytes(stored.body)) + 5)
    report = Recording(file.parent).run_digest()
    assert report.digest != before.digest
    assert "episode 0, frame 2 (recording-0000.mcap, offset" in report.damage[0]
    assert "link of 'link': its digest is" in report.damage[0]
    assert "frame 2" in report.damage[1]
    assert "CRC-32" in report.damage[1]
    assert len(report.damage) == 2


def test_a_damaged_frame_is_refused_by_place_and_its_neighbours_are_read(tmp_path):
    file = only_segment(tmp_path / "run")
    chunk = Segment(file).chunks[2]
    flip(file, chunk.stop - 20)
    recording = Recording(tmp_path / "run")
    assert recording.frame(0, 1).payloads("link", Link) == {"link": link(1)}
    assert recording.frame(0, 3).payloads("link", Link) == {"link": link(3)}
    with pytest.raises(
        RecordingError, match=rf"frame 2: the chunk at offset {chunk.offset} of .*recording-0000\.mcap"
    ):
        recording.frame(0, 2).payloads("link", Link)


@pytest.mark.parametrize("closed", [True, False])
def test_no_flipped_byte_of_a_frame_goes_unnoticed(tmp_path, closed):
    """Through a whole chunk, its head too: damage is reported, or an error names the file."""
    file = only_segment(tmp_path / "run")
    chunk, after = Segment(file).chunks[1:3]
    clean = file.read_bytes() if closed else file.read_bytes()[: after.stop]
    if not closed:
        (file.parent / "recording.json").unlink()
    unnoticed = []
    for offset in [*range(chunk.offset, chunk.start + 20), *range(chunk.start, chunk.stop, 11)]:
        file.write_bytes(clean)
        flip(file, offset)
        message = noticed(tmp_path / "run")
        if "recording-0000.mcap" not in message:
            unnoticed.append(offset - chunk.offset)
    assert unnoticed == []


def noticed(run: Path) -> str:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RecordingWarning)
        try:
            return " ".join(Recording(run).run_digest().damage)
        except RecordingError as error:
            return str(error)


def test_cut_anywhere_it_yields_every_whole_frame(tmp_path):
    file = only_segment(tmp_path / "run")
    clean = file.read_bytes()
    chunks = Segment(file).chunks
    sealed = [clean.index(SEAL, chunk.stop) + len(SEAL) + 4 for chunk in chunks]
    """Where each frame is covered by a seal after it."""
    for size in [*range(chunks[0].offset, len(clean), 173), *(c.stop for c in chunks), *sealed]:
        (tmp_path / "cut").mkdir(exist_ok=True)
        cut = tmp_path / "cut" / file.name
        cut.write_bytes(clean[:size])
        recording = Recording(tmp_path / "cut")
        whole = sum(place <= size for place in sealed)
        assert len(recording) == whole
        assert not recording.complete
        assert [f.payloads("link", Link)["link"] for f in recording.frames()] == [
            link(k) for k in range(whole)
        ]
        assert recording.run_digest().damage == ()


@pytest.mark.parametrize("size", [0, 3, 8, 60])
def test_a_recording_cut_before_its_metadata_says_so(tmp_path, size):
    file = only_segment(tmp_path / "run")
    file.write_bytes(file.read_bytes()[:size])
    with pytest.raises(RecordingError, match=rf"breaks off at {size} B, before its metadata"):
        Recording(tmp_path / "run")


def test_a_next_segment_that_was_only_begun_loses_nothing(run):
    last = run / "recording-0003.mcap"
    last.write_bytes(b"\x89MCAP0\r\n")
    recording = Recording(run)
    assert len(recording) == 6
    assert not recording.complete


def test_a_missing_segment_is_named(run):
    (run / "recording-0001.mcap").unlink()
    lost = r"recording-0001\.mcap is missing: lost are all frames after frame 1 of episode 0 up to frame 3"
    with pytest.warns(RecordingWarning, match=lost + r" of episode 0, and those of recording-0002\.mcap"):
        recording = Recording(run)
    assert not recording.complete
    assert [frame.number for frame in recording.frames()] == [0, 1]
    (run / "recording-0000.mcap").unlink()
    with pytest.raises(RecordingError, match=r"recording-0000\.mcap.*recording-0002"):
        Recording(run)


def test_a_segment_that_breaks_off_before_others_is_read_up_to_there(run):
    file = run / "recording-0001.mcap"
    file.write_bytes(file.read_bytes()[:-100])
    with pytest.warns(RecordingWarning, match=r"0001\.mcap has \d+ B of \d+ B"):
        assert len(Recording(run)) == 6
    file.write_bytes(file.read_bytes()[: Segment(file).chunks[1].stop])
    with pytest.warns(RecordingWarning, match=r"frame 2 of episode 0.*frame 3"):
        assert len(Recording(run)) == 3
    (run / "recording.json").unlink()
    with pytest.warns(RecordingWarning, match=r"at byte \d+: .*frame 2"):
        assert len(Recording(run)) == 3


def test_segments_of_two_runs_are_refused(run, tmp_path):
    other = record(tmp_path / "other", frames=6, segment_frames=2)
    shutil.copy(other / "recording-0000.mcap", run / "recording-0003.mcap")
    with pytest.raises(RecordingError, match=r"recording-\d+.mcap.*segments of two runs are mixed"):
        Recording(run)


def test_an_empty_run_has_metadata_and_no_frames(tmp_path):
    recording = Recording(record(tmp_path, frames=0))
    assert recording.complete
    assert len(recording) == 0
    assert recording.topics == {}
    assert recording.run_digest().digest == RunDigest().hexdigest()
    with pytest.raises(RecordingError, match="it has no frame"):
        recording.frame(0, 0)


def test_a_run_before_its_end_can_be_read(tmp_path):
    made = recorder(tmp_path)
    made.step(frame(0))
    recording = Recording(tmp_path)
    assert (len(recording), recording.complete) == (1, False)
    made.step(frame(1))
    made.close()
    assert len(Recording(tmp_path)) == 2


def test_a_held_product_in_an_earlier_segment_needs_that_segment(tmp_path):
    record(
        tmp_path,
        [
            frame(0, product("link", "link", link(0), 0)),
            frame(1, product("link", "link", link(0), 0, Status.HELD, used_in=1)),
        ],
        segment_frames=1,
    )
    assert Recording(tmp_path).product(0, 1, "link", "link") == link(0)
    with pytest.raises(RecordingError, match=r"frame 0,.*recording-0001\.mcap"):
        Recording(tmp_path / "recording-0001.mcap").product(0, 1, "link", "link")


def test_what_is_no_recording_is_refused_by_name(tmp_path):
    with pytest.raises(RecordingError, match="does not exist: give a run directory"):
        Recording(tmp_path / "nothing")
    with pytest.raises(RecordingError, match=r"recording-\*\.mcap"):
        Recording(tmp_path)
    record(tmp_path / "runs" / "sample-1", frames=1)
    with pytest.raises(RecordingError, match=r"/runs/sample-1$"):
        Recording(tmp_path / "runs")
    scenario = tmp_path / "mine.toml"
    scenario.write_text("[run]\n")
    with pytest.raises(RecordingError, match=r"mine\.toml"):
        Recording(scenario)
    text = tmp_path / "notes.txt"
    text.write_text("hello, this is text")
    with pytest.raises(RecordingError, match="does not begin as an MCAP file"):
        Recording(text)
    foreign = tmp_path / "robot.mcap"
    with foreign.open("wb") as stream:
        writer = Writer(stream, compression=CompressionType.NONE)
        writer.start(profile="ros2")
        writer.finish()
    with pytest.raises(RecordingError, match=r"'ros2'.*CAVIAR"):
        Recording(foreign)


def test_another_format_is_refused(tmp_path):
    file = only_segment(tmp_path / "run")
    data = file.read_bytes()
    place = data.index(b"format\x01\x00\x00\x001") + len(b"format\x01\x00\x00\x00")
    file.write_bytes(data[:place] + b"2" + data[place + 1 :])
    with pytest.raises(RecordingError, match=r"format 2.*format 1"):
        Recording(tmp_path / "run")


def test_the_newest_run_is_that_recorded_last_of_those_that_match(tmp_path: Path) -> None:
    for age, name in enumerate(["smoke-3", "smoke-1", "city-2"]):
        segment = record(tmp_path / name) / "recording-0000.mcap"
        os.utime(segment, ns=(10**18 - age, 10**18 - age))
    (tmp_path / "smoke-4" / "logs").mkdir(parents=True)
    assert newest_run(tmp_path) == tmp_path / "smoke-3"
    assert newest_run(str(tmp_path), "city-*") == tmp_path / "city-2"
    for root, name in ((tmp_path, "smoke-4"), (tmp_path / "nothing", "*")):
        with pytest.raises(RecordingError) as none:
            newest_run(root, name)
        assert (
            str(none.value)
            == f"no run with a recording is at {root / name}; make one with: caviar run SCENARIO"
        )
