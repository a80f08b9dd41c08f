"""A world, sensor or agent that says what cannot be is refused at its first product, and blamed for it."""

from __future__ import annotations

from pathlib import Path

import pytest
import wrong_worlds
from scenarios_support import SCENARIOS, run, scenario_file

from caviar_clients.session.embedded import EmbeddedRun
from caviar_protocol.scenario import Scenario, load_scenario, parse_scenario

OBJECTS = "[[services.world.settings.objects]]"
WORDS = {
    "orientation of length 2": "object 'car': orientation (2, 0, 0, 0) has norm 2",
    "orientation of length 3": "object 'car': orientation (3, 0, 0, 0) has norm 3",
    "orientation of zeros": "object 'car': orientation (0, 0, 0, 0) has norm 0",
    "negative dimensions": "object 'car': dimensions (-4.5, -1.8, -1.5) m",
    "dimensions of 1e300": "object 'car': dimensions (4.5e+300, 1.8e+300, 1.5e+300) m",
    "a position beyond the planets": "object 'car': position (1e+200, 1e+200, 1e+200) m",
    "names unsorted": "object 'uav' stands before 'car'",
    "a name twice": "two objects are named 'car'",
    "a name without the prefix": "'bike' has none of the prefixes that READY declared: 'bs', 'car', 'uav'",
    "no devices": "device 'bs' of the scenario is missing",
    "a mount ignored": "device 'bs': position (0, 0, 0), by the scenario it is (0, 0, 10)",
    "a mesh never offered": "object 'car': mesh 'objects/tank.ply' was never offered",
    "a position that is not a number": "object 'car': position (nan, 12345, 12345) m",
}


def wrong(fault: str, since: int = 0) -> list[tuple[str, str]]:
    """Changes of ``smoke`` that put a wrong world in the place of its own."""
    settings = f'[services.world.settings]\nwrong = "{fault}"\nsince = {since}\n\n{OBJECTS}'
    return [
        ('use = "trajectory"', 'use = "wrong_worlds:World"'),
        (OBJECTS, settings),
        ("frames = 100", "frames = 10"),
    ]


def embedded(fault: str, since: int = 0) -> EmbeddedRun:
    """The run in this process, at its end."""
    text = (SCENARIOS / "smoke.toml").read_text()
    for old, new in wrong(fault, since):
        text = text.replace(old, new, 1)
    scenario: Scenario = parse_scenario(text)
    made = EmbeddedRun(scenario, None)
    made.run()
    return made


def test_a_right_world_ends_well() -> None:
    outcome = embedded("").outcome
    assert outcome is not None
    assert (outcome.error, outcome.culprit) == ("", "")


@pytest.mark.parametrize("fault", [*wrong_worlds.WRONG, "a position that is not a number"])
@pytest.mark.parametrize("since", [0, 4])
def test_a_wrong_world_is_refused_and_named(fault: str, since: int) -> None:
    outcome = embedded(fault, since).outcome
    assert outcome is not None
    expected = f"world 'world' made a wrong product: scene of 'world', frame {since}: "
    assert outcome.error.startswith(expected + WORDS[fault] if not since else expected)
    assert outcome.culprit == "world"


def test_processes_blame_the_world_and_not_who_noticed(tmp_path: Path) -> None:
    finished = run(scenario_file(tmp_path, wrong("orientation of length 2")), tmp_path / "out")
    assert finished.status == 1
    assert "world 'world' made a wrong product: scene of 'world', frame 0: object 'car'" in finished.output
    assert "Traceback" not in finished.output


def test_a_false_digest_is_refused_before_it_is_recorded(tmp_path: Path) -> None:
    finished = run(scenario_file(tmp_path, wrong("a false digest")), tmp_path / "out")
    assert finished.status == 1
    assert "world 'world' made a wrong product: scene of 'world', frame 0: its digest is" in finished.output


def test_the_broker_brings_a_pattern_file_that_the_world_does_not(tmp_path: Path) -> None:
    rows = ["theta_deg,phi_deg,gain_dbi", *(f"{t},{p},0" for t in (0, 90, 180) for p in (0, 180, 360))]
    (tmp_path / "sector.csv").write_text("\n".join(rows))
    text = (SCENARIOS / "smoke.toml").read_text().replace("frames = 100", "frames = 3")
    old = "array = { rows = 4, columns = 8"
    assert old in text
    text = text.replace(old, old.replace("{", '{ pattern_file = "file:sector.csv",'), 1)
    digests = set()
    for name, use in [("own", "trajectory"), ("broker", "wrong_worlds:Patternless")]:
        file = tmp_path / f"{name}.toml"
        file.write_text(text.replace('use = "trajectory"', f'use = "{use}"'))
        (tmp_path / name).mkdir()
        outcome = EmbeddedRun(load_scenario(file), tmp_path / name).run()
        assert outcome.error == ""
        assert [item.name for item in (tmp_path / name).rglob("sector.csv")] == ["sector.csv"]
        digests.add(outcome.digest)
    assert len(digests) == 1


@pytest.mark.parametrize("part", ["h", "taps"])
def test_a_channel_without_a_part_in_demand_is_refused(tmp_path: Path, part: str) -> None:
    text = (SCENARIOS / "smoke.toml").read_text()
    for old, new in [
        ('use = "free-space"', f'use = "wrong_worlds:Partless"\nsettings = {{ lacks = "{part}" }}'),
        ('record = ["scene", "channel", "action", "link"]', 'record = ["channel.taps"]'),
        ("[[carriers]]", "[[carriers]]\ntaps = 4"),
        ("frames = 100", "frames = 3"),
    ]:
        assert old in text
        text = text.replace(old, new, 1)
    made = EmbeddedRun(parse_scenario(text), tmp_path)
    outcome = made.run()
    assert outcome.error.startswith("channel 'channel' made a wrong product: channel of 'channel', frame 0: ")
    assert f"part {part!r} is in demand" in outcome.error
    assert outcome.culprit == "channel"


def test_the_recorder_refuses_a_large_product_with_a_false_digest(tmp_path: Path) -> None:
    liar = '[services.liar]\nrole = "sensors"\nuse = "wrong_worlds:Liar"\nbudget_ms = 50\n'
    demand = ('record = ["scene", "channel", "action", "link"]', 'record = ["scene", "lidar"]')
    scenario = scenario_file(tmp_path, [demand, ("frames = 100", "frames = 10")], liar)
    finished = run(scenario, tmp_path / "out")
    assert finished.status == 1
    assert "sensors 'liar' made a wrong product: lidar of 'liar', frame 0: its digest is" in finished.output
    assert "(refused by recorder 'recorder')" in finished.output
