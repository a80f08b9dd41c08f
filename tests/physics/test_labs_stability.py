"""Every case of `caviar measure stability` is right, and the table in the documentation shows them all."""

from __future__ import annotations

from pathlib import Path

import pytest

from caviar_labs.stability.case import cases, run

pytestmark = pytest.mark.channel

DOCUMENT = Path(__file__).parents[2] / "docs" / "topics" / "channel-stability.md"
GROUPS = sorted({case.group for case in cases() if case.traced})

LONG = {"mesh", "place", "paths", "edge", "material", "frequency", "distance", "flush"}
"""Groups that take most of the time."""


@pytest.mark.parametrize(
    "group",
    [pytest.param(group, marks=pytest.mark.exhaustive if group in LONG else ()) for group in GROUPS],
)
def test_cases_that_trace_are_right(group: str) -> None:
    results = run([case for case in cases() if case.group == group and case.traced])
    assert [result for result in results if result.verdict != "right"] == []


def test_the_document_shows_every_case() -> None:
    """In order, each with the verdict right; after a change of cases it is written anew."""
    rows = [line.split(" | ") for line in DOCUMENT.read_text("utf-8").splitlines() if line.startswith("| ")]
    shown = [row[0].removeprefix("| ") for row in rows if row[-1] in ("right |", "wrong |")]
    assert shown == [case.title.replace("|", "\\|") for case in cases()]
    assert not [row for row in rows if row[-1] == "wrong |"]
