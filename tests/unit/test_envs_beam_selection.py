"""``caviar/BeamSelection-v0`` as gymnasium and a learner see it, in one process."""

from __future__ import annotations

import copy
import itertools
import math
import pickle
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.utils.env_checker import check_env

import caviar_clients.envs  # noqa: F401  # registers the environments
from caviar_clients.envs.base import BeamSelectionEnv
from caviar_protocol.errors import CaviarError, PayloadError, RunError, ScenarioError
from caviar_protocol.recording import Recording
from caviar_protocol.space.beams import straight_beams
from caviar_protocol.space.scene import directions
from caviar_protocol.topics import Action, BeamChoice, Link

pytestmark = pytest.mark.slow

SCENARIOS = Path(__file__).parents[2] / "deploy" / "caviar_scenarios"
GEOMETRIC, SMOKE = SCENARIOS / "geometric.toml", SCENARIOS / "smoke.toml"
PARTS = ("aoa", "aod", "position", "velocity", "last_abs_y")
BEAMS = 64
NOISE_FIGURE_DB = 9.0  # of the link, unless the scenario says otherwise


@contextmanager
def environment(scenario: Path = GEOMETRIC, **options: Any) -> Iterator[BeamSelectionEnv]:
    """An environment that is closed in the end."""
    with closing(BeamSelectionEnv(scenario, **{"observe": PARTS} | options)) as env:
        yield env


def changed(folder: Path, base: Path, *changes: tuple[str, str], extra: str = "") -> Path:
    """A shipped scenario with some text replaced, and some appended."""
    text = base.read_text()
    for old, new in changes:
        assert old in text, f"{old!r} is not in {base}"
        text = text.replace(old, new, 1)
    path = folder / "scenario.toml"
    path.write_text(text + extra)
    return path


def play(env: BeamSelectionEnv, steps: int, seed: int | None = None) -> tuple[list[float], list[float]]:
    """Rewards, and the numbers of all observations in one list, of the first steps of an episode."""
    observation, _ = env.reset(seed=seed)
    rewards, numbers = [], flat(observation)
    for index in range(steps):
        observation, reward, *_ = env.step(np.int64(7 * index % BEAMS))
        rewards.append(reward)
        numbers += flat(observation)
    return rewards, numbers


def flat(observation: dict[str, Any]) -> list[float]:
    """All numbers of an observation."""
    return [number for name in sorted(observation) for number in observation[name].ravel().tolist()]


# --- the rules of gymnasium ----------------------------------------------------------------------------


def test_it_keeps_the_rules_that_gymnasium_checks() -> None:
    with environment(render_mode="rgb_array") as env:
        check_env(env, skip_render_check=True)


def test_it_keeps_the_rules_that_stable_baselines3_checks() -> None:
    checker = pytest.importorskip(
        "stable_baselines3.common.env_checker", reason="Stable-Baselines3 is not installed"
    )
    with environment() as env:
        checker.check_env(env)


def test_it_is_made_by_name() -> None:
    env = gymnasium.make("caviar/BeamSelection-v0", scenario=GEOMETRIC, observe=PARTS)
    with closing(env):
        observation, _ = env.reset(seed=1)
        assert env.observation_space.contains(observation)
        assert env.action_space == spaces.Discrete(BEAMS)


# --- episodes ------------------------------------------------------------------------------------------


def test_a_seed_repeats_an_episode_in_the_same_environment_and_in_another_one() -> None:
    with environment() as env, environment() as other:
        first = play(env, 50, seed=5)
        assert play(env, 50, seed=5) == first
        assert play(other, 50, seed=5) == first
        assert len(set(first[0])) == 50, "the channel is drawn anew every frame"


@pytest.mark.parametrize("taken", [copy.deepcopy, lambda env: pickle.loads(pickle.dumps(env))])  # noqa: S301
def test_a_copy_begins_an_episode_of_its_own(taken: Any) -> None:
    with closing(gymnasium.make("caviar/BeamSelection-v0", scenario="geometric")) as env:
        env.reset(seed=3)
        with closing(taken(env)) as other:
            with pytest.raises(RunError, match=r"call reset\(\)"):
                other.unwrapped.step(np.int64(0))
            observation, _ = other.reset(seed=4)
            env.step(np.int64(0))  # that of the first goes on
            assert observation["aoa"] == env.reset(seed=4)[0]["aoa"]


def test_another_seed_gives_another_episode() -> None:
    with environment() as env:
        first, second = play(env, 50, seed=5)[0], play(env, 50, seed=6)[0]
    assert not set(first) & set(second)


def test_without_a_seed_the_next_episode_differs_and_follows_from_the_last_seed() -> None:
    with environment() as env:
        first, second, third = (play(env, 50, seed)[0] for seed in (5, None, None))
        assert not set(first) & set(second)
        assert not set(second) & set(third)
        again = [play(env, steps, seed)[0] for steps, seed in ((3, 5), (50, None), (50, None))]
    assert again == [first[:3], second, third], "however long the episodes were"


def test_the_first_episode_without_a_seed_is_that_of_the_scenario() -> None:
    with environment() as env, environment() as other:
        assert play(env, 5) == play(other, 5)
        assert play(other, 5, seed=1) == play(env, 5, seed=1), "run.seed is 1"


def test_a_reset_in_the_middle_begins_at_frame_0() -> None:
    with environment() as env:
        whole = play(env, 20, seed=9)
        env.reset(seed=3)
        for _ in range(7):
            env.step(np.int64(1))
        _, info = env.reset(seed=9)
        assert info == {"frame": 0, "t_ns": 0}
        assert env.reset(seed=9)[1] == info, "reset twice in a row, too"
        assert play(env, 20, seed=9) == whole


def test_an_episode_is_truncated_after_its_last_frame_and_shows_that_frame_last(tmp_path: Path) -> None:
    frames = 12
    scenario = changed(tmp_path, GEOMETRIC, ("frames = 500", f"frames = {frames}"))
    with environment(scenario) as env:
        env.reset(seed=1)
        steps = [env.step(np.int64(index)) for index in range(frames)]
        with pytest.raises(RunError, match=r"the episode is over.*call reset\(\)"):
            env.step(np.int64(0))
        _, info = env.reset()
        assert info["frame"] == 0
        env.step(np.int64(0))
    assert [truncated for _, _, _, truncated, _ in steps] == [False] * (frames - 1) + [True]
    assert not any(terminated for _, _, terminated, _, _ in steps)
    (before, *_), (last, reward, _, _, info) = steps[-2:]
    for name in ("position", "velocity", "aoa", "aod"):
        assert last[name].tolist() == before[name].tolist(), f"{name} of the last frame"
    assert last["last_abs_y"] == pytest.approx(reward, rel=1e-6), "and its link"
    assert info["abs_y"].tolist() == [reward]


def test_a_seed_after_a_whole_episode_repeats_one_as_well(tmp_path: Path) -> None:
    with environment(changed(tmp_path, GEOMETRIC, ("frames = 500", "frames = 6"))) as env:
        first = play(env, 6, seed=3)
        assert play(env, 6, seed=8) != first
        assert play(env, 6, seed=3) == first
        following = play(env, 6)
        assert play(env, 6, seed=3) == first
        assert play(env, 6) == following


def test_the_clock_of_an_episode_is_that_of_the_run() -> None:
    with environment() as env:
        env.reset(seed=1)
        infos = [env.step(np.int64(0))[4] for _ in range(3)]
    assert [(info["frame"], info["t_ns"]) for info in infos] == [
        (1, 100_000_000),
        (2, 200_000_000),
        (3, 300_000_000),
    ]


def test_stepping_before_the_first_reset_says_what_to_do() -> None:
    with environment() as env, pytest.raises(RunError, match=r"none has begun; call reset\(\)"):
        env.step(np.int64(0))


def test_stepping_after_close_says_what_to_do_and_a_reset_begins_a_new_run() -> None:
    env = BeamSelectionEnv(GEOMETRIC, observe=PARTS)
    rewards = play(env, 5, seed=2)
    env.close()
    env.close()  # again: nothing
    with pytest.raises(RunError, match=r"call reset\(\)"):
        env.step(np.int64(0))
    with closing(env):
        assert play(env, 5, seed=2) == rewards


def test_a_run_that_failed_is_blamed_at_every_further_call() -> None:
    with environment() as env:
        env.reset(seed=1)
        env._sizes = [BEAMS + 1]  # so that a beam that does not exist gets as far as the link
        for call in (lambda: env.step(np.int64(BEAMS)), lambda: env.step(np.int64(0)), lambda: env.reset()):
            with pytest.raises(RunError, match=r"'agent'.*TX beam 64"):
                call()


# --- observations and rewards ----------------------------------------------------------------------------


def test_the_last_magnitude_is_that_of_the_frame_before_and_0_in_frame_0() -> None:
    with environment() as env:
        observation, _ = env.reset(seed=1)
        assert observation["last_abs_y"] == 0
        for beam in range(10):
            observation, reward, *_ = env.step(np.int64(beam))
            assert observation["last_abs_y"] == pytest.approx([reward], rel=1e-6)


def test_observations_that_were_handed_out_do_not_change() -> None:
    with environment() as env:
        kept = [env.reset(seed=1)[0]] + [env.step(np.int64(0))[0] for _ in range(3)]
        numbers = [flat(observation) for observation in kept]
        for _ in range(5):
            env.step(np.int64(1))
        assert [flat(observation) for observation in kept] == numbers


def rewards_of(kind: str, scenario: Path = GEOMETRIC, steps: int = 30) -> list[tuple[float, dict[str, Any]]]:
    """Reward and info of the first steps of an episode."""
    with environment(scenario, reward=kind) as env:
        env.reset(seed=4)
        found = [env.step(np.int64(5 * index % BEAMS)) for index in range(steps)]
    return [(reward, info) for _, reward, _, _, info in found]


def test_reward_abs_y_is_the_magnitude_of_the_chosen_pair() -> None:
    for reward, info in rewards_of("abs_y"):
        assert [reward] == info["abs_y"].tolist()
        assert 0 < reward <= info["best_abs_y"][0]


def test_reward_normalised_is_the_share_of_the_best_pair(tmp_path: Path) -> None:
    """Also where the line of sight is blocked, and the pair along it is not the best one."""
    blocked = changed(tmp_path, GEOMETRIC, ("[20.0, 30.0]", "[-90.0, 90.0]"))
    found = rewards_of("normalised", blocked)
    assert any(info["best_abs_y"][0] > 2 * info["baseline_abs_y"][0] for _, info in found)
    for reward, info in found + rewards_of("normalised"):
        assert reward == pytest.approx(info["abs_y"][0] / info["best_abs_y"][0], rel=1e-12)
        assert 0 < reward <= 1


def test_reward_snr_is_power_over_thermal_noise() -> None:
    """−75 dBm over k·T·B with T = 290 K, B = 100 MHz and the link's noise figure, which is one factor."""
    factors = [reward / info["abs_y"][0] ** 2 for reward, info in rewards_of("snr")]
    assert factors == pytest.approx([factors[0]] * len(factors), rel=1e-9)
    noise_figure_db = 10 * math.log10(10**-10.5 / (1.380649e-23 * 290.0 * 100e6) / factors[0])
    assert noise_figure_db == pytest.approx(NOISE_FIGURE_DB, abs=0.05)


def test_reward_spectral_efficiency_is_that_of_shannon() -> None:
    snr = [reward for reward, _ in rewards_of("snr")]
    efficiency = [reward for reward, _ in rewards_of("spectral_efficiency")]
    assert efficiency == pytest.approx([math.log2(1 + value) for value in snr], rel=1e-12)


def test_the_best_of_all_beams_earns_what_info_calls_the_best() -> None:
    with environment(reward="normalised") as env:
        rewards = []
        for beam in range(BEAMS):
            env.reset(seed=11)
            rewards.append(env.step(np.int64(beam))[1])
    assert max(rewards) == pytest.approx(1.0, rel=1e-12)
    assert sorted(rewards)[-2] < 1.0


def test_the_reward_of_several_users_is_their_mean() -> None:
    with environment(SMOKE) as env:
        env.reset(seed=1)
        for index in range(10):
            _, reward, _, _, info = env.step(np.array([9 * index, 3 * index]))
            assert len(info["abs_y"]) == 2
            assert reward == pytest.approx(float(np.mean(info["abs_y"])), rel=1e-12)


def test_users_who_are_not_served_do_not_count() -> None:
    with environment(SMOKE, users="uav/*") as env:
        env.reset(seed=1)
        _, reward, _, _, info = env.step(np.int64(3))
    assert info["abs_y"][0] == 0, "car/rx has no beams"
    assert reward == info["abs_y"][1] > 0


# --- actions -------------------------------------------------------------------------------------------


def chosen(folder: Path, frames: int) -> list[tuple[str, int, int]]:
    """(receiver, TX beam, RX beam) of the choices of the first frames of a recording."""
    recording = Recording(folder)
    return [
        (command.rx, command.tx_beam, command.rx_beam)
        for frame in range(frames)
        for command in recording.frame(0, frame).payloads("action", Action)["agent"].commands
        if isinstance(command, BeamChoice)
    ]


@pytest.mark.parametrize(
    ("users", "beams"), [("*/rx", (32, 4)), ("uav/rx-uav", (32, 1)), (["*/rx", "none"], (32, 4))]
)
def test_an_action_is_an_index_of_a_pair_of_beams(
    tmp_path: Path, users: str | list[str], beams: tuple[int, int]
) -> None:
    tx, rx = beams
    wanted = [(5, 0), (0, rx - 1), (31, rx - 1), (17, rx // 2)]
    with environment(SMOKE, users=users, directory=tmp_path / "run") as env:
        assert env.action_space == spaces.Discrete(tx * rx)
        assert env.observation_space["aoa"].shape == (1,)
        env.reset(seed=1)
        for tx_beam, rx_beam in wanted:
            env.step(np.int64(tx_beam * rx + rx_beam))
    name = "uav/rx-uav" if rx == 1 else "car/rx"
    assert chosen(tmp_path / "run", len(wanted)) == [(name, *pair) for pair in wanted]


def test_two_users_are_two_places_by_name(tmp_path: Path) -> None:
    with environment(SMOKE, directory=tmp_path / "run") as env:
        assert env.action_space == spaces.MultiDiscrete([128, 32])
        assert env.observation_space["position"].shape == (6,)
        env.reset(seed=1)
        env.step(np.array([4 * 19 + 3, 30]))
    assert chosen(tmp_path / "run", 1) == [("car/rx", 19, 3), ("uav/rx-uav", 30, 0)]


@pytest.mark.parametrize("action", [np.int64(64), -1, 1.5, "x", np.array([1, 2])])
def test_an_action_that_is_no_pair_is_refused_by_value_and_the_episode_goes_on(action: Any) -> None:
    with environment() as env, environment() as other:
        env.reset(seed=1)
        other.reset(seed=1)
        with pytest.raises(PayloadError, match=r"bs → uav/rx.*from 0 to 63") as error:
            env.step(action)
        assert " ".join(repr(action).split()) in str(error.value)
        assert env.step(np.int64(3))[1] == other.step(np.int64(3))[1]


@pytest.mark.parametrize("action", [5, np.array([1]), np.array([128, 0]), np.array([0, -1]), [0.5, 1]])
def test_an_action_of_several_users_has_an_index_for_each(action: Any) -> None:
    with environment(SMOKE) as env:
        env.reset(seed=1)
        with pytest.raises(PayloadError, match=r"2 ints.*0 to 127.*0 to 31") as error:
            env.step(action)
        text = str(error.value)
        if np.size(action) == 2:
            assert any(
                place in text for place in ("at place 0 (bs → car/rx)", "at place 1 (bs → uav/rx-uav)")
            )


# --- packets ---------------------------------------------------------------------------------------------

CELL = SCENARIOS / "cell.toml"


def served_by_the_best(env: BeamSelectionEnv, steps: int) -> Iterator[tuple[float, dict[str, Any], Link]]:
    """Reward, information and link of steps in which every user has the beams of the straight line."""
    env.reset(seed=2)
    for _ in range(steps):
        moment = env._moment
        assert moment is not None
        action = [0] * len(env.users)
        for place, pair in moment.users:
            ends = directions(moment.scene, [pair])
            tx, rx = straight_beams(pair.tx.array, ends[0][0], pair.rx.array, ends[1][0])
            action[place] = tx * pair.rx.array.size + rx
        _, reward, _, _, info = env.step(np.array(action))
        assert env._moment is not None
        assert env._moment.link is not None
        yield reward, info, env._moment.link


@pytest.mark.parametrize("kind", ["throughput", "delay"])
def test_packets_are_rewarded_over_the_users_that_are_served(kind: str) -> None:
    """Against sums of their own over the receivers, of which one transmitter serves each."""
    with environment(CELL, reward=kind, observe=("aod", "buffered", "waiting", "last_throughput")) as env:
        rewards = []
        for reward, info, link in served_by_the_best(env, 12):
            rewards.append(reward)
            assert link.serving is not None
            receivers = sorted(set(link.rx))
            assert sorted(np.array(link.rx)[link.serving].tolist()) == receivers
            figures = {"throughput": 0.0, "delay": 0.0}
            for rx in receivers:
                rows = [u for u, name in enumerate(link.rx) if name == rx]
                figures["throughput"] += sum(info["throughput"][rows]) / 1e6
                figures["delay"] -= 1e3 * max(sum(info["delay"][rows]), sum(info["waiting"][rows]))
            assert reward == pytest.approx(figures[kind] / len(receivers))
        assert (min(rewards) > 0) if kind == "throughput" else (max(rewards) <= 0 > min(rewards))


def test_what_waits_is_observed_before_it_is_decided_upon() -> None:
    """Two transmitters: the one that serves a receiver has its buffer, the other one nothing."""
    with environment(CELL, observe=("buffered", "last_throughput")) as env:
        for _, info, _ in served_by_the_best(env, 5):
            assert env._moment is not None
            seen = env._observation(env._moment)
            assert env.observation_space.contains(seen)
            assert seen["buffered"].sum() == pytest.approx(info["buffered"].sum() / 1e6, rel=1e-6)
            assert seen["last_throughput"].sum() == pytest.approx(info["throughput"].sum() / 1e6, rel=1e-6)


@pytest.mark.parametrize("options", [{"reward": "delay"}, {"observe": ("buffered",)}])
def test_packets_are_not_for_a_link_that_sends_none(options: dict[str, Any]) -> None:
    with pytest.raises(ScenarioError, match=r"packets.*'link' is 'beams'") as error:
        BeamSelectionEnv(GEOMETRIC, **options)
    assert 'use = "cell"' in str(error.value)


# --- mistakes --------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("options", "told"),
    [
        ({"users": "train*"}, ["no receiver of the scenario is train*", "uav/rx"]),
        ({"users": ("car/*", "x")}, ["car/* or x", "there are: uav/rx"]),
        ({"observe": ("aoa", "aoaa")}, ["'aoaa'", "did you mean 'aoa'?", "last_abs_y"]),
        ({"observe": ("camera",)}, ["'camera'", "no device of kind 'camera'"]),
        ({"observe": ("aoa:left",)}, ["'aoa:left'", "write 'aoa'"]),
        ({"observe": ()}, ["write observe=('aoa',)"]),
        ({"observe": "aod"}, ["observe is the text 'aod'", "observe=('aod',)"]),
        ({"reward": "absy"}, ["'absy'", "abs_y, normalised, snr, spectral_efficiency"]),
        ({"agent": "agnet"}, ["'agnet'", "its agents are: agent"]),
        ({"agent": "link"}, ["no agent 'link'", "its agents are: agent"]),
        ({"render_mode": "human"}, ["'human'", "write 'rgb_array' or None"]),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, dict) else "",
)
def test_a_mistake_is_named_with_what_to_write(options: dict[str, Any], told: list[str]) -> None:
    with pytest.raises(ScenarioError) as error, environment(**options):
        pass
    for text in told:
        assert text in str(error.value)


@pytest.mark.parametrize("seed", [2**63, 2**64])
def test_a_seed_that_no_run_can_have_is_refused_and_the_environment_goes_on(seed: int) -> None:
    with environment() as env:
        env.reset(seed=1)
        with pytest.raises(PayloadError, match=rf"seed={seed}; write a whole number from 0 to 2\*\*63 - 1"):
            env.reset(seed=seed)
        assert env.reset(seed=2**63 - 1)[1]["frame"] == 0


def test_options_of_reset_are_refused_by_name() -> None:
    with environment() as env, pytest.raises(ScenarioError, match=r"\['frames'\].*in the scenario"):
        env.reset(options={"frames": 3})


def test_a_connected_environment_does_not_record_here() -> None:
    env = BeamSelectionEnv(GEOMETRIC, broker="tcp://127.0.0.1:9", directory="run")
    with closing(env), pytest.raises(ScenarioError, match="leave directory=… out"):
        env.reset()


SECOND_AGENT = """
[services.second]
role = "agent"
use = "oracle"
budget_ms = 20
users = ["uav/*"]
"""


def two_agents(folder: Path) -> Path:
    """The car is the first agent's, the UAV the second's."""
    return changed(
        folder, SMOKE, ('use = "los-beam"', 'use = "los-beam"\nusers = ["car/*"]'), extra=SECOND_AGENT
    )


def test_with_two_agents_one_has_to_be_named(tmp_path: Path) -> None:
    with pytest.raises(ScenarioError, match=r"agent=….*agent, second"):
        BeamSelectionEnv(two_agents(tmp_path))


def test_the_agent_that_is_named_is_taken_and_the_other_one_decides_for_itself(tmp_path: Path) -> None:
    with environment(two_agents(tmp_path), agent="agent", users="car/*", reward="normalised") as env:
        env.reset(seed=1)
        _, reward, _, _, info = env.step(np.int64(77))
    assert 0 < reward < 1
    assert info["abs_y"][1] == pytest.approx(info["best_abs_y"][1]), "the oracle's beams are the best ones"


def test_errors_are_of_the_project() -> None:
    with pytest.raises(CaviarError, match=r"nowhere\.toml: cannot be read"):
        BeamSelectionEnv("nowhere.toml")


# --- pictures and recordings -----------------------------------------------------------------------------


def test_pictures_have_one_size_and_change_from_frame_to_frame() -> None:
    pytest.importorskip("matplotlib", reason="Matplotlib is not installed")
    with environment(render_mode="rgb_array") as env:
        assert env.render() is None, "there is nothing to see yet"
        env.reset(seed=1)
        pictures = [env.render()]
        for beam in (0, 9):
            env.step(np.int64(beam))
            pictures.append(env.render())
    assert [(p.shape, p.dtype) for p in pictures] == [((480, 640, 3), np.uint8)] * 3
    assert all((a != b).any() for a, b in itertools.pairwise(pictures))


def test_without_a_render_mode_there_is_no_picture() -> None:
    with environment() as env:
        env.reset(seed=1)
        assert env.render() is None


def test_a_directory_is_recorded_into_and_can_be_read(tmp_path: Path) -> None:
    with environment(directory=tmp_path / "run") as env:
        rewards, _ = play(env, 6, seed=1)
        env.reset(seed=2)
        env.step(np.int64(0))
    recording = Recording(tmp_path / "run")
    assert len(recording) >= 7
    found = [recording.frame(0, frame).payloads("link", Link)["link"].abs_y.tolist() for frame in range(6)]
    assert found == [[reward] for reward in rewards]


def test_without_a_directory_no_file_is_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    with environment() as env:
        play(env, 6, seed=1)
        play(env, 6)
    assert list(tmp_path.iterdir()) == []


def test_recorded_and_unrecorded_episodes_are_equal(tmp_path: Path) -> None:
    with environment(directory=tmp_path / "run") as recorded, environment() as env:
        for seed in (3, None):
            assert play(recorded, 20, seed) == play(env, 20, seed)
