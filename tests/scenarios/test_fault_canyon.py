"""Six of the fault matrix with traffic and ray tracing: SUMO, sionna-rt, and the broker (clause 18)."""

from __future__ import annotations

import json
import os
import signal
from pathlib import Path

import pytest
from scenarios_support import caviar, eventually, pid_of, recorded_below, run, running, scenario_file

pytestmark = [pytest.mark.sumo, pytest.mark.channel]

FRAMES = 12
FAULT_FRAME = 4
CHANGES = [
    ("frames = 100\n", f"frames = {FRAMES}\ncheckpoint_frames = 3\n"),
    ("max_depth = 3", "samples = 4_000\nmax_depth = 3"),
    ("budget_ms = 300", "budget_ms = 3000"),
]


@pytest.fixture(scope="module")
def scenario(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Street canyon with few rays; as it is shipped, the dead are waited for."""
    path = scenario_file(tmp_path_factory.mktemp("canyon"), CHANGES, base="street-canyon")
    folder = Path(__file__).resolve().parents[2] / "deploy" / "caviar_scenarios"
    path.write_text(path.read_text().replace('"file:', f'"file:{folder}/'))
    return path


@pytest.fixture(scope="module")
def digest(scenario: Path, tmp_path_factory: pytest.TempPathFactory) -> str:
    """Of the undisturbed run."""
    finished = run(scenario, tmp_path_factory.mktemp("undisturbed"), timeout=120)
    assert finished.status == 0, finished.output
    return str(json.loads((finished.directory / "summary.json").read_text())["digest"])


@pytest.mark.parametrize(
    ("victim", "number"),
    [
        pytest.param("caviar_services traffic", signal.SIGKILL, marks=pytest.mark.exhaustive),
        ("caviar_services channel", signal.SIGKILL),
        pytest.param("caviar_services agent", signal.SIGKILL, marks=pytest.mark.exhaustive),
        pytest.param("caviar_services recorder", signal.SIGKILL, marks=pytest.mark.exhaustive),
        pytest.param("caviar_broker", signal.SIGKILL, marks=pytest.mark.exhaustive),
        pytest.param("caviar_services channel", signal.SIGSTOP, marks=pytest.mark.exhaustive),
    ],
)
def test_whoever_is_lost_the_digest_is_the_same(
    scenario: Path, digest: str, tmp_path: Path, victim: str, number: signal.Signals
) -> None:
    with running(scenario, tmp_path) as (process, mark):
        eventually(lambda: recorded_below(tmp_path) >= FAULT_FRAME, 60, f"{FAULT_FRAME} frames are recorded")
        os.kill(pid_of(mark, victim), number)
        output, _ = process.communicate(timeout=120)
    assert process.returncode == 0, output
    directory = next(tmp_path.glob("*/"))
    assert json.loads((directory / "summary.json").read_text())["digest"] == digest
    assert caviar("inspect", "--digest", directory).output.split() == [digest]
    told = [json.loads(line) for line in (directory / "events.jsonl").read_text().splitlines()]
    kinds = {line["kind"] for line in told}
    assert "differs" not in kinds
    assert ("restarted" if victim == "caviar_broker" else "back") in kinds
