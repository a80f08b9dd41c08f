"""Clause 18 with real processes: any of them is killed, and the digest is what it would have been."""

from __future__ import annotations

import contextlib
import json
import os
import signal
from pathlib import Path

import pytest
from scenarios_support import (
    caviar,
    eventually,
    frames_recorded,
    marked,
    pid_of,
    recorded_below,
    run,
    running,
    scenario_file,
)

FRAMES = 150
"""So many that a machine that is busy kills in time: a frame takes 10 ms."""
ADDER = """
[services.adder]
role = "sensors"
use = "stateful:Adding"
budget_ms = 50
settings = { seconds = 0.01 }

[timeouts]
rejoin_s = 20.0
"""
CHANGES = [
    ("frames = 100\n", f"frames = {FRAMES}\ncheckpoint_frames = 7\n"),
    ('"action", "link"]', '"action", "link", "lidar"]'),
]


@pytest.fixture(scope="module")
def scenario(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Smoke with a service that adds up all it ever took in."""
    return scenario_file(tmp_path_factory.mktemp("going-on"), CHANGES, ADDER)


@pytest.fixture(scope="module")
def digest(scenario: Path, tmp_path_factory: pytest.TempPathFactory) -> str:
    """Of the undisturbed run."""
    finished = run(scenario, tmp_path_factory.mktemp("undisturbed"))
    assert finished.status == 0, finished.output
    return str(json.loads((finished.directory / "summary.json").read_text())["digest"])


def assert_same(out: Path, output: str, status: int, digest: str) -> Path:
    """The run came to its end, and what it recorded is whole and the same."""
    assert status == 0, output
    directory = next(out.glob("*/"))
    assert json.loads((directory / "summary.json").read_text())["digest"] == digest
    assert frames_recorded(directory) == FRAMES
    recomputed = caviar("inspect", "--digest", directory)
    assert recomputed.output.split() == [digest]
    assert recomputed.status == 0
    return directory


@pytest.mark.parametrize(
    ("service", "number"),
    [
        ("adder", signal.SIGKILL),
        pytest.param("recorder", signal.SIGKILL, marks=pytest.mark.exhaustive),
        pytest.param("world", signal.SIGKILL, marks=pytest.mark.exhaustive),
        ("agent", signal.SIGSTOP),
    ],
)
def test_a_service_that_is_killed_twice_is_started_again_and_the_digest_is_the_same(
    scenario: Path, digest: str, tmp_path: Path, service: str, number: signal.Signals
) -> None:
    with running(scenario, tmp_path) as (process, mark):
        for frame in (10, 35):
            eventually(lambda f=frame: recorded_below(tmp_path) > f, 30, f"frame {frame} is recorded")
            os.kill(pid_of(mark, f"caviar_services {service}"), number)
        output, _ = process.communicate(timeout=120)
        assert marked(mark) == []
    directory = assert_same(tmp_path, output, process.returncode, digest)
    told = [json.loads(line) for line in (directory / "events.jsonl").read_text().splitlines()]
    kinds = [line["kind"] for line in told if line["service"] == service]
    assert kinds.count("restarted") == kinds.count("back") == 2
    assert "differs" not in kinds


def test_a_broker_that_is_killed_is_followed_by_another_and_the_digest_is_the_same(
    scenario: Path, digest: str, tmp_path: Path
) -> None:
    with running(scenario, tmp_path) as (process, mark):
        for frame in (10, 35):
            eventually(lambda f=frame: recorded_below(tmp_path) > f, 30, f"frame {frame} is recorded")
            os.kill(pid_of(mark, "caviar_broker"), signal.SIGKILL)
        output, _ = process.communicate(timeout=120)
        assert marked(mark) == []
    assert_same(tmp_path, output, process.returncode, digest)
    assert output.count("another one resumes the run") == 2


def test_a_run_whose_machine_went_down_is_resumed(scenario: Path, digest: str, tmp_path: Path) -> None:
    with running(scenario, tmp_path) as (process, mark):
        eventually(lambda: recorded_below(tmp_path) > 25, 30, "frame 25 is recorded")
        for entry in [f"{process.pid} ", *marked(mark)]:
            with contextlib.suppress(ProcessLookupError):
                os.kill(int(entry.split()[0]), signal.SIGKILL)
        process.communicate(timeout=120)
    resumed = caviar("run", "--resume", next(tmp_path.glob("*/")))
    assert resumed.leftovers == []
    assert_same(tmp_path, resumed.output, resumed.status, digest)


@pytest.mark.parametrize("command", ["run", "broker"])
def test_what_cannot_be_resumed_is_named(scenario: Path, tmp_path: Path, command: str) -> None:
    empty = caviar(command, "--resume", tmp_path)
    assert empty.status == 1
    assert "run.json" in empty.output
    both = caviar(command, scenario, "--resume", tmp_path)
    assert both.status == 1
    assert "--resume takes no scenario" in both.output
    neither = caviar(command)
    assert neither.status == 1
    assert "give a scenario" in neither.output
