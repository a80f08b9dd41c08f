"""Which users an agent serves, what it declares, and what its action looks like."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np
import pytest
from link_builders import antenna, frame_of, given, scene_of

from caviar_protocol.codec import decode_payload, encode_payload
from caviar_protocol.errors import PayloadError, ScenarioError
from caviar_protocol.space.scene import Pair
from caviar_protocol.topics import Action, BeamChoice, Carrier, Scene, VelocityCommand
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


WIDE = scene_of(
    antenna("bs1", "tx", (2, 4)),
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


class Odd(Agent[AgentSettings]):
    """Returns what it is told to, of the pairs that it is given."""

    def __init__(self, make: Callable[[Sequence[Pair]], Any], carriers: tuple[Carrier, ...] = ()) -> None:
        super().__init__(AgentSettings(users=("car.*",)), RunInfo(name="pilot", carriers=carriers))
        self._make = make

    def choose(self, frame: Frame, scene: Scene, pairs: Sequence[Pair]) -> Any:
        return self._make(pairs)


def beams(tx: object = "bs1", rx: object = "car.1/rx", **fields: Any) -> BeamChoice:
    return BeamChoice(**{"tx": tx, "rx": rx, "tx_beam": 0, **fields})


@pytest.mark.parametrize(
    ("made", "words"),
    [
        (None, "Odd.choose returned None; return a list of BeamChoice"),
        (5, "Odd.choose returned 5; return a list of BeamChoice"),
        (beams(), r"Odd.choose returned BeamChoice\(.*; return a list"),
        ([None], r"Odd.choose chose None, which is no BeamChoice; write BeamChoice\(tx=pair.tx.name"),
        ([(0, 0)], r"Odd.choose chose \(0, 0\), which is no BeamChoice"),
        (np.zeros(2), r"Odd.choose chose np.float64\(0.0\), which is no BeamChoice"),
        ({"car.1/rx": 0}, "Odd.choose chose 'car.1/rx', which is no BeamChoice"),
        ([beams(tx_beam=-1)], "tx_beam=-1 for bs1 → car.1/rx; write an int from 0 to 7, the beams of 'bs1'"),
        ([beams(tx_beam=8)], "tx_beam=8 for bs1 → car.1/rx; write an int from 0 to 7, the beams of 'bs1'"),
        ([beams(rx_beam=1)], "rx_beam=1 for bs1 → car.1/rx; write 0, the only beam of 'car.1/rx'"),
        ([beams(tx_beam=2.0)], "tx_beam=2.0 for bs1 → car.1/rx; write an int from 0 to 7"),
        ([beams(tx_beam=None)], "tx_beam=None for bs1 → car.1/rx; write an int from 0 to 7"),
        ([beams(tx_beam=np.array([1, 2]))], r"tx_beam=array\(\[1, 2\]\) for bs1 → car.1/rx; write an int"),
        ([beams(tx_beam=np.zeros(9))], r"tx_beam=array\(\[0., 0., 0., 0., 0., 0., 0., 0., 0.\]\) for"),
        ([beams(tx=7)], "tx=7 is no name; write tx=pair.tx.name"),
        ([beams(rx=["car.1/rx"])], r"rx=\['car.1/rx'\] is no name; write rx=pair.rx.name"),
        ([beams(carrier=0)], "carrier=0 is no name; write the carrier's name"),
        ([beams(carrier="sub6")], "carrier='sub6' for bs1 → car.1/rx; the run has: mmwave"),
        (
            [beams(rx="uav/rx")],
            "for bs1 → uav/rx, which it does not serve in this frame; .*: bs1 → car.1/rx, bs1 → car.2/rx",
        ),
        ([beams(), beams(tx_beam=3)], r"for bs1 → car.1/rx twice, \(0, 0\) and \(3, 0\); write one"),
    ],
)
def test_a_choice_that_is_none_is_refused_with_class_value_user_and_range(made: Any, words: str) -> None:
    carriers = (Carrier(name="mmwave", frequency_hz=28e9),)
    with pytest.raises(PayloadError, match=f"^Odd.choose.*{words.removeprefix('Odd.choose')}"):
        Odd(lambda pairs: made, carriers).step(frame_of(given("scene", WIDE)))


def test_whole_numbers_of_numpy_and_a_choice_of_its_own_for_a_carrier_are_right() -> None:
    chosen = [beams(tx_beam=np.argmax([0, 1])), beams(tx_beam=np.int64(3), carrier="mmwave")]
    result = Odd(lambda pairs: iter(chosen)).step(frame_of(given("scene", WIDE)))
    action = decode_payload("action", *encode_payload(result.products["action"]))
    assert isinstance(action, Action)
    assert [(c.carrier, c.tx_beam) for c in action.commands if isinstance(c, BeamChoice)] == [
        ("", 1),
        ("mmwave", 3),
    ]


def test_other_commands_stand_after_the_beams() -> None:
    """Sorted by actuator: ``beam:`` before ``motion:`` before ``schedule:``."""
    commands = action(driver(("motion:uav", "car.1*"))).commands
    assert [type(command) for command in commands] == [BeamChoice] * 4 + [VelocityCommand]


def test_a_command_for_an_actuator_that_is_not_declared_is_refused() -> None:
    """The broker looks for two owners among what agents declare."""

    class Undeclared(DriverAgent):
        def other_actuators(self) -> tuple[str, ...]:
            return ("motion:drone",)

    with pytest.raises(PayloadError, match=r"VelocityCommand.*'motion:uav'.*'motion:drone'"):
        action(Undeclared(AgentSettings(users=("*",)), RunInfo(name="pilot")))


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
    with pytest.raises(ScenarioError, match=r"'motion:uva'.*'motion:uav'"):
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
