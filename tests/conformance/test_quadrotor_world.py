"""World ``flight`` with quadrotors passes the conformance tests of worlds; the registry's test has points."""

from __future__ import annotations

from pathlib import Path

from caviar_protocol.scenario import load_scenario
from caviar_services.testing import WorldConformance
from caviar_services.world.flight import FlightWorld

_SCENARIO = load_scenario(
    Path(__file__).resolve().parents[2] / "deploy" / "caviar_scenarios" / "uav-wind.toml"
)


class TestQuadrotorWorld(WorldConformance):
    """Of scenario ``uav-wind``: in wind and gusts."""

    service_class = FlightWorld
    settings = _SCENARIO.services["world"].settings
    devices = _SCENARIO.devices
