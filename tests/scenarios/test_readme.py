"""The README does what it says: its commands and scripts run as they are printed, in their order."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest
from scenarios_support import ROOT, run_as_printed

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


def test_the_commands_are_followed_from_top_to_bottom_in_an_empty_folder(tmp_path: Path) -> None:
    pytest.importorskip("matplotlib", reason="needs the extra `plot`")
    shell = blocks("sh")
    assert len(shell) == 2
    for block in shell:
        run_as_printed(["bash", "-e", "-c", block], tmp_path)
    assert len(list(tmp_path.glob("runs/smoke-*/map.png"))) == 1
    assert (tmp_path / "crossing.toml").is_file()
    assert len(list(tmp_path.glob("runs/crossing-*/summary.json"))) == 1
    (expression,) = re.findall(r"`(caviar\.open\(.*?\.h)`", README)
    program = f"import caviar\nprint({expression}.shape)\n"
    assert "(100, 2, 4, 32)" in run_as_printed(script(program, tmp_path), tmp_path)


def test_the_network_learns_from_a_dataset_and_ranks_beams(tmp_path: Path) -> None:
    """On two flights of `geometric` in place of a hundred episodes of a street, which take minutes."""
    pytest.importorskip("torch", reason="needs PyTorch")
    (generate,) = re.findall(r"caviar dataset generate .*(?= #)", README)
    assert generate.strip() == "caviar dataset generate s008 --out data/s008 --episodes 100"
    shorter = generate.replace("s008 --out", "geometric --workers 1 --scenes 40 --out").replace("100", "5")
    run_as_printed(shorter.split(), tmp_path)
    (learn,) = blocks("python")
    printed = run_as_printed(script(learn, tmp_path), tmp_path)
    found = re.search(r"the best beam is first in (\d+)%, among five in (\d+)%", printed)
    assert found is not None
    assert int(found[1]) <= int(found[2])
    assert int(found[2]) > 50, "chance has 8 %"


def test_a_mistake_is_told_as_the_readme_shows(tmp_path: Path) -> None:
    shown = re.search(r"^caviar: (crossing\.toml:\d+: .*)$", README, re.MULTILINE)
    assert shown is not None
    run_as_printed(["caviar", "new", "crossing"], tmp_path)
    file = tmp_path / "crossing.toml"
    file.write_text(file.read_text().replace("normalization", "normalisation"))
    refused = subprocess.run(
        [sys.executable, "-m", "caviar_clients", "run", "crossing.toml"],
        cwd=tmp_path, capture_output=True, text=True, timeout=120,
    )  # fmt: skip
    assert refused.returncode == 1
    assert shown[1] in refused.stderr


@pytest.mark.parametrize("steps", [300, pytest.param(2000, marks=pytest.mark.exhaustive)])
def test_the_learning_script_of_its_how_to_trains_and_compares(steps: int, tmp_path: Path) -> None:
    pytest.importorskip("stable_baselines3", reason="needs the extra `learning`")
    guide = (ROOT / "docs" / "howto" / "train-an-agent.md").read_text()
    (train,) = [block for block in re.findall(r"```py\n(.*?)```", guide, re.DOTALL) if "DQN(" in block]
    assert "agent.learn(2000)" in train
    shorter = train.replace("agent.learn(2000)", f"agent.learn({steps})")
    out = run_as_printed(script(shorter, tmp_path), tmp_path)
    printed = re.search(r"DQN ([\d.]+), los-beam ([\d.]+), oracle ([\d.]+)", out)
    assert printed is not None, out
    dqn, straight, best = map(float, printed.groups())
    assert straight < best
    if steps == 2000:
        assert 0.3 * best < dqn < best, "better than chance, which has about a tenth of the best"
