"""The byte vectors read in another language, by npm's msgpack."""

from __future__ import annotations

import json
import subprocess
from pathlib import Path

import pytest
from node_project import node_project
from vector_files import FOLDER, all_vectors

HERE = Path(__file__).parent / "node"


@pytest.fixture(scope="module")
def reader(tmp_path_factory: pytest.TempPathFactory, pytestconfig: pytest.Config) -> Path:
    """A copy of ``node/`` with its dependency installed; kept in pytest's cache between sessions."""
    cache = pytestconfig.cache
    folder = cache.mkdir("vectors-node") if cache is not None else tmp_path_factory.mktemp("node")
    return node_project(HERE, "read.mjs", folder)


def test_npm_msgpack_reads_every_vector_and_its_arrays(reader: Path) -> None:
    result = subprocess.run(
        ["node", "read.mjs", FOLDER],
        cwd=reader,
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
