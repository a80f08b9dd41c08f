"""A recorder that died and was started again: nothing is there twice, nothing is lost (clause 18)."""

from __future__ import annotations

from pathlib import Path

import pytest
from mcap.reader import make_reader
from recording_builders import absent, frame, link, product, record, recorder

from caviar_protocol.errors import RunError
from caviar_protocol.messages import Status
from caviar_protocol.recording import Manifest, Recording, integrity, read_manifest
from caviar_services.recorder.mcap import McapRecorder

pytestmark = pytest.mark.slow


def killed(made: McapRecorder) -> None:
    """What is buffered is lost, and no index is written."""
    if made._persistence is not None:
        made._persistence.abandon()
    if made._segment is not None:
        made._segment.abandon()


def times(recording: Recording) -> list[tuple[str, int, int, int]]:
    """Of every message: topic, sequence, run time, time that it was computed for."""
    found = []
    for file in recording.files:
        with file.open("rb") as stream:
            read = make_reader(stream, validate_crcs=True)
            found += [(c.topic, m.sequence, m.log_time, m.publish_time) for _, c, m in read.iter_messages()]
    return found


FRAMES = [frame(k, episode=e) for e in (0, 1) for k in range(5)]


@pytest.mark.parametrize("settings", [{}, {"segment_frames": 2}, {"compression": "lz4"}], ids=str)
@pytest.mark.parametrize("written", range(11))
@pytest.mark.parametrize("repeated", [0, 1, 3])
def test_the_recording_is_the_one_of_a_recorder_that_was_not_killed(
    tmp_path: Path, written: int, repeated: int, settings: dict[str, object]
) -> None:
    """``repeated`` frames were written, and are granted once more."""
    expected = Recording(record(tmp_path / "whole", FRAMES, **settings))
    folder = tmp_path / "killed"
    folder.mkdir()
    made = recorder(folder, **settings)
    for one in FRAMES[:written]:
        made.step(one)
    killed(made)
    made = recorder(folder, again=True, **settings)
    for one in FRAMES[max(0, written - repeated) :]:
        made.step(one)
    made.close()
    recording = Recording(folder)
    assert recording.complete
    assert recording.run_digest() == expected.run_digest()
    assert recording.run_digest().damage == ()
    assert times(recording) == times(expected)


@pytest.mark.parametrize("bytes_lost", [1, 50, 3000])
def test_a_frame_that_was_half_written_is_written_anew(tmp_path: Path, bytes_lost: int) -> None:
    expected = Recording(record(tmp_path / "whole", FRAMES))
    folder = tmp_path / "killed"
    folder.mkdir()
    made = recorder(folder)
    for one in FRAMES[:4]:
        made.step(one)
    killed(made)
    file = folder / "recording-0000.mcap"
    file.write_bytes(file.read_bytes()[:-bytes_lost])
    made = recorder(folder, again=True)
    for one in FRAMES[3 if bytes_lost < 3000 else 2 :]:
        made.step(one)
    made.close()
    assert Recording(folder).run_digest() == expected.run_digest()


def test_a_held_product_is_not_stored_again(tmp_path: Path) -> None:
    frames = [frame(0, product("link", "link", link(0), 0))]
    frames += [frame(k, product("link", "link", link(0), 0, Status.HELD, used_in=k)) for k in (1, 2)]
    made = recorder(tmp_path)
    made.step(frames[0])
    made.step(frames[1])
    killed(made)
    made = recorder(tmp_path, again=True)
    made.step(frames[2])
    made.close()
    recording = Recording(tmp_path)
    assert [topic for topic, *_ in times(recording)].count("link/link") == 1
    assert recording.product(0, 2, "link", "link") == link(0)


def test_one_that_is_granted_nothing_more_leaves_a_whole_recording(tmp_path: Path) -> None:
    made = recorder(tmp_path)
    made.step(FRAMES[0])
    killed(made)
    assert not Recording(tmp_path).complete
    recorder(tmp_path, again=True).close()
    assert Recording(tmp_path).complete
    assert len(Recording(tmp_path)) == 1


def test_one_that_died_before_it_wrote_anything_begins_anew(tmp_path: Path) -> None:
    (tmp_path / "recording-0000.mcap").write_bytes(b"")
    made = recorder(tmp_path, again=True)
    made.step(frame(0, absent("link", "link", "late")))
    made.close()
    assert len(Recording(tmp_path)) == 1


def test_a_recording_that_is_there_when_a_run_begins_is_not_touched(tmp_path: Path) -> None:
    record(tmp_path / "whole", FRAMES)
    before = (tmp_path / "whole" / "recording-0000.mcap").read_bytes()
    with pytest.raises(RunError, match="is there already"):
        recorder(tmp_path / "whole")
    assert (tmp_path / "whole" / "recording-0000.mcap").read_bytes() == before


def killed_in_the_second_segment(folder: Path) -> None:
    made = recorder(folder, segment_frames=3, run={"durability": "none"})
    for one in FRAMES[:5]:
        made.step(one)
    killed(made)


def go_back_to_frame_2(folder: Path) -> None:
    made = recorder(folder, again=True, segment_frames=3, run={"durability": "none"})
    made.step(FRAMES[2])
    killed(made)


def test_a_reader_meets_no_damage_while_it_goes_back(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    killed_in_the_second_segment(tmp_path)
    replace, unlink, met = Path.replace, Path.unlink, list[int]()

    def read(path: Path) -> None:
        if path.suffix == ".mcap":
            met.append(len(Recording(tmp_path)))

    def read_and_replace(path: Path, target: Path) -> Path:
        read(target)
        replaced = replace(path, target)
        read(target)
        return replaced

    def unlink_and_read(path: Path, *, missing_ok: bool = False) -> None:
        unlink(path, missing_ok=missing_ok)
        read(path)

    monkeypatch.setattr(Path, "replace", read_and_replace)
    monkeypatch.setattr(Path, "unlink", unlink_and_read)
    go_back_to_frame_2(tmp_path)
    assert met == [3, 3, 2]


def test_a_reader_that_began_before_it_went_back_reads_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    killed_in_the_second_segment(tmp_path)
    times_read = list[Path]()

    def read_and_go_back(folder: Path) -> Manifest | None:
        manifest = read_manifest(folder)
        times_read.append(folder)
        if len(times_read) == 1:
            go_back_to_frame_2(tmp_path)
        return manifest

    monkeypatch.setattr(integrity, "read_manifest", read_and_go_back)
    assert len(Recording(tmp_path)) == 3
