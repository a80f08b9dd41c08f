"""The tutorials do what they say: files are written, commands run and outputs appear as they are printed.

In an empty folder the blocks of a page are followed from top to bottom. A block whose first line is a comment
with a file name is written to that file; other blocks of ``sh`` and ``python`` are run. What a block of
``text`` shows has to be in the output of the command before it, with anything for ``…``.
"""

from __future__ import annotations

import re
import sys
from pathlib import Path

import pytest
from scenarios_support import ROOT, run_as_printed

TUTORIALS = ROOT / "docs" / "tutorials"
CHANNEL = {"own-scenario"}
"""Pages that need the ray tracer."""


def blocks(page: str) -> list[tuple[str, str]]:
    """Language and content of the fenced blocks of a page."""
    text = (TUTORIALS / f"{page}.md").read_text("utf-8")
    return re.findall(r"^```(\w+)\n(.*?)^```$", text, re.DOTALL | re.MULTILINE)


def shown(line: str) -> re.Pattern[str]:
    """A line of output, whatever its spaces, with anything for ``…``."""
    words = [re.escape(word).replace("…", ".*") for word in line.split()]
    return re.compile(r"\s+".join(words))


@pytest.mark.parametrize(
    "page",
    [
        pytest.param(file.stem, marks=[pytest.mark.channel] if file.stem in CHANNEL else [])
        for file in sorted(TUTORIALS.glob("*.md"))
        if file.stem != "index"
    ],
)
def test_a_tutorial_is_followed_from_top_to_bottom_in_an_empty_folder(page: str, tmp_path: Path) -> None:
    output = ""
    for language, content in blocks(page):
        name = re.match(r"# ([\w.-]+\.\w+)\n", content)
        if name:
            (tmp_path / name[1]).write_text(content, "utf-8")
        elif language == "sh":
            output = run_as_printed(["bash", "-e", "-o", "pipefail", "-c", content], tmp_path)
        elif language == "python":
            output = run_as_printed([sys.executable, "-c", content], tmp_path)
        elif language == "text":
            for line in content.splitlines():
                assert shown(line).search(output), f"{page} shows {line!r}; the command printed\n{output}"


def test_the_tutorials_are_found() -> None:
    listed = re.findall(r"^[a-z-]+$", (TUTORIALS / "index.md").read_text("utf-8"), re.MULTILINE)
    assert sorted(listed) == sorted(file.stem for file in TUTORIALS.glob("*.md") if file.stem != "index")
