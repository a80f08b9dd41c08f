"""``gymnasium.make_vec`` of ``caviar/BeamSelection-v0``: equal, bit by bit, to environments one by one."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from gymnasium.vector.utils import batch_space

import caviar_clients.envs  # noqa: F401  # registers the environments
from caviar_clients.envs.base import BeamSelectionEnv
from caviar_clients.envs.vector import BeamSelectionVectorEnv
from caviar_protocol.errors import PayloadError, RunError, ScenarioError

pytestmark = pytest.mark.slow

SCENARIOS = Path(__file__).parents[2] / "deploy" / "caviar_scenarios"
GEOMETRIC, SMOKE, FIG2 = (SCENARIOS / f"{name}.toml" for name in ("geometric", "smoke", "fig2"))
TWO_CARRIERS = SCENARIOS / "uav-base-station.toml"
NAME = "caviar/BeamSelection-v0"
PARTS = ("aoa", "aod", "position", "velocity", "last_abs_y", "last_rate", "last_beam")
SHORT = ("frames = 500", "frames = 12")


@contextmanager
def vector(num_envs: int, scenario: Path = GEOMETRIC, **options: Any) -> Iterator[BeamSelectionVectorEnv]:
    """A vector environment that is closed in the end."""
    with closing(BeamSelectionVectorEnv(num_envs, scenario, **{"observe": PARTS} | options)) as envs:
        yield envs


def changed(folder: Path, base: Path, *changes: tuple[str, str], extra: str = "") -> Path:
    """A shipped scenario with some text replaced, and some appended."""
    text = base.read_text()
    for old, new in changes:
        assert old in text, f"{old!r} is not in {base}"
        text = text.replace(old, new, 1)
    path = folder / "scenario.toml"
    path.write_text(text + extra)
    return path


def assert_same(found: Any, wanted: Any, where: str = "") -> None:
    """Equal in names, types, shapes and bits, of dictionaries all the way down."""
    if isinstance(wanted, dict):
        assert found.keys() == wanted.keys(), where
        for name, value in wanted.items():
            assert_same(found[name], value, f"{where}/{name}")
    elif wanted.dtype == object:
        for number, (one, other) in enumerate(zip(found, wanted, strict=True)):
            assert_same(one, other, f"{where}[{number}]")
    else:
        assert (found.dtype, found.shape) == (wanted.dtype, wanted.shape), where
        assert found.tobytes() == wanted.tobytes(), where


def assert_as_one_by_one(
    scenario: Path, num_envs: int, steps: int, seed: int, mode: AutoresetMode, **options: Any
) -> None:
    """The vector environment does what gymnasium's does with as many single environments."""
    options = {"observe": PARTS} | options
    single = [lambda: BeamSelectionEnv(scenario, **options)] * num_envs
    with (
        vector(num_envs, scenario, autoreset_mode=mode, **options) as envs,
        closing(SyncVectorEnv(single, autoreset_mode=mode)) as others,
    ):
        assert envs.observation_space == others.observation_space
        assert envs.action_space == others.action_space
        for one, other in zip(envs.reset(seed=seed), others.reset(seed=seed), strict=True):
            assert_same(one, other, "reset")
        envs.action_space.seed(seed)
        for step in range(steps):
            actions = envs.action_space.sample()
            for number, both in enumerate(zip(envs.step(actions), others.step(actions), strict=True)):
                assert_same(*both, f"step {step}, result {number}")


# --- equal to single environments ------------------------------------------------------------------------


@pytest.mark.parametrize("seed", [0, 77, 2**40])
def test_each_member_is_a_single_environment_of_its_seed(seed: int) -> None:
    assert_as_one_by_one(GEOMETRIC, 4, 50, seed, AutoresetMode.NEXT_STEP)


@pytest.mark.exhaustive
def test_a_hundred_members_are_single_environments_of_their_seeds() -> None:
    assert_as_one_by_one(GEOMETRIC, 100, 50, 1000, AutoresetMode.NEXT_STEP)


@pytest.mark.parametrize("mode", [AutoresetMode.NEXT_STEP, AutoresetMode.SAME_STEP])
def test_episodes_end_and_begin_as_those_of_single_environments(mode: AutoresetMode, tmp_path: Path) -> None:
    """Three episodes of 12 frames, with what gymnasium says about the last step of each."""
    assert_as_one_by_one(changed(tmp_path, GEOMETRIC, SHORT), 3, 38, 5, mode)


def test_a_whole_episode_is_equal_over_all_blocks_of_draws() -> None:
    assert_as_one_by_one(GEOMETRIC, 2, 510, 9, AutoresetMode.SAME_STEP)


@pytest.mark.parametrize("scenario", [SMOKE, FIG2, TWO_CARRIERS], ids=lambda file: file.stem)
@pytest.mark.parametrize("reward", ["normalised", "spectral_efficiency"])
def test_several_users_carriers_and_blocked_lines_are_equal(scenario: Path, reward: str) -> None:
    assert_as_one_by_one(scenario, 2, 15, 3, AutoresetMode.NEXT_STEP, reward=reward)


CHANGES: dict[str, tuple[Path, tuple[tuple[str, str], ...]]] = {
    "draws that last an episode": (GEOMETRIC, (SHORT, ('redraw = "frame"', 'redraw = "episode"'))),
    "a single component": (GEOMETRIC, (SHORT, ("components = 3", "components = 1"))),
    "many components, one element": (
        GEOMETRIC, (SHORT, ("components = 3", "components = 20"), ("columns = 64", "columns = 1")),
    ),
    "an odd array with patterns": (
        FIG2,
        (
            ("array = { rows = 8, columns = 8 }", 'array = { rows = 3, columns = 37, pattern = "tr38901" }'),
            ("array = { columns = 4 }", 'array = { columns = 3, pattern = "dipole" }'),
            ('normalization = "path-loss"', 'normalization = "path-loss"\natmosphere = {}'),
        ),
    ),
    "devices at one place": (
        GEOMETRIC, (SHORT, ("position_m = [0.0, 0.0, 20.0]", "position_m = [60.0, -25.0, 0.155]")),
    ),
}  # fmt: skip


@pytest.mark.parametrize("case", CHANGES)
def test_other_settings_are_equal_too(case: str, tmp_path: Path) -> None:
    base, changes = CHANGES[case]
    assert_as_one_by_one(changed(tmp_path, base, *changes), 3, 14, 11, AutoresetMode.SAME_STEP, reward="snr")


def test_some_users_are_served_and_the_others_are_not() -> None:
    options = {"users": "uav/*", "reward": "snr"}
    assert_as_one_by_one(SMOKE, 2, 5, 1, AutoresetMode.NEXT_STEP, **options)


def test_a_member_does_not_depend_on_how_many_there_are() -> None:
    def played(num_envs: int, seed: int, member: int) -> list[bytes]:
        with vector(num_envs) as envs:
            envs.reset(seed=seed)
            results = [envs.step(np.full(num_envs, 7 * step % 64)) for step in range(20)]
        return [
            rewards[member].tobytes() + found["last_rate"][member].tobytes() for found, rewards, *_ in results
        ]

    assert played(37, 100, 30) == played(1, 130, 0) == played(2, 129, 1)


# --- seeds -----------------------------------------------------------------------------------------------


def rewards_of(envs: BeamSelectionVectorEnv, **reset: Any) -> list[list[float]]:
    """Rewards of the first steps of an episode, step by step."""
    envs.reset(**reset)
    return [envs.step(np.full(envs.num_envs, 7 * step % 64))[1].tolist() for step in range(5)]


def test_seeds_may_be_given_one_by_one() -> None:
    with vector(3) as envs:
        counted, listed = rewards_of(envs, seed=4), rewards_of(envs, seed=[6, 5, 4])
        assert [step[::-1] for step in counted] == listed


def test_a_reset_without_a_seed_is_the_episode_that_follows() -> None:
    with vector(2) as envs, closing(BeamSelectionEnv(GEOMETRIC)) as single:
        rewards_of(envs, seed=4)
        found = rewards_of(envs, seed=[None, 9])
        single.reset(seed=4)
        single.reset()
        assert [step[0] for step in found] == [single.step(np.int64(7 * k % 64))[1] for k in range(5)]
        assert [step[1] for step in found] == [step[0] for step in rewards_of(envs, seed=9)]


def test_the_first_episodes_without_a_seed_are_those_of_the_scenarios_seed_and_up() -> None:
    with vector(3) as envs, vector(3) as others:
        assert rewards_of(envs) == rewards_of(others, seed=1), "run.seed is 1"


# --- the rules of gymnasium --------------------------------------------------------------------------------


def test_make_vec_makes_it_with_the_options_of_the_single_environment() -> None:
    envs = gymnasium.make_vec(NAME, num_envs=5, scenario=GEOMETRIC, observe=("aod",), reward="snr")
    with closing(envs):
        assert type(envs.unwrapped) is BeamSelectionVectorEnv
        assert envs.metadata["autoreset_mode"] is AutoresetMode.NEXT_STEP
        assert envs.single_action_space == spaces.Discrete(64)
        assert envs.observation_space == batch_space(envs.single_observation_space, 5)
        observation, infos = envs.reset(seed=1)
        assert envs.observation_space.contains(observation)
        assert infos["frame"].tolist() == [0] * 5
        for _ in range(3):
            observation, rewards, terminations, truncations, infos = envs.step(envs.action_space.sample())
            assert envs.observation_space.contains(observation)
            assert rewards.dtype == np.float64
            assert terminations.dtype == truncations.dtype == np.bool_
        assert (infos["abs_y"] <= infos["best_abs_y"]).all()


def test_what_was_returned_stays_as_it_is() -> None:
    """A learner keeps observations, and may write into them."""
    with vector(2) as envs:
        envs.reset(seed=1)
        first, rewards, *_, infos = envs.step(np.array([1, 2]))
        kept = {name: value.copy() for name, value in first.items()}, rewards.copy(), infos["abs_y"].copy()
        second, *_ = envs.step(np.array([3, 4]))
        assert_same(first, kept[0])
        assert (rewards == kept[1]).all()
        assert (infos["abs_y"] == kept[2]).all()
        for value in first.values():
            value[:] = 99
        envs.reset(seed=1)
        assert_same(envs.step(np.array([1, 2]))[0], kept[0])
        assert second["aoa"].max() < 99


def test_a_closed_environment_begins_again() -> None:
    with vector(2) as envs:
        first = rewards_of(envs, seed=3)
        envs.close()
        with pytest.raises(RunError, match=r"call reset\(\)"):
            envs.step(np.array([1, 2]))
        assert rewards_of(envs, seed=3) == first
        envs.close()
        with pytest.raises(RunError, match=r"call reset\(\)"):
            envs.step(np.array([1, 2]))


# --- mistakes ----------------------------------------------------------------------------------------

SECOND_AGENT = """
[services.second]
role = "agent"
use = "oracle"
budget_ms = 20
users = ["uav/*"]
"""


def test_a_world_that_differs_from_episode_to_episode_is_refused_with_the_remedy() -> None:
    with pytest.raises(ScenarioError, match=r"street-canyon\.toml.*'traffic'.*'sumo'") as error:
        gymnasium.make_vec(NAME, num_envs=2, scenario=SCENARIOS / "street-canyon.toml")
    for text in ("services.traffic.use", "SyncVectorEnv", 'vectorization_mode="sync"', "AsyncVectorEnv"):
        assert text in str(error.value)


@pytest.mark.parametrize(
    ("use", "named"),
    [
        ('use = "sionna-rt"', "channel 'channel' is 'sionna-rt'"),
        ('use = "remote"', "channel 'channel' is another program"),
        ('use = "mine:Mine"', "channel 'channel' is 'mine:Mine', which computes one episode at a time"),
    ],
)
def test_a_channel_that_is_computed_for_one_episode_at_a_time_is_refused(
    use: str, named: str, tmp_path: Path
) -> None:
    """A subclass of one that is computed for many, too: what it overrides would be left out."""
    (tmp_path / "mine.py").write_text(
        "from caviar_services.channel.statistical.free_space import FreeSpaceChannel\n\n\n"
        "class Mine(FreeSpaceChannel):\n    pass\n"
    )
    scenario = changed(tmp_path, SMOKE, ('use = "free-space"', use))
    with pytest.raises(ScenarioError) as error:
        BeamSelectionVectorEnv(2, scenario)
    assert named in str(error.value)


def test_an_agent_that_decides_beside_is_refused(tmp_path: Path) -> None:
    scenario = changed(
        tmp_path, SMOKE, ('use = "los-beam"', 'use = "los-beam"\nusers = ["car/*"]'), extra=SECOND_AGENT
    )
    with pytest.raises(ScenarioError, match="agent 'second' decides beside 'agent'"):
        BeamSelectionVectorEnv(2, scenario, agent="agent")


@pytest.mark.parametrize(
    ("options", "told"),
    [
        ({"num_envs": 0}, "num_envs=0; write a whole number from 1 to 65536"),
        ({"broker": "tcp://127.0.0.1:9"}, r"broker='tcp://127.0.0.1:9' is not for many.*SyncVectorEnv"),
        ({"directory": "run"}, r"directory='run' is not for many"),
        ({"render_mode": "rgb_array"}, r"render_mode='rgb_array' is not for many"),
        ({"autoreset_mode": AutoresetMode.DISABLED}, "write 'NextStep' or 'SameStep'"),
        ({"autoreset_mode": "next"}, "autoreset_mode='next'.*write 'NextStep' or 'SameStep'"),
        ({"observe": ("aoaa",)}, "did you mean 'aoa'"),
        ({"reward": "absy"}, "no reward is called 'absy'"),
    ],
)
def test_a_mistake_is_named_with_what_to_write(options: dict[str, Any], told: str) -> None:
    with pytest.raises(ScenarioError, match=told):
        BeamSelectionVectorEnv(**{"num_envs": 2, "scenario": GEOMETRIC} | options)


def test_sensors_are_not_observed_by_many(tmp_path: Path) -> None:
    lidar = '\n[[devices]]\nname = "l"\nkind = "lidar"\non = "uav"\nposition_m = [0.0, 0.0, 0.2]\n'
    service = (
        '\n[services.lidar]\nrole = "sensors"\nuse = "lidar"\nbudget_ms = 100\n[services.lidar.settings]\n'
        "grid = { minimum_m = [0, 0, 0], maximum_m = [10, 10, 10], cell_m = [1, 1, 1] }\n"
    )
    scenario = changed(tmp_path, GEOMETRIC, extra=lidar + service)
    with pytest.raises(ScenarioError, match=r"needs lidar.*one scene"):
        BeamSelectionVectorEnv(2, scenario, observe=("lidar_grid",))


@pytest.mark.parametrize(
    ("actions", "told"),
    [
        (np.array([1, 64]), r"member 1 is \[64\]; write numbers from 0 to 63"),
        (np.array([-1, 3]), r"member 0 is \[-1\]"),
        (np.array([1, 2, 3]), r"of shape \[3\]; write whole numbers of shape \[2\]"),
        (np.array([1.0, 2.0]), "float64 of shape"),
        (np.int64(3), r"of shape \[\]"),
    ],
)
def test_an_action_that_is_none_is_refused_and_the_episode_goes_on(actions: Any, told: str) -> None:
    with vector(2) as envs:
        envs.reset(seed=1)
        with pytest.raises(PayloadError, match=told):
            envs.step(actions)
        assert envs.step(np.array([1, 2]))[-1]["frame"].tolist() == [1, 1]


def test_seeds_and_options_that_cannot_be_are_refused() -> None:
    with vector(2) as envs:
        with pytest.raises(ScenarioError, match="seed has 3 numbers; write 2"):
            envs.reset(seed=[1, 2, 3])
        with pytest.raises(ScenarioError, match=rf"seed {2**63}; write whole numbers from 0 to 2\*\*63 - 1"):
            envs.reset(seed=2**63 - 1)
        with pytest.raises(ScenarioError, match=r"\['frames'\]; there are none"):
            envs.reset(options={"frames": 3})
        with pytest.raises(RunError, match=r"call reset\(\)"):
            envs.step(np.array([1, 2]))
