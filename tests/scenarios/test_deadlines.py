"""Deadlines, end to end: every policy in real processes, what consumers are told, who is blamed, paces."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scenarios_support import Finished, caviar, run, scenario_file

from caviar_protocol.errors import ScenarioError
from caviar_protocol.messages import Status
from caviar_protocol.recording import Recording
from caviar_protocol.scenario import load_scenario

BUDGET_MS, LATE_S = 500, 1.25
"""Late by so much that the next frame comes while the service is busy, and the one after it does not."""
VICTIMS = {"channel": ("channel", 3), "eyes": ("lidar", 6), "link": ("link", 9), "agent": ("action", 12)}
"""Service to its topic, and the frame in which it is late."""
FRAMES = 16
ROLES = {"channel": "Channel", "eyes": "Sensors", "link": "Link", "agent": "Agent"}


def scenario(folder: Path, policy: str, late_s: float = LATE_S, only: str = "") -> Path:
    """The smoke scenario, whose services are late once each, or only one of them is."""
    changes = [
        ("frames = 100\n", f"frames = {FRAMES}\nframes_in_flight = 1\n"),
        ('"action", "link"]', '"action", "link", "lidar", "camera"]'),
        ('use = "trajectory"\nbudget_ms = 20', 'use = "trajectory"\nbudget_ms = 5000'),
        ('use = "mcap"\nbudget_ms = 100', 'use = "mcap"\nbudget_ms = 5000'),
    ]
    extra = ""
    for name, use in {"channel": "free-space", "link": "beams", "agent": "los-beam", "eyes": ""}.items():
        frame = VICTIMS[name][1] if only in ("", name) else -1
        body = f"""use = "late:Late{ROLES[name]}"
budget_ms = {BUDGET_MS}
policy = "{policy}"
settings = {{ frame = {frame}, late_s = {late_s} }}
"""
        if use:
            changes.append((f'use = "{use}"\nbudget_ms = 20\n', body))
        else:
            extra += f'\n[services.{name}]\nrole = "sensors"\n{body}'
    extra += f"""
[services.spy]
role = "sensors"
use = "late:Spy"
budget_ms = 5000
settings = {{ file = "{folder / "told.jsonl"}" }}

[timeouts]
shutdown_s = 0.3
"""
    return scenario_file(folder, changes, extra)


def told(folder: Path) -> list[dict[str, Any]]:
    """What the spy was told, frame by frame: provenance by topic."""
    return [json.loads(line) for line in (folder / "told.jsonl").read_text().splitlines()]


def notices(finished: Finished, kind: str, service: str) -> list[dict[str, Any]]:
    """What was reported of a service."""
    lines = map(json.loads, (finished.directory / "events.jsonl").read_text().splitlines())
    return [line for line in lines if line.get("kind") == kind and line["service"] == service]


def summary(finished: Finished) -> dict[str, Any]:
    found: dict[str, Any] = json.loads((finished.directory / "summary.json").read_text())
    return found


def assert_blamed_in_full(text: str, service: str, frame: int) -> None:
    """Clause 14: service, frame, phase, elapsed and budget, last heartbeat, progress."""
    for word in (f"'{service}'", f"in frame {frame}", f"budget {BUDGET_MS} ms", "since its grant"):
        assert word in text
    assert re.search(r"last heartbeat [\d.]+ m?s ago: (phase '.+'|no phase stated), progress \d+", text), text


def late_in_recording(finished: Finished) -> set[tuple[str, int]]:
    """(topic, frame) of the products that the recorder got late, under their true frame."""
    return {
        (entry.topic, entry.frame)
        for frame in Recording(finished.directory).frames()
        for entry in frame.inputs
        if entry.status is Status.LATE
    }


@pytest.mark.parametrize("policy", ["hold", pytest.param("drop", marks=pytest.mark.exhaustive)])
def test_a_frame_goes_on_without_who_is_late_and_every_consumer_is_told(tmp_path: Path, policy: str) -> None:
    finished = run(scenario(tmp_path, policy), tmp_path / "out", timeout=120)
    assert finished.status == 0, finished.output
    frames = told(tmp_path)
    assert len(frames) == FRAMES, "no frame is skipped"
    figures = summary(finished)
    for service, (topic, late) in VICTIMS.items():
        entry = frames[late][topic]
        cause = f"{service} missed frame {late} ({policy}, budget {BUDGET_MS}.0 ms)"
        assert entry["cause"] == cause
        if policy == "hold":
            assert (entry["status"], entry["frame"], entry["age"]) == ("held", late - 1, 1)
            assert entry["digest"] == frames[late - 1][topic]["digest"]
        else:
            assert entry["status"] == "absent"
        busy = frames[late + 1][topic]
        assert busy["status"] == {"hold": "held", "drop": "absent"}[policy]
        assert f"still busy with frame {late}" in busy["cause"]
        assert (topic, late) in late_in_recording(finished), "what came late is kept under its true frame"
        assert figures["services"][service]["misses"] >= 2
        (miss,) = (n for n in notices(finished, "miss", service) if n["frame"] == late)
        assert_blamed_in_full(miss["text"], service, late)
        assert any(n["frame"] == late for n in notices(finished, "late", service))
    if policy == "drop":  # clause 10: by consequence, with the cause at the origin
        assert frames[3]["link"]["status"] == "absent"
        assert "channel missed frame 3" in frames[3]["link"]["cause"]
    decided = figures["deadlines"]
    assert decided["decisions"] >= 2 * len(VICTIMS)
    assert 0.0 <= decided["p99_ms"] <= decided["worst_ms"]
    with np.load(finished.directory / "latency.npz") as saved:
        assert len(saved["decision_lateness_ns"]) == decided["decisions"]
        assert (saved["decision_lateness_ns"] >= 0).all(), "no service is given up before the deadline"


def test_under_wait_the_frame_waits_and_misses_are_counted(tmp_path: Path) -> None:
    (tmp_path / "punctual").mkdir()
    (tmp_path / "late").mkdir()
    punctual = run(scenario(tmp_path / "punctual", "wait", 0.0), tmp_path / "punctual" / "out", timeout=120)
    late = run(scenario(tmp_path / "late", "wait"), tmp_path / "late" / "out", timeout=120)
    assert punctual.status == late.status == 0, late.output
    assert summary(late)["digest"] == summary(punctual)["digest"], "waiting changes nothing"
    for entry in (entry for frame in told(tmp_path / "late") for entry in frame.values()):
        assert (entry["status"], entry.get("age", 0)) == ("fresh", 0)
    for service, (_, frame) in VICTIMS.items():
        assert summary(late)["services"][service]["misses"] >= 1
        (miss,) = (n for n in notices(late, "miss", service) if n["frame"] == frame)
        assert_blamed_in_full(miss["text"], service, frame)
        assert miss["text"].endswith("the frame waits")
    assert late_in_recording(late) == set()
    assert re.search(r"missed deadlines(:\s\d+|,) decided", (late.directory / "summary.txt").read_text())


@pytest.mark.parametrize(
    "service",
    [
        pytest.param(name, marks=() if name in ("channel", "link") else pytest.mark.exhaustive)
        for name in sorted(VICTIMS)
    ],
)
def test_under_abort_the_run_ends_at_the_deadline_with_blame(tmp_path: Path, service: str) -> None:
    finished = run(scenario(tmp_path, "abort", 30.0, only=service), tmp_path / "out", timeout=120)
    assert finished.status == 1
    assert finished.leftovers == []
    error = summary(finished)["error"]
    assert "overran its budget (policy abort)" in error
    assert_blamed_in_full(error, service, VICTIMS[service][1])


@pytest.mark.parametrize("policy", ["hold", "drop"])
@pytest.mark.parametrize(("service", "use"), [("world", "trajectory"), ("recorder", "mcap")])
def test_worlds_and_recorders_cannot_be_done_without(
    tmp_path: Path, service: str, use: str, policy: str
) -> None:
    path = scenario_file(tmp_path, [(f'use = "{use}"\n', f'use = "{use}"\npolicy = "{policy}"\n')])
    line = 1 + path.read_text().split(f'policy = "{policy}"')[0].count("\n")
    with pytest.raises(ScenarioError) as caught:
        load_scenario(path)
    assert f"scenario.toml:{line}: services.{service}.policy" in str(caught.value)
    assert 'write "wait" or "abort"' in str(caught.value)


@pytest.mark.parametrize("pace", ["realtime", "2", pytest.param("0.5", marks=pytest.mark.exhaustive)])
def test_frames_come_at_the_pace_that_was_asked_for(tmp_path: Path, pace: str) -> None:
    finished = run(scenario_file(tmp_path), tmp_path / "out", "--frames", "8", "--pace", pace)
    assert finished.status == 0, finished.output
    with np.load(finished.directory / "latency.npz") as saved:
        ends = saved["finished_ns"]
        # The first frame took no longer than its services would one after another.
        first = sum(int(saved[name][0]) for name in saved.files if name.startswith("latency_ns/"))
    assert len(ends) == 8, "no frame is skipped"
    period = 0.1 / (1.0 if pace == "realtime" else float(pace))
    # The last frame is released seven periods after the first at the earliest, however late that one ended.
    assert (ends[-1] - ends[0] + first) / 1e9 > 6.0 * period
    figures = summary(finished)["pace"]
    assert figures["slips"] >= 0
    assert figures["lag_ms"] >= figures["worst_slip_ms"]


def test_a_run_that_cannot_keep_its_pace_slips_and_says_so(tmp_path: Path) -> None:
    finished = run(scenario_file(tmp_path), tmp_path / "out", "--frames", "10", "--pace", "10000")
    assert finished.status == 0, finished.output
    pace = summary(finished)["pace"]
    assert summary(finished)["frames"] == 10, "no frame is skipped"
    assert 0 < pace["slips"] < 10
    assert pace["lag_ms"] >= pace["worst_slip_ms"] > 0.0
    assert "frames slipped behind real time" in (finished.directory / "summary.txt").read_text()


@pytest.mark.parametrize("pace", ["0", "-1", "nan", "quick"])
def test_a_pace_that_is_none_is_refused_before_anything_starts(tmp_path: Path, pace: str) -> None:
    finished = caviar("run", scenario_file(tmp_path), "--out", tmp_path / "out", f"--pace={pace}")
    assert finished.status not in (0, None)
    assert "run.pace: is" in finished.output
    assert "Traceback" not in finished.output
    assert not (tmp_path / "out").exists()
