"""``caviar/UavPath-v0`` over open ground: what a flight is, and what is said where it cannot be."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from caviar_clients.envs.uav_path import UavPathEnv
from caviar_protocol.errors import PayloadError, RunError, ScenarioError
from caviar_protocol.recording import Recording
from caviar_protocol.space.beams import beam_towards
from caviar_protocol.topics import Action, BeamChoice, VelocityCommand

pytestmark = pytest.mark.slow

SHIPPED = Path(__file__).parents[2] / "deploy" / "caviar_scenarios"
MAX_SPEED = 15.0
START = (-2.0, 140.0, 18.0)
Changes = tuple[tuple[str, str], ...]

OPEN_GROUND: Changes = (
    ('scenery = "sionna:munich"  # comes with sionna-rt\n', ""),
    ('use = "sionna-rt"', 'use = "free-space"'),
)
"""No buildings, and no ray tracer."""


def scenario(folder: Path, *changes: tuple[str, str]) -> Path:
    """The shipped flight over open ground, with some text replaced."""
    text = (SHIPPED / "uav-path.toml").read_text()
    head, _, tail = text.partition("[services.channel.settings]")
    text = head + tail[tail.index("[services.link]") :]
    for old, new in OPEN_GROUND + changes:
        assert old in text, f"{old!r} is not in the scenario"
        text = text.replace(old, new, 1)
    path = folder / "scenario.toml"
    path.write_text(text)
    return path


@contextmanager
def flight(folder: Path, *changes: tuple[str, str], **options: Any) -> Iterator[UavPathEnv]:
    """An environment that is closed in the end."""
    with closing(UavPathEnv(scenario(folder, *changes), **options)) as env:
        yield env


def flown(env: UavPathEnv, action: list[float], steps: int) -> tuple[dict[str, Any], dict[str, Any]]:
    """The last observation and info of a flight with one and the same action."""
    found: Any = None
    for _ in range(steps):
        found = env.step(np.array(action, np.float32))
    return found[0], found[4]


def test_it_keeps_the_rules_that_gymnasium_checks(tmp_path: Path) -> None:
    with flight(tmp_path, goal_m=(0.0, 100.0, 20.0)) as env:
        check_env(env, skip_render_check=True)


def test_it_keeps_the_rules_that_stable_baselines3_checks(tmp_path: Path) -> None:
    checker = pytest.importorskip(
        "stable_baselines3.common.env_checker", reason="Stable-Baselines3 is not installed"
    )
    with flight(tmp_path, goal_m=(0.0, 100.0, 20.0)) as env:
        checker.check_env(env)


def test_an_action_is_a_share_of_the_greatest_speed_in_world_axes(tmp_path: Path) -> None:
    """The UAV is turned by 70°, which does not matter to where it flies."""
    with flight(tmp_path) as env:
        env.reset(seed=1)
        observation, _ = flown(env, [0.2, -0.4, 0.1], 12)
    assert observation["velocity"] == pytest.approx([3.0, -6.0, 1.5], abs=1e-4)
    way = observation["position"] - np.array(START)
    assert way[0] > 0 > way[1]


@pytest.mark.parametrize("action", [[1.0, 1.0, 0.0], [-1.0, 1.0, 0.5], [0.0, 7.0, 0.0]])
def test_an_action_longer_than_1_is_shortened_to_it(tmp_path: Path, action: list[float]) -> None:
    with flight(tmp_path, directory=tmp_path / "run") as env:
        env.reset(seed=1)
        env.step(np.array(action, np.float32))
    commands = Recording(tmp_path / "run").frame(0, 0).payloads("action", Action)["agent"].commands
    velocity = next(c.velocity for c in commands if isinstance(c, VelocityCommand))
    assert math.dist(velocity, (0, 0, 0)) == pytest.approx(MAX_SPEED, rel=1e-6)
    assert np.cross(velocity, action) == pytest.approx([0, 0, 0], abs=1e-4)


def test_beams_point_along_the_straight_line(tmp_path: Path) -> None:
    with flight(tmp_path, directory=tmp_path / "run") as env:
        env.reset(seed=1)
        for _ in range(6):
            env.step(np.array([0.9, -0.4, 0.1], np.float32))
    recording, beams = Recording(tmp_path / "run"), []
    for number in range(6):
        frame = recording.frame(0, number)
        scene, commands = frame.scene(), frame.payloads("action", Action)["agent"].commands
        assert scene is not None
        (choice,) = (c for c in commands if isinstance(c, BeamChoice))
        assert (choice.tx, choice.rx, choice.rx_beam) == ("bs", "uav/rx", 0)
        devices: dict[str, Any] = {device.name: device for device in scene.devices}
        bs, rx = devices["bs"], devices["uav/rx"]
        uav = scene.position[scene.names.index("uav")]
        yaw = math.radians(62.0)
        way = uav - np.array([0, 0, 0.175]) - np.array([8.5, 21.3, 27.0])
        left = np.array([-math.sin(yaw), math.cos(yaw), 0.0]) @ way / np.linalg.norm(way)
        assert choice.tx_beam == beam_towards(bs.array, (math.sqrt(1 - left**2), float(left), 0.0))
        assert rx.parent == "uav"
        beams.append(choice.tx_beam)
    assert len(set(beams)) > 1, "they follow the UAV"


def test_the_goal_is_the_way_that_is_left_and_reaching_it_terminates(tmp_path: Path) -> None:
    goal = (10.0, 140.0, 18.0)
    with flight(tmp_path, goal_m=goal, reach_m=3.0, progress_weight=0.5) as env:
        observation, _ = env.reset(seed=1)
        assert observation["goal"] == pytest.approx(np.array(goal) - START, abs=1e-4)
        left, ended = [12.0], False
        while not ended:
            observation, reward, ended, truncated, info = env.step(np.array([0.2, 0, 0], np.float32))
            assert not truncated
            left.append(float(np.linalg.norm(observation["goal"])))
            assert reward == pytest.approx(info["abs_y"][0] + 0.5 * (left[-2] - left[-1]), abs=1e-5)
    assert left[-1] <= 3.0 < left[-2]
    assert left == sorted(left, reverse=True)


def test_flying_away_from_the_goal_costs(tmp_path: Path) -> None:
    with flight(tmp_path, goal_m=(10.0, 140.0, 18.0), progress_weight=1.0) as env:
        env.reset(seed=1)
        rewards = [env.step(np.array([-1.0, 0, 0], np.float32))[1] for _ in range(5)]
    assert max(rewards) < 0


def test_an_episode_after_a_goal_begins_at_the_start_again(tmp_path: Path) -> None:
    with flight(tmp_path, goal_m=(0.0, 140.0, 18.0), reach_m=1.0) as env:
        first, _ = env.reset(seed=1)
        while not env.step(np.array([0.1, 0, 0], np.float32))[2]:
            pass
        again, info = env.reset()
    assert info == {"frame": 0, "t_ns": 0}
    assert again["position"] == pytest.approx(first["position"], abs=1e-9)
    assert again["velocity"].tolist() == [0, 0, 0]


def test_without_a_goal_an_episode_lasts_all_its_frames(tmp_path: Path) -> None:
    with flight(tmp_path, ("frames = 60", "frames = 5")) as env:
        observation, _ = env.reset(seed=1)
        assert "goal" not in observation
        ends = [env.step(np.zeros(3, np.float32))[2:4] for _ in range(5)]
        with pytest.raises(RunError, match=r"call reset\(\)"):
            env.step(np.zeros(3, np.float32))
    assert ends == [(False, False)] * 4 + [(False, True)]


@pytest.mark.parametrize("action", [[math.nan, 0, 0], [0, math.inf, 0], [0.1, 0.2], 0.5, [[0, 0, 0]], "up"])
def test_an_action_that_is_no_velocity_is_refused_and_the_flight_goes_on(tmp_path: Path, action: Any) -> None:
    with flight(tmp_path) as env:
        env.reset(seed=1)
        with pytest.raises(PayloadError, match="write three numbers within -1 and 1"):
            env.step(action if isinstance(action, str) else np.array(action, np.float32))
        env.step(np.zeros(3, np.float32))


# --- mistakes ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("vehicle", ["uaw", "bs", ""])
def test_a_vehicle_that_is_not_flown_is_named_with_those_that_are(tmp_path: Path, vehicle: str) -> None:
    told = f"vehicle='{vehicle}' is no flown object of the scenario; there are: uav"
    with pytest.raises(ScenarioError, match=told), flight(tmp_path, vehicle=vehicle):
        pass


def test_a_scenario_in_which_nothing_is_flown_is_told_what_to_add() -> None:
    with pytest.raises(ScenarioError, match=r"none; use a world 'flight' with \[\[services"):
        UavPathEnv(SHIPPED / "smoke.toml")


def test_an_agent_that_does_not_own_the_motion_is_told_what_to_add(tmp_path: Path) -> None:
    with (
        pytest.raises(ScenarioError, match=r"agent 'agent' owns beam:uav/rx; add 'motion:uav' to its users"),
        flight(tmp_path, ('["motion:uav", "beam:uav/rx"]', '["beam:uav/rx"]')),
    ):
        pass


@pytest.mark.parametrize("goal", [(1.0, 2.0), (1.0, 2.0, math.nan), (1.0, 2.0, 3.0, 4.0)])
def test_a_goal_that_is_no_point_is_named(tmp_path: Path, goal: tuple[float, ...]) -> None:
    with pytest.raises(ScenarioError, match=r"goal_m=.*three"), flight(tmp_path, goal_m=goal):
        pass
