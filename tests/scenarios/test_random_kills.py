"""A short run with random kills; `random_kills` does two hundred."""

from __future__ import annotations

from pathlib import Path

import pytest
import random_kills


@pytest.mark.slow
def test_a_run_in_which_processes_are_killed_at_random_has_its_digest(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    status = random_kills.main(["--kills", "15", "--seed", "3", "--out", str(tmp_path)])
    assert status == 0, capsys.readouterr().out
