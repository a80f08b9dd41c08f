"""The pair of agents: PettingZoo's own checks, the parts of each agent, recordings, and mistakes."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from caviar_protocol.errors import PayloadError, RunError, ScenarioError
from caviar_protocol.recording import Recording

pytest.importorskip("pettingzoo", reason="PettingZoo is not installed")
from pettingzoo.test import parallel_api_test, parallel_seed_test

from caviar_clients.envs.pair import UavPairEnv

pytestmark = pytest.mark.slow

STILL = np.zeros(3, np.float32)


@contextmanager
def pair(**options: Any) -> Iterator[UavPairEnv]:
    with closing(UavPairEnv("uav-pair", **options)) as env:
        yield env


def episode(env: UavPairEnv, seed: int, beams: Callable[[int], int]) -> list[tuple[Any, ...]]:
    """What each step of an episode of at most 20 gives, the UAV flying east."""
    env.reset(seed=seed)
    told: list[tuple[Any, ...]] = []
    while env.agents and len(told) < 20:
        actions = {"pilot": np.array([1, 0, 0], np.float32), "beams": np.int64(beams(len(told)))}
        observations, rewards, terminations, truncations, infos = env.step(actions)
        plain = {name: {key: v.tolist() for key, v in seen.items()} for name, seen in observations.items()}
        told.append((plain, rewards, terminations, truncations, infos["pilot"]["distance_m"]))
    return told


def test_it_passes_the_checks_of_pettingzoo() -> None:
    with pair(flight={"deliveries": 3}) as env, warnings.catch_warnings():
        warnings.filterwarnings("ignore", "no options of reset are called")  # the check passes one
        parallel_api_test(env, num_cycles=150)
    parallel_seed_test(lambda: UavPairEnv("uav-pair", flight={"deliveries": 3}), num_cycles=150)


def test_each_agent_has_the_consequences_of_both() -> None:
    """The beams change |y| and the rate that the pilot is rewarded for; the flight is the same."""
    with pair() as env:
        good = episode(env, 3, lambda step: 0)
        other = episode(env, 3, lambda step: 16)
    assert [step[4] for step in good] == [step[4] for step in other]
    assert all(a[1]["beams"] != b[1]["beams"] for a, b in zip(good, other, strict=True))
    assert any(a[1]["pilot"] != b[1]["pilot"] for a, b in zip(good, other, strict=True))


def test_a_recorded_run_is_the_same_and_has_both_actions(tmp_path: Path) -> None:
    with pair() as env:
        here = episode(env, 5, lambda step: step)
    with pair(directory=tmp_path / "run") as env:
        recorded = episode(env, 5, lambda step: step)
    assert repr(recorded) == repr(here)
    actions = {
        product.provenance.source
        for frame in Recording(tmp_path / "run").frames()
        for product in frame.products
        if product.provenance.topic == "action"
    }
    assert actions == {"pilot", "beams"}


def test_the_episode_ends_for_both_with_the_last_frame() -> None:
    with pair() as env:
        env.reset(seed=2)
        steps = 0
        while env.agents:
            *_, truncations, _ = env.step({"pilot": STILL, "beams": np.int64(0)})
            steps += 1
        assert steps == 120
        assert truncations == {"pilot": True, "beams": True}
        with pytest.raises(RunError, match=r"call reset\(\)"):
            env.step({"pilot": STILL, "beams": np.int64(0)})


def test_mistakes_are_named() -> None:
    with pytest.raises(ScenarioError, match=r"its agents are: agent;.*none"):
        UavPairEnv("geometric")
    with pytest.raises(ScenarioError, match=r"pilot='beams'.*beams=None"):
        UavPairEnv("uav-pair", pilot="beams")
    with pair() as env:
        with pytest.raises(RunError, match=r"call reset\(\)"):
            env.step({"pilot": STILL, "beams": np.int64(0)})
        env.reset(seed=1)
        with pytest.raises(PayloadError, match=r"\['pilot'\].*one for 'pilot'"):
            env.step({"pilot": STILL})
        with pytest.raises(PayloadError, match="the action is"):
            env.step({"pilot": STILL, "beams": np.int64(32)})
        env.step({"pilot": STILL, "beams": np.int64(31)})
        with pytest.warns(UserWarning, match=r"\['strat'\].*start"):
            env.reset(seed=1, options={"strat": 1})


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        ({"scenario": None}, "scenario=None; write a path"),
        ({"flight": {"delivery": 2}}, "flight has no option 'delivery'; did you mean 'deliveries'"),
        ({"flight": [1]}, r"flight=\[1\]; write options by name"),
        ({"selection": {"obsrve": ("aod",)}}, "selection has no option 'obsrve'; did you mean 'observe'"),
        ({"selection": {"broker": "tcp://127.0.0.1:5570"}}, "selection has no option 'broker'"),
    ],
)
def test_options_that_are_not_there_are_named(options: dict[str, Any], expected: str) -> None:
    with pytest.raises(ScenarioError, match=expected):
        UavPairEnv(**{"scenario": "uav-pair", **options})


def test_actions_that_are_no_mapping_are_refused() -> None:
    with pair() as env, pytest.raises(PayloadError, match="actions are None; write one for 'pilot'"):
        env.step(None)  # type: ignore[arg-type]
