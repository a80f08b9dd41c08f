"""``caviar/RadioStrike-v0``: both rules against a second implementation, and the contract of gymnasium."""

from __future__ import annotations

import csv
import math
import warnings
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from radio_strike_reference import Fixed, Legacy

import caviar_clients.envs
from caviar_labs.radio_strike.draws import BlockDraws
from caviar_labs.radio_strike.env import RadioStrikeEnv
from caviar_labs.radio_strike.rules import FIXED, LEGACY, Rays, magnitudes, straight_lines
from caviar_labs.radio_strike.simulation import EpisodesOverError
from caviar_labs.radio_strike.sources import synthetic_episode
from caviar_labs.radio_strike.trajectories import Episode, read_episode
from caviar_protocol.errors import RunError, ScenarioError
from caviar_protocol.space.antenna_arrays import dft_codebook, steering_vector
from caviar_protocol.topics import AntennaArray

pytestmark = pytest.mark.slow

gymnasium.register_envs(caviar_clients.envs)

STEPS = 10_000
WITHIN = 1e-12


def short_episode(number: int, steps: int = 40) -> Episode:
    """The beginning of a flight, each user from another instant on."""
    position = synthetic_episode(number).position
    return Episode(f"test {number}", np.stack([position[9 * u : 9 * u + steps, u] for u in range(3)], axis=1))


def actions(count: int, seed: int) -> list[list[int]]:
    """Random users and beams."""
    drawn: list[list[int]] = np.random.default_rng(seed).integers([3, 64], size=(count, 2)).tolist()
    return drawn


def assert_same(returned: tuple[Any, ...], expected: dict[str, Any]) -> None:
    """A step of the environment is that of the reference."""
    observation, reward, *_, info = returned
    assert abs(reward - expected["reward"]) <= WITHIN
    assert observation[:6].tolist() == expected["observation"][:6]
    # The rate is of 1e9 bit/s.
    assert math.isclose(observation[6], expected["observation"][6], rel_tol=WITHIN, abs_tol=1e9 * WITHIN)
    assert math.isclose(info["channel_mag"], expected["channel_mag"], rel_tol=WITHIN, abs_tol=WITHIN)


# --- legacy -------------------------------------------------------------------------------------------------


def test_legacy_has_the_rewards_of_the_originals_rules_for_its_random_numbers() -> None:
    """10,000 steps: dense and light traffic, five times each."""
    ways = synthetic_episode(3)
    env = RadioStrikeEnv("legacy", episodes=ways)
    env.reset(seed=20211)
    reference = Legacy(ways.position.swapaxes(0, 1).tolist(), seed=20211)
    for user, beam in actions(STEPS, seed=4):
        returned, expected = env.step([user, beam]), reference.play(user, beam)
        assert_same(returned, expected)
        assert returned[2] == expected["terminated"]
        assert returned[4]["packets"] == expected["packets"]


def test_the_best_beam_of_legacy_is_that_of_an_exhaustive_search() -> None:
    ways = short_episode(5)
    env = RadioStrikeEnv("legacy", episodes=ways)
    env.reset(seed=9)
    reference = Legacy(ways.position.swapaxes(0, 1).tolist(), seed=9)
    for user, _ in actions(60, seed=5):
        returned, expected = env.best_beam_step(user), reference.play(user, None)
        assert_same(returned, expected)
        assert returned[4]["best_beam"] == expected["best_beam"]


def test_the_rate_of_each_row_of_a_published_run_follows_from_its_channel(shared_data: Path) -> None:
    with (shared_data / "radiostrike" / "data_output_optimun_traffic.csv").open(newline="") as text:
        rows = list(csv.DictReader(text))
    assert len(rows) == 7399
    magnitude, rate = (np.array([float(row[key]) for row in rows]) for key in ("channel_mag", "bit_rate"))
    assert np.abs(LEGACY.bit_rate(magnitude) / 1e9 / rate - 1).max() <= WITHIN


def test_legacy_plays_the_trajectory_of_a_published_run(shared_data: Path) -> None:
    """Its rows are positions of the scheduled users: scheduled as they were, each comes again."""
    file = shared_data / "radiostrike" / "data_output_optimun_traffic.csv"
    env = RadioStrikeEnv("legacy", episodes=file)
    env.reset(seed=1)
    with file.open(newline="") as text:
        rows = list(csv.DictReader(text))[:6000]
    for row in rows:
        observation, *_ = env.step([int(row["ue_number"]), int(row["beam_index"])])
        assert observation[:3].tolist() == [float(row[axis]) for axis in "xyz"]


def test_users_straight_beside_the_base_station_have_the_channel_of_the_original() -> None:
    """It moves them by a millimetre where x is 0, and the straight line turns."""
    ways = Episode("beside", np.array([[[0.0, 10.0, 2.0], [0.0, -15.0, 7.0], [-20.0, 0.0, 0.0]]] * 30))
    env, reference = RadioStrikeEnv("legacy", episodes=ways), Legacy(ways.position.swapaxes(0, 1).tolist(), 6)
    env.reset(seed=6)
    for user, beam in actions(30, seed=8):
        assert_same(env.step([user, beam]), reference.play(user, beam))


def test_only_the_scheduled_user_moves_in_legacy() -> None:
    episode = short_episode(1)
    env = RadioStrikeEnv("legacy", episodes=episode)
    env.reset(seed=1)
    seen = [env.step([user, 0])[0][:3].tolist() for user in (0, 2, 2, 0, 1)]
    steps = [(0, 0), (0, 2), (1, 2), (1, 0), (0, 1)]
    assert seen == [episode.position[step, user].tolist() for step, user in steps]


def test_a_reset_of_legacy_without_a_seed_changes_nothing_and_observes_zeros() -> None:
    plain, with_resets = (RadioStrikeEnv("legacy", episodes=short_episode(2)) for _ in range(2))
    plain.reset(seed=3)
    with_resets.reset(seed=3)
    for step, action in enumerate(actions(60, seed=6)):
        one, other = plain.step(action), with_resets.step(action)
        assert one[0].tolist() == other[0].tolist()
        assert one[1:] == other[1:]
        assert one[2] == (step >= 19)  # from step 20 on it says that it is done, and goes on
        assert not with_resets.reset()[0].any()


def test_users_of_legacy_go_on_to_the_next_episode_each_by_itself_and_the_last_one_ends_in_an_error() -> None:
    first, second = short_episode(1, steps=3), short_episode(2, steps=2)
    env = RadioStrikeEnv("legacy", episodes=[first, second])
    env.reset(seed=1)
    seen = [env.step([user, 0])[0][:3].tolist() for user in (0, 0, 0, 0, 1, 0)]
    assert seen[3:] == [second.position[0, 0].tolist(), first.position[0, 1].tolist(),
                        second.position[1, 0].tolist()]  # fmt: skip
    with pytest.raises(EpisodesOverError, match=r"uav1.*last of 2 episodes") as caught:
        env.step([0, 0])
    assert isinstance(caught.value, TypeError)
    env.reset(seed=1)
    assert env.step([0, 0])[0][:3].tolist() == seen[0]


def test_a_seed_of_more_than_32_bits_is_a_stream_of_its_own() -> None:
    rewards = []
    for seed in (5, 5 + (1 << 32), 5 + (1 << 32)):
        env = RadioStrikeEnv("legacy", episodes=short_episode(2))
        env.reset(seed=seed)
        rewards.append([env.step(action)[1] for action in actions(20, seed=6)])
    assert rewards[0] != rewards[1] == rewards[2]


# --- fixed --------------------------------------------------------------------------------------------------


def test_fixed_follows_the_documented_rules(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two episodes over dense and light traffic; the reference has the numbers that the environment drew."""
    drawn: list[Any] = []
    draw = BlockDraws.draw

    def noting(*arguments: Any) -> Any:
        drawn.append(draw(*arguments))
        return drawn[-1]

    monkeypatch.setattr(BlockDraws, "draw", noting)
    ways = Episode("test", synthetic_episode(7).position[:1500])
    env = RadioStrikeEnv(episodes=ways)
    for _ in range(2):
        observation, _ = env.reset(seed=5)
        assert observation.tolist() == [*ways.position[0, 0], 0, 0, 0, 0]
        reference = Fixed(ways.position.swapaxes(0, 1).tolist())
        for user, beam in actions(ways.steps, seed=7):
            returned = env.step([user, beam])
            packets, rays = drawn[-1]
            expected = reference.play(
                user, beam, packets[0], rays.gain_db[0],
                list(zip(rays.azimuth_deg[0], rays.zenith_deg[0], strict=True)), rays.phase[0],
            )  # fmt: skip
            assert_same(returned, expected)
            assert returned[2:4] == (False, reference.steps == ways.steps)
    arrived = np.array([packets[0] for packets, _ in drawn])
    # Means of Poisson numbers, within five standard deviations.
    for first, load in ((0, 9.6e6), (1000, 4.8e6)):
        for user, share in enumerate((0.5, 0.3, 0.2)):
            mean = share * load / 65_504
            part = arrived[first : first + 500, user]
            assert abs(part.mean() - mean) < 5 * math.sqrt(mean / 500)


def test_the_rays_of_fixed_have_the_stated_distributions() -> None:
    draws = BlockDraws(FIXED, 1)
    draws.seed(0, np.random.default_rng(8), 8)
    zero, far = np.zeros(1, np.int64), np.array([10**6])
    rays = [draws.draw(zero, zero, np.array([step]), far).rays for step in range(4000)]
    gain, azimuth, zenith, phase = (np.concatenate(part).ravel() for part in zip(*rays, strict=True))
    assert gain.mean() == pytest.approx(2 * math.sqrt(2 / math.pi), rel=0.03)  # twice a half-normal number
    assert [azimuth.std(), zenith.std()] == pytest.approx([1.0, 1.0], rel=0.03)
    assert abs(np.exp(1j * phase).mean()) < 0.05


def test_the_beams_of_fixed_are_those_of_a_codebook_of_an_array_that_looks_down() -> None:
    """Of `AntennaArray` and `dft_codebook`: columns along north, rows from east to west."""
    array, random = AntennaArray(rows=8, columns=8), np.random.default_rng(1)
    for position in random.uniform([-40, -40, -20], [40, 40, 9], (20, 3)):
        azimuth, zenith, level = straight_lines(position[None], FIXED)
        still = Rays(*np.zeros((4, 1, 2)))
        abs_y = magnitudes(FIXED, azimuth, zenith, level, still, np.arange(64)[None])[0]
        north, east, down = position / np.linalg.norm(position)
        response = steering_vector(array, np.array([down, north, east])) @ dft_codebook(array).conj().T
        amplitude = 299_792_458 / 60e9 / (4 * np.pi * np.linalg.norm(position))
        assert np.abs(abs_y - 2 * amplitude * np.abs(response)).max() <= WITHIN * 16 * amplitude


def test_a_reset_of_fixed_begins_an_episode_and_the_seed_draws_which() -> None:
    episodes = [short_episode(number, steps=5 + number) for number in range(4)]
    env = RadioStrikeEnv(episodes=episodes)
    seen = []
    for begun in range(12):
        _, info = env.reset(seed=2 if begun == 0 else None)
        seen.append(info["episode"])
        ends = [env.step([0, 0])[3] for _ in range(5 + seen[-1])]
        assert ends == [False] * (4 + seen[-1]) + [True]
    assert len(set(seen)) > 1
    again = RadioStrikeEnv(episodes=episodes)
    assert [again.reset(seed=None if begun else 2)[1]["episode"] for begun in range(2)] == seen[:2]
    assert env.reset(seed=2, options={"episode": 3})[1]["episode"] == 3
    assert env.step([1, 0])[0][3:6:2].tolist() == [0, 0]  # nothing waits from before


def test_steps_bound_an_episode() -> None:
    env = RadioStrikeEnv(episodes=short_episode(1), steps=3)
    env.reset(seed=1)
    assert [env.step([0, 0])[3] for _ in range(3)] == [False, False, True]


def test_a_step_after_the_end_of_an_episode_is_refused() -> None:
    env = RadioStrikeEnv(episodes=short_episode(1), steps=1)
    env.reset(seed=1)
    env.step([0, 0])
    with pytest.raises(RunError, match=r"the episode is over; call reset\(\)"):
        env.step([0, 0])


# --- the contract of gymnasium ------------------------------------------------------------------------------


@pytest.mark.parametrize("rules", ["legacy", "fixed"])
def test_it_keeps_the_rules_that_gymnasium_checks(rules: str) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(gymnasium.make("caviar/RadioStrike-v0", rules=rules).unwrapped)


@pytest.mark.parametrize("rules", ["legacy", "fixed"])
def test_it_keeps_the_rules_that_stable_baselines3_checks(rules: str) -> None:
    checker = pytest.importorskip(
        "stable_baselines3.common.env_checker", reason="Stable-Baselines3 is not installed"
    )
    checker.check_env(RadioStrikeEnv(rules))  # type: ignore[arg-type]


@pytest.mark.parametrize("rules", ["legacy", "fixed"])
def test_the_same_seed_gives_the_same_rewards_and_another_one_others(rules: Any) -> None:
    found = []
    for seed in (1, 1, 2):
        env = RadioStrikeEnv(rules, episodes=short_episode(0))
        env.reset(seed=seed)
        found.append([env.step(action)[1] for action in actions(30, seed=2)])
    assert found[0] == found[1] != found[2]


# --- wrong arguments ----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"rules": "legcy"}, "rules='legcy'; did you mean 'legacy'"),
        ({"rules": 3}, "rules=3; write one of legacy, fixed"),
        ({"steps": 0}, "steps=0; write a whole number from 1 on"),
        ({"steps": 2.5}, "steps=2.5; write a whole number"),
        ({"rules": "legacy", "steps": 5}, 'steps has no effect with rules="legacy"'),
        ({"episodes": []}, "name one source at least"),
        ({"episodes": "ep0.csv"}, "'ep0.csv': there is no such file or folder"),
        ({"render_mode": "human"}, "render_mode='human'; the environment draws nothing"),
    ],
)
def test_a_wrong_argument_is_refused_with_the_remedy(arguments: dict[str, Any], message: str) -> None:
    with pytest.raises(ScenarioError, match=message):
        RadioStrikeEnv(**arguments)


@pytest.mark.parametrize(
    ("action", "message"),
    [((3, 0), "no user 3; write a number from 0 to 2"), ((0, 64), "beam 64 is not in the codebook"),
     ((-1, 0), "no user -1"), ((0, -1), "beam -1")],
)  # fmt: skip
def test_a_wrong_action_is_refused(action: tuple[int, int], message: str) -> None:
    env = RadioStrikeEnv(episodes=short_episode(0))
    env.reset(seed=1)
    with pytest.raises(ScenarioError, match=message):
        env.step(action)


def test_wrong_options_of_a_reset_are_refused() -> None:
    env = RadioStrikeEnv(episodes=short_episode(0))
    with pytest.raises(ScenarioError, match=r"'episod'.*episode"):
        env.reset(options={"episod": 1})
    with pytest.raises(ScenarioError, match=r"episode 1 .*from 0 to 0"):
        env.reset(options={"episode": 1})
    with pytest.raises(ScenarioError, match="plays its episodes in order"):
        RadioStrikeEnv("legacy", episodes=short_episode(0)).reset(options={"episode": 0})


def test_a_step_before_the_first_reset_is_refused() -> None:
    with pytest.raises(RunError, match=r"call reset\(\)"):
        RadioStrikeEnv(episodes=short_episode(0)).step([0, 0])


def test_an_output_file_is_an_episode_too(tmp_path: Path) -> None:
    """Rows of the users in the order in which they were scheduled; as long as the shortest."""
    episode = short_episode(4, steps=4)
    file = tmp_path / "output.csv"
    with file.open("w", newline="") as text:
        writer = csv.writer(text)
        writer.writerow(["chosen_ue", "ue_index", "beam_index", "x", "y", "z", "pkts_dropped"])
        names = ("uav1", "simulation_car1", "simulation_pedestrian1")
        counts = [0, 0, 0]
        for user in (0, 0, 1, 2, 0, 2, 1, 1):
            place = episode.position[counts[user], user].tolist()
            writer.writerow([names[user], user, 7, *map(repr, place), 0.0])
            counts[user] += 1
    assert read_episode(file).position.tolist() == episode.position[:2].tolist()
