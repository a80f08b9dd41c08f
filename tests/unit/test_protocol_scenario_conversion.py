"""Texts of services about the scenario, with the line that they are about."""

from __future__ import annotations

import subprocess
import sys

import pytest

from caviar_protocol.scenario import parse_scenario
from caviar_protocol.scenario.conversion import Source, located

TEXT = """\
[run]
name = "r"
frames = 3

[services.world]
role = "world"
use = "trajectory"
budget_ms = 5

[[services.world.settings.objects]]
name = "car"
kind = "car"

[services."left wing"]
role = "sensors"
use = "lidar"
budget_ms = 5
settings = { bodies = 3 }

[[devices]]
name = "top"
kind = "lidar"
"""


@pytest.fixture(scope="module")
def source() -> Source:
    return parse_scenario(TEXT, "town.toml").source


@pytest.mark.parametrize(
    ("said", "service", "stands", "key"),
    [
        ("services.world.settings.objects[0].name: is bad", "world", 'name = "car"', ""),
        ("settings.objects[0].kind: is bad", "world", 'kind = "car"', "services.world."),
        ("settings.bodies: is bad", "left wing", "settings = {", 'services."left wing".'),
        ("settings.objects[0].mass_kg: is bad", "world", "[[services.world", "services.world."),
        ("settings: needs a net", "left wing", "settings = {", 'services."left wing".'),
        ("run.sampling_period_ns: is bad: 3 of 4", "world", "[run]", ""),
        ("devices[0].kind: is bad", "world", 'kind = "lidar"', ""),
        ("objects[0].kind: is bad", "world", 'kind = "car"', "services.world.settings."),
        ("objects: is unknown", "world", "[[services.world", "services.world.settings."),
    ],
)
def test_a_key_is_told_with_its_line_or_that_of_the_table_around_it(
    source: Source, said: str, service: str, stands: str, key: str
) -> None:
    line = 1 + TEXT[: TEXT.index(stands)].count("\n")
    assert located(said, service, source) == f"town.toml:{line}: {key}{said}"


@pytest.mark.parametrize(
    "said",
    [
        "no libLLVM; apt-get install libllvm19",
        "ValueError: services.world is bad",
        "car: is not there",
        "/data/way.csv:3: services.world.settings.objects[0].waypoints: is bad",
        "services.world is bad",
        "settings_of: nothing",
        "",
    ],
)
def test_what_is_not_about_a_key_stays_as_it_is(source: Source, said: str) -> None:
    assert located(said, "world", source) == said


def test_a_scenario_without_a_file_has_no_lines() -> None:
    assert located("settings.net: is bad", "world", Source()) == "settings.net: is bad"


THREADS = """
import sys, threading
from caviar_protocol.scenario import load_scenario

sys.setswitchinterval(1e-6)
together = threading.Barrier(6)

def load():
    together.wait()
    load_scenario("smoke")

threads = [threading.Thread(target=load) for _ in range(6)]
for thread in threads:
    thread.start()
for thread in threads:
    thread.join()
"""


def test_threads_may_read_their_first_scenarios_at_once() -> None:
    """Without the lock 19 of 30 such processes died of a segmentation fault."""
    for _ in range(3):
        assert subprocess.run([sys.executable, "-c", THREADS], timeout=60).returncode == 0
