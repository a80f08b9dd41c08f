"""Which agent chose what for which user; every contradiction names its culprit."""

from __future__ import annotations

from typing import Any

import pytest
from link_builders import CARRIER, antenna, choices, frame_of, scene_of

from caviar_protocol.errors import PayloadError, ProductError
from caviar_protocol.messages import Status
from caviar_protocol.topics import Carrier, UserSchedule, WaypointCommand
from caviar_services.link.base import Choices, choices_of, users_of
from caviar_services.service import FrameInput

SECOND = Carrier(name="sub6", frequency_hz=3.5e9)
SCENE = scene_of(
    antenna("bs", "tx", (1, 4)),
    antenna("a/rx", "rx", (1, 2), (9.0, 0.0, 0.0)),
    antenna("b/rx", "rx", (1, 2), (0.0, 9.0, 0.0)),
)


def chosen(*inputs: FrameInput, carriers: tuple[Carrier, ...] = (CARRIER,)) -> Choices:
    return choices_of(frame_of(*inputs), users_of(SCENE, carriers))


def beams(found: Choices) -> list[tuple[int, int]]:
    return list(zip(found.tx_beam.tolist(), found.rx_beam.tolist(), strict=True))


def test_without_any_action_nobody_is_served() -> None:
    assert beams(chosen()) == [(-1, -1), (-1, -1)]


def test_two_agents_serve_one_user_each() -> None:
    found = chosen(choices("two", ("bs", "b/rx", 2, 0)), choices("one", ("bs", "a/rx", 3, 1)))
    assert beams(found) == [(3, 1), (2, 0)]


def test_a_choice_without_carrier_holds_where_its_agent_names_none() -> None:
    """Whatever the order of the two commands."""
    general, special = ("bs", "a/rx", 1, 0), ("bs", "a/rx", 2, 1, "sub6")
    for commands in ((general, special), (special, general)):
        found = chosen(choices("agent", *commands), carriers=(CARRIER, SECOND))
        assert beams(found) == [(1, 0), (-1, -1), (2, 1), (-1, -1)]


def test_commands_to_things_that_move_are_not_the_links_business() -> None:
    fly = WaypointCommand(object="uav", position=(0.0, 0.0, 9.0), speed=3.0)
    assert beams(chosen(choices("pilot", fly, ("bs", "a/rx", 1, 1)))) == [(1, 1), (-1, -1)]


def test_a_scheduled_receiver_is_the_only_one_served() -> None:
    found = chosen(
        choices("beams", ("bs", "a/rx", 1, 1), ("bs", "b/rx", 2, 0)),
        choices("scheduler", UserSchedule(tx="bs", rx="b/rx")),
    )
    assert beams(found) == [(-1, -1), (2, 0)]


def test_several_receivers_of_a_transmitter_may_be_scheduled() -> None:
    found = chosen(
        choices("beams", ("bs", "a/rx", 1, 1), ("bs", "b/rx", 2, 0)),
        choices("scheduler", UserSchedule(tx="bs", rx="a/rx"), UserSchedule(tx="bs", rx="b/rx")),
    )
    assert beams(found) == [(1, 1), (2, 0)]


def test_an_absent_action_is_no_action() -> None:
    absent = choices("late", ("bs", "a/rx", 1, 1), status=Status.ABSENT)
    assert beams(chosen(absent)) == [(-1, -1), (-1, -1)]


def test_a_held_action_may_name_a_user_that_left_and_is_counted() -> None:
    found = chosen(
        choices("agent", ("bs", "gone/rx", 1, 1), ("bs", "a/rx", 1, 1), status=Status.HELD),
        choices("scheduler", UserSchedule(tx="bs", rx="gone/rx"), status=Status.HELD),
    )
    assert beams(found) == [(1, 1), (-1, -1)]
    assert found.outdated == 2


@pytest.mark.parametrize(
    ("inputs", "message"),
    [
        (
            (choices("dqn", ("bs", "a/rx", 1, 1)), choices("greedy", ("bs", "a/rx", 1, 1))),
            r"agents 'dqn' and 'greedy' both choose beams for bs → a/rx on carrier 'mmwave'; .*users",
        ),
        (
            (choices("dqn", ("bs", "a/rx", 1, 1)), choices("greedy", ("bs", "a/rx", 1, 1, "mmwave"))),
            r"agents 'dqn' and 'greedy' both choose beams for bs → a/rx",
        ),
        (
            (choices("dqn", ("bs", "a/rx", 1, 1), ("bs", "a/rx", 2, 1)),),
            r"action of 'dqn', frame .*: two commands choose beams for bs → a/rx",
        ),
        (
            (choices("dqn", ("bs", "a/rx", 4, 0)),),
            r"of 'dqn', frame .*: it chose TX beam 4 for bs → a/rx; the codebook of 'bs' has beams 0 to 3",
        ),
        (
            (choices("dqn", ("bs", "a/rx", -1, 0)),),  # within one process nothing decodes it
            r"of 'dqn', frame .*: it chose TX beam -1 for bs → a/rx; the codebook of 'bs' has beams 0 to 3",
        ),
        (
            (choices("dqn", ("bs", "b/rx", 0, 2)),),
            r"of 'dqn', frame .*: it chose RX beam 2 for bs → b/rx; the codebook of 'b/rx' has beams 0 to 1",
        ),
        (
            (choices("dqn", ("bs", "c/rx", 0, 0)),),
            r"of 'dqn', frame .*: it commands bs → c/rx, which does not exist .* are: bs → a/rx, bs → b/rx",
        ),
        (
            (choices("dqn", ("bs", "a/rx", 0, 0, "x-band")),),
            r"action of 'dqn', frame .*: it commands bs → a/rx on carrier 'x-band', which does not exist",
        ),
        (
            (choices("dqn", UserSchedule(tx="bs2", rx="a/rx")),),
            r"action of 'dqn', frame .*: it commands bs2 → a/rx, which does not exist",
        ),
        (
            (
                choices("p", UserSchedule(tx="bs", rx="a/rx")),
                choices("q", UserSchedule(tx="bs", rx="b/rx")),
            ),
            r"agents 'p' and 'q' both schedule receivers of 'bs'; let one of them own 'schedule:bs'",
        ),
        (
            (choices("p", UserSchedule(tx="bs", rx="a/rx"), UserSchedule(tx="bs", rx="a/rx")),),
            r"action of 'p', frame .*: two commands schedule bs → a/rx",
        ),
    ],
)
def test_contradictions_and_strangers_are_refused_by_name(inputs: Any, message: str) -> None:
    error = PayloadError if message.startswith("agents") else ProductError
    with pytest.raises(error, match=message):
        chosen(*inputs)
