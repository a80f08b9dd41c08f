"""``caviar/UavPath-v1``: bounded observations, a reward whose parts are comparable, starts and goals."""

from __future__ import annotations

import math
import warnings
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

import caviar_clients.envs
from caviar_clients.envs.uav_path import UavPathEnv
from caviar_protocol.errors import PayloadError, RunError, ScenarioError
from caviar_protocol.recording import Recording
from caviar_protocol.space.antenna_arrays import beam_towards
from caviar_protocol.topics import Action, BeamChoice
from caviar_space.meshes import Mesh, box, ply

pytestmark = pytest.mark.slow

gymnasium.register_envs(caviar_clients.envs)

SHIPPED = Path(__file__).parents[2] / "deploy" / "caviar_scenarios"
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


LOW, HIGH = (-100.0, 0.0, 2.0), (200.0, 300.0, 80.0)
"""Bounds of the UAV in the scenario."""
STEP_WAY = 15.0 * 0.5
"""[m] that it flies in a frame at its greatest speed."""
HOUSE = ((-80.0, 40.0, 0.0), (180.0, 280.0, 60.0))
"""Corners of a house over most of the place."""
STILL = np.zeros(3, np.float32)


@contextmanager
def flight(folder: Path, *changes: tuple[str, str], **options: Any) -> Iterator[UavPathEnv]:
    """An environment over open ground that is closed in the end."""
    with closing(UavPathEnv(scenario(folder, *changes), **options)) as env:
        yield env


def town(folder: Path) -> tuple[str, str]:
    """Change that brings ground and the house as the scenery."""
    ground = np.array([[-150.0, -50, 0], [250, -50, 0], [250, 350, 0], [-150, 350, 0]])
    (folder / "ground.ply").write_bytes(ply(Mesh(ground, np.array([[0, 1, 2], [0, 2, 3]], np.int32))))
    (x0, y0, z0), (x1, y1, z1) = HOUSE
    (folder / "house.ply").write_bytes(ply(box((x0, x1), (y0, y1), (z0, z1))))
    (folder / "town.xml").write_text(
        '<scene version="2.1.0"><shape type="ply" id="house">'
        '<string name="filename" value="house.ply"/></shape><shape type="ply" id="ground">'
        '<string name="filename" value="ground.ply"/></shape></scene>'
    )
    begin = "[services.world.settings]\n"
    return begin, f'{begin}scenery = "file:{folder}/town.xml"\n'


def towards(env: UavPathEnv, target: Sequence[float], position: np.ndarray) -> np.ndarray:  # type: ignore[type-arg]
    """An action that leads to a point [m] from an observed position."""
    here = np.array(LOW) + (position + 1) / 2 * np.subtract(HIGH, LOW)
    way = np.subtract(target, here)
    return (way / max(float(np.linalg.norm(way)), STEP_WAY)).astype(np.float32)


def test_without_a_scenario_it_is_that_of_the_shipped_flight() -> None:
    assert gymnasium.make("caviar/UavPath-v1").unwrapped.scenario.run.name == "uav-path"


def test_it_keeps_the_rules_that_gymnasium_checks(tmp_path: Path) -> None:
    with flight(tmp_path, town(tmp_path), ("[-2.0, 140.0, 18.0]", "[-90.0, 10.0, 18.0]")) as env:
        check_env(env, skip_render_check=True)


@pytest.mark.parametrize("action", [[2.0, 0, 0], [0, 0, -1.01], [1e9, 0, 0], [math.nan, 0, 0], -1])
def test_an_action_outside_its_space_is_refused_and_the_flight_goes_on(tmp_path: Path, action: Any) -> None:
    """Shortened without a word, it would be another action than the one that is learned from."""
    with flight(tmp_path) as env:
        env.reset(seed=1)
        words = r"the action is .*; write three numbers within -1 and 1: the velocity .* over 15 m/s"
        with pytest.raises(PayloadError, match=words) as error:
            env.step(np.array(action))
        assert " ".join(repr(np.array(action)).split()) in str(error.value)
        for fits in (
            np.ones(3, np.float32),
            np.array([0, -1.0000001, 0]),
        ):  # corners, and what rounding makes
            env.step(fits)


def test_it_keeps_the_rules_that_stable_baselines3_checks(tmp_path: Path) -> None:
    checker = pytest.importorskip(
        "stable_baselines3.common.env_checker", reason="Stable-Baselines3 is not installed"
    )
    with flight(tmp_path) as env, warnings.catch_warnings():
        warnings.simplefilter("error")
        checker.check_env(env)


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


# --- start and goal ------------------------------------------------------------------------------------


def test_start_and_goal_follow_from_the_seed(tmp_path: Path) -> None:
    with flight(tmp_path) as env:
        found = [env.reset(seed=seed) for seed in (1, 2, 1)]
        following = env.reset()
    places = [(o["position"].tolist(), info["goal_m"]) for o, info in (*found, following)]
    assert places[0] == places[2]
    assert len({str(place) for place in places}) == 3, "another seed and another episode have others"
    for _, info in found:
        assert 0.1 * 59 * STEP_WAY <= info["distance_m"] <= 0.5 * 59 * STEP_WAY


def test_start_and_goal_are_clear_of_the_scenery_and_outside_of_it(tmp_path: Path) -> None:
    """The house takes two thirds of the place; the world refuses what is near to its walls."""
    (x0, y0, _), (x1, y1, z1) = HOUSE
    outside = ("[-2.0, 140.0, 18.0]", "[-90.0, 10.0, 18.0]")
    with flight(tmp_path, town(tmp_path), outside) as env:
        for seed in range(12):
            observation, info = env.reset(seed=seed)
            start = np.array(LOW) + (observation["position"] + 1) / 2 * np.subtract(HIGH, LOW)
            for x, y, z in (start.tolist(), info["goal_m"]):
                assert not (x0 - 1.9 < x < x1 + 1.9 and y0 - 1.9 < y < y1 + 1.9 and z < z1 + 1.9)


def test_options_set_start_and_goal(tmp_path: Path) -> None:
    start, goal = (10.0, 20.0, 30.0), (60.0, 20.0, 30.0)
    with flight(tmp_path) as env:
        observation, info = env.reset(seed=1, options={"start": start, "goal": goal})
        assert observation["position"] == pytest.approx(
            [2 * 110 / 300 - 1, 2 * 20 / 300 - 1, 2 * 28 / 78 - 1]
        )
        assert observation["velocity"].tolist() == [0, 0, 0]
        assert observation["goal"] == pytest.approx([50 / 300, 0, 0])
        assert (observation["rate"].item(), observation["outage"].item()) == (0, 0)
        assert (info["goal_m"], info["distance_m"]) == (goal, pytest.approx(50.0))
        _, one = env.reset(seed=1, options={"goal": goal})
        _, drawn = env.reset(seed=1)
        assert one["goal_m"] == goal != drawn["goal_m"]


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"strat": (1, 2, 3)}, "no options of reset are called .*strat.*there are: start, goal"),
        ({"start": (1, 2)}, r"start \(1, 2\) is no place for 'uav'"),
        ({"goal": (0.0, 20.0, 90.0)}, r"goal .* is no place .* between \[-100.0, 0.0, 2.0\]"),
        ({"goal": (0.0, 150.0, 30.0)}, "goal .* outside of buildings"),
        ({"goal": (-81.0, 150.0, 30.0)}, "goal .* clear of the scenery"),
        ({"start": (-95.0, 20.0, 9.0), "goal": (-94.0, 20.0, 9.0)}, "is within reach_m=5 of goal"),
    ],
)
def test_an_option_that_cannot_be_is_refused_and_another_reset_is_well(
    tmp_path: Path, options: dict[str, Any], words: str
) -> None:
    outside = ("[-2.0, 140.0, 18.0]", "[-90.0, 10.0, 18.0]")
    with flight(tmp_path, town(tmp_path), outside) as env:
        with pytest.raises(ScenarioError, match=words):
            env.reset(seed=1, options=options)
        with pytest.raises(RunError, match=r"call reset\(\)"):
            env.step(STILL)
        env.reset(seed=1)
        env.step(STILL)


# --- reward --------------------------------------------------------------------------------------------


def test_the_reward_is_the_weighted_sum_of_parts_within_their_ranges(tmp_path: Path) -> None:
    weights = {"progress": 2.0, "radio": 3.0, "outage": 5.0, "arrival": 7.0}
    with flight(tmp_path, weights=weights, efficiency_bit_s_hz=30.0) as env:
        observation, info = env.reset(seed=4)
        left, ended, steps = info["distance_m"], False, 0
        while not ended:
            observation, reward, ended, truncated, info = env.step(
                towards(env, info["goal_m"], observation["position"])
            )
            parts = info["reward_parts"]
            assert env.observation_space.contains(observation)
            assert reward == pytest.approx(sum(weights[name] * parts[name] for name in weights))
            assert parts["progress"] == pytest.approx((left - info["distance_m"]) / STEP_WAY)
            assert -1 <= parts["radio"] < 0
            assert parts["radio"] == pytest.approx(observation["rate"].item() - 1, abs=1e-6)
            assert parts["outage"] == 0 == observation["outage"].item()
            assert parts["arrival"] == float(ended)
            assert not truncated
            left, steps = info["distance_m"], steps + 1
        assert left <= 5.0
        assert steps < 59


def test_an_episode_has_a_step_less_than_frames(tmp_path: Path) -> None:
    with flight(tmp_path, ("frames = 60", "frames = 5"), distance_m=(20.0, 400.0)) as env:
        env.reset(seed=1)
        assert [env.step(STILL)[2:4] for _ in range(4)] == [(False, False)] * 3 + [(False, True)]


def test_users_below_the_snr_asked_for_are_in_outage(tmp_path: Path) -> None:
    with flight(tmp_path, outage_snr_db=100.0) as env:
        env.reset(seed=1)
        observation, reward, _, _, info = env.step(STILL)
    assert info["reward_parts"]["outage"] == -1
    assert observation["outage"].item() == 1
    assert reward <= -1


WALL = """
[services.channel.settings]
normalization = "path-loss"
nlos = "geometry"
nlos_loss_db = 30.0
obstacles = [{ minimum_m = [12.0, 60.0, 0.0], maximum_m = [60.0, 62.0, 80.0] }]
"""
"""In sight of the base station is what is west of it, and not the east."""


def test_two_flights_that_differ_in_the_radio_alone_differ_by_half_of_their_return(tmp_path: Path) -> None:
    """Both go around the middle in mirrored arcs, so that progress is equal in every step; a wall hides the
    east from the base station. Version 0 gives them 11.7980 and 11.7977."""
    geometric = ('use = "free-space"\nbudget_ms = 200\n', f'use = "geometric"\nbudget_ms = 200\n{WALL}')
    station = ("position_m = [8.5, 21.3, 27.0]", "position_m = [0.0, 20.0, 27.0]")
    ways = {}
    with flight(tmp_path, geometric, station) as env:
        for side in (-1, 1):
            ends = {"start": (0.0, 80.0, 20.0), "goal": (0.0, 200.0, 20.0)}
            observation, info = env.reset(seed=1, options=ends)
            parts, ended = [], False
            while not ended:
                y = LOW[1] + (float(observation["position"][1]) + 1) / 2 * (HIGH[1] - LOW[1])
                aim = (40.0 * side, 140.0, 20.0) if y < 135.0 else ends["goal"]
                action = towards(env, aim, observation["position"])
                observation, reward, ended, truncated, info = env.step(action)
                assert not truncated
                parts.append(info["reward_parts"] | {"return": reward})
            ways[side] = {name: np.array([step[name] for step in parts]) for name in parts[0]}
    west, east = ways[-1], ways[1]
    assert west["progress"] == pytest.approx(east["progress"], abs=1e-4)
    total = float(west["return"].sum())
    margin = total - float(east["return"].sum())
    assert margin > 0.5 * total > 0
    of_radio = sum(float((west[name] - east[name]).sum()) for name in ("radio", "outage"))
    assert margin == pytest.approx(of_radio, abs=1e-3)


# --- mistakes ------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"reward": "snr"}, "leave reward=… out, or write weights"),
        ({"observe": ("position",)}, "position of observe is always observed"),
        (
            {"weights": {"raido": 1.0}},
            "weights has no part raido; there are: progress, radio, outage, arrival",
        ),
        ({"weights": {"radio": -1.0}}, "write finite numbers from 0 on"),
        ({"weights": [1]}, r"weights=\[1\]; write numbers by name"),
        ({"weights": {"radio": "a"}}, "write finite numbers from 0 on"),
        ({"outage_snr_db": float("nan")}, "outage_snr_db=nan; write a number from -300 to 300"),
        ({"outage_snr_db": 1e6}, "outage_snr_db=1000000.0; write a number"),
        ({"distance_m": (1,)}, r"distance_m=\(1,\); write two ascending numbers"),
        ({"distance_m": 5}, "distance_m=5; write two ascending numbers"),
        ({"box_m": 5}, "box_m=5 is no box"),
        ({"reach_m": 0.0}, "reach_m=0.0; write a finite number above 0"),
        ({"efficiency_bit_s_hz": math.inf}, "efficiency_bit_s_hz=inf; write a finite number"),
        ({"distance_m": (50.0, 20.0)}, "write two ascending numbers above reach_m=5"),
        ({"box_m": ((0.0, 0.0, 0.0), (10.0, 10.0, 10.0))}, r"is no box within \[-100.0, 0.0, 2.0\]"),
    ],
)
def test_an_argument_out_of_range_is_named(tmp_path: Path, options: dict[str, Any], words: str) -> None:
    with pytest.raises(ScenarioError, match=words), flight(tmp_path, **options):
        pass


def test_a_flight_without_bounds_is_told_to_have_some(tmp_path: Path) -> None:
    with (
        pytest.raises(ScenarioError, match="write minimum_m and maximum_m"),
        flight(tmp_path, ("maximum_m = [200.0, 300.0, 80.0]\n", "")),
    ):
        pass


def test_a_box_in_which_no_goal_is_far_enough_is_told(tmp_path: Path) -> None:
    box_m = ((0.0, 50.0, 20.0), (10.0, 60.0, 30.0))
    with (
        flight(tmp_path, box_m=box_m, distance_m=(100.0, 200.0)) as env,
        pytest.raises(ScenarioError, match="start and goal 100 to 200 m"),
    ):
        env.reset(seed=1)


@pytest.mark.parametrize("vehicle", ["uaw", "bs", ""])
def test_a_vehicle_that_is_not_flown_is_named_with_those_that_are(tmp_path: Path, vehicle: str) -> None:
    told = f"vehicle='{vehicle}' is no flown object of the scenario; there are: uav"
    with pytest.raises(ScenarioError, match=told), flight(tmp_path, vehicle=vehicle):
        pass


def test_a_scenario_in_which_nothing_is_flown_is_told_what_to_add() -> None:
    with pytest.raises(ScenarioError, match=r"'flight'.*\[\[services"):
        UavPathEnv(SHIPPED / "smoke.toml")


def test_an_agent_that_does_not_own_the_motion_is_told_what_to_add(tmp_path: Path) -> None:
    with (
        pytest.raises(ScenarioError, match=r"'agent'.*beam:uav/rx.*'motion:uav'"),
        flight(tmp_path, ('["motion:uav", "beam:uav/rx"]', '["beam:uav/rx"]')),
    ):
        pass
