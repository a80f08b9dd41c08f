"""Agents that learn while they serve: one that is killed goes on with what it learnt."""

from __future__ import annotations

import json
import os
import signal
import sys
from pathlib import Path

import numpy as np
import pytest
from scenarios_support import (
    ROOT,
    eventually,
    follow,
    pid_of,
    recorded_below,
    run,
    run_as_printed,
    running,
    scenario_file,
)

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
    directory = killed_twice(scenario, tmp_path / "broken")
    assert digest(directory) == digest(whole.directory)
    assert len(np.unique(Recording(directory)["link"].tx_beam)) > 3, "it tries beams"


def killed_twice(scenario: Path, out: Path) -> Path:
    """The directory of a run whose agent is killed twice."""
    out.mkdir()
    with running(scenario, out) as (process, mark):
        for frame in (30, 120):
            eventually(lambda f=frame: recorded_below(out) > f, 30, f"frame {frame} is recorded")
            os.kill(pid_of(mark, "caviar_services agent"), signal.SIGKILL)
        output, _ = process.communicate(timeout=120)
    assert process.returncode == 0, output
    directory = next(out.glob("*/"))
    told = [json.loads(line) for line in (directory / "events.jsonl").read_text().splitlines()]
    assert [line["service"] for line in told if line["kind"] == "back"] == ["agent", "agent"]
    assert not any(line["kind"] == "differs" for line in told)
    return directory


@pytest.mark.exhaustive
def test_the_agent_of_the_page_learns_and_is_killed_without_a_trace(tmp_path: Path) -> None:
    """The page is followed; its agent is killed twice in its scenario, and passes the conformance tests."""
    pytest.importorskip("torch", reason="PyTorch is not installed")
    follow(ROOT / "docs" / "howto" / "beam-agents.md", tmp_path)
    (whole,) = (tmp_path / "runs").glob("geometric-*/")
    assert digest(killed_twice(tmp_path / "online.toml", tmp_path / "broken")) == digest(whole)
    (tmp_path / "test_my_learner.py").write_text(
        "from caviar_services.testing import AgentConformance\nfrom my_learner import Learn\n\n\n"
        "class TestLearn(AgentConformance):\n    service_class = Learn\n"
    )
    run_as_printed([sys.executable, "-m", "pytest", "-q", "test_my_learner.py"], tmp_path)
