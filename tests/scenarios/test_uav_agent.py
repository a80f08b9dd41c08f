"""The agent of `docs/howto/uav-dynamics.md` flies its rectangle in the scenario that the page puts it in."""

from __future__ import annotations

import re
import sys
from pathlib import Path

import numpy as np
import pytest
from scenarios_support import ROOT, SCENARIOS

import caviar

PAGE = ROOT / "docs" / "howto" / "uav-dynamics.md"


def block(language: str, first: str) -> str:
    """The block of the page that begins so."""
    found: list[str] = re.findall(rf"```{language}\n(.*?)```", PAGE.read_text("utf-8"), re.DOTALL)
    return next(text for text in found if text.startswith(first))


def test_the_agent_of_the_page_flies_to_its_corners(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "path", [*sys.path])
    (tmp_path / "patrol.py").write_text(block("python", "# patrol.py"), "utf-8")
    text = (SCENARIOS / "uav-wind.toml").read_text("utf-8")
    agent = text[text.index("[services.agent]") : text.index("[services.recorder]")]
    patrol = block("toml", '[services.agent]\nrole = "agent"\nuse = "patrol')
    (tmp_path / "patrol.toml").write_text(text.replace(agent, f"{patrol}\n"), "utf-8")
    run = caviar.run(tmp_path / "patrol.toml", out=tmp_path / "runs", embedded=True)
    positions = caviar.open(run)["scene"].position[:, 0]
    for corner in ((50.0, 0.0, 25.0), (50.0, 30.0, 25.0), (0.0, 30.0, 25.0)):
        assert np.linalg.norm(positions - corner, axis=1).min() < 1.0
