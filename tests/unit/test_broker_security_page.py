"""docs/topics/threat-model.md promises only what a test holds."""

from __future__ import annotations

import ast
import re
from pathlib import Path

import msgspec
import pytest

from caviar_broker.connections import HANDSHAKE_MS
from caviar_broker.security.access import BAR_NS
from caviar_broker.security.limits import PeerLimits
from caviar_protocol.scenario import Limits

pytestmark = pytest.mark.slow

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs" / "topics" / "threat-model.md").read_text()


def known_tests() -> set[str]:
    found = set()
    for path in (ROOT / "tests").rglob("test_*.py"):
        tree = ast.parse(path.read_text())
        found |= {node.name for node in ast.walk(tree) if isinstance(node, ast.FunctionDef)}
    return found


def test_each_promise_names_tests_that_exist() -> None:
    held = PAGE[: PAGE.index("### Other limits")] + PAGE[PAGE.index("## What is secret") :]
    rows = [line for line in held.splitlines() if line.startswith("| ") and "| test |" not in line]
    promises = [row for row in rows if not row.startswith("| ---")]
    assert len(promises) > 15
    for row in promises:
        assert "`test_" in row, f"no test holds: {row}"
    named = set(re.findall(r"`(test_\w+)`", PAGE))
    assert named <= known_tests()


def test_its_figures_are_those_of_the_code() -> None:
    limits = PeerLimits()
    assert f"{limits.rate:.0f} messages a second" in PAGE
    assert f"{limits.stranger_bytes >> 20} MiB before HELLO" in PAGE
    assert f"{limits.queued / 2**30:.2f} GiB" in PAGE
    assert f"after {HANDSHAKE_MS // 1000} s" in PAGE
    assert f"barred for {BAR_NS // 10**9} s" in PAGE


def test_it_tells_every_limit_of_a_scenario_with_its_default() -> None:
    told = re.findall(r"^\| `(\w+)` \| ([\d.]+) \|", PAGE, re.MULTILINE)
    assert [(name, float(value)) for name, value in told] == list(msgspec.structs.asdict(Limits()).items())
