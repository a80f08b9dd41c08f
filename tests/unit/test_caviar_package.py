"""`caviar`, the package that users import: runs, recordings, scenarios, environments."""

from __future__ import annotations

import asyncio
import base64
import json
import pickle
import shutil
import signal
import subprocess
import sys
import warnings
from html import unescape
from pathlib import Path

import pytest

import caviar
from caviar_protocol.errors import RecordingError, RunError, ScenarioError
from caviar_protocol.recording import Recording
from caviar_services.agent.baselines import LosBeamAgent
from caviar_services.service import Frame, StepResult

pytestmark = pytest.mark.slow


def test_a_run_gives_its_directory_and_open_reads_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(RecordingError, match="no run with a recording"):
        caviar.open()
    run = caviar.run("smoke", frames=3, seed=7, embedded=True)
    assert capsys.readouterr().out == ""
    assert (len(caviar.open(run)), caviar.open().directory.name) == (3, run.name)
    assert json.loads((run / "summary.json").read_text())["seed"] == 7


@pytest.mark.parametrize("embedded", [False, True])
def test_a_run_from_a_thread_leaves_signals_alone(tmp_path: Path, embedded: bool) -> None:
    before = signal.getsignal(signal.SIGINT)
    run = asyncio.run(asyncio.to_thread(caviar.run, "smoke", frames=2, out=tmp_path, embedded=embedded))
    assert len(caviar.open(run)) == 2
    assert signal.getsignal(signal.SIGINT) is before


def test_a_run_that_ends_early_raises_its_cause(tmp_path: Path) -> None:
    path = tmp_path / "sick.toml"
    text = Path(__file__).parents[2].joinpath("deploy/caviar_scenarios/smoke.toml").read_text()
    sick = """
[services.sick]
role = "sensors"
use = "runner_services:Sensors"
budget_ms = 50
settings = { wrong = "step" }
"""
    path.write_text(text.replace("record = [", 'record = ["lidar", ') + sick)
    with pytest.raises(RunError, match=r"smoke-.*nothing to divide in step"):
        caviar.run(path, frames=3, out=tmp_path, embedded=True)


def test_a_run_takes_episodes_settings_and_topics_as_the_command_does(tmp_path: Path) -> None:
    run = caviar.run(
        "smoke", frames=2, episodes=2, settings=["services.channel.budget_ms=77"], record=["scene", "link"],
        out=tmp_path, embedded=True,
    )  # fmt: skip
    recording = caviar.open(run)
    scenario = recording.metadata.scenario
    assert (len(recording), scenario["run"]["record"]) == (4, ["scene", "link"])
    assert scenario["services"]["channel"]["budget_ms"] == 77
    with pytest.raises(ScenarioError, match="--set channel: write it as in"):
        caviar.run("smoke", settings=["channel"], out=tmp_path)
    for wrong in ("run.seed=3", {"run.seed": 3}, 3, [3]):
        with pytest.raises(TypeError, match=r"settings is .*KEY=VALUE"):
            caviar.run("smoke", settings=wrong, out=tmp_path)  # type: ignore[arg-type]


def test_a_notebook_shows_summary_map_and_page_of_a_run(tmp_path: Path) -> None:
    out = tmp_path / "<script>alert(1)</script>"
    recording = caviar.open(caviar.run("smoke", frames=3, out=out, embedded=True))
    html = recording._repr_html_()
    assert "<script>" not in html
    assert "&lt;script&gt;" in html
    assert "3 frames, " in html
    image = html.partition("data:image/png;base64,")[2].partition('"')[0]
    assert base64.b64decode(image).startswith(b"\x89PNG")
    page = recording.view(limit_mb=4.0, height=300)
    frame = page._repr_html_()
    assert frame.startswith('<iframe sandbox="allow-scripts" style="width: 100%; height: 300px')
    assert unescape(frame.partition('srcdoc="')[2].partition('"')[0]) == page.html
    assert len(page.html.encode()) < 4e6
    assert isinstance(pickle.loads(pickle.dumps(recording)), Recording)  # noqa: S301 - its own


def test_a_notebook_shows_a_damaged_run_by_its_text(tmp_path: Path) -> None:
    run = caviar.run("smoke", frames=3, out=tmp_path, embedded=True)
    (run / "summary.txt").unlink()
    segment, place = caviar.open(run).segment_of(1)
    content = bytearray(segment.path.read_bytes())
    content[segment.chunks[place].offset + 200] ^= 1
    segment.path.write_bytes(content)
    with warnings.catch_warnings(action="ignore"):
        html = caviar.open(run)._repr_html_()
    assert "Recording of" in html
    assert "<img" not in html


def test_a_scenario_is_loaded_by_name_and_by_file(tmp_path: Path) -> None:
    assert caviar.load_scenario("smoke").run.name == "smoke"
    with pytest.raises(ScenarioError, match="did you mean 'smoke'"):
        caviar.load_scenario("smokee")


def test_an_environment_needs_no_other_import() -> None:
    code = (
        "import gymnasium; env = gymnasium.make('caviar:caviar/BeamSelection-v0', scenario='geometric'); "
        "print(env.reset(seed=1)[1].keys() is not None); env.close()"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120)
    assert (done.returncode, done.stdout.strip()) == (0, "True"), done.stderr[-2000:]


def test_a_run_whose_directory_is_deleted_ends_and_says_so(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    answer = LosBeamAgent.step

    def step(agent: LosBeamAgent, frame: Frame) -> StepResult:
        if frame.number == 3:
            shutil.rmtree(next(tmp_path.iterdir()))
        return answer(agent, frame)

    monkeypatch.setattr(LosBeamAgent, "step", step)
    with pytest.raises(RunError, match=r"was deleted.*ended it$"):
        caviar.run("smoke", frames=1_000_000, out=tmp_path, embedded=True)
    assert list(tmp_path.iterdir()) == []
