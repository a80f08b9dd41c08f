"""Which users an agent serves, what it declares, and what its action looks like."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import pytest
from link_builders import antenna, frame_of, given, scene_of

from caviar_protocol.codec import encode_payload
from caviar_protocol.errors import ScenarioError
from caviar_protocol.space.scene import Pair
from caviar_protocol.topics import Action, BeamChoice, Scene, VelocityCommand
from caviar_services.agent.base import Agent, AgentSettings
from caviar_services.registry import load
from caviar_services.service import Frame, Preparation, RunInfo

SCENE = scene_of(
    antenna("bs1", "tx"),
    antenna("bs2", "tx"),
    antenna("car.1/rx", "rx", position=(9.0, 0.0, 0.0)),
    antenna("car.2/rx", "rx", position=(0.0, 9.0, 0.0)),
    antenna("uav/rx", "rx", position=(0.0, 0.0, 9.0)),
)


class FirstBeamAgent(Agent[AgentSettings]):
    """Beam 0 for everybody, on two carriers, in reverse order."""

    Settings = AgentSettings

    def choose(self, frame: Frame, scene: Scene, pairs: Sequence[Pair]) -> Iterator[BeamChoice]:
        for pair in reversed(pairs):
            for carrier in ("z", "a"):
                yield BeamChoice(tx=pair.tx.name, rx=pair.rx.name, tx_beam=0, carrier=carrier)


def agent(users: tuple[str, ...] = ("*",), except_users: tuple[str, ...] = ()) -> FirstBeamAgent:
    return FirstBeamAgent(AgentSettings(users=users, except_users=except_users), RunInfo(name="pilot"))


def action(of: Agent[AgentSettings]) -> Action:
    product = of.step(frame_of(given("scene", SCENE))).products["action"]
    assert isinstance(product, Action)
    return product


def served(of: Agent[AgentSettings]) -> set[str]:
    return {command.rx for command in action(of).commands if isinstance(command, BeamChoice)}


def test_commands_are_sorted_by_actuator_then_tx_then_carrier() -> None:
    keys = [(c.rx, c.tx, c.carrier) for c in action(agent()).commands if isinstance(c, BeamChoice)]
    assert keys == sorted(keys)
    assert len(set(keys)) == 3 * 2 * 2


@pytest.mark.parametrize(
    ("users", "except_users", "expected"),
    [
        (("*",), (), {"car.1/rx", "car.2/rx", "uav/rx"}),
        (("car.*",), (), {"car.1/rx", "car.2/rx"}),
        (("beam:car.1/rx", "uav*"), (), {"car.1/rx", "uav/rx"}),
        (("*",), ("beam:car.*",), {"uav/rx"}),
        (("*",), ("motion:uav", "schedule:bs1"), {"car.1/rx", "car.2/rx", "uav/rx"}),
        (("car.?/rx",), ("car.2*",), {"car.1/rx"}),
        (("car",), (), set()),
        ((), (), set()),
    ],
)
def test_an_agent_serves_the_receivers_it_owns(
    users: tuple[str, ...], except_users: tuple[str, ...], expected: set[str]
) -> None:
    assert served(agent(users, except_users)) == expected


def test_owned_receivers_are_declared_as_beam_actuators() -> None:
    prepared = agent(("car.*", "beam:uav/rx")).prepare(Preparation(demand={}))
    assert prepared.actuators == ("beam:car.*", "beam:uav/rx")


def test_an_agent_that_leaves_users_to_others_declares_none_by_name() -> None:
    """`beam:*` would clash with what the others own."""
    prepared = agent(("*",), ("car.*",)).prepare(Preparation(demand={}))
    assert prepared.actuators == ()
    assert prepared.notes == ("serves the users that no other agent owns",)


@pytest.mark.parametrize("actuator", ["motion:uav", "schedule:bs1"])
def test_owning_something_else_than_beams_is_refused_with_the_key(actuator: str) -> None:
    with pytest.raises(ScenarioError, match=rf"services\.pilot\.users: '{actuator}' is no beam"):
        agent((actuator,))


class DriverAgent(FirstBeamAgent):
    """Moves a UAV, too."""

    def other_actuators(self) -> tuple[str, ...]:
        return ("motion:uav",)

    def other_commands(self, frame: Frame, scene: Scene) -> Iterator[VelocityCommand]:
        yield VelocityCommand(object="uav", velocity=(1.0, 2.0, 0.0))


def driver(users: tuple[str, ...], except_users: tuple[str, ...] = ()) -> DriverAgent:
    return DriverAgent(AgentSettings(users=users, except_users=except_users), RunInfo(name="pilot"))


def test_other_commands_stand_after_the_beams() -> None:
    """Sorted by actuator: ``beam:`` before ``motion:`` before ``schedule:``."""
    commands = action(driver(("motion:uav", "car.1*"))).commands
    assert [type(command) for command in commands] == [BeamChoice] * 4 + [VelocityCommand]


@pytest.mark.parametrize(
    ("users", "except_users", "expected"),
    [
        (("motion:uav", "uav/rx"), (), ("beam:uav/rx", "motion:uav")),
        (("*",), (), ("beam:*", "motion:uav")),
        (("motion:uav",), (), ("motion:uav",)),
        (("*",), ("beam:car.*",), ("motion:uav",)),
    ],
)
def test_other_actuators_are_always_declared(
    users: tuple[str, ...], except_users: tuple[str, ...], expected: tuple[str, ...]
) -> None:
    assert driver(users, except_users).prepare(Preparation(demand={})).actuators == expected


def test_owning_the_motion_of_another_object_is_refused() -> None:
    with pytest.raises(
        ScenarioError, match="'motion:uva' is no beam, and this agent steers beams and 'motion:uav'"
    ):
        driver(("motion:uva",))


def test_the_final_grant_takes_no_action() -> None:
    """It brings no scene either (clause 16)."""
    assert agent().step(frame_of(final=True)).products == {}


@pytest.mark.parametrize("name", ["los-beam", "random", "oracle"])
def test_registered_agents_hear_scene_and_last_link_and_say_action(name: str) -> None:
    cls = load("agent", name)
    heard = {(entry.topic, entry.lag): entry.required for entry in cls.inputs}
    assert heard.pop(("scene", 0)) is True
    assert heard.pop(("link", 1)) is False
    assert heard == ({("channel", 0): True} if name == "oracle" else {})
    assert cls.outputs == ("action",)


@pytest.mark.parametrize(("users", "counts"), [(("*",), {}), (("nobody",), {"frames-without-users": 1})])
def test_a_frame_without_users_is_counted(users: tuple[str, ...], counts: dict[str, int]) -> None:
    assert agent(users).step(frame_of(given("scene", SCENE))).counts == counts


def test_an_action_without_users_is_an_action() -> None:
    """The link then knows that no user is served by choice, not by absence."""
    assert encode_payload(action(agent(())))[1] == b""
