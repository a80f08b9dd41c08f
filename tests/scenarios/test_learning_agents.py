"""Agents that learn while they serve: one that is killed goes on with what it learnt."""

from __future__ import annotations

import json
import os
import signal
from pathlib import Path

import numpy as np
import pytest
from scenarios_support import eventually, pid_of, recorded_below, run, running, scenario_file

from caviar_protocol.recording import Recording


def digest(directory: Path) -> str:
    text: str = json.loads((directory / "summary.json").read_text())["digest"]
    return text


@pytest.mark.parametrize(
    "use",
    [
        'use = "learner"\nsettings = { explore_frames = 100, observe = ["aod", "last_beam"] }',
        pytest.param('use = "thompson"', marks=pytest.mark.exhaustive),
        pytest.param('use = "ucb"\nsettings = { cell_m = 5.0 }', marks=pytest.mark.exhaustive),
        pytest.param('use = "last-sweep"', marks=pytest.mark.exhaustive),
    ],
)
def test_an_agent_that_is_killed_goes_on_with_what_it_learnt(use: str, tmp_path: Path) -> None:
    """Twice in one run; the digest is that of an undisturbed one in one process."""
    changes = [("frames = 500\n", "frames = 250\ncheckpoint_frames = 9\n"), ('use = "los-beam"', use)]
    scenario = scenario_file(tmp_path, changes, extra="[timeouts]\nrejoin_s = 20.0\n", base="geometric")
    whole = run(scenario, tmp_path / "whole", "--embedded")
    assert whole.status == 0, whole.output
    out = tmp_path / "broken"
    out.mkdir()
    with running(scenario, out) as (process, mark):
        for frame in (30, 120):
            eventually(lambda f=frame: recorded_below(out) > f, 30, f"frame {frame} is recorded")
            os.kill(pid_of(mark, "caviar_services agent"), signal.SIGKILL)
        output, _ = process.communicate(timeout=60)
    assert process.returncode == 0, output
    directory = next(out.glob("*/"))
    told = [json.loads(line) for line in (directory / "events.jsonl").read_text().splitlines()]
    assert [line["service"] for line in told if line["kind"] == "back"] == ["agent", "agent"]
    assert not any(line["kind"] == "differs" for line in told)
    assert digest(directory) == digest(whole.directory)
    assert len(np.unique(Recording(directory)["link"].tx_beam)) > 3, "it tries beams"
