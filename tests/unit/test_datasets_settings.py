"""In what two datasets differ, as a user reads it."""

from __future__ import annotations

from typing import Any

import pytest

from caviar_clients.datasets.settings import SHOWN, differences, refusal


@pytest.mark.parametrize(
    ("before", "now", "said"),
    [
        ({"run": {"seed": 1}}, {"run": {"seed": 2}}, ["run.seed was 1, is 2"]),
        (
            {"services": {"a": 1}, "run": {"frames": 1, "name": "x"}},
            {"services": {"a": 2}, "run": {"frames": 2, "name": "y"}},
            ["run.name was 'x', is 'y'", "run.frames was 1, is 2", "services.a was 1, is 2"],
        ),
        (
            {"carriers": [{"name": "a", "frequency_hz": 28e9}]},
            {"carriers": [{"name": "a", "frequency_hz": 60e9}, {"name": "b", "frequency_hz": 5e9}]},
            ["carriers[0].frequency_hz was 28e9, is 60e9", "carriers[1] was not there, is that of 'b'"],
        ),
        (
            {"run": {"record": ["scene", "lidar.grid", "link"]}},
            {"run": {"record": ("scene", "link", "camera")}},
            ["run.record is without 'lidar.grid'", "run.record has 'camera' too"],
        ),
        ({"run": {"record": ["a", "b"]}}, {"run": {"record": ["a", "b"]}}, []),
        (
            {"run": {"instants_s": [0.5]}},
            {"run": {"instants_s": []}},
            ["run.instants_s[0] was 0.5, is not there"],
        ),
        ({"x": 2.5e6}, {"x": 123456.7}, ["x was 2.5e6, is 123.4567e3"]),
        ({"x": "a" * 99}, {"x": None}, [f"x was 'a{'a' * 57}…, is None"]),
    ],
)
def test_a_difference_has_the_key_of_the_scenario_and_both_values(
    before: dict[str, Any], now: dict[str, Any], said: list[str]
) -> None:
    assert list(differences({"scenario": before}, {"scenario": now})) == said


def test_files_and_code_have_changed_and_no_digest_is_shown() -> None:
    before = {"code": {"pack.mine": "1" * 64, "old": "2"}, "files": {"a.xml": "3"}, "device": "llvm"}
    now = {"code": {"pack.mine": "4" * 64}, "files": {"a.xml": "5", "b.xml": "6"}, "device": "cuda"}
    assert list(differences(before, now)) == [
        "pack/mine.py, or a module that it imports, has changed",
        "old.py, or a module that it imports, is gone",
        "a.xml has changed",
        "b.xml is new",
        "device was 'llvm', is 'cuda'",
    ]


def test_a_refusal_names_some_keys_and_counts_the_others() -> None:
    before, now = ({"scenario": {f"k{at}": value for at in range(11)}} for value in (1, 2))
    lines = refusal("d holds another dataset", before, now).splitlines()
    assert lines[:2] == ["d holds another dataset:", "  k0 was 1, is 2"]
    assert lines[SHOWN + 1 : -1] == ["  and 3 more"]
    assert lines[-1].startswith("give another --out")
    assert refusal("d", {"x": 1}, {"x": 2}).startswith("d: x was 1, is 2; give another --out")
    assert refusal("d", {"x": 1}, {"x": 1}) == ""
    assert refusal("d", {"x": 1}, {"x": 1}, "the device").startswith("d: the device; give")
