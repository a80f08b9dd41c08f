"""What `caviar run` sums up."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from recording_samples import record
from rich.console import Console

from caviar_clients.cli.run import run_scenario
from caviar_clients.cli.summary import recorded_figures, summary_of, summary_table
from caviar_protocol.errors import RunError
from caviar_protocol.recording import Recording


def outcome(frames: int, error: str = "") -> dict[str, Any]:
    return {
        "error": error,
        "frames": frames,
        "frames_per_second": 10.0,
        "warm_up_frames": 0,
        "services": {},
        "deadlines": {"decisions": 0},
        "pace": {"slips": 0},
        "digest": "d",
    }


@pytest.mark.parametrize("finished", [4, 5])
def test_a_recording_with_a_frame_more_than_the_run_finished_is_told(tmp_path: Path, finished: int) -> None:
    record(tmp_path, frames=5)
    error = "" if finished == 5 else "stopped"
    summary = summary_of(outcome(finished, error), recorded_figures(tmp_path), "smoke", tmp_path, 1)
    assert (summary["frames"], summary["frames_recorded"]) == (finished, 5)
    told = "5 frames recorded, of which the run finished 4; its digest is that of these"
    assert (told in str(summary_table(summary).caption)) == (finished == 4)


def test_a_run_without_a_recording_has_no_recorded_frames(tmp_path: Path) -> None:
    summary = summary_of(outcome(4), recorded_figures(tmp_path), "smoke", tmp_path, 1)
    assert summary["frames_recorded"] is None
    assert "recorded" not in str(summary_table(summary).caption)


@pytest.mark.parametrize(
    ("decisions", "said"), [(1, "1 missed deadline, decided"), (2, "2 missed deadlines, decided")]
)
def test_missed_deadlines_are_counted_in_words_that_fit(tmp_path: Path, decisions: int, said: str) -> None:
    late = {"decisions": decisions, "p99_ms": 1.0, "worst_ms": 2.0}
    told = str(
        summary_table(summary_of(outcome(4) | {"deadlines": late}, None, "smoke", tmp_path, 1)).caption
    )
    assert said in told


def test_a_full_disk_costs_the_summary_and_not_the_figures_on_the_screen(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    """The recording is whole, the log of notices and the summary are not; status 1, and one line says why."""
    directory, figures = tmp_path / "run", tmp_path / "figures.json"
    directory.mkdir()
    for name in ("events.jsonl", "summary.json"):
        (directory / name).symlink_to("/dev/full")
    monkeypatch.setattr("caviar_clients.cli.run.run_directory", lambda root, name: directory)
    with pytest.raises(
        RunError, match=r"cannot write .*summary\.json: No space left on device; free space there"
    ):
        run_scenario(Path("smoke"), tmp_path, Console(), frames=3, json_file=figures, embedded=True)
    assert "digest" in capsys.readouterr().out
    assert json.loads(figures.read_text())["frames"] == 3
    assert Recording(directory).complete


def test_a_disk_that_fills_during_the_run_is_named_and_what_was_recorded_is_readable(
    capsys: pytest.CaptureFixture[str], small_disk: Path
) -> None:
    with pytest.raises(RunError, match="No space left on device") as told:
        run_scenario(Path("smoke"), small_disk, Console(width=500), embedded=True)
    said = f"{capsys.readouterr().out} {told.value}"
    assert "recorder" in said or "journal" in said
    assert "free space" in said
    (directory,) = small_disk.iterdir()
    recording = Recording(directory)
    assert not recording.complete
    assert len(recording) == len(recording["link"].abs_y) > 10
