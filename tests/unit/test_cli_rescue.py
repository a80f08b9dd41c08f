"""``caviar doctor RUN``: what it says of a damaged run, what it saves, and its status."""

from __future__ import annotations

import shutil
from contextlib import closing
from io import StringIO
from pathlib import Path

import pytest
from recording_builders import frame, record, recorder
from rich.console import Console

from caviar_broker.core.events import Journal
from caviar_broker.journal import JournalFile
from caviar_broker.journal_format import MAGIC
from caviar_broker.run_record import RunRecord
from caviar_clients.cli.recordings import inspect_command, rescue_run
from caviar_clients.session.embedded import EmbeddedRun
from caviar_clients.session.prepared import prepare
from caviar_protocol.errors import RunError
from caviar_protocol.recording import Manifest, Recording, SegmentRecord
from caviar_protocol.recording.segment import Segment
from caviar_protocol.scenario import load_scenario


def rescue(run: Path) -> tuple[int, str]:
    console = Console(width=300, file=StringIO(), record=True)
    return rescue_run(run, console), console.export_text()


def content(folder: Path) -> dict[str, bytes]:
    return {str(p.relative_to(folder)): p.read_bytes() for p in folder.rglob("*") if p.is_file()}


def test_a_whole_run_is_said_to_be_whole_and_not_copied(tmp_path):
    run = record(tmp_path / "run")
    status, text = rescue(run)
    assert status == 0
    assert "5 frames can be read, up to frame 4 of episode 0" in text
    assert list(tmp_path.iterdir()) == [run]


def test_a_run_that_was_killed_is_whole_up_to_there(tmp_path):
    made = recorder(tmp_path / "run")
    made.step(frame(0))
    status, text = rescue(tmp_path / "run")
    assert "--resume" not in text  # it has no record, as an embedded run
    kept = RunRecord(run="sample-1", epoch=1, endpoint="tcp://127.0.0.1:1", scenario=load_scenario("smoke"))
    kept.save(tmp_path / "run")
    (tmp_path / "run" / "journal.msgpack").write_bytes(MAGIC)
    assert f"caviar run --resume {tmp_path / 'run'}\n" in rescue(tmp_path / "run")[1]
    made.close()
    assert status == 0
    assert "1 frames can be read, up to frame 0 of episode 0; it breaks off there" in text


def test_what_can_be_read_of_a_damaged_recording_is_saved_beside_it(tmp_path):
    run = record(tmp_path / "run", frames=6, segment_frames=3)
    file = run / "recording-0001.mcap"
    chunk = Segment(file).chunks[1]
    data = bytearray(file.read_bytes())
    data[chunk.stop - 20] ^= 1
    file.write_bytes(data)
    before = content(run)
    status, text = rescue(run)
    assert status == 1
    assert content(run) == before
    assert "5 frames can be read" in text
    assert "frame 4 (recording-0001.mcap" in text
    saved = tmp_path / "run-rescued"
    assert f"what can be read of it is in {saved}" in text
    assert [f.number for f in Recording(saved).frames()] == [0, 1, 2, 3, 5]
    for stored in Recording(saved).frames():
        assert [p.digest for p in stored.products] == [e.digest for e in stored.inputs]
    assert rescue(run)[0] == 1
    assert (tmp_path / "run-rescued-2").is_dir()


def test_a_recording_without_its_last_segment_is_saved_without_damage(tmp_path):
    run = record(tmp_path / "run", frames=6, segment_frames=3)
    (run / "recording-0001.mcap").unlink()
    status, text = rescue(run)
    assert status == 1
    assert "recording-0001.mcap is missing: lost are all frames after frame 2" in text
    assert Recording(tmp_path / "run-rescued").complete
    assert Recording(tmp_path / "run-rescued").run_digest().damage == ()


def test_a_part_of_which_nothing_can_be_read_is_lost(tmp_path):
    run = record(tmp_path / "run")
    (run / "recording-0000.mcap").write_bytes(bytes(5000))
    (run / "run.json").write_bytes(b"")
    status, text = rescue(run)
    assert status == 2
    assert "does not begin as an MCAP file" in text
    assert "run.json is damaged: it is empty" in text


def test_no_run_is_named(tmp_path):
    with pytest.raises(RunError, match="is no directory; give"):
        rescue(tmp_path / "nothing")


def test_a_folder_that_is_no_runs_is_refused_with_the_run_in_it(tmp_path):
    with pytest.raises(RunError, match=r"neither recording, run\.json nor"):
        rescue(tmp_path)
    record(tmp_path / "sample-1", frames=1)
    with pytest.raises(RunError, match=r"holds runs.*sample-1$"):
        rescue(tmp_path)


@pytest.mark.parametrize("lost", [False, True])
def test_a_run_in_one_process_lacks_nothing(tmp_path, lost):
    """It has a journal, and no record; a run of a broker whose record is lost has another epoch."""
    (tmp_path / "run").mkdir()
    EmbeddedRun(prepare("smoke", frames=2), tmp_path / "run").run()
    if lost:
        file = tmp_path / "run" / "journal.msgpack"
        file.unlink()
        with closing(JournalFile(file, epoch=1, run="run")) as journal:
            journal.write([Journal(1, 0, 0, "", "episode")])
    status, text = rescue(tmp_path / "run")
    assert status == (1 if lost else 0), text
    assert ("there is none, as of every run in one process" in text) is not lost
    assert (tmp_path / "run-rescued").exists() is lost


def test_a_journal_is_saved_up_to_its_damage(tmp_path):
    run = record(tmp_path / "run")
    (run / "journal.msgpack").write_bytes(MAGIC + bytes(200))
    status, text = rescue(run)
    assert status == 2  # without run.json, whose scenario this recording does not have either
    assert "0 entries can be read" in text
    assert "200 B are lost" in text
    assert (tmp_path / "run-rescued" / "journal.msgpack").read_bytes() == MAGIC
    shutil.rmtree(tmp_path / "run-rescued")


@pytest.mark.parametrize("ended", [True, False])
def test_a_closed_recording_of_a_run_without_a_summary_goes_on_too(tmp_path, capsys, ended):
    """Where `caviar run` alone is killed, its recording is closed; a run that ended has a summary."""
    run = record(tmp_path / "run", frames=5)
    scenario = load_scenario("smoke")
    RunRecord(run="sample-1", epoch=1, endpoint="tcp://127.0.0.1:1", scenario=scenario).save(run)
    if ended:
        (run / "summary.json").write_text("{}")
    assert inspect_command(run) == 0
    assert (f"caviar run --resume {run}\n" in capsys.readouterr().out) is not ended


@pytest.mark.parametrize("lost", ["recording-0000.mcap", "recording-0001.mcap"])
def test_what_comes_after_a_segment_that_is_missing_is_saved(tmp_path, lost):
    run = record(tmp_path / "run", frames=9, segment_frames=3)
    (run / lost).unlink()
    status, text = rescue(run)
    assert status == 1
    assert "6 frames can be read, up to frame 8 of episode 0" in text
    first = 3 * int(lost[13])
    extent = f"frame {first} of episode 0 to frame {first + 2} of episode 0"
    assert f"{lost} is missing: its frames are lost, {extent}" in text
    expected = [number for number in range(9) if number // 3 != first // 3]
    assert [f.number for f in Recording(tmp_path / "run-rescued").frames()] == expected


def test_where_nothing_can_be_read_no_directory_is_left(tmp_path):
    run = record(tmp_path / "run")
    (run / "recording-0000.mcap").unlink()
    status, text = rescue(run)
    assert status == 2
    assert "nothing is saved, since nothing can be read" in text
    assert list(tmp_path.iterdir()) == [run]


def test_a_manifest_of_another_run_is_said_to_be_that_and_left_aside(tmp_path):
    run = record(tmp_path / "run", frames=3)
    Manifest(run="sample-2", segments=(SegmentRecord(name="recording-0001.mcap"),), closed=True).save(
        run, sync=False
    )
    status, text = rescue(run)
    assert status == 1
    assert "recording.json is of run 'sample-2', and recording-0000.mcap of run 'sample-1'" in text
    assert Recording(tmp_path / "run-rescued").complete


def test_parts_of_several_runs_are_told_apart_and_not_saved_as_one(tmp_path):
    run = record(tmp_path / "run", frames=3)
    scenario = load_scenario("smoke")
    RunRecord(run="sample-2", epoch=1, endpoint="tcp://127.0.0.1:1", scenario=scenario).save(run)
    status, text = rescue(run)
    assert status == 2
    assert "of run 'sample-1'" in text
    assert "of run 'sample-2'" in text
    assert "put the files of one run together" in text
    assert list(tmp_path.iterdir()) == [run]
