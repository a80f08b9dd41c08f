"""Scenario files: their types, their rules, and reading them.

>>> from caviar_protocol.scenario import load_scenario
>>> load_scenario("smoke").run.frames
100
"""

from caviar_protocol.scenario.loader import find_scenario, load_scenario, parse_scenario, shipped_scenarios
from caviar_protocol.scenario.schema import (
    REMOTE,
    REMOTE_REJOIN_S,
    DeviceSpec,
    Limits,
    ReplaySpec,
    Run,
    Scenario,
    ServiceSpec,
    Timeouts,
)
