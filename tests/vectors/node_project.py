"""npm projects of this repository, installed for a test where Node and npm's registry are at hand."""

from __future__ import annotations

import json
import shutil
import subprocess
from pathlib import Path

import pytest

UNREACHABLE = ("ENOTFOUND", "EAI_AGAIN", "ECONNREFUSED", "ETIMEDOUT", "ENETUNREACH", "ENOTCACHED")


def node_project(source: Path, script: str, folder: Path) -> Path:
    """``folder`` with the script of ``source`` and the dependencies of its package.json.

    What is installed there already stays; skips by name where Node or npm's registry is missing.
    """
    for program in ("node", "npm"):
        if shutil.which(program) is None:
            pytest.skip(f"{program} is not installed")
    if not _installed(source, folder):
        shutil.copy(source / "package.json", folder)
        result = subprocess.run(
            ["npm", "install", "--no-audit", "--no-fund", "--no-package-lock", "--ignore-scripts"],
            cwd=folder,
            capture_output=True,
            text=True,
            timeout=120,
            check=False,
        )
        if any(code in result.stderr for code in UNREACHABLE):
            pytest.skip(f"npm cannot reach its registry: {result.stderr.strip().splitlines()[0]}")
        assert result.returncode == 0, result.stderr
    shutil.copy(source / script, folder)
    return folder


def _installed(source: Path, folder: Path) -> bool:
    """Whether the wanted versions are there already."""
    wanted = json.loads((source / "package.json").read_text("utf-8"))["dependencies"]
    found = {name: folder / "node_modules" / name / "package.json" for name in wanted}
    return all(
        path.exists() and json.loads(path.read_text("utf-8"))["version"] == wanted[name]
        for name, path in found.items()
    )
