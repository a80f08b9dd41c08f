"""The documentation renders without a warning, and is read without a server and without a network."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest
from scenarios_support import ROOT

LOADED = r"<(?:script|link|img|iframe)\b[^>]*(?:src|href)=\"((?:https?:)?//[^\"]*)"
"""What a page loads from another host; links to other sites are no such thing."""


@pytest.mark.exhaustive
@pytest.mark.timeout(1500)
def test_the_documentation_renders_in_strict_mode_and_loads_nothing_from_elsewhere(tmp_path: Path) -> None:
    """A dead link, a missing heading, a page in no table of contents: each is a warning, and fails."""
    command = [sys.executable, "-m", "sphinx", "--quiet", "--fail-on-warning", "--keep-going"]
    done = subprocess.run([*command, "-c", "docs", ".", tmp_path], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    first = re.search(r"url=([^\"]+)", (tmp_path / "index.html").read_text())
    assert first is not None
    assert (tmp_path / first[1]).is_file()
    assert "codebook" in (tmp_path / "searchindex.js").read_text()
    for page in tmp_path.rglob("*.html"):
        loaded = re.findall(LOADED, page.read_text())
        assert not loaded, f"{page.name} loads {loaded}"
    for style in tmp_path.rglob("*.css"):
        assert not re.search(r"url\([\"']?(?:https?:)?//", style.read_text()), style.name
