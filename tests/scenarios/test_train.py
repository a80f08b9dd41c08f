"""``caviar policy train``: seeds in processes of their own, ended by Ctrl-C and by kill -9, resumed."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from forked import Forked
from scenarios_support import ROOT, blocks
from typer.testing import CliRunner

from caviar_clients.cli.main import app
from caviar_clients.learning.checkpoints import newest_checkpoint
from caviar_protocol.scenario import find_scenario

pytest.importorskip("stable_baselines3", reason="needs the extra `learning`")
pytest.importorskip("onnx", reason="needs the extra `learning`")

PATIENCE_S = 120.0


def written(folder: Path, steps: int, seeds: str = "[1, 2]", observe: str = "aod") -> Path:
    """A file of an experiment with episodes of 20 frames."""
    text = find_scenario("geometric").read_text().replace("frames = 500", "frames = 20")
    (folder / "short.toml").write_text(text)
    file = folder / "mine.toml"
    file.write_text(
        f"""
        experiment = {{ name = "beams", seeds = {seeds}, steps = {steps}, checkpoint_steps = 200 }}
        algorithm = {{ name = "dqn", learning_starts = 20, gamma = 0.0 }}
        [environment]
        id = "caviar/BeamSelection-v0"
        members = 2
        options = {{ scenario = "file:short.toml", observe = ["{observe}"] }}
        """
    )
    return file


PRELOAD = (
    "caviar_clients.cli.main",
    "caviar_clients.cli.learning",
    "caviar_clients.learning.campaign",
    "caviar_clients.learning.training",
    "onnx",
    "onnxruntime",
    "stable_baselines3",
)


def results(folder: Path) -> dict[int, str]:
    """SHA-256 of the policy of each seed that is done."""
    found = [json.loads(path.read_text()) for path in folder.glob("beams/*/result.json")]
    return {result["seed"]: result["policy"] for result in found}


def train(file: Path, out: str, jobs: int = 2, folder: Path | None = None) -> subprocess.Popen[str]:
    """Start the command, in a process group of its own, as a terminal has it."""
    command = [
        sys.executable,
        "-m",
        "caviar_clients",
        "policy",
        "train",
        str(file),
        "--out",
        out,
        "--jobs",
        str(jobs),
    ]
    return Forked(
        command, PRELOAD, cwd=folder or file.parent, start_new_session=True, text=True,
        stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
    )  # fmt: skip


def wait_for_checkpoint(folder: Path, process: subprocess.Popen[str]) -> None:
    until = time.monotonic() + PATIENCE_S
    while newest_checkpoint(folder / "beams" / "seed-1" / "checkpoints") is None:
        assert process.poll() is None, process.communicate()[0]
        assert time.monotonic() < until
        time.sleep(0.05)


def finish(process: subprocess.Popen[str]) -> tuple[int, str]:
    output, _ = process.communicate(timeout=PATIENCE_S)
    return process.returncode, output


def test_a_killed_command_goes_on_to_the_policy_of_one_that_was_not(tmp_path: Path) -> None:
    """kill -9 in the middle; the files of the policies are the same bytes."""
    file = written(tmp_path, steps=2000, seeds="[1]")
    first = train(file, "killed")
    wait_for_checkpoint(tmp_path / "killed", first)
    os.killpg(first.pid, signal.SIGKILL)
    assert finish(first)[0] == -signal.SIGKILL
    assert not results(tmp_path / "killed")
    status, output = finish(train(file, "killed"))
    assert status == 0, output
    assert "killed/beams goes on: seed 1 from step " in output
    whole = CliRunner().invoke(app, ["policy", "train", str(file), "--out", str(tmp_path / "whole")])
    assert whole.exit_code == 0, whole.output
    assert results(tmp_path / "killed") == results(tmp_path / "whole")
    assert len(results(tmp_path / "whole")) == 1


@pytest.mark.exhaustive
def test_an_environment_beside_the_experiment_is_trained_in_every_process(tmp_path: Path) -> None:
    """That of the page, and its reward alone: a policy is exported where agents can observe the same."""
    (block,) = (text for _, text in blocks(ROOT / "docs/howto/train-an-agent.md") if "# my_env.py" in text)
    (tmp_path / "my_env.py").write_text(
        f'{block}\ngymnasium.register("Steady-v0", lambda **options: Steady(BeamSelectionEnv(**options)))\n'
    )
    file = written(tmp_path, steps=200)
    text = file.read_text()
    for name, is_exported in (("Mine-v0", False), ("Steady-v0", True)):
        file.write_text(text.replace("caviar/BeamSelection-v0", f"my_env:{name}"))
        status, output = finish(train(file, name))
        assert status == 0, output
        found = results(tmp_path / name)
        assert [policy is not None for _, policy in sorted(found.items())] == [is_exported] * 2


@pytest.mark.exhaustive
def test_ctrl_c_ends_all_seeds_and_says_how_to_go_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    file = written(tmp_path, steps=2000)
    first = train(file, "training")
    wait_for_checkpoint(tmp_path / "training", first)
    os.killpg(first.pid, signal.SIGINT)
    status, output = finish(first)
    assert status == 130, output
    assert f"stopped; caviar policy train {file} --out training goes on: seed 1 from step " in output
    assert "Traceback" not in output
    second = CliRunner().invoke(app, ["policy", "train", str(file), "--jobs", "2"])
    assert second.exit_code == 0, second.output
    policies = results(tmp_path / "training")
    assert sorted(policies) == [1, 2]
    # One more seed is all that is left to a third call.
    file.write_text(file.read_text().replace("[1, 2]", "[1, 2, 3]"))
    third = CliRunner().invoke(app, ["policy", "train", str(file), "--jobs", "2"])
    assert third.exit_code == 0, third.output
    assert "seed 1 is done, seed 2 is done, seed 3 from step 0" in third.output
    assert policies.items() < results(tmp_path / "training").items()


@pytest.mark.parametrize(
    ("algorithm", "real", "why"),
    [
        ('name = "ppo", n_steps = 64, batch_size = 64', 256, "PPO learns from n_steps × members = 64 × 2"),
        ('name = "dqn", learning_starts = 20, train_freq = 7', 210, "train_freq × members = 7 × 2 steps"),
        ('name = "a2c"', 200, None),
    ],
)
def test_bar_and_table_have_the_steps_that_are_trained_and_say_why(
    algorithm: str, real: int, why: str | None, tmp_path: Path
) -> None:
    file = written(tmp_path, steps=200)
    text = file.read_text().replace('name = "dqn", learning_starts = 20, gamma = 0.0', algorithm)
    file.write_text(text.replace("seeds = [1, 2]", "seeds = [1]"))
    command = ["policy", "train", str(file), "--out", str(tmp_path)]
    first, again = (CliRunner().invoke(app, command, env={"COLUMNS": "200"}).output for _ in range(2))
    for output in (first, again):
        assert f"{real}/{real} steps" in output
        assert f"│ {real} │" in output.replace("   ", " ").replace("  ", " ")
        assert ("and the 200 of the file are no multiple of these" in output) == bool(why)
    assert why is None or f"{real} steps a seed: " in first
    assert why is None or why in first


OWN = """
import gymnasium, numpy

class Mine(gymnasium.Env):
    observation_space = gymnasium.spaces.Box(-1, 1, (2,), numpy.float32)
    action_space = gymnasium.spaces.Discrete(2)

    def __init__(self, length=10):
        self.length, self.done = length, 0

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.done = 0
        return self.np_random.uniform(-1, 1, 2).astype(numpy.float32), {}

    def step(self, action):
        self.done += 1
        seen = self.np_random.uniform(-1, 1, 2).astype(numpy.float32)
        return seen, float(action), False, self.done >= self.length, {}

gymnasium.register("Mine-v0", entry_point=Mine)
"""


@pytest.mark.parametrize("jobs", [pytest.param(1, marks=pytest.mark.exhaustive), 2])
def test_an_environment_of_ones_own_beside_the_file_is_trained_and_gone_on_with(
    jobs: int, tmp_path: Path
) -> None:
    """From another folder than that of the file, in this process and in others."""
    beside, elsewhere = tmp_path / "beside", tmp_path / "elsewhere"
    beside.mkdir()
    elsewhere.mkdir()
    (beside / "my_env.py").write_text(OWN)
    file = beside / "mine.toml"
    file.write_text("""
        experiment = { name = "beams", seeds = [1, 2], steps = 1500, checkpoint_steps = 200 }
        environment = { id = "my_env:Mine-v0", members = 2, options = { length = 5 } }
        algorithm = { name = "a2c" }
        """)
    first = train(file, str(tmp_path / "out"), jobs, folder=elsewhere)
    wait_for_checkpoint(tmp_path / "out", first)
    os.killpg(first.pid, signal.SIGKILL)
    finish(first)
    status, output = finish(train(file, str(tmp_path / "out"), jobs, folder=elsewhere))
    assert status == 0, output
    assert "goes on: seed 1 from step " in output
    for seed in (1, 2):
        assert (tmp_path / "out" / "beams" / f"seed-{seed}" / "model.zip").is_file()


def test_what_goes_wrong_in_a_process_is_one_line_of_the_command(tmp_path: Path) -> None:
    status, output = finish(train(written(tmp_path, steps=100, observe="aodd"), "training"))
    assert status == 1
    assert "environment.options.observe: no observation is called 'aodd'; did you mean 'aod'?" in output
    assert "Traceback" not in output
