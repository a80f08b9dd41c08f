"""What goes wrong inside a service reaches the broker as a FAULT that says where."""

from __future__ import annotations

import pytest
from runner_harness import IDS, Broker, ends, played_broker, service

from caviar_labs.conform.street import product
from caviar_protocol import messages as m
from caviar_protocol.digest import payload_digest

pytestmark = pytest.mark.slow

__all__ = ["played_broker"]


FAULTS = {
    "prepare": ("prepare", "ZeroDivisionError: nothing to divide in prepare"),
    "reset": ("reset", "ZeroDivisionError: nothing to divide in reset"),
    "step": ("step", "ZeroDivisionError: nothing to divide in step"),
    "nothing": ("step", ".step returned None; return a StepResult"),
    "told by name": ("step", "town.toml:7: devices.0: the mast is 3 m too low"),
    "non-finite": ("encode", "scans[0].points[0, 0] is nan"),
    "wrong type": ("encode", "a payload Action for the topic 'lidar'"),
}


@pytest.mark.parametrize(("wrong", "phase", "words"), [(w, *f) for w, f in FAULTS.items()], ids=FAULTS)
def test_a_failure_becomes_a_fault_with_phase_and_text(
    broker: Broker, wrong: str, phase: str, words: str
) -> None:
    with service(broker.endpoint) as process:
        broker.welcome(settings={"wrong": wrong})
        broker.prepare()
        if wrong != "prepare":
            broker.expect(m.Ready)
            broker.send(m.Reset(**IDS, episode=0, seed=9, t0_ns=0))
        if wrong not in ("prepare", "reset"):
            broker.expect(m.ResetDone)
            broker.grant(3)
        fault = broker.expect(m.Fault)
        assert fault.phase == phase
        assert words in fault.message
        assert fault.frame == (3 if phase in ("step", "encode") else -1)
        assert ("Traceback" in fault.detail) == ("ZeroDivision" in words)
        broker.shutdown()
        ends(process, 0)


@pytest.mark.parametrize(("reason", "status"), [("sensors 'sick' makes no progress", 1), ("sick", 0)])
def test_a_service_that_is_blamed_ends_with_status_1(broker: Broker, reason: str, status: int) -> None:
    with service(broker.endpoint) as process:
        broker.welcome()
        broker.prepare()
        broker.expect(m.Ready)
        broker.shutdown(reason)
        ends(process, status)


def test_a_setting_that_does_not_exist_is_a_fault(broker: Broker) -> None:
    with service(broker.endpoint):
        broker.welcome(settings={"wrogn": "x"})
        fault = broker.expect(m.Fault)
        assert fault.phase == "settings"
        assert "wrogn" in fault.message


def test_a_service_that_cannot_be_made_is_a_fault_and_leaves_when_told(broker: Broker) -> None:
    with service(broker.endpoint, "sensors:Environment") as process:
        broker.welcome()
        assert "OSError: no GPU in" in broker.expect(m.Fault).message
        broker.shutdown()
        ends(process, 0)


def test_an_input_that_cannot_be_decoded_is_a_fault_that_names_its_producer(broker: Broker) -> None:
    fault = refused(broker, b"\xff", b"")
    assert "scene of 'world', frame 0: cannot be read: scene payload" in fault.message


def test_an_input_with_another_digest_is_a_fault_that_names_its_producer(broker: Broker) -> None:
    header, body = product("scene", "traffic", 0)
    fault = refused(broker, header, body, digest="0" * 64)
    assert f"scene of 'world', frame 0: its digest is {payload_digest(header, body)}" in fault.message


def refused(broker: Broker, header: bytes, body: bytes, digest: str = "") -> m.Fault:
    """The FAULT of a service that reads a scene with these bytes."""
    with service(broker.endpoint, "link:Reader") as process:
        broker.start()
        digest = digest or payload_digest(header, body)
        entry = m.GrantInput(topic="scene", source="world", status=m.Status.FRESH, frame=0, digest=digest)
        broker.send(m.Grant(**IDS, episode=0, frame=0, t_ns=0, inputs=(entry,)), header, body)
        fault = broker.expect(m.Fault)
        assert (fault.phase, fault.culprit) == ("step", "world")
        broker.shutdown()
        ends(process, 0)
    return fault


def test_a_process_that_ends_itself_ends_with_that_status(broker: Broker) -> None:
    with service(broker.endpoint, "sensors:Leaves") as process:
        broker.start()
        broker.grant(0)
        assert "the simulator has quit" in ends(process, 1)
