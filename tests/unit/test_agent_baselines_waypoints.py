"""The agent that flies from point to point."""

from __future__ import annotations

import numpy as np
import pytest
from link_builders import antenna, frame_of, given, scene_of

from caviar_protocol.errors import ScenarioError
from caviar_protocol.scenario.conversion import convert_settings
from caviar_protocol.space.coordinates import Vector
from caviar_protocol.topics import Action, BeamChoice, Scene, WaypointCommand
from caviar_services.agent.base import AgentSettings
from caviar_services.agent.baselines import LosBeamAgent, WaypointsAgent, WaypointsSettings
from caviar_services.service import Preparation, RunInfo

POINTS = ((10.0, 0.0, 5.0), (10.0, 20.0, 5.0), (0.0, 0.0, 5.0))


def agent(users: tuple[str, ...] = ("motion:uav", "beam:uav/rx")) -> WaypointsAgent:
    made = WaypointsAgent(
        WaypointsSettings(users=users, object="uav", waypoints_m=POINTS, speed_m_s=6.0, reach_m=2.0),
        RunInfo(name="pilot"),
    )
    made.reset(0, 1, 0)
    return made


def scene(position: Vector, name: str = "uav") -> Scene:
    """One object, a base station and two receivers."""
    devices = scene_of(
        antenna("bs", "tx"),
        antenna("car/rx", "rx", position=(3.0, 9.0, 0.0)),
        antenna("uav/rx", "rx", position=(9.0, 3.0, 1.0)),
    )
    return Scene(
        names=(name,),
        classes=("uav",),
        assets=("",),
        position=np.array([position], dtype=np.float64),
        orientation=np.array([[1.0, 0.0, 0.0, 0.0]]),
        velocity=np.zeros((1, 3)),
        dimensions=np.array([[0.6, 0.6, 0.25]]),
        devices=devices.devices,
    )


def commands(of: WaypointsAgent | LosBeamAgent, seen: Scene) -> tuple[object, ...]:
    product = of.step(frame_of(given("scene", seen))).products["action"]
    assert isinstance(product, Action)
    return product.commands


def targets(of: WaypointsAgent, *positions: Vector) -> list[Vector]:
    return [
        command.position
        for position in positions
        for command in commands(of, scene(position))
        if isinstance(command, WaypointCommand)
    ]


def test_the_next_waypoint_follows_when_one_is_reached() -> None:
    """Reached within 2 m; at the last one it stays, also where it passes the first again."""
    way: list[Vector] = [
        (0, 0, 5),
        (7.9, 0, 5),
        (8.1, 0, 5),
        (10, 0, 5),
        (10, 18.5, 5),
        (0, 0, 5),
        (10, 0, 5),
    ]
    assert targets(agent(), *way) == [
        POINTS[0],
        POINTS[0],
        POINTS[1],
        POINTS[1],
        POINTS[2],
        POINTS[2],
        POINTS[2],
    ]


def test_waypoints_that_are_near_are_passed_at_once() -> None:
    made = agent()
    made.settings = WaypointsSettings(object="uav", waypoints_m=POINTS, speed_m_s=6.0, reach_m=15.0)
    assert targets(made, (10.0, 10.0, 5.0)) == [POINTS[2]]


def test_an_episode_begins_with_the_first_waypoint() -> None:
    made = agent()
    targets(made, (10.0, 0.0, 5.0), (10.0, 20.0, 5.0))
    made.reset(1, 2, 0)
    assert targets(made, (10.0, 20.0, 5.0)) == [POINTS[0]]


def test_it_owns_the_motion_and_its_beams() -> None:
    assert agent().prepare(Preparation(demand={})).actuators == ("beam:uav/rx", "motion:uav")


def test_its_beams_are_those_of_the_straight_line() -> None:
    made = LosBeamAgent(AgentSettings(users=("beam:uav/rx",)), RunInfo(name="pilot"))
    expected = commands(made, scene((0.0, 0.0, 5.0)))
    found = commands(agent(), scene((0.0, 0.0, 5.0)))
    assert len(expected) == 1
    assert found[:-1] == expected
    assert found[-1] == WaypointCommand(object="uav", position=POINTS[0], speed=6.0)


def test_without_beams_among_its_users_it_only_flies() -> None:
    assert not [c for c in commands(agent(("motion:uav",)), scene((0, 0, 5))) if isinstance(c, BeamChoice)]


def test_an_object_that_is_not_there_is_not_commanded() -> None:
    found = commands(agent(), scene((0.0, 0.0, 5.0), name="other"))
    assert [type(command) for command in found] == [BeamChoice]


def test_another_objects_motion_is_refused() -> None:
    with pytest.raises(ScenarioError, match="'motion:car' is no beam"):
        agent(("motion:car",))


@pytest.mark.parametrize(
    "wrong", [{"waypoints_m": []}, {"speed_m_s": 0.0}, {"reach_m": -1.0}, {"object": ""}]
)
def test_settings_without_sense_are_refused(wrong: dict[str, object]) -> None:
    plain: dict[str, object] = {"object": "uav", "waypoints_m": [[0.0, 0.0, 1.0]], "speed_m_s": 1.0}
    convert_settings(WaypointsSettings, plain)
    with pytest.raises(ScenarioError):
        convert_settings(WaypointsSettings, {**plain, **wrong})


def test_another_process_goes_on_to_the_same_waypoint() -> None:
    """Which were reached does not follow from where the object is."""
    first, second = agent(), agent()
    assert targets(first, (10.0, 0.5, 5.0)) == [POINTS[1]]
    second.restore(first.checkpoint())
    assert second.checkpoint() == first.checkpoint()
    assert targets(second, (3.0, 3.0, 5.0)) == [POINTS[1]] == targets(first, (3.0, 3.0, 5.0))
    assert targets(agent(), (3.0, 3.0, 5.0)) == [POINTS[0]]
