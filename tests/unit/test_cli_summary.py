"""What `caviar run` sums up."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from recording_samples import record

from caviar_clients.cli.summary import recorded_figures, summary_of, summary_table


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
