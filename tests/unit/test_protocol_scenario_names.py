"""Scenarios that ship with the package are found by their names, from any folder."""

from __future__ import annotations

from pathlib import Path

import pytest

from caviar_protocol.errors import ScenarioError
from caviar_protocol.scenario import find_scenario, load_scenario, shipped_scenarios


def test_every_shipped_scenario_is_loaded_by_its_name_from_any_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert {"smoke", "street-canyon", "geometric"} <= set(shipped_scenarios())
    for name, path in shipped_scenarios().items():
        assert load_scenario(name) == load_scenario(path)


@pytest.mark.parametrize("own", ["smoke", "smoke.toml"])
def test_a_name_that_is_a_shipped_scenario_and_a_file_here_is_refused(
    own: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    shipped = find_scenario("smoke")
    Path(own).write_text("x")
    with pytest.raises(ScenarioError, match=rf"^smoke is .*, and {own} is a file here: write .*/{own} or .*"):
        find_scenario("smoke")
    assert find_scenario("smoke.toml") == Path("smoke.toml")
    assert find_scenario(str(shipped)) == shipped


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ("smok", "did you mean 'smoke'\\?.*street-canyon"),
        ("deploy/scenarios/smoke.toml", "called by its name: smoke"),
        ("smoke.toml", "called by its name: smoke"),
        ("mine", "there is a mine.toml"),
    ],
)
def test_what_is_neither_a_file_nor_a_name_is_refused_with_what_was_meant(
    given: str, said: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("mine.toml").write_text("")
    with pytest.raises(ScenarioError, match=said):
        load_scenario(given)


def test_the_demo_is_the_street_canyon_with_less_recorded() -> None:
    demo, street = load_scenario("demo"), load_scenario("street-canyon")
    assert demo.devices == street.devices
    assert demo.carriers == street.carriers
    assert demo.timeouts == street.timeouts
    assert {name for name in street.services if demo.services[name] != street.services[name]} == {
        "lidar",
        "recorder",
    }
