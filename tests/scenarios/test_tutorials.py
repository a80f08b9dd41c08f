"""The tutorials do what they say: files are written, commands run and outputs appear as they are printed."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from scenarios_support import ROOT, follow

TUTORIALS = ROOT / "docs" / "tutorials"
CHANNEL = {"own-scenario", "beam-selector"}
"""Pages that need the ray tracer."""
LONG = {"own-scenario", "first-agent", "beam-selector"}
"""Pages that take most of the time."""


@pytest.mark.parametrize(
    "page",
    [
        pytest.param(
            file.stem,
            marks=[pytest.mark.channel] * (file.stem in CHANNEL)
            + [pytest.mark.exhaustive] * (file.stem in LONG),
        )
        for file in sorted(TUTORIALS.glob("*.md"))
        if file.stem != "index"
    ],
)
def test_a_tutorial_is_followed_from_top_to_bottom_in_an_empty_folder(page: str, tmp_path: Path) -> None:
    follow(TUTORIALS / f"{page}.md", tmp_path)


def test_the_tutorials_are_found() -> None:
    listed = re.findall(r"^[a-z-]+$", (TUTORIALS / "index.md").read_text("utf-8"), re.MULTILINE)
    assert sorted(listed) == sorted(file.stem for file in TUTORIALS.glob("*.md") if file.stem != "index")
