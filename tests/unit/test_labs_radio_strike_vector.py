"""``caviar/RadioStrike-v0`` in a batch: each member is a single environment of its seed, to the last bit."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode, SyncVectorEnv, VectorEnv
from test_labs_radio_strike import short_episode

import caviar_clients.envs
from caviar_labs.radio_strike.env import RadioStrikeEnv
from caviar_labs.radio_strike.simulation import EpisodesOverError
from caviar_labs.radio_strike.vector_env import RadioStrikeVectorEnv
from caviar_protocol.errors import PayloadError, RunError, ScenarioError

pytestmark = pytest.mark.slow

gymnasium.register_envs(caviar_clients.envs)

SEEDS, STEPS = 100, 50
MODES = [AutoresetMode.NEXT_STEP, AutoresetMode.SAME_STEP]
EPISODES = [short_episode(number, steps=7 + 4 * number) for number in range(5)]


def batch(
    members: int, mode: AutoresetMode = AutoresetMode.NEXT_STEP, **options: Any
) -> RadioStrikeVectorEnv:
    """A batch by way of gymnasium's registry."""
    made = gymnasium.make_vec(
        "caviar/RadioStrike-v0", num_envs=members, autoreset_mode=mode, **{"episodes": EPISODES} | options
    )
    assert isinstance(made, RadioStrikeVectorEnv)
    return made


def looped(members: int, mode: AutoresetMode, **options: Any) -> VectorEnv[Any, Any, Any]:
    """Single environments in gymnasium's loop."""
    made = {"episodes": EPISODES} | options
    return SyncVectorEnv([lambda: RadioStrikeEnv(**made)] * members, autoreset_mode=mode)


def assert_same(one: Any, other: Any) -> None:
    """Equal to the last bit: values, kinds of numbers, keys."""
    if isinstance(other, dict):
        assert one.keys() == other.keys()
        for key in other:
            assert_same(one[key], other[key])
    elif isinstance(other, tuple):
        assert len(one) == len(other)
        for mine, expected in zip(one, other, strict=True):
            assert_same(mine, expected)
    elif other.dtype == object:
        for mine, expected in zip(one, other, strict=True):
            assert type(mine) is type(expected)
            assert np.array_equal(mine, expected)
    else:
        assert one.dtype == other.dtype
        assert one.tobytes() == other.tobytes()


@pytest.mark.parametrize("rules", ["legacy", "fixed"])
def test_members_have_the_numbers_of_single_environments_of_their_seeds(rules: Any) -> None:
    envs = batch(SEEDS, rules=rules, episodes=short_episode(1, steps=STEPS))
    singles = [RadioStrikeEnv(rules, episodes=short_episode(1, steps=STEPS)) for _ in range(SEEDS)]
    observations, _ = envs.reset(seed=1000)
    for seed, (observation, single) in enumerate(zip(observations, singles, strict=True), 1000):
        assert_same(observation, single.reset(seed=seed)[0])
    # As long as no member of `legacy` has ended, and would be reset in the next step.
    played = 20 if rules == "legacy" else STEPS
    drawn = np.random.default_rng(3).integers([3, 64], size=(played, SEEDS, 2))
    for actions in drawn:
        observations, rewards, terminated, truncated, infos = envs.step(actions)
        for member, single in enumerate(singles):
            observation, reward, ends, is_cut, info = single.step(actions[member])
            assert_same(observations[member], observation)
            assert (rewards[member], terminated[member], truncated[member]) == (reward, ends, is_cut)
            assert {key: infos[key][member] for key in info} == info


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("rules", ["legacy", "fixed"])
def test_it_returns_what_gymnasiums_loop_over_single_environments_does(
    rules: str, mode: AutoresetMode
) -> None:
    """Over many ends of episodes of different lengths, with all that `info` has."""
    envs, reference = batch(6, mode, rules=rules), looped(6, mode, rules=rules)
    assert envs.metadata["autoreset_mode"] is mode
    assert envs.observation_space == reference.observation_space
    assert envs.action_space == reference.action_space
    assert_same(envs.reset(seed=77), reference.reset(seed=77))
    random = np.random.default_rng(4)
    for _ in range(45):
        actions = random.integers([3, 64], size=(6, 2))
        assert_same(envs.step(actions), reference.step(actions))
    assert_same(envs.reset(seed=[1, None, 2, None, 3, 4]), reference.reset(seed=[1, None, 2, None, 3, 4]))
    assert_same(envs.step(actions), reference.step(actions))
    assert envs.np_random_seed == reference.np_random_seed


@pytest.mark.parametrize("mode", MODES)
def test_episodes_that_all_end_at_once_begin_anew_at_once(mode: AutoresetMode) -> None:
    envs, reference = (make(3, mode, steps=4) for make in (batch, looped))
    assert_same(envs.reset(seed=5), reference.reset(seed=5))
    for step in range(12):
        actions = np.full((3, 2), step % 3)
        assert_same(envs.step(actions), reference.step(actions))


def test_a_member_does_not_depend_on_the_size_of_the_batch() -> None:
    found = []
    for members in (1, 3, 64):
        envs = batch(members, AutoresetMode.SAME_STEP)
        envs.reset(seed=11)
        drawn = np.random.default_rng(5).integers([3, 64], size=(80, 2))
        found.append([envs.step(np.tile(action, (members, 1)))[1][0] for action in drawn])
    assert found[0] == found[1] == found[2]


def test_the_best_beams_are_those_of_single_environments() -> None:
    envs, single = batch(4, AutoresetMode.SAME_STEP), RadioStrikeEnv(episodes=EPISODES)
    envs.reset(seed=21)
    single.reset(seed=23)
    for step in range(60):
        observations, rewards, _, _, infos = envs.best_beam_step(np.full(4, step % 3))
        _, reward, _, truncated, info = single.best_beam_step(step % 3)
        of_member = infos["final_info"] if truncated else infos
        assert (rewards[2], of_member["best_beam"][2]) == (reward, info["best_beam"])
        if truncated:
            assert_same(observations[2], single.reset()[0])


def test_what_a_step_returns_stays_as_it_is() -> None:
    """A caller keeps observations and infos: neither later steps nor each other change them."""
    envs = batch(2)
    envs.reset(seed=1)
    actions = np.zeros((2, 2), np.int64)
    observations, rewards, _, _, infos = envs.step(actions)
    kept, reward = observations.copy(), rewards.copy()
    infos["bit_rate"][:] = -1
    for _ in range(3):
        envs.step(actions)
    assert_same((observations, rewards), (kept, reward))


def test_without_a_seed_members_differ_from_each_other_and_from_run_to_run() -> None:
    # Of many frames: in a single one two members may well be blocked alike, and have the same reward.
    rewards = []
    for _ in range(2):
        envs = batch(2)
        envs.reset()
        rewards += list(zip(*[envs.step(np.ones((2, 2), np.int64))[1] for _ in range(7)], strict=True))
    assert len(set(rewards)) == 4


def test_stable_baselines3_trains_on_it() -> None:
    learners = pytest.importorskip("stable_baselines3", reason="needs the extra `learning`")
    from caviar_clients.learning.vec_env import stable_baselines3_env

    made = stable_baselines3_env(batch(4, AutoresetMode.SAME_STEP, steps=5))
    assert learners.A2C("MlpPolicy", made, n_steps=4, device="cpu").learn(64).num_timesteps == 64
    made.close()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"members": 0}, "num_envs=0"),
        ({"mode": AutoresetMode.DISABLED}, "autoreset_mode=.*write one of NextStep, SameStep"),
        ({"rules": "mended"}, "rules='mended'"),
    ],
)
def test_a_wrong_argument_is_refused(arguments: dict[str, Any], message: str) -> None:
    with pytest.raises(ScenarioError, match=message):
        batch(**{"members": 2} | arguments)


def test_wrong_actions_and_seeds_are_refused_with_the_member() -> None:
    envs = batch(3)
    with pytest.raises(RunError, match=r"call reset\(\)"):
        envs.step(np.zeros((3, 2), np.int64))
    with pytest.raises(ScenarioError, match="seed has 2 numbers; write 3"):
        envs.reset(seed=[1, 2])
    envs.reset(seed=1)
    with pytest.raises(ScenarioError, match=r"action \[0, 64\] of member 1"):
        envs.step(np.array([[0, 0], [0, 64], [0, 0]]))
    with pytest.raises(ScenarioError, match=r"action \[-1, 3\] of member 2"):
        envs.step(np.array([[0, 0], [0, 1], [-1, 3]]))
    with pytest.raises(PayloadError, match=r"int64 of shape \[2, 2\].*\[3, 2\]"):
        envs.step(np.zeros((2, 2), np.int64))


def test_a_batch_of_legacy_ends_where_the_episodes_do() -> None:
    envs = batch(2, AutoresetMode.SAME_STEP, rules="legacy", episodes=short_episode(0, steps=3))
    envs.reset(seed=1)
    for _ in range(3):
        envs.step(np.array([[0, 0], [1, 0]]))
    with pytest.raises(EpisodesOverError, match="uav1 is at the end"):
        envs.step(np.array([[0, 0], [2, 0]]))
