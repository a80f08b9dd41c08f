"""The vector environment as Stable-Baselines3 takes it, beside one of single environments."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from caviar_clients.envs.base import BeamSelectionEnv
from caviar_clients.envs.vector import BeamSelectionVectorEnv
from caviar_clients.learning.vec_env import stable_baselines3_env
from caviar_protocol.errors import ScenarioError

stable_baselines3 = pytest.importorskip("stable_baselines3", reason="Stable-Baselines3 is not installed")
vec_env = pytest.importorskip("stable_baselines3.common.vec_env")

pytestmark = pytest.mark.slow

GEOMETRIC = Path(__file__).parents[2] / "deploy" / "caviar_scenarios" / "geometric.toml"
PARTS = ("aod", "last_abs_y")
FRAMES = 10


@pytest.fixture
def scenario(tmp_path: Path) -> Path:
    """Episodes of 10 frames."""
    path = tmp_path / "scenario.toml"
    path.write_text(GEOMETRIC.read_text().replace("frames = 500", f"frames = {FRAMES}"))
    return path


@pytest.fixture
def envs(scenario: Path) -> Iterator[Any]:
    """Four members."""
    made = BeamSelectionVectorEnv(4, scenario, observe=PARTS, autoreset_mode="SameStep")
    with closing(stable_baselines3_env(made)) as found:
        yield found


def test_it_steps_as_single_environments_do_with_their_last_observations(envs: Any, scenario: Path) -> None:
    """Two and a half episodes beside `DummyVecEnv`, which steps them one by one."""
    with closing(vec_env.DummyVecEnv([lambda: BeamSelectionEnv(scenario, observe=PARTS)] * 4)) as singles:
        for each in (envs, singles):
            each.seed(31)
        assert_same(envs.reset(), singles.reset())
        rng, ended = np.random.default_rng(2), 0
        for _ in range(25):
            actions = rng.integers(64, size=4)
            found, wanted = envs.step(actions), singles.step(actions)
            for one, other in zip(found, wanted, strict=True):
                assert_same(one, other)
            assert_same(envs.reset_infos, singles.reset_infos)
            if found[2].any():
                ended += 1
                assert all(info["TimeLimit.truncated"] for info in found[3])
                assert found[0]["last_abs_y"].max() == 0, "the next episode has begun"
                assert found[3][0]["terminal_observation"]["last_abs_y"] > 0, "the last one is not lost"
        assert ended == 2


def assert_same(found: Any, wanted: Any) -> None:
    """Equal to the bit, of dictionaries and lists all the way down."""
    if isinstance(wanted, dict):
        assert found.keys() == wanted.keys()
        for name in wanted:
            assert_same(found[name], wanted[name])
    elif isinstance(wanted, list):
        for one, other in zip(found, wanted, strict=True):
            assert_same(one, other)
    else:
        assert np.asarray(found).tobytes() == np.asarray(wanted).tobytes()


def test_ppo_trains_on_it(envs: Any) -> None:
    """A short flight stays near its best beam: the reward rises from that of random beams."""
    stable_baselines3.common.utils.set_random_seed(0)
    envs.seed(3)
    monitored = vec_env.VecMonitor(envs)
    model = stable_baselines3.PPO(
        "MultiInputPolicy", monitored, n_steps=60, batch_size=120, n_epochs=5, gamma=0.0, gae_lambda=0.0,
        seed=1, learning_rate=1e-2, policy_kwargs={"net_arch": [32]}, device="cpu",
    )  # fmt: skip
    rewards: list[float] = []
    model.learn(60 * 4 * 8, callback=lambda known, _: rewards.extend(known["rewards"].tolist()) or True)
    assert np.mean(rewards[-400:]) > 5 * np.mean(rewards[:400])
    assert all(np.isfinite(p.detach().numpy()).all() for p in model.policy.parameters())


def test_a_seed_is_for_one_reset(envs: Any) -> None:
    def first_rewards() -> list[float]:
        envs.reset()
        return [float(envs.step(np.full(4, 5))[1][0]) for _ in range(3)]

    envs.seed(8)
    first, second = first_rewards(), first_rewards()
    envs.seed(8)
    assert first_rewards() == first != second


def test_members_have_no_attributes_and_methods_of_their_own(envs: Any) -> None:
    assert envs.get_attr("num_envs") == [4] * 4
    assert envs.get_attr("num_envs", 2) == [4]
    assert envs.env_is_wrapped(vec_env.VecEnvWrapper) == [False] * 4
    assert not envs.has_attr("elephants")
    with pytest.raises(AttributeError, match="'reward' cannot be set"):
        envs.set_attr("reward", 3)
    with pytest.raises(AttributeError, match="'render' cannot be called"):
        envs.env_method("render")


def test_environments_that_begin_episodes_a_step_later_are_refused_with_what_to_write(scenario: Path) -> None:
    with closing(BeamSelectionVectorEnv(2, scenario)) as made, pytest.raises(ScenarioError) as error:
        stable_baselines3_env(made)
    assert 'make them with autoreset_mode="SameStep"' in str(error.value)
