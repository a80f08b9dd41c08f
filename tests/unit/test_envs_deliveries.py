"""Deliveries of ``caviar/UavPath-v1``: tours, boxes, energy, and the environment with several addresses."""

from __future__ import annotations

import itertools
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from test_envs_uav_path import HIGH, LOW, STEP_WAY, flight, towards

from caviar_clients.envs.deliveries import Box, Deliveries, rotary_wing_power
from caviar_clients.envs.uav_path import UavPathEnv
from caviar_protocol.errors import ScenarioError

REACH = 5.0


def points(random: np.random.Generator, count: int) -> list[tuple[float, float, float]]:
    return [(x, y, z) for x, y, z in random.uniform(LOW, HIGH, (count, 3)).tolist()]


@pytest.mark.parametrize("count", [1, 2, 5, 7])
def test_tours_are_the_shortest_of_all_orders(count: int) -> None:
    """Against every permutation, with all addresses left and after one is delivered to."""
    random = np.random.default_rng(count)
    addresses, (here,) = points(random, count), points(random, 1)
    street = Deliveries(addresses, REACH)
    for left in (addresses, addresses[1:]):
        tours = [sum(map(math.dist, (here, *order), order)) for order in itertools.permutations(left)]
        assert street.tour_m(here) == pytest.approx(min(tours), rel=1e-12)
        street.deliver(addresses[0])
    assert street.delivered == (True, *[False] * (count - 1))


def test_no_way_shortens_a_tour_by_more_than_itself() -> None:
    """So progress lies within ±1 whatever is flown."""
    random = np.random.default_rng(3)
    street = Deliveries(points(random, 6), REACH)
    places = points(random, 200)
    for a, b in itertools.pairwise(places):
        assert abs(street.tour_m(a) - street.tour_m(b)) <= math.dist(a, b) + 1e-9


def test_a_way_through_a_box_meets_it() -> None:
    box = Box((0.0, 0.0, 0.0), (10.0, 10.0, 10.0))
    random = np.random.default_rng(5)
    for start, end in zip(points(random, 300), points(random, 300), strict=True):
        a, b = np.array(start) / 10, np.array(end) / 10
        along = a + np.linspace(0.0, 1.0, 4001)[:, None] * (b - a)
        sampled = bool(((along >= 0.0) & (along <= 10.0)).all(1).any())
        # Sampling may miss a corner; it never finds what is not there.
        assert box.meets(tuple(a), tuple(b)) >= sampled


def test_power_is_that_of_the_paper() -> None:
    """Zeng, Xu and Zhang 2019: 168.49 W in hovering, and the least, about 126 W, at some 10.2 m/s."""
    speeds = np.arange(0.0, 30.0, 0.1)
    powers = [rotary_wing_power((v, 0.0, 0.0)) for v in speeds.tolist()]
    assert powers[0] == pytest.approx(79.86 + 88.63)
    assert min(powers) == pytest.approx(126.0, abs=0.5)
    assert speeds[int(np.argmin(powers))] == pytest.approx(10.2, abs=0.2)
    assert rotary_wing_power((0.0, 0.0, 3.0)) - powers[0] == pytest.approx(60.0)


# --- the environment -------------------------------------------------------------------------------------


def delivered_by(env: UavPathEnv, seed: int) -> tuple[list[dict[str, Any]], float]:
    """Information of each step of an episode that flies to the next address, and the sum of rewards."""
    observation, info = env.reset(seed=seed)
    infos, total, ended, truncated = [info], 0.0, False, False
    while not (ended or truncated):
        action = towards(env, info["goal_m"], observation["position"])
        observation, reward, ended, truncated, info = env.step(action)
        assert env.observation_space.contains(observation)
        infos.append(info)
        total += reward
    assert ended
    return infos, total


@pytest.mark.slow
def test_an_episode_ends_with_the_last_delivery(tmp_path: Path) -> None:
    with flight(tmp_path, deliveries=3, weights={"energy": 0.5}) as env:
        infos, total = delivered_by(env, seed=6)
        parts = [info["reward_parts"] for info in infos[1:]]
    assert [part["arrival"] for part in parts].count(1.0) == 3
    assert infos[0]["delivered"] == (False,) * 3
    assert infos[-1]["delivered"] == (True,) * 3
    assert infos[-1]["distance_m"] == 0.0
    # What is left of the tour at the start was flown, but for what was in reach.
    flown = sum(part["progress"] for part in parts) * STEP_WAY
    assert infos[0]["distance_m"] - 3 * REACH - STEP_WAY <= flown <= infos[0]["distance_m"]
    assert all(-1.0 <= part["energy"] < 0.0 for part in parts)
    assert infos[-1]["energy_j"] == pytest.approx(
        sum(-part["energy"] for part in parts) * env._greatest_power * 0.5
    )
    assert total == pytest.approx(
        sum(
            p["progress"] + p["radio"] + p["outage"] + 10 * p["arrival"] + p["intrusion"] + p["energy"] / 2
            for p in parts
        )
    )


@pytest.mark.slow
def test_any_order_can_be_flown(tmp_path: Path) -> None:
    """The far address first: the way counts as what it is, and both deliveries do."""
    near, far = (0.0, 150.0, 30.0), (30.0, 150.0, 30.0)
    with flight(tmp_path, deliveries=2) as env:
        observation, info = env.reset(
            seed=1, options={"start": (-30.0, 120.0, 30.0), "addresses": [near, far]}
        )
        assert info["goal_m"] == near
        arrivals = 0.0
        for target in (far, near):
            for _ in range(20):
                observation, _, ended, _, info = env.step(towards(env, target, observation["position"]))
                arrivals += info["reward_parts"]["arrival"]
                if info["delivered"][(near, far).index(target)]:
                    break
        assert ended
        assert arrivals == 2.0
        assert observation["delivered"].tolist() == [1.0, 1.0]
        assert not observation["addresses"].any()


@pytest.mark.slow
def test_boxes_are_kept_out_of_by_draws_and_cost_who_flies_into_them(tmp_path: Path) -> None:
    box = ((-20.0, 100.0, 0.0), (120.0, 200.0, 80.0))
    with flight(tmp_path, deliveries=2, no_fly_m=[box]) as env:
        inside = Box(*box)
        for seed in range(8):
            env.reset(seed=seed)
            assert env._deliveries is not None
            assert not any(inside.meets(place, place) for place in env._deliveries.addresses)
        addresses = [(150.0, 150.0, 20.0), (150.0, 180.0, 20.0)]
        observation, _ = env.reset(seed=1, options={"start": (-40.0, 150.0, 20.0), "addresses": addresses})
        intrusions = []
        for _ in range(8):
            observation, _, _, _, info = env.step(np.array([1.0, 0.0, 0.0], np.float32))
            x = LOW[0] + (observation["position"][0] + 1) / 2 * (HIGH[0] - LOW[0])
            intrusions.append((info["reward_parts"]["intrusion"], x >= -20.0))
        assert {cost == -1.0 for cost, is_in in intrusions if is_in} == {True}
        assert {cost for cost, is_in in intrusions if not is_in} == {0.0}


@pytest.mark.slow
def test_it_keeps_the_rules_that_gymnasium_checks(tmp_path: Path) -> None:
    with flight(tmp_path, deliveries=4) as env:
        check_env(env, skip_render_check=True)


@pytest.mark.parametrize(
    ("options", "text"),
    [
        ({"deliveries": 9}, "deliveries=9; write a whole number from 0 to 8"),
        ({"deliveries": True}, "deliveries=True; write a whole number"),
        ({"no_fly_m": [((0, 0, 0), (1, 1))]}, "lowest and the highest corner of a box"),
        ({"no_fly_m": [((0, 0, 5), (1, 1, 5))]}, "lowest and the highest corner of a box"),
    ],
)
def test_wrong_arguments_say_what_to_write(tmp_path: Path, options: dict[str, Any], text: str) -> None:
    with pytest.raises(ScenarioError, match=text), flight(tmp_path, **options):
        pass


@pytest.mark.parametrize(
    ("deliveries", "options", "text"),
    [
        (
            0,
            {"addresses": [(0.0, 100.0, 20.0)]},
            "option 'addresses' does not go with deliveries=0",
        ),
        (2, {"goal": (0.0, 100.0, 20.0)}, "option 'goal' does not go with deliveries=2; write 'addresses'"),
        (2, {"addresses": [(0.0, 100.0, 20.0)]}, "are not 2 points"),
        (1, {"start": (0, 99, 20), "addresses": [(0, 100, 20)]}, "within reach_m=5 of address"),
    ],
)
def test_wrong_options_say_what_to_write(
    tmp_path: Path, deliveries: int, options: dict[str, Any], text: str
) -> None:
    with flight(tmp_path, deliveries=deliveries) as env, pytest.raises(ScenarioError, match=text):
        env.reset(seed=1, options=options)
