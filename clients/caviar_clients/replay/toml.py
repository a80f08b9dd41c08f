"""A scenario as TOML text."""

from __future__ import annotations

from caviar_protocol.scenario import Scenario
from caviar_protocol.scenario.rules import plain
from caviar_protocol.scenario.toml import toml_text


def scenario_text(scenario: Scenario) -> str:
    """What `caviar_protocol.scenario.load_scenario` reads as this scenario."""
    table = plain(scenario, defaults=False)
    table.pop("source", None)
    if table["run"].get("instants_s"):  # which tell the others
        table["run"].pop("frames", None)
        table["run"].pop("sampling_period_ns", None)
    return toml_text(table)
