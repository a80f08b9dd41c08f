"""What `caviar run` sums up."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from recording_builders import record
from rich.console import Console

from caviar_clients.cli.run import run_scenario
from caviar_clients.cli.scenarios import new_scenario
from caviar_clients.cli.summary import ReportTally, recorded_figures, summary_of
from caviar_clients.cli.summary_table import summary_table
from caviar_protocol.errors import RunError
from caviar_protocol.fields import Report
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


def test_misses_that_were_answered_before_the_broker_looked_are_told_apart(tmp_path: Path) -> None:
    """The first number is the sum of the table's column."""
    figures = {"p50_ms": 1.0, "p99_ms": 2.0, "budget_ms": 1.0, "frames": 100}
    services = {"channel": figures | {"misses": 50}, "link": figures | {"misses": 30}}
    late = {"decisions": 76, "p99_ms": 1.0, "worst_ms": 2.0}
    ended = outcome(4) | {"deadlines": late, "services": services}
    told = str(summary_table(summary_of(ended, None, "smoke", tmp_path, 1)).caption)
    assert "80 missed deadlines: 76 decided 1.00 ms late (p99), 2.00 ms at worst; 4 answered before" in told


def test_a_service_that_is_not_run_stands_on_the_screen_and_in_the_summary(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    """The LIDAR that the template of `caviar new` has commented out, without "lidar" in `record`."""
    path = new_scenario(str(tmp_path / "idle"))
    text = path.read_text()
    for block in ("[services.lidar]", "[[devices]]"):
        begin = text.index(f"# {block}")
        end = text.index("\n\n", begin)
        text = text[:begin] + text[begin:end].replace("# ", "") + text[end:]
    path.write_text(text)
    assert run_scenario(path, tmp_path / "runs", Console(width=300), frames=2, embedded=True).status == 0
    said = 'no service takes its lidar, so it is not run; add "lidar" to run.record'
    assert f"idle: lidar: {said}" in capsys.readouterr().out
    (directory,) = (tmp_path / "runs").iterdir()
    assert f"lidar: {said}" in json.loads((directory / "summary.json").read_text())["warnings"]
    assert 'add "lidar" to run.record' in (directory / "summary.txt").read_text().replace("\n", " ")


def test_a_full_disk_costs_the_summary_and_not_the_figures_on_the_screen(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    """The recording is whole, the log of notices and the summary are not; status 1, and one line says why."""
    directory, figures = tmp_path / "run", tmp_path / "figures.json"
    directory.mkdir()
    for name in ("events.jsonl", "summary.json"):
        (directory / name).symlink_to("/dev/full")
    monkeypatch.setattr("caviar_clients.cli.run.new_run_directory", lambda root, name: directory)
    with pytest.raises(RunError, match=r"summary\.json: No space left"):
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


def test_a_policy_that_was_refused_is_a_warning_and_no_choice_of_frames() -> None:
    tally, served = ReportTally(), "3f" * 32
    refused = {"policy": served, "policy.refused": f"{'ab' * 32} it has 3 inputs, not 2"}
    for decisions in ({"policy": served}, refused, {"policy": served}):
        tally.add(0, [Report(source="agent", decisions=decisions)])
    assert tally.warnings() == [
        "agent refused policy abababababab…, and stayed with the one that it had: it has 3 inputs, not 2"
    ]
    assert [(one.decision, one.frames) for one in tally.decisions()] == [("policy", {served: 3})]
