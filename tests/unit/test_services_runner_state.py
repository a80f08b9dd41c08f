"""CHECKPOINT and RESTORE: the real runner in a process of its own, and a broker played by hand."""

from __future__ import annotations

from typing import Any

import pytest
from runner_harness import IDS, Broker, ends, played_broker, service

from caviar_protocol import messages as m

pytestmark = pytest.mark.slow

__all__ = ["played_broker"]

STATEFUL = "sensors:Stateful"


def checkpoint(broker: Broker, frame: int) -> bytes:
    broker.send(m.Checkpoint(**IDS, episode=0, frame=frame))
    assert broker.expect(m.CheckpointDone) == m.CheckpointDone(**IDS, episode=0, frame=frame)
    (state,) = broker.parts
    return state


def granted(broker: Broker, frame: int) -> tuple[Any, ...]:
    """Products of a frame: headers with digests, and their bytes."""
    broker.grant(frame)
    return (broker.expect(m.Done).products, *broker.parts)


def test_only_a_service_with_state_names_the_capability(broker: Broker) -> None:
    for use, able in ((STATEFUL, True), ("sensors:Sensors", False)):
        with service(broker.endpoint, use) as process:
            assert ("checkpoint" in broker.welcome().capabilities) is able
            broker.shutdown()
            ends(process, 0)


def test_another_process_goes_on_where_the_one_before_was(broker: Broker) -> None:
    """State after frame 1; the grants since and those to come have the same products."""
    with service(broker.endpoint, STATEFUL) as process:
        broker.start()
        for frame in range(2):
            granted(broker, frame)
        state = checkpoint(broker, 1)
        expected = [granted(broker, frame) for frame in range(2, 5)]
        process.kill()
    with service(broker.endpoint, STATEFUL) as process:
        broker.start()
        broker.send(m.Restore(**IDS, episode=0, frame=1), state)
        assert broker.expect(m.Ready) == m.Ready(**IDS)
        assert [granted(broker, frame) for frame in range(2, 5)] == expected
        broker.shutdown()
        ends(process, 0)


def test_frames_up_to_the_state_are_not_answered_again(broker: Broker) -> None:
    """What they would get of the state after them is not what they got."""
    with service(broker.endpoint, STATEFUL) as process:
        broker.start()
        broker.grant(0)
        broker.expect(m.Done)
        broker.send(m.Restore(**IDS, episode=0, frame=3), b"4")
        broker.expect(m.Ready)
        for frame in (0, 3):
            broker.grant(frame)
            assert f"frame {frame} was answered long ago" in broker.expect(m.Error).message
        assert granted(broker, 4)
        assert checkpoint(broker, 4) == b"5"
        broker.shutdown()
        ends(process, 0)


def test_what_is_no_state_is_a_fault_that_says_so(broker: Broker) -> None:
    with service(broker.endpoint, STATEFUL) as process:
        broker.start()
        broker.send(m.Restore(**IDS, episode=0, frame=3), b"garbage")
        fault = broker.expect(m.Fault)
        assert (fault.phase, fault.frame, fault.detail) == ("restore", 3, "")
        assert "b'garbage' is no number of steps" in fault.message
        broker.shutdown()
        ends(process, 0)


def test_a_state_that_cannot_be_saved_is_a_fault(broker: Broker) -> None:
    with service(broker.endpoint, STATEFUL) as process:
        broker.start(settings={"wrong": "checkpoint"})
        granted(broker, 0)
        broker.send(m.Checkpoint(**IDS, episode=0, frame=0))
        fault = broker.expect(m.Fault)
        assert (fault.phase, fault.frame) == ("checkpoint", 0)
        assert "nothing to divide in checkpoint" in fault.message
        broker.shutdown()
        ends(process, 0)


def test_orders_of_another_episode_or_for_a_service_without_state_are_not_used(broker: Broker) -> None:
    for use, episode, told in (
        (STATEFUL, 2, "there was no RESET to episode 2"),
        ("sensors:Sensors", 0, "has no state, and named no capability 'checkpoint'"),
    ):
        with service(broker.endpoint, use) as process:
            broker.start()
            broker.send(m.Checkpoint(**IDS, episode=episode, frame=0))
            error = broker.expect(m.Error)
            assert (error.code, error.of) == ("unexpected", "CHECKPOINT")
            assert told in error.message
            broker.send(m.Restore(**IDS, episode=episode, frame=0), b"1")
            assert told in broker.expect(m.Error).message
            broker.shutdown()
            ends(process, 0)
