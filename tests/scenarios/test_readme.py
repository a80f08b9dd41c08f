"""The script of the README does what the README says."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest
from scenarios_support import ROOT


def test_the_learning_script_trains_and_compares(tmp_path: Path) -> None:
    pytest.importorskip("stable_baselines3", reason="needs the extra `learning`")
    text = (ROOT / "README.md").read_text()
    found = re.search(r"```python\n(.*?)```", text, re.DOTALL)
    assert found is not None
    script = tmp_path / "train.py"
    script.write_text(found[1])
    assert len(found[1].splitlines()) <= 30
    done = subprocess.run(
        [sys.executable, script], cwd=ROOT, capture_output=True, text=True, timeout=240, check=False
    )
    assert done.returncode == 0, done.stderr
    printed = re.search(r"DQN ([\d.]+), los-beam ([\d.]+), oracle ([\d.]+)", done.stdout)
    assert printed is not None, done.stdout
    dqn, straight, best = map(float, printed.groups())
    assert 0.3 * best < dqn < best, "better than chance, which has about a tenth of the best"
    assert straight < best
