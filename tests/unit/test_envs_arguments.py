"""Arguments of environments: what is wrong is refused with its value, before an array is made of it."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest

import caviar_clients.envs  # noqa: F401  # registers the environments
from caviar_clients.envs.arguments import (
    MOST_MEMBERS,
    checked_members,
    checked_names,
    checked_patterns,
    checked_seeds,
    whole_numbers,
)
from caviar_protocol.errors import PayloadError, ScenarioError
from caviar_protocol.scenario import find_scenario


@pytest.mark.parametrize("wrong", [0, -1, 1.5, "3", None, True, MOST_MEMBERS + 1, 10**9])
def test_a_number_of_members_that_cannot_be_is_refused(wrong: object) -> None:
    with pytest.raises(ScenarioError, match=r"num_envs=.*from 1 to 65536"):
        checked_members(wrong)


def test_a_number_of_members_may_be_numpys() -> None:
    found = checked_members(np.int64(3))
    assert (found, type(found)) == (3, int)


@pytest.mark.parametrize(
    "wrong", [1.5, "abc", True, [1, 2], [1, 2, -3], [1, 2.0, 3], 2**63 - 2, -1, [1, 2, "3"]]
)
def test_seeds_that_cannot_be_are_refused(wrong: object) -> None:
    with pytest.raises(ScenarioError, match=r"seed.*; write "):
        checked_seeds(wrong, 3)


def test_seeds_are_of_each_member() -> None:
    assert checked_seeds(np.int64(4), 3) == [4, 5, 6]
    assert checked_seeds(None, 2) == [None, None]
    assert checked_seeds((1, None), 2) == [1, None]
    assert checked_seeds(np.array([7, 1]), 2) == [7, 1]


@pytest.mark.parametrize("wrong", [3, None, [3], ["aod", None], "aod", b"aod", {"aod": 1}])
def test_names_that_are_no_texts_are_refused(wrong: object) -> None:
    with pytest.raises(ScenarioError, match=r"observe.*; write a tuple of names"):
        checked_names("observe", wrong)


def test_patterns_may_be_one_text() -> None:
    assert checked_patterns("users", "uav/*") == ("uav/*",)
    assert checked_patterns("users", ["a", "b"]) == ("a", "b")


@pytest.mark.parametrize(
    "wrong", [None, "ab", [1, 2, 3], [0.0, 1.0], [np.nan, 0], [1, [2]], [True, False], 5, {"a": 1}]
)
def test_actions_that_are_no_whole_numbers_are_refused(wrong: object) -> None:
    with pytest.raises(PayloadError, match=r"the actions are .*shape \[2\]"):
        whole_numbers(wrong, (2,))


def test_actions_have_one_of_the_shapes() -> None:
    assert whole_numbers([[1], [2]], (2,), (2, 1)).shape == (2, 1)
    assert whole_numbers(np.array([1, 2], np.uint8), (2,)).tolist() == [1, 2]


@pytest.mark.parametrize(
    ("name", "given", "expected"),
    [
        ("BeamSelection", {"scenario": None}, "scenario=None; write a path"),
        ("BeamSelection", {"scenario": "a\0b"}, r"scenario='a.x00b'; write a path"),
        ("BeamSelection", {"scenario": ""}, "scenario=''; write a path"),
        ("BeamSelection", {"scenario": "geometric", "observe": 3}, "observe=3: 3 is no text"),
        ("BeamSelection", {"scenario": "geometric", "observe": [3]}, "3 is no text"),
        ("BeamSelection", {"scenario": "geometric", "users": 3}, "users=3: 3 is no text"),
        ("BeamSelection", {"scenario": "geometric", "broker": 3}, "broker=3; write its address"),
        ("RadioStrike", {"episodes": 3}, "episodes=3; write a path, or a list"),
        ("RadioStrike", {"episodes": [3]}, "episodes has 3; write paths"),
        ("RadioStrike", {"users": 3}, "users=3: 3 is no text"),
        ("RadioStrike", {"users": ("uav", "car", "bus")}, r"users=\('uav', 'car', 'bus'\) is of a recording"),
        ("RadioStrike", {"base_station": "bs"}, "base_station='bs' is of a recording; name its directory"),
    ],
)
def test_an_environment_names_the_argument_that_is_wrong(
    name: str, given: dict[str, Any], expected: str
) -> None:
    with pytest.raises(ScenarioError, match=expected):
        gymnasium.make(f"caviar/{name}-v0", **given)
    if "broker" not in given:  # there vectors are refused for another reason
        with pytest.raises(ScenarioError, match=expected):
            gymnasium.make_vec(f"caviar/{name}-v0", num_envs=2, **given)


def test_a_scenario_without_a_link_is_refused_when_the_environment_is_made(tmp_path: Path) -> None:
    text = find_scenario("geometric").read_text().replace(', "link"', "")
    before, _, after = text.partition("[services.link]")
    file = tmp_path / "without.toml"
    file.write_text(before + after[after.index("[services.agent]") :])
    for make in (gymnasium.make, partial(gymnasium.make_vec, num_envs=2)):
        with pytest.raises(ScenarioError, match=r"without\.toml:\d+: services: .*link"):
            make("caviar/BeamSelection-v0", scenario=str(file))


def test_an_action_of_radio_strike_is_two_whole_numbers() -> None:
    env = gymnasium.make("caviar/RadioStrike-v0").unwrapped
    env.reset(seed=1)
    wrong: Any
    for wrong in ([0], [0, 1.5], "ab", None, [[0, 1]], [0, 1, 2], 5):
        with pytest.raises(PayloadError, match=r"write whole numbers of shape \[2\]"):
            env.step(wrong)
