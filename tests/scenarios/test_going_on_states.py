"""Clause 18 with the services that keep state: SUMO, a flown object, its pilot, followed paths."""

from __future__ import annotations

import json
import os
import signal
from pathlib import Path

import pytest
from scenarios_support import eventually, pid_of, recorded_below, run, running

pytestmark = pytest.mark.sumo

SCENARIOS = Path(__file__).resolve().parents[2] / "deploy" / "caviar_scenarios"
FRAMES = 40
CHANGES = [
    ("frames = 100\n", f"frames = {FRAMES}\ncheckpoint_frames = 7\n"),
    ('"lidar", "action"', '"action"'),
    ("max_depth = 3", "samples = 4_000\nfollow = 4\nmax_depth = 3"),
    ("bus = 8 }", "bus = 8, uav = 2 }"),
    ("budget_ms = 300", "budget_ms = 3000"),
    ('use = "los-beam"\n', 'use = "los-beam"\nusers = ["vehicle.*"]\n'),
    ('name = "bs"\n', 'name = "bs"\nworld = "traffic"\n'),
    ('name = "rx"\n', 'name = "rx"\nworld = "traffic"\n'),
]
FLIGHT = """
[services.air]
role = "world"
use = "flight"
budget_ms = 50

[[services.air.settings.flown]]
name = "uav"
start_m = [0.0, 0.0, 12.0]
max_speed_m_s = 12.0
max_acceleration_m_s2 = 4.0

[services.pilot]
role = "agent"
use = "waypoints"
budget_ms = 50
users = ["motion:uav", "beam:uav/rx-uav"]

[services.pilot.settings]
object = "uav"
waypoints_m = [[3.0, 1.0, 13.0], [8.0, 0.0, 14.0], [0.0, 0.0, 12.0]]
speed_m_s = 6.0

[[devices]]
name = "rx-uav"
world = "air"
kind = "antenna"
role = "rx"
on = "uav"
position_m = [0.0, 0.0, -0.3]
array = { columns = 4 }
"""


def without(text: str, begin: str, end: str) -> str:
    """The text without what stands from ``begin`` to ``end``; to the last line where there is no end."""
    start = text.index(begin)
    return text[:start] + (text[text.index(end, start) :] if end else "")


@pytest.fixture
def scenario(tmp_path: Path) -> Path:
    """Street canyon without its LIDAR, and above it a UAV that flies from point to point."""
    text = (SCENARIOS / "street-canyon.toml").read_text()
    text = without(without(text, '[[devices]]\nname = "lidar"', ""), "[services.lidar]", "[services.link]")
    for old, new in CHANGES:
        assert text.count(old) == 1, old
        text = text.replace(old, new)
    path = tmp_path / "scenario.toml"
    path.write_text(text.replace("file:", f"file:{SCENARIOS}/") + FLIGHT)
    return path


@pytest.mark.exhaustive
def test_every_kind_of_state_outlives_its_process(scenario: Path, tmp_path: Path) -> None:
    """Each of the four is killed once; the digest is that of an undisturbed run."""
    whole = run(scenario, tmp_path / "whole", timeout=120)
    assert whole.status == 0, whole.output
    out = tmp_path / "broken"
    out.mkdir()
    killed = {"traffic": 9, "air": 12, "pilot": 17, "channel": 24}
    with running(scenario, out) as (process, mark):
        for service, frame in killed.items():
            eventually(lambda f=frame: recorded_below(out) > f, 60, f"frame {frame} is recorded")
            os.kill(pid_of(mark, f"caviar_services {service}"), signal.SIGKILL)
        output, _ = process.communicate(timeout=100)
    assert process.returncode == 0, output
    directory = next(out.glob("*/"))
    told = [json.loads(line) for line in (directory / "events.jsonl").read_text().splitlines()]
    assert {line["service"] for line in told if line["kind"] == "back"} == set(killed)
    assert "differs" not in {line["kind"] for line in told}
    digests = [json.loads((d / "summary.json").read_text())["digest"] for d in (whole.directory, directory)]
    assert digests[0] == digests[1]
