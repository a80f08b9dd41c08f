"""The byte vectors read in another language, by npm's msgpack."""

from __future__ import annotations

import json
import shutil
import subprocess
from pathlib import Path

import pytest
from vector_files import FOLDER, all_vectors

HERE = Path(__file__).parent / "node"
UNREACHABLE = ("ENOTFOUND", "EAI_AGAIN", "ECONNREFUSED", "ETIMEDOUT", "ENETUNREACH", "ENOTCACHED")


@pytest.fixture(scope="module")
def node_project(tmp_path_factory: pytest.TempPathFactory, pytestconfig: pytest.Config) -> Path:
    """A copy of ``node/`` with its dependency installed; kept in pytest's cache between sessions."""
    for program in ("node", "npm"):
        if shutil.which(program) is None:
            pytest.skip(f"{program} is not installed")
    cache = pytestconfig.cache
    folder = cache.mkdir("vectors-node") if cache is not None else tmp_path_factory.mktemp("node")
    if not installed(folder):
        shutil.copy(HERE / "package.json", folder)
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
    shutil.copy(HERE / "read.mjs", folder)
    return folder


def installed(folder: Path) -> bool:
    """Whether the wanted version is there already."""
    wanted = json.loads((HERE / "package.json").read_text("utf-8"))["dependencies"]["@msgpack/msgpack"]
    found = folder / "node_modules" / "@msgpack" / "msgpack" / "package.json"
    return found.exists() and json.loads(found.read_text("utf-8"))["version"] == wanted


def test_npm_msgpack_reads_every_vector_and_its_arrays(node_project: Path) -> None:
    result = subprocess.run(
        ["node", "read.mjs", FOLDER],
        cwd=node_project,
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    assert result.stdout, result.stderr
    report = json.loads(result.stdout)
    assert report["wrong"] == []
    assert report["read"] == sum(v.refused is None and "value" in v.stated for v in all_vectors())
    assert report["read"] >= 60
