"""What WELCOME tells each service about the scenario it is part of."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import msgspec

from caviar_protocol.scenario import Scenario, ServiceSpec
from caviar_protocol.scenario.rules import resolved, world_of


def briefings(scenario: Scenario, directory: Path) -> dict[str, dict[str, Any]]:
    """By service: carriers, devices, timing, and for the recorder where to write what.

    Worlds are told the devices that they publish, all other services all of them, with their worlds.
    """
    plain = resolved(scenario)
    devices = [device | {"world": world_of(scenario, index)} for index, device in enumerate(plain["devices"])]
    common = {
        "carriers": plain["carriers"],
        "sampling_period_ns": scenario.run.sampling_period_ns,
        "frames": scenario.run.frames,
        "episodes": scenario.run.episodes,
    }
    told = {}
    for name, spec in scenario.services.items():
        told[name] = common | {"devices": devices}
        if spec.role == "world":
            told[name]["devices"] = [device for device in devices if device["world"] == name]
        if spec.role == "recorder":
            told[name] |= {"directory": str(directory), "resolved": plain}
    return told


def with_ownership(scenario: Scenario) -> Scenario:
    """The scenario with `ServiceSpec.users` of agents in their settings (contract, clause 17).

    An agent with ``users`` owns those; one without is a default agent and serves all others.
    """
    owned = tuple(
        pattern for spec in scenario.services.values() if spec.role == "agent" for pattern in spec.users
    )
    services = {name: _agent_settings(spec, owned) for name, spec in scenario.services.items()}
    return msgspec.structs.replace(scenario, services=services)


def _agent_settings(spec: ServiceSpec, owned: tuple[str, ...]) -> ServiceSpec:
    if spec.role != "agent" or not owned:
        return spec
    ownership: Mapping[str, Any] = {"users": spec.users} if spec.users else {"except_users": owned}
    return msgspec.structs.replace(spec, settings={**spec.settings, **ownership})
