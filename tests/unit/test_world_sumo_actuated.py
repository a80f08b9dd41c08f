"""What agents command in the world ``sumo-actuated``: SUMO does it in the next frame, or it is refused."""

from __future__ import annotations

import importlib.util
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from world_builders import T_SAM_NS, wire_bytes

from caviar_protocol.errors import PayloadError, RunError
from caviar_protocol.messages import GrantInput, Status
from caviar_protocol.topics import Action, DriveCommand, RoadStop, Scene, SignalCommand, WaypointCommand
from caviar_protocol.topics.link import Command
from caviar_services.service import Frame, FrameInput, Preparation, RunInfo
from caviar_services.world.sumo import ActuatedSumoWorld, SumoSettings

pytestmark = [
    pytest.mark.slow,
    pytest.mark.sumo,
    pytest.mark.skipif(importlib.util.find_spec("libsumo") is None, reason="needs the world extra"),
]

ROUTES = """<routes>
  <vType id="car" vClass="passenger" sigma="0" speedDev="0" speedFactor="1.0" maxSpeed="10"/>
  <vehicle id="one" type="car" depart="0" departLane="1" departPos="5" departSpeed="10">
    <route edges="east1 east2 east3"/>
  </vehicle>
  <person id="walker" depart="0"><walk from="west1" to="west3"/></person>
</routes>"""


class Driven:
    """A world whose frames have commands of agents."""

    def __init__(self, world: ActuatedSumoWorld) -> None:
        self.world, self.frame = world, 0
        world.reset(0, 1, 0)

    def step(self, *commands: Command, agent: str = "driver", **others: Command) -> Scene:
        """The next frame, with the commands that this agent, and others, decided in the one before."""
        actions = {agent: commands, **{name: (command,) for name, command in others.items()}}
        given = tuple(_given(name, action, self.frame - 1) for name, action in actions.items() if action)
        frame = Frame(
            episode=0,
            number=self.frame,
            t_ns=self.frame * T_SAM_NS,
            previous=self.frame - 1,
            inputs=given,
        )
        self.frame += 1
        scene = self.world.step(frame).products["scene"]
        assert isinstance(scene, Scene)
        return scene

    def on(self, frames: int) -> Scene:
        """So many frames without commands; the last scene."""
        return [self.step() for _ in range(frames)][-1]

    @property
    def api(self) -> Any:
        return self.world._started().api


def _given(agent: str, commands: tuple[Command, ...], frame: int) -> FrameInput:
    provenance = GrantInput(topic="action", source=agent, frame=frame, status=Status.FRESH)
    return FrameInput(provenance, payload=Action(commands=commands))


@pytest.fixture
def files(repository: Path, tmp_path: Path) -> SumoSettings:
    routes = tmp_path / "one.rou.xml"
    routes.write_text(ROUTES)
    net = repository / "deploy" / "caviar_scenarios" / "crossing" / "crossing.net.xml"
    return SumoSettings(net=str(net), routes=str(routes), begin_s=1.0)


@pytest.fixture
def driven(files: SumoSettings) -> Iterator[Driven]:
    world = ActuatedSumoWorld(files, RunInfo(name="traffic", sampling_period_ns=T_SAM_NS))
    world.prepare(Preparation(demand={}))
    yield Driven(world)
    world.close()


def car(scene: Scene) -> tuple[np.ndarray, float]:
    """Position and speed of the car."""
    index = scene.names.index("traffic.one")
    return scene.position[index], float(np.linalg.norm(scene.velocity[index]))


def test_a_speed_is_held_until_the_vehicle_is_given_back(driven: Driven) -> None:
    assert car(driven.step())[1] == pytest.approx(10.0, abs=0.2)
    driven.step(DriveCommand(object="traffic.one", speed=4.0))
    assert car(driven.on(30))[1] == pytest.approx(4.0, abs=1e-6)
    driven.step(DriveCommand(object="traffic.one"))
    assert car(driven.on(25))[1] == pytest.approx(10.0, abs=0.2)


def test_a_vehicle_brakes_from_the_frame_after_the_command_on(driven: Driven) -> None:
    before = car(driven.step())[1]
    assert car(driven.step(DriveCommand(object="traffic.one", speed=0.0)))[1] < before
    assert car(driven.on(40))[1] == 0.0


def test_lane_route_and_stop(driven: Driven) -> None:
    """To the inner lane, 3 m to its left, then on another way, on which it stops."""
    outer = car(driven.step())[0][1]
    driven.step(DriveCommand(object="traffic.one", lane=2))
    assert car(driven.on(10))[0][1] - outer == pytest.approx(3.0, abs=0.01)
    stop = RoadStop(road="north-west-out", position=30.0, duration=5.0, lane=1)
    route = ("east1", "north-west-out")
    driven.step(DriveCommand(object="traffic.one", route=route, stop=stop))
    assert driven.api.vehicle.getRoute("one") == route
    assert [(s.lane, s.endPos, s.duration) for s in driven.api.vehicle.getStops("one")] == [
        ("north-west-out_1", 30.0, 5.0)
    ]


def test_traffic_lights_are_switched_and_their_program_continues(driven: Driven) -> None:
    lights = driven.api.trafficlight
    driven.step()
    assert lights.getPhase("junction-east") == 0
    driven.step(SignalCommand(signal="traffic.junction-east", phase=3, duration=1.0))
    assert lights.getPhase("junction-east") == 3
    driven.on(15)
    assert lights.getPhase("junction-east") == 4
    assert lights.getPhase("junction-west") == 0


@pytest.mark.parametrize(
    ("command", "says"),
    [
        (
            DriveCommand(object="traffic.two"),
            "'traffic.two' is commanded to drive and is no vehicle that is there",
        ),
        (DriveCommand(object="traffic.walker"), "is a person, who walks by itself"),
        (DriveCommand(object="uav"), "'driver' commands 'uav', and the names of world 'traffic' begin with"),
        (DriveCommand(object="traffic.one", lane=3), "on road 'east1' with lanes 0 to 2, and lane 3"),
        (DriveCommand(object="traffic.one", speed=float("inf")), "not finite"),
        (DriveCommand(object="traffic.one", route=("east1", "east4")), "no road 'east4'; did you mean 'east"),
        (DriveCommand(object="traffic.one", route=("west1",)), "SUMO refuses DriveCommand"),
        (
            DriveCommand(object="traffic.one", stop=RoadStop(road="east2", position=900.0, duration=1.0)),
            "road 'east2' is .* m long, and a stop at 900 m",
        ),
        (
            DriveCommand(
                object="traffic.one", stop=RoadStop(road="east2", position=9.0, duration=1.0, lane=7)
            ),
            "lanes 0 to 2, and a stop on lane 7",
        ),
        (
            SignalCommand(signal="traffic.junction-north", phase=0),
            "no traffic lights 'traffic.junction-north'",
        ),
        (SignalCommand(signal="traffic.junction-east", phase=9), "have phases 0 to 5, and phase 9"),
        (
            WaypointCommand(object="traffic.one", position=(0.0, 0.0, 0.0), speed=1.0),
            "sends WaypointCommand to 'traffic.one', which world 'traffic' drives on roads",
        ),
    ],
)
def test_what_is_not_there_is_refused_by_name(driven: Driven, command: Command, says: str) -> None:
    driven.step()
    with pytest.raises(PayloadError, match=says):
        driven.step(command)


def test_two_agents_that_drive_one_vehicle_are_both_named(driven: Driven) -> None:
    driven.step()
    with pytest.raises(PayloadError, match=r"'driver'.*'other'.*'traffic.one'"):
        driven.step(DriveCommand(object="traffic.one", speed=1.0), other=DriveCommand(object="traffic.one"))


def test_commands_are_part_of_the_state(driven: Driven, files: SumoSettings) -> None:
    """Another process goes the same way again, commands included, to the bit."""
    driven.on(5)
    driven.step(
        DriveCommand(object="traffic.one", speed=3.5),
        SignalCommand(signal="traffic.junction-west", phase=3),
    )
    driven.on(10)
    driven.step(DriveCommand(object="traffic.one", lane=2))
    driven.on(3)
    state = driven.world.checkpoint()
    expected = [wire_bytes(driven.step()) for _ in range(20)]
    frame = driven.frame - 20
    driven.world.close()
    again = ActuatedSumoWorld(files, RunInfo(name="traffic", sampling_period_ns=T_SAM_NS))
    again.prepare(Preparation(demand={}))
    other = Driven(again)
    again.restore(state)
    assert again.checkpoint() == state
    other.frame = frame
    assert [wire_bytes(other.step()) for _ in range(20)] == expected
    again.close()


def test_a_world_that_lost_its_commands_says_so(driven: Driven) -> None:
    driven.frame = 7
    with pytest.raises(RunError, match=r"frame 7: .*commanded"):
        driven.step()
