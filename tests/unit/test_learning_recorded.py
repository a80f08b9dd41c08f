"""Environments of recorded users: what they say is what a run with the same beams would say."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from msgspec.structs import replace
from recording_builders import record_run

import caviar_clients.envs as _registered  # noqa: F401
from caviar_clients.envs.base import BeamSelectionEnv
from caviar_clients.learning.recorded import RecordedBeamsEnv, RecordedBeamsVectorEnv
from caviar_clients.learning.tracks import read_tracks
from caviar_protocol.errors import CaviarError, PayloadError, RunError, ScenarioError
from caviar_protocol.observations import OBSERVATION_PARTS, is_feedback
from caviar_protocol.recording import Recording
from caviar_protocol.scenario import find_scenario, load_scenario, parse_scenario

FRAMES = 40
OBSERVED = ("departure", "position", "velocity", "last_abs_y", "last_beam", "last_rate")


@pytest.fixture(scope="module")
def geometric(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """Scenario and run of `geometric` with two episodes of 40 frames, some of them in the blocked range."""
    folder = tmp_path_factory.mktemp("geometric")
    text = find_scenario("geometric").read_text()
    text = text.replace("frames = 500", f"frames = {FRAMES}\nepisodes = 2").replace(
        "100_000_000", "1_000_000_000"
    )
    scenario = folder / "short.toml"
    scenario.write_text(text)
    record_run(folder / "run", parse_scenario(text, folder=folder))
    return scenario, folder / "run"


def smoke(folder: Path) -> Path:
    """A run of `smoke`: a car with 4 elements and a UAV with one, in 10 frames."""
    text = find_scenario("smoke").read_text().replace("frames = 100", "frames = 10")
    record_run(folder / "smoke", parse_scenario(text, folder=folder))
    return folder / "smoke"


def test_it_says_what_a_run_with_the_same_beams_says(geometric: tuple[Path, Path]) -> None:
    """Both episodes, step by step: observations, reward, |y|, best and straight pair, line of sight."""
    scenario, run = geometric
    live = BeamSelectionEnv(scenario, observe=OBSERVED, reward="normalised")
    recorded = RecordedBeamsEnv([run], observe=OBSERVED, reward="normalised")
    assert recorded.observation_space == live.observation_space
    assert recorded.action_space == live.action_space
    random, blocked = np.random.default_rng(5), 0
    seed = Recording(run).metadata.seed
    for episode in range(2):
        seen, _ = live.reset(seed=None if episode else seed)
        replayed, _ = recorded.reset(seed=1, options={"track": episode})
        for step in range(FRAMES):
            for name in OBSERVED:
                assert replayed[name].tolist() == seen[name].tolist(), (episode, step, name)
            beam = np.int64(random.integers(64))
            seen, reward, _, over, info = live.step(beam)
            replayed, other, _, ended, known = recorded.step(beam)
            assert (other, ended) == (pytest.approx(reward, rel=1e-12), over)
            for name in ("abs_y", "best_abs_y", "baseline_abs_y", "los"):
                assert known[name].tolist() == pytest.approx(info[name].tolist(), rel=1e-12), name
            blocked += not known["los"][0]
        assert over
    assert 4 < blocked < FRAMES
    live.close()


def test_it_keeps_the_rules_of_gymnasium_and_stable_baselines3(geometric: tuple[Path, Path]) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # about bounds that are infinite or wide
        env = gymnasium.make("caviar/RecordedBeams-v0", recordings=[geometric[1]])
        check_env(env.unwrapped, skip_render_check=True)
        checker = pytest.importorskip(
            "stable_baselines3.common.env_checker", reason="needs Stable-Baselines3"
        )
        checker.check_env(env.unwrapped)


def test_unit_channels_have_entries_of_mean_square_one(geometric: tuple[Path, Path]) -> None:
    _, run = geometric
    h = Recording(run)["channel"].h[:FRAMES, 0]  # Shape [F, 1, 64]
    rms = np.sqrt(np.mean(np.abs(h) ** 2, axis=(1, 2)))
    as_recorded = RecordedBeamsEnv([run], observe=("last_abs_y",))
    unit = RecordedBeamsEnv([run], observe=("last_abs_y",), normalization="unit")
    for env in (as_recorded, unit):
        env.reset(seed=1, options={"track": 0})
    for frame in range(FRAMES):
        beam = np.int64(7 * frame % 64)
        seen, reward, _, _, info = as_recorded.step(beam)
        scaled, scaled_reward, _, _, scaled_info = unit.step(beam)
        assert scaled_reward == pytest.approx(reward / rms[frame], rel=1e-9)
        assert scaled_info["best_abs_y"] == pytest.approx(info["best_abs_y"] / rms[frame], rel=1e-9)
        assert scaled["last_abs_y"] == seen["last_abs_y"]  # as a receiver measures it


def test_every_user_comes_once_before_one_comes_again(tmp_path: Path) -> None:
    """Three members, each with an order of its own; the same seeds lead to the same orders."""
    run = smoke(tmp_path)
    other = run.parent / "other"
    text = (
        find_scenario("smoke")
        .read_text()
        .replace("frames = 100", "frames = 10")
        .replace("seed = 1", "seed = 2")
    )
    record_run(other, parse_scenario(text, folder=tmp_path))
    orders = []
    for _ in range(2):
        env = RecordedBeamsVectorEnv(3, [run, other], observe=("position",), users="uav/*")
        assert [(track.recording.name, len(track)) for track in env.tracks.tracks] == [
            ("smoke", 10),
            ("other", 10),
        ]
        env.reset(seed=4)
        begun = [env._row.tolist()]
        for _ in range(3 * 11):
            _, _, _, over, _ = env.step(np.zeros(3, np.int64))
            if not over.any() and env._row[0] % 10 == 0:
                begun.append(env._row.tolist())
        orders.append(begun)
    assert orders[0] == orders[1]
    first, second, third, fourth = np.array(orders[0]).tolist()
    assert [a + b for a, b in zip(first, second, strict=True)] == [10, 10, 10]
    assert [a + b for a, b in zip(third, fourth, strict=True)] == [10, 10, 10]


@pytest.mark.parametrize("mode", ["NextStep", "SameStep"])
def test_episodes_end_and_begin_as_gymnasium_says(mode: str, geometric: tuple[Path, Path]) -> None:
    env: Any = gymnasium.make_vec(
        "caviar/RecordedBeams-v0",
        2,
        recordings=[geometric[1]],
        observe=("position", "last_beam"),
        autoreset_mode=mode,
    )
    first, _ = env.reset(seed=1, options={"tracks": [0, 0]})
    for frame in range(FRAMES):
        observation, reward, ended, over, info = env.step(np.array([3, 4]))
        assert over.all() == (frame == FRAMES - 1)
        assert not ended.any()
    assert reward.shape == (2,)
    if mode == "SameStep":
        last = info["final_obs"][1]
        assert last["last_beam"] == pytest.approx([5 / 64])
        assert info["final_info"]["abs_y"].shape == (2, 1)
    else:
        assert observation["last_beam"][1] == pytest.approx(5 / 64)
        observation, reward, _, over, info = env.step(np.array([3, 4]))
        assert reward.tolist() == [0.0, 0.0]
        assert not over.any()
        assert not info["_abs_y"].any()
    # The next episode is that of the other track; its first position is the same, and nothing was fed back.
    assert observation["last_beam"].tolist() == [[0.0], [0.0]]
    assert observation["position"].tolist() == first["position"].tolist()
    observation, *_ = env.step(np.array([0, 1]))
    assert observation["last_beam"].tolist() == [[1 / 64], [2 / 64]]


def test_dqn_of_stable_baselines3_trains_on_it(geometric: tuple[Path, Path]) -> None:
    library = pytest.importorskip("stable_baselines3")
    from caviar_clients.learning.vec_env import stable_baselines3_env

    env: Any = gymnasium.make_vec(
        "caviar/RecordedBeams-v0", 4, recordings=[geometric[1]], autoreset_mode="SameStep"
    )
    model = library.DQN("MultiInputPolicy", stable_baselines3_env(env), learning_starts=20, gamma=0.0)
    assert model.learn(208).num_timesteps == 208


def test_which_parts_are_fed_back() -> None:
    of_packets = ["last_throughput", "buffered", "waiting"]
    assert [n for n in OBSERVATION_PARTS if is_feedback(n)] == [
        "last_abs_y",
        "last_rate",
        "last_beam",
        *of_packets,
    ]
    assert not is_feedback("no_such_part")


@pytest.mark.parametrize(
    ("options", "error", "expected"),
    [
        ({"users": "bike/*"}, ScenarioError, "no receiver of .* is bike/"),
        ({"users": "*"}, CaviarError, "the arrays of .* are not those of"),
        ({"observe": ("aodd",)}, ScenarioError, "no observation is called 'aodd'; did you mean 'aod'"),
        ({"observe": "aod"}, ScenarioError, r"observe is the text 'aod'; write a tuple of names"),
        ({"observe": 3}, ScenarioError, "observe=3: 3 is no text"),
        ({"observe": [3]}, ScenarioError, "3 is no text"),
        ({"observe": []}, ScenarioError, "observe names no part"),
        ({"observe": ["buffered"]}, ScenarioError, "'buffered' is of packets, which are not replayed"),
        ({"reward": "delay"}, ScenarioError, "reward 'delay' is of packets, which are not replayed"),
        ({"users": 3}, ScenarioError, "users=3: 3 is no text"),
        ({"carrier": "none"}, ScenarioError, "is uav/. on carrier 'none'; name others"),
        ({"recordings": "runs/x"}, ScenarioError, "recordings is the text 'runs/x'"),
        ({"recordings": [3]}, ScenarioError, "3 is no text"),
        ({"autoreset_mode": "now"}, ScenarioError, "autoreset_mode='now'; write 'NextStep' or 'SameStep'"),
        ({"num_envs": 0}, ScenarioError, "num_envs=0; write a whole number from 1 to 65536"),
        ({"num_envs": 10**9}, ScenarioError, "write a whole number from 1 to 65536"),
        ({"reward": "rate"}, ScenarioError, "no reward is called 'rate'"),
        ({"normalization": "units"}, ScenarioError, "write 'recorded' or 'unit'"),
    ],
)
def test_what_does_not_fit_is_refused(
    options: dict[str, Any], error: type[Exception], expected: str, tmp_path: Path
) -> None:
    given = {"num_envs": 2, "recordings": [smoke(tmp_path)], "users": "uav/*"}
    with pytest.raises(error, match=expected):
        RecordedBeamsVectorEnv(**{**given, **options})


def test_a_recording_without_a_channel_is_refused(tmp_path: Path) -> None:
    scenario = load_scenario("smoke")
    services = {name: scenario.services[name] for name in ("world", "recorder")}
    record_run(tmp_path / "run", replace(scenario, services=services), frames=3, record=("scene",))
    with pytest.raises(CaviarError, match=r"frame 0.*record ="):
        read_tracks([tmp_path / "run"], ("aod",))


def test_actions_are_checked_and_an_episode_has_to_begin(geometric: tuple[Path, Path]) -> None:
    env = RecordedBeamsVectorEnv(2, [geometric[1]])
    with pytest.raises(RunError, match=r"call reset\(\)"):
        env.step(np.zeros(2, np.int64))
    env.reset(seed=1)
    with pytest.raises(PayloadError, match=r"member 1 is 64.*0 to 63"):
        env.step(np.array([0, 64]))
    with pytest.raises(PayloadError, match=r"whole numbers of shape \[2\]"):
        env.step(np.array([0.5, 1.0]))
    with pytest.raises(PayloadError, match=r"write whole numbers of shape \[2\]"):
        env.step([1, [2]])  # type: ignore[arg-type]
    with pytest.raises(ScenarioError, match="there is: tracks"):
        env.reset(options={"track": 1})


@pytest.mark.parametrize("tracks", [[0, 99], [0, -1], [0], 0, "ab", [], [0.5, 0], [0, 0, 0]])
def test_users_that_are_not_recorded_are_refused(tracks: Any, geometric: tuple[Path, Path]) -> None:
    env = RecordedBeamsVectorEnv(2, [geometric[1]])
    with pytest.raises(ScenarioError, match=r"2 whole numbers from 0 to \d+"):
        env.reset(options={"tracks": tracks})


@pytest.mark.parametrize("track", [99, -1, "a", 0.5, [0]])
def test_a_user_that_is_not_recorded_is_refused(track: Any, geometric: tuple[Path, Path]) -> None:
    env = RecordedBeamsEnv([geometric[1]])
    with pytest.raises(ScenarioError, match=r"; write a whole number from 0 to \d+"):
        env.reset(options={"track": track})
