"""A service whose broker is absent, late, refusing or gone."""

from __future__ import annotations

import sys
import time

import pytest
from runner_harness import IDS, MS, Broker, ends, hears, played_broker, service

from caviar_protocol import messages as m

pytestmark = pytest.mark.slow

__all__ = ["played_broker"]


def test_without_a_broker_it_waits_as_long_as_told_and_says_where(broker: Broker) -> None:
    endpoint = broker.endpoint
    broker.socket.unbind(endpoint)
    started = time.monotonic()
    with service(endpoint, "sensors:Sensors", "--connect-timeout", "0.5") as process:
        said = ends(process, 1)
    assert f"no answer from a broker at {endpoint} within 0.5 s; is `caviar broker` running there?" in said
    assert "Traceback" not in said
    assert time.monotonic() - started > 0.5


def test_a_broker_that_starts_later_is_found(broker: Broker) -> None:
    endpoint = broker.endpoint
    broker.socket.unbind(endpoint)
    with service(endpoint, "sensors:SlowStart") as process:
        hears(process, "loaded")  # by now it is about to connect
        with pytest.raises(AssertionError, match="nothing came"):
            broker.receive(within_s=0.5)
        broker.socket.bind(endpoint)
        broker.start()
        broker.shutdown()
        ends(process, 0)


def test_an_address_that_is_none_is_named() -> None:
    with service("tpc:/nowhere") as process:
        said = ends(process, 1)
    assert "cannot connect to 'tpc:/nowhere'" in said
    assert "Traceback" not in said


def test_a_refusal_ends_it_with_the_reason(broker: Broker) -> None:
    with service(broker.endpoint) as process:
        broker.expect(m.Hello)
        broker.send(m.Refuse(code="name-taken", message="a service named 'sick' takes part already"))
        said = ends(process, 1)
    assert "(name-taken): a service named 'sick' takes part already" in said
    assert "Traceback" not in said


def test_a_refusal_at_ready_ends_it_with_the_reason(broker: Broker) -> None:
    """As where its actuators clash with those of another agent."""
    with service(broker.endpoint) as process:
        broker.welcome()
        broker.prepare()
        broker.send(m.Refuse(code="clash", message="agents 'a' and 'b' own the same"))
        said = ends(process, 1)
    assert "(clash): agents 'a' and 'b' own the same" in said


def test_a_broker_of_another_major_version_is_left_naming_both(broker: Broker) -> None:
    with service(broker.endpoint) as process:
        broker.expect(m.Hello)
        welcome = m.Welcome(version=(3, 1), run="x", **IDS, heartbeat_ns=1, liveness_ns=1)
        broker.send(welcome)
        said = ends(process, 1)
    assert "3.1" in said
    assert ".".join(map(str, m.PROTOCOL_VERSION)) in said


def test_a_run_that_is_over_before_it_began_ends_it(broker: Broker) -> None:
    with service(broker.endpoint) as process:
        broker.expect(m.Hello)
        broker.send(m.Shutdown(reason="the world did not come"))
        assert "the run ended before 'sick' was in it: the world did not come" in ends(process, 1)


def test_a_broker_that_does_not_know_it_any_more_ends_it(broker: Broker) -> None:
    with service(broker.endpoint) as process:
        broker.start()
        broker.send(m.Error(code="unknown-peer", of="DONE", message="DONE came before HELLO"))
        assert "does not know 'sick' any more" in ends(process, 1)


def test_a_service_ends_when_its_broker_dies(broker: Broker) -> None:
    with service(broker.endpoint) as process:
        broker.start(heartbeat_ns=100 * MS, liveness_ns=1000 * MS)
        broker.socket.unbind(broker.endpoint)
        started = time.monotonic()
        said = ends(process, 1)
        elapsed = time.monotonic() - started
    sys.stdout.write(f"the death of the broker was noticed after {elapsed:.2f} s with a liveness of 1 s\n")
    assert "has been silent for 1." in said
    assert "the run does not wait until it has connected again (timeouts.rejoin_s of the scenario)" in said
    assert "closed" in said
    assert "Traceback" not in said
    assert 0.9 < elapsed < 20.0


def test_a_service_that_is_stuck_ends_too_when_its_broker_dies(broker: Broker) -> None:
    with service(broker.endpoint, "sensors:SleepsInC") as process:
        broker.start(heartbeat_ns=100 * MS, liveness_ns=1000 * MS)
        broker.grant(0)
        hears(process, "stuck")
        started = time.monotonic()
        said = ends(process, 1)
        assert "has been silent" in said
        assert time.monotonic() - started < 20.0


def test_a_service_that_held_the_interpreter_does_not_take_its_broker_for_dead(broker: Broker) -> None:
    """Answers waited in the socket while nothing could look (clause 15, the other way round)."""
    with service(broker.endpoint, "sensors:HoldsTheInterpreter") as process:
        broker.start(heartbeat_ns=50 * MS, liveness_ns=400 * MS)
        for frame in range(3):
            broker.grant(frame)
            hears(process, "stuck")
            broker.expect(m.Done)
        broker.shutdown()
        ends(process, 0)


def comes_back(broker: Broker) -> None:
    """Up to the first grant of the incarnation that follows upon the one of `runner_harness.IDS`."""
    hello = broker.expect(m.Hello)
    assert hello.name == "sick"
    told = {"heartbeat_ns": 100 * MS, "liveness_ns": 400 * MS, "rejoin_ns": 10_000 * MS}
    broker.send(m.Welcome(version=m.PROTOCOL_VERSION, **NEXT, run="test", **told))
    broker.send(m.Prepare(**NEXT, demand=(m.Demand(topic="lidar"),)))
    assert broker.expect(m.Ready).attempt == NEXT["attempt"]
    broker.send(m.Reset(**NEXT, episode=0, seed=9, t0_ns=0))
    assert broker.expect(m.ResetDone) == m.ResetDone(**NEXT, episode=0)


NEXT = IDS | {"attempt": IDS["attempt"] + 1}


def test_a_service_whose_place_is_held_comes_back_when_it_lost_its_broker(broker: Broker) -> None:
    with service(broker.endpoint) as process:
        broker.start(heartbeat_ns=100 * MS, liveness_ns=400 * MS, rejoin_ns=10_000 * MS)
        broker.grant(0)
        broker.expect(m.Done)
        lost, broker.answering = broker.route, False
        broker.expect(m.Hello)
        assert broker.route != lost
        broker.answering = True
        broker.send(m.Refuse(code="name-taken", message="a service named 'sick' takes part already"))
        comes_back(broker)
        broker.grant(0, **NEXT)
        assert broker.expect(m.Done).attempt == NEXT["attempt"]
        broker.shutdown()
        said = ends(process, 0)
    assert "trying to come back for at most 10 s (timeouts.rejoin_s)" in said
    assert "as attempt 3" in said


def test_a_service_that_its_broker_forgot_comes_back(broker: Broker) -> None:
    """As where the broker was started again: it is another epoch, or another attempt, than before."""
    with service(broker.endpoint) as process:
        broker.start(rejoin_ns=10_000 * MS)
        broker.send(m.Error(code="unknown-peer", of="DONE", message="DONE came before HELLO"))
        comes_back(broker)
        broker.shutdown()
        ends(process, 0)


def test_a_service_that_cannot_come_back_gives_up_naming_the_setting(broker: Broker) -> None:
    with service(broker.endpoint) as process:
        broker.start(heartbeat_ns=100 * MS, liveness_ns=400 * MS, rejoin_ns=1_000 * MS)
        broker.socket.unbind(broker.endpoint)
        started = time.monotonic()
        said = ends(process, 1)
        assert 1.0 < time.monotonic() - started < 20.0
    assert "has been silent for 0." in said
    assert "it could not come back within 1 s" in said
    assert "timeouts.rejoin_s of the scenario says for how long the run waits" in said
    assert "Traceback" not in said


def test_a_refusal_is_the_end_of_coming_back(broker: Broker) -> None:
    with service(broker.endpoint) as process:
        broker.start(rejoin_ns=10_000 * MS)
        broker.send(m.Error(code="unknown-peer", of="DONE", message="DONE came before HELLO"))
        broker.expect(m.Hello)
        broker.send(m.Refuse(code="late", message="the run is over"))
        assert "(late): the run is over" in ends(process, 1)


def test_a_stuck_service_ends_once_its_place_is_given_up(broker: Broker) -> None:
    with service(broker.endpoint, "sensors:SleepsInC") as process:
        broker.start(heartbeat_ns=100 * MS, liveness_ns=400 * MS, rejoin_ns=1_000 * MS)
        broker.grant(0)
        hears(process, "stuck")
        broker.answering = False
        started = time.monotonic()
        assert "has been silent" in ends(process, 1)
        assert 1.0 < time.monotonic() - started < 20.0
