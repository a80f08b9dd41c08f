"""People walk: no body jumps or turns about, whatever SUMO's models do, and what they did is counted."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from caviar_services.world.sumo_conventions import FASTEST, JUMPS, PLACED, TURNS, People

STEP_S = 0.1
places = st.lists(st.tuples(st.floats(-30, 30), st.floats(-30, 30), st.floats(0, 2)), min_size=2, max_size=40)


def walked(people: People, way: list[tuple[float, float, float]], speed: float = 1.4) -> np.ndarray:
    """Positions of a body whose person is at these places, step by step."""
    found = []
    for place in way:
        people.step("p", place, 0.0, speed)
        found.append(people.body("p").position)
    return np.array(found)


def test_a_person_who_walks_is_where_sumo_has_it_with_its_displacement_as_velocity() -> None:
    people = People(STEP_S)
    way = [(0.14 * k, 0.05 * k, 0.01 * k) for k in range(50)]
    assert walked(people, way) == pytest.approx(np.array(way), abs=1e-12)
    body = people.body("p")
    assert body.velocity == pytest.approx((1.4, 0.5, 0.1))
    assert body.yaw == pytest.approx(math.atan2(0.05, 0.14))
    assert people.taken_counts() == {}


def test_a_jump_is_walked_and_counted_once() -> None:
    """3.5 m in a step, as `striping` does at junctions: 12 steps at just below 3 m/s."""
    people = People(STEP_S)
    places = walked(people, [(0.0, 0.0, 0.0)] + [(3.5, 0.0, 0.0)] * 13)
    assert (np.linalg.norm(np.diff(places, axis=0), axis=1) <= FASTEST * STEP_S).all()
    assert places[11, 0] < 3.5
    assert places[12, 0] == pytest.approx(3.5)
    assert people.taken_counts() == {JUMPS: 1}
    assert people.taken_counts() == {}


def test_who_is_put_elsewhere_is_shown_there_at_once_and_counted() -> None:
    people = People(STEP_S)
    places = walked(people, [(0.0, 0.0, 0.0), (40.0, 0.0, 0.0)])
    assert places[1].tolist() == [40.0, 0.0, 0.0]
    assert people.body("p").velocity == (1.4, 0.0, 0.0)
    assert people.taken_counts() == {JUMPS: 1, PLACED: 1}


def test_a_runner_whom_sumo_states_to_run_is_no_jump() -> None:
    people = People(STEP_S)
    way = [(0.5 * k, 0.0, 0.0) for k in range(20)]
    assert walked(people, way, speed=5.0) == pytest.approx(np.array(way), abs=1e-4)
    assert people.taken_counts() == {}


def test_who_turns_about_turns_gradually_to_the_left_or_right() -> None:
    """There and back: SUMO turns by 180° in a step, the body in five and more."""
    people = People(STEP_S)
    yaws = []
    for k in range(40):
        forth = k < 20
        x = 0.14 * (k if forth else 40 - k)
        people.step("p", (x, 0.0, 0.0), 0.0 if forth else math.pi, 1.4)
        yaws.append(people.body("p").yaw)
        assert people.body("p").yaw_rate == pytest.approx((yaws[-1] - yaws[-2]) / STEP_S if k else 0.0)
    turned = np.abs(np.diff(yaws))
    assert turned.max() == pytest.approx(2 * math.pi * STEP_S)
    assert abs(math.remainder(yaws[-1] - math.pi, 2 * math.pi)) < 1e-9
    assert people.taken_counts() == {TURNS: 1}


def test_who_stands_and_sways_does_not_turn() -> None:
    generator = np.random.default_rng(1)
    people = People(STEP_S)
    for x, y in generator.uniform(-0.09, 0.09, (200, 2)):
        people.step("p", (float(x), float(y), 0.0), float(generator.uniform(-3, 3)), 0.1)
    assert people.body("p").yaw_rate == 0.0


def test_who_rode_in_a_vehicle_is_new_where_it_gets_off() -> None:
    people = People(STEP_S)
    walked(people, [(0.0, 0.0, 0.0)])
    people.keep([])
    assert "p" not in people
    assert walked(people, [(300.0, 0.0, 0.0)]).tolist() == [[300.0, 0.0, 0.0]]
    assert people.taken_counts() == {}


@given(places, st.floats(0, 2))
def test_nobody_exceeds_3_m_s_or_turns_by_more_than_36_degrees_unless_put_elsewhere(
    way: list[tuple[float, float, float]], speed: float
) -> None:
    people = People(STEP_S)
    before = None
    for place in way:
        people.step("p", place, math.atan2(place[1], place[0]), speed)
        body = people.body("p")
        if not people.taken_counts().get(PLACED) and before is not None:
            gone = math.dist(body.position, before.position)
            assert gone <= FASTEST * STEP_S
            assert body.velocity == pytest.approx(
                tuple((b - a) / STEP_S for a, b in zip(before.position, body.position, strict=True)), abs=1e-9
            )
            assert abs(body.yaw - before.yaw) <= 2 * math.pi * STEP_S + 1e-9
        before = body
