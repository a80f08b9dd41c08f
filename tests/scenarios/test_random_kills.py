"""A short run with random kills; `random_kills` does two hundred."""

from __future__ import annotations

from pathlib import Path

import pytest
import random_kills


@pytest.mark.parametrize(
    ("kills", "seed"),
    [
        # Up to seven at once, the broker in two of the kills; two with the launcher suspended.
        ("6", "418"),
        pytest.param("200", "1", marks=pytest.mark.exhaustive),
    ],
)
def test_a_run_in_which_several_processes_are_killed_at_once_and_at_random_has_its_digest(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], kills: str, seed: str
) -> None:
    status = random_kills.main(["--kills", kills, "--seed", seed, "--out", str(tmp_path)])
    assert status == 0, capsys.readouterr().out
