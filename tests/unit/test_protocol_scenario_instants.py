"""Instants of frames that a scenario lists."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from caviar_broker.core.plan import plan_run
from caviar_protocol.errors import ScenarioError
from caviar_protocol.scenario import Scenario, instants_ns, parse_scenario
from caviar_protocol.scenario.rules import resolved, with_overrides

pytestmark = pytest.mark.slow

TEXT = """\
[run]
name = "x"
INSTANTS
[services.streets]
role = "world"
use = "trajectory"
budget_ms = 5
"""


def parsed(lines: str) -> Scenario:
    return parse_scenario(TEXT.replace("INSTANTS", lines), "x.toml", Path())


@given(st.lists(st.integers(0, 10**13), min_size=1, max_size=20, unique=True).map(sorted))
def test_whole_nanoseconds_are_exact(expected: list[int]) -> None:
    """Written with nine decimals, as in a file, and planned as they are."""
    text = ", ".join(f"{t // 10**9}.{t % 10**9:09d}" for t in expected)
    scenario = parsed(f"instants_s = [{text}]")
    assert instants_ns(scenario.run.instants_s) == tuple(expected)
    plan = plan_run(scenario, "run", {})
    assert [plan.t_ns(frame) for frame in range(plan.frames)] == expected
    assert all(t % plan.sampling_period_ns == 0 for t in expected if expected != [0])
    assert plan.t_ns(plan.frames) == expected[-1] + plan.sampling_period_ns  # the final grant


@given(st.lists(st.integers(0, 10**15), min_size=1, max_size=20, unique=True).map(sorted))
def test_whole_numbers_of_nanoseconds_are_the_same_instants(expected: list[int]) -> None:
    scenario = parsed(f"instants_ns = {expected}")
    assert plan_run(scenario, "run", {}).instants_ns == tuple(expected)


def test_a_file_lists_instants(tmp_path: Path) -> None:
    """With comments and empty lines, and relative to the scenario."""
    (tmp_path / "when.csv").write_text("# of a measurement\nt_s\n0.0\n\n0.1\n  0.350000001\n")
    text = TEXT.replace("INSTANTS", 'instants_s = "file:when.csv"')
    scenario = parse_scenario(text, "x.toml", tmp_path)
    assert plan_run(scenario, "run", {}).instants_ns == (0, 100_000_000, 350_000_001)
    assert scenario.run.frames == 3


@pytest.mark.parametrize(
    ("content", "line", "says"),
    [
        ("t_s\n0.1\n0.1\n", 3, "0.1 does not come after 0.1"),
        ("t_s\n0.1\nsoon\n", 3, "'soon' is no number"),
        ("t_s\n0.0000000001\n", 2, "at most 9 decimals"),
        ("t_s\n-1\n", 2, "seconds ≥ 0"),
        ("t_s\nnan\n", 2, "seconds ≥ 0"),
        ("time\n0.1\n", 1, "the first line is 'time'; write t_s"),
        ("t_s\n", None, "holds no instant"),
    ],
)
def test_what_is_wrong_in_a_file_is_named_with_its_line(
    tmp_path: Path, content: str, line: int | None, says: str
) -> None:
    (tmp_path / "when.csv").write_text(content)
    with pytest.raises(ScenarioError) as caught:
        parse_scenario(TEXT.replace("INSTANTS", 'instants_s = "file:when.csv"'), "x.toml", tmp_path)
    assert (caught.value.file, caught.value.line) == (str(tmp_path / "when.csv"), line)
    assert says in str(caught.value)


def test_a_file_that_is_not_there_is_named() -> None:
    with pytest.raises(ScenarioError, match=r"run\.instants_s.*nowhere\.csv"):
        parsed('instants_s = "file:nowhere.csv"')


def test_frames_and_period_follow() -> None:
    """0.1 s and 0.35 s are both multiples of 50 ms, and of nothing longer."""
    run = parsed("instants_s = [0, 0.1, 0.35]").run
    assert (run.frames, run.sampling_period_ns) == (3, 50_000_000)


def test_one_instant_is_a_run_of_one_frame() -> None:
    run = parsed("instants_s = [0.0]").run
    assert (run.frames, run.sampling_period_ns) == (1, 100_000_000)


def test_without_instants_frames_are_evenly_spaced() -> None:
    plan = plan_run(parsed("frames = 4\nsampling_period_ns = 7"), "run", {})
    assert [plan.t_ns(frame) for frame in range(5)] == [0, 7, 14, 21, 28]


def test_the_resolved_scenario_has_all_three() -> None:
    found = json.loads(json.dumps(resolved(parsed("instants_s = [0.5, 0.75]"))))["run"]
    assert (found["instants_s"], found["frames"], found["sampling_period_ns"]) == (
        [0.5, 0.75],
        2,
        250_000_000,
    )


def test_fewer_frames_are_the_first_instants_and_more_are_refused() -> None:
    scenario = parsed("instants_s = [0.1, 0.2, 0.4]")
    plan = plan_run(with_overrides(scenario, frames=2), "run", {})
    assert [plan.t_ns(frame) for frame in range(plan.frames)] == [100_000_000, 200_000_000]
    assert plan.t_ns(2) == 400_000_000
    with pytest.raises(ScenarioError, match=r"run\.frames: is 4.* 3 instants"):
        with_overrides(scenario, frames=4)


@pytest.mark.parametrize(
    ("lines", "key", "says"),
    [
        ("instants_s = [0.0, 0.2, 0.2]", "run.instants_s[2]", "0.2 does not come after 0.2"),
        ("instants_s = [0.3, 0.1]", "run.instants_s[1]", "0.1 does not come after 0.3"),
        ("instants_s = [0.0, 0.0000000005]", "run.instants_s[1]", "at most 9 decimals"),
        ("instants_s = [-1.0, 0.0]", "run.instants_s[0]", "is -1.0, write seconds ≥ 0"),
        ("instants_s = [0.0, inf]", "run.instants_s[1]", "is inf, write seconds ≥ 0"),
        ("instants_s = [nan]", "run.instants_s[0]", "is nan, write seconds ≥ 0"),
        ("instants_s = []", "run.instants_s", "is [], write the instant of each frame"),
        ("instants_s = 3", "run.instants_s", "is 3, write"),
        ("instants_s = [0.0, true]", "run.instants_s[1]", "is true, write a number"),
        ("instants_ns = [0, 3, 2]", "run.instants_ns[2]", "2 does not come after 3"),
        ("instants_ns = [0, 1.5]", "run.instants_ns[1]", "is 1.5, write whole nanoseconds ≥ 0"),
        ("instants_ns = [-4]", "run.instants_ns[0]", "is -4, write whole nanoseconds ≥ 0"),
        ("instants_ns = []", "run.instants_ns", "is [], write the instant of each frame"),
        ("instants_ns = [90071992547409931]", "run.instants_ns[0]", "so late that nanoseconds"),
        ("instants_ns = [0]\nframes = 1", "run.frames", "follows from instants_ns; remove one of both"),
        ("instants_ns = [0]\ninstants_s = [0.0]", "run.instants_s", "follows from instants_ns"),
        ("instants_s = [0.0]\nframes = 1", "run.frames", "follows from instants_s; remove one of both keys"),
        ("instants_s = [0.0]\nsampling_period_ns = 1", "run.sampling_period_ns", "follows from instants_s"),
    ],
)
def test_what_is_no_list_of_instants_is_named(lines: str, key: str, says: str) -> None:
    with pytest.raises(ScenarioError) as caught:
        parsed(lines)
    assert caught.value.key == key
    assert caught.value.line in (3, 4)
    assert says in str(caught.value)
