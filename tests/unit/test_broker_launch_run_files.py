"""A broker goes on only with files, and with those of its run."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
from recording_builders import record_run

from caviar_broker.control.launcher import LogFile
from caviar_broker.control.socket import ControlSocket
from caviar_broker.journal_format import JournalReader, run_of_journal
from caviar_broker.launch import parser, serve
from caviar_broker.run_record import RunRecord, versions_of
from caviar_protocol.errors import CaviarError, RunError
from caviar_protocol.recording import read_manifest
from caviar_protocol.scenario import load_scenario
from caviar_protocol.scenario.rules import with_overrides

SMOKE = with_overrides(load_scenario("smoke"), 2, None, None)
FILES = ["run.json", "journal.msgpack", "recording.json", "recording-0000.mcap"]
KINDS: dict[str, Callable[[Path], None]] = {"named pipe": os.mkfifo, "directory": os.mkdir}


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two runs, ``a`` and ``b``."""
    folder = tmp_path_factory.mktemp("runs")
    for name in ("a", "b"):
        record_run(folder / name, SMOKE)
        record = RunRecord(
            run=name, epoch=1, endpoint="tcp://127.0.0.1:0", scenario=SMOKE, versions=versions_of(SMOKE)
        )
        record.save(folder / name)
    return folder


@pytest.fixture
def run(runs: Path, tmp_path: Path) -> Path:
    """A copy of run ``a``."""
    return shutil.copytree(runs / "a", tmp_path / "a")


def refusal(run: Path) -> str:
    """With which a broker that is to resume a run ends."""
    with pytest.raises(CaviarError) as refused:
        serve(parser().parse_args(["--resume", str(run)]))
    return str(refused.value)


def test_a_run_whose_files_belong_together_is_taken_for_finished(run: Path) -> None:
    (run / "latency.npz").write_bytes(b"there")
    assert "all its frames are finished" in refusal(run)


@pytest.mark.parametrize("name", FILES)
@pytest.mark.parametrize("kind", KINDS)
def test_what_is_no_file_is_refused_by_name_and_not_waited_for(run: Path, name: str, kind: str) -> None:
    (run / name).unlink()
    KINDS[kind](run / name)
    words = refusal(run)
    assert f"{run / name}: it is a {kind}, not a file; move it away, and put the file" in words
    assert "embedded" not in words


@pytest.mark.parametrize("name", [name for name in FILES if name != "run.json"])
def test_a_file_of_another_run_is_refused_before_anything_is_written(
    runs: Path, run: Path, name: str
) -> None:
    shutil.copyfile(runs / "b" / name, run / name)
    before = {path: path.read_bytes() for path in run.iterdir() if path.is_file()}
    words = refusal(run)
    assert f"run.json is of run 'a', but {name} is of run 'b'" in words
    assert before == {path: path.read_bytes() for path in run.iterdir() if path.is_file()}


def test_journal_and_recording_say_of_which_run_they_are(runs: Path) -> None:
    manifest = read_manifest(runs / "b")
    assert manifest is not None
    assert (run_of_journal(runs / "b" / "journal.msgpack"), manifest.run) == ("b", "b")
    assert [e.run for e in JournalReader(runs / "b" / "journal.msgpack")][1:3] == ["", ""]


@pytest.mark.parametrize("kind", KINDS)
def test_where_a_run_writes_what_is_no_file_is_named_with_the_remedy(tmp_path: Path, kind: str) -> None:
    KINDS[kind](tmp_path / "events.jsonl")
    KINDS[kind](tmp_path / "control.json")
    words = f"it is a {kind}, not a file; move it away"
    with pytest.raises(RunError, match=f"cannot write {tmp_path}/events.jsonl: {words}"):
        LogFile(tmp_path / "events.jsonl")
    place = ControlSocket(tmp_path)
    with pytest.raises(RunError, match=f"cannot write {tmp_path}/control.json: {words}"):
        place.announce(run="a")
    place.close()
    assert (tmp_path / "control.json").exists() is (kind == "directory")
