"""The README does what it says: its commands and scripts run as they are printed, in their order."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest
from scenarios_support import ROOT, run_as_printed

from caviar_protocol.recording import Recording, newest_run

README = (ROOT / "README.md").read_text()


def blocks(language: str) -> list[str]:
    """Blocks of a language, in their order."""
    return re.findall(rf"```{language}\n(.*?)```", README, re.DOTALL)


def script(text: str, folder: Path) -> list[str | Path]:
    """A command that runs a block of Python."""
    file = folder / "script.py"
    file.write_text(text)
    assert len(text.splitlines()) <= 30
    return [sys.executable, file]


def test_the_first_half_is_followed_from_top_to_bottom_in_an_empty_folder(tmp_path: Path) -> None:
    shell = blocks("sh")
    assert len(shell) == 2
    for block in shell:
        run_as_printed(["bash", "-e", "-c", block], tmp_path)
    assert (tmp_path / "crossing.toml").is_file()
    assert len(list(tmp_path.glob("runs/crossing-*/summary.json"))) == 1
    program, _, read, _ = blocks("python")
    checked = f"{program}assert recording['channel'].h.shape == (100, 2, 4, 32)\n"
    run_as_printed(script(checked, tmp_path), tmp_path)
    printed = run_as_printed(script(read, tmp_path), tmp_path)
    assert "(100, 2, 4, 32)" in printed
    assert re.search(r"\|y\| of the agent: (100\.0|99\.\d)%", printed), printed


def test_a_class_beside_the_scenario_takes_part(tmp_path: Path) -> None:
    _, agent, _, _ = blocks("python")
    (tmp_path / "my_agent.py").write_text(agent)
    run_as_printed(["caviar", "new", "crossing"], tmp_path)
    file = tmp_path / "crossing.toml"
    use = re.search(r"`(use = \"my_agent:\w+\")`", README)
    assert use is not None
    text = file.read_text()
    assert text.count('use = "los-beam"') == 1
    file.write_text(text.replace('use = "los-beam"', use[1]))
    run_as_printed(["caviar", "run", "crossing.toml", "--frames", "9", "--embedded"], tmp_path)
    link = Recording(newest_run(tmp_path / "runs"))["link"]
    assert link.tx_beam.tolist() == [[frame, frame] for frame in range(9)]


def test_a_mistake_is_told_as_the_readme_shows(tmp_path: Path) -> None:
    shown = re.search(r"^caviar: (crossing\.toml:\d+: .*)$", README, re.MULTILINE)
    assert shown is not None
    run_as_printed(["caviar", "new", "crossing"], tmp_path)
    file = tmp_path / "crossing.toml"
    file.write_text(file.read_text().replace("normalization", "normalisation"))
    refused = subprocess.run(
        [sys.executable, "-m", "caviar_clients", "run", "crossing.toml"],
        cwd=tmp_path, capture_output=True, text=True, timeout=60,
    )  # fmt: skip
    assert refused.returncode == 1
    assert shown[1] in refused.stderr


@pytest.mark.parametrize("steps", [300, pytest.param(2000, marks=pytest.mark.exhaustive)])
def test_the_learning_script_trains_and_compares(steps: int, tmp_path: Path) -> None:
    pytest.importorskip("stable_baselines3", reason="needs the extra `learning`")
    _, _, _, train = blocks("python")
    assert "agent.learn(2000)" in train
    shorter = train.replace("agent.learn(2000)", f"agent.learn({steps})")
    out = run_as_printed(script(shorter, tmp_path), tmp_path)
    printed = re.search(r"DQN ([\d.]+), los-beam ([\d.]+), oracle ([\d.]+)", out)
    assert printed is not None, out
    dqn, straight, best = map(float, printed.groups())
    assert straight < best
    if steps == 2000:
        assert 0.3 * best < dqn < best, "better than chance, which has about a tenth of the best"
