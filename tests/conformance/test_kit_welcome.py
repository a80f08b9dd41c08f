"""The kit welcomes a client with the bytes that a broker sends it for the same scenario."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from caviar_broker.core import events as ev
from caviar_broker.core.clock import FrameClock
from caviar_broker.core.plan import briefings, plan_run, with_ownership
from caviar_labs.conform import session as kit
from caviar_labs.conform.client import Rules, pack, unpack
from caviar_labs.conform.session import Seen, Session
from caviar_labs.conform.street import SCENARIO, scenario_of
from caviar_protocol import messages as m
from caviar_protocol.codec import encode_message
from caviar_protocol.scenario import parse_scenario

ROLES = {service: spec.role for service, spec in parse_scenario(SCENARIO).services.items()}


class Wire:
    """Keeps the header that the kit sends."""

    header = b""

    def send(self, _: bytes, header: dict[str, Any]) -> None:
        self.header = pack(header)


def from_broker(hello: m.Hello, directory: Path) -> bytes:
    text = scenario_of({"role": hello.role, "version": hello.version})
    # A scenario in a file says `file:`; what is loaded from it is as this.
    scenario = with_ownership(parse_scenario(text))
    clock = FrameClock(plan_run(scenario, "conformance", briefings(scenario, directory)), 0)
    clock.receive(ev.Joined(hello), 0)
    (welcome,) = [action.message for action in clock.actions() if isinstance(action, ev.Send)]
    return encode_message(welcome)


def from_kit(hello: m.Hello, directory: Path) -> bytes:
    wire = Wire()
    rules = Rules(directory=str(directory))
    session = Session(wire, None, rules, Seen())  # type: ignore[arg-type]
    session.hello = unpack(encode_message(hello))
    session.welcome()
    return wire.header


@pytest.mark.parametrize("version", [(1, 0), (1, 4)])
@pytest.mark.parametrize("name", ROLES)
def test_kit_and_broker_send_the_same_welcome(name: str, version: tuple[int, int], tmp_path: Path) -> None:
    capabilities = ("parts", "checkpoint", "from-the-future")
    hello = m.Hello(version=version, name=name, role=ROLES[name], capabilities=capabilities)
    expected, got = (unpack(make(hello, tmp_path)) for make in (from_broker, from_kit))
    if ROLES[name] == "recorder":  # each life of a recorder has a directory of its own
        expected["scenario"]["directory"] = got["scenario"]["directory"]
    expected.pop("rejoin_ns")  # the kit's broker does not come back
    # The run's own identity, its seed and its time-outs are what a case plays with.
    own = {"epoch": kit.EPOCH, "attempt": kit.ATTEMPT, "seed": kit.SEED, "heartbeat_ns": 50_000_000}
    assert pack(got) == pack(expected | own | {"liveness_ns": 3_000_000_000})


def test_a_client_without_capabilities_gets_none() -> None:
    hello = m.Hello(version=(1, 0), name="pilot", role="agent")
    assert "capabilities" not in unpack(from_kit(hello, Path("/nowhere")))


def test_a_world_of_this_version_is_told_of_all_that_it_brought_to_arrays() -> None:
    told = {}
    for version in ((1, 3), (1, 4)):
        hello = m.Hello(version=version, name="traffic", role="world")
        arrays = [
            device["array"] or {}
            for device in unpack(from_kit(hello, Path("/nowhere")))["scenario"]["devices"]
        ]
        told[version] = [any(array.get(key) for array in arrays) for key in ("panels", "pattern_file")]
        told[version].append(any(array.get("polarization") == "cross" for array in arrays))
    assert told == {(1, 3): [False] * 3, (1, 4): [True] * 3}
