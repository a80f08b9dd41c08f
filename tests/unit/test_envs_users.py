"""Who is observed: the pairs of a scene that an environment serves, and their places."""

from __future__ import annotations

import pytest
from link_builders import antenna, scene_of
from observation_builders import (
    PER_USER,
    antenna_spec,
    car_street,
    cars,
    link_of,
    moment_of,
    read,
    scenario_of,
)

from caviar_protocol.errors import ScenarioError
from caviar_protocol.observations import Users, part
from caviar_protocol.scenario import Scenario


@pytest.fixture
def scenario() -> Scenario:
    return car_street()


def test_users_fill_the_places_in_the_order_of_their_names(scenario: Scenario) -> None:
    position = read(scenario, "position", cars(3, 1, 2)).reshape(3, 3)
    assert position.tolist() == [[10, 1, 1], [20, 4, 1], [30, 9, 1]]


@pytest.mark.parametrize("name", PER_USER)
def test_a_place_whose_vehicle_left_is_zeros(scenario: Scenario, name: str) -> None:
    users = Users(scenario, ("*",))
    found = part(scenario, users, name)
    width = PER_USER[name]
    for present in ((1, 2, 3), (2, 3), (3,), (), (1, 3)):
        scene = cars(*present)
        link = link_of([("bs", f"car.{n}/rx", 0.5) for n in present])
        value = found.read(moment_of(users, scene, link=link))
        assert value is not None
        assert value.shape == (3 * width,)
        assert not value[width * len(present) :].any()
        if name in ("aod", "position", "last_abs_y", "last_beam"):
            assert value.reshape(3, width)[: len(present)].any(axis=1).all()


def test_a_receiver_that_is_not_served_takes_no_place() -> None:
    both = scenario_of(antenna_spec("bs", "tx"), antenna_spec("rx", "rx", on="car.*", count=3))
    users = Users(both, ("car.2/*",))
    scene = cars(1, 2, 3)
    assert [(place, pair.rx.name) for place, pair in users.present(scene)] == [(0, "car.2/rx")]
    value = part(both, users, "position").read(moment_of(users, scene))
    assert value is not None
    assert value[:3].tolist() == [20, 4, 1]
    assert not value[3:].any()


def test_places_stand_by_transmitter_and_then_by_receiver() -> None:
    two = scenario_of(
        antenna_spec("north", "tx"),
        antenna_spec("east", "tx"),
        antenna_spec("rx", "rx", on="car.*", count=2),
        antenna_spec("mast", "rx"),
    )
    users = Users(two, ("*",))
    scene = scene_of(
        antenna("north", "tx"),
        antenna("east", "tx"),
        antenna("mast", "rx", position=(5, 5, 5)),
        antenna("car.7/rx", "rx", parent="car.7"),
        objects={"car.7": ((1, 2, 3), 0.0)},
    )
    assert len(users) == 6
    assert [
        (place, p.tx.name, p.rx.name) for place, p in sorted(users.present(scene), key=lambda u: u[0])
    ] == [
        (0, "east", "mast"),
        (1, "east", "car.7/rx"),
        (3, "north", "mast"),
        (4, "north", "car.7/rx"),
    ]


@pytest.mark.parametrize(
    ("pattern", "served"),
    [("car.1/rx", 3), ("car*", 3), ("*/rx", 3), ("?ar.1?/rx", 3), ("bus*", 0), ("car.1", 0), ("rx", 0)],
)
def test_a_pattern_serves_what_it_can_match(scenario: Scenario, pattern: str, served: int) -> None:
    if served:
        assert len(Users(scenario, (pattern,))) == served
    else:
        with pytest.raises(ScenarioError) as error:
            Users(scenario, (pattern,))
        assert f"no receiver of the scenario is {pattern}; there are: car.*/rx" in str(error.value)
