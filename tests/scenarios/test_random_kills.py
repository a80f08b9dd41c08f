"""A short run with random kills; `random_kills` does two hundred."""

from __future__ import annotations

from pathlib import Path

import pytest
import random_kills


@pytest.mark.slow
def test_a_run_in_which_several_processes_are_killed_at_once_and_at_random_has_its_digest(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    # Up to seven at once, the broker in two of the kills; two with the launcher suspended.
    status = random_kills.main(["--kills", "6", "--seed", "418", "--out", str(tmp_path)])
    assert status == 0, capsys.readouterr().out
