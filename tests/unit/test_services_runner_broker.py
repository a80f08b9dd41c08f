"""A service whose broker is absent, late, refusing or gone."""

from __future__ import annotations

import sys
import time

import pytest
from runner_harness import IDS, MS, Broker, ends, hears, played_broker, service

from caviar_protocol import messages as m

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
    assert "1.2" in said


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
    assert "closed" in said
    assert "Traceback" not in said
    assert 0.9 < elapsed < 2.0


def test_a_service_that_is_stuck_ends_too_when_its_broker_dies(broker: Broker) -> None:
    with service(broker.endpoint, "sensors:SleepsInC") as process:
        broker.start(heartbeat_ns=100 * MS, liveness_ns=1000 * MS)
        broker.grant(0)
        hears(process, "stuck")
        started = time.monotonic()
        said = ends(process, 1)
        assert "has been silent" in said
        assert time.monotonic() - started < 1.0 + 1.0 + 0.7


def test_a_service_that_held_the_interpreter_does_not_take_its_broker_for_dead(broker: Broker) -> None:
    """Answers waited in the socket while nobody could look (clause 15, the other way round)."""
    with service(broker.endpoint, "sensors:HoldsTheInterpreter") as process:
        broker.start(heartbeat_ns=50 * MS, liveness_ns=400 * MS)
        for frame in range(3):
            broker.grant(frame)
            hears(process, "stuck")
            broker.expect(m.Done)
        broker.shutdown()
        ends(process, 0)
