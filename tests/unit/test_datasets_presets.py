"""Presets: the columns of the paper's Table 2 on any scenario."""

from __future__ import annotations

import pytest
from msgspec.structs import replace

from caviar_clients.datasets.plan import (
    PRESETS,
    apply_preset,
    find_preset,
    further_transmitters,
    with_cameras,
    with_own_traffic,
)
from caviar_clients.session.prepared import prepare
from caviar_protocol.errors import ScenarioError
from caviar_protocol.scenario import Scenario, load_scenario

# Table 2 of the paper: GHz, receivers, ms between scenes, s between episodes, episodes, scenes, valid / 1000.
TABLE = {
    "s001": ((60,), "mobile", 100, 30, 116, 50, 41),
    "s005": ((2.8, 5), "fixed", 10, 35, 125, 80, 100),
    "s006": ((28, 60), "fixed", 1, 35, 200, 10, 20),
    "s008": ((60,), "mobile", None, 30, 2086, 1, 11),
    "s011": ((60,), "mobile", 500, 6, 76, 20, 13),
    "s012": ((60,), "fixed", 500, 6, 105, 20, 21),
}


def receivers(scenario: Scenario) -> list[tuple[bool, int]]:
    """(whether it is on an object, count) of each entry of receivers."""
    return [(bool(d.on), d.count) for d in scenario.devices if d.kind == "antenna" and d.role == "rx"]


@pytest.mark.parametrize("name", TABLE)
def test_a_preset_has_the_columns_of_the_table(name: str) -> None:
    ghz, kind, between_ms, between_s, episodes, scenes, valid = TABLE[name]
    preset = PRESETS[name]
    assert preset.valid_channels == valid * 1000
    scenario = prepare(apply_preset(preset, load_scenario(preset.scenario))).scenario
    assert [carrier.frequency_hz / 1e9 for carrier in scenario.carriers] == pytest.approx(ghz)
    assert receivers(scenario) == ([(True, 10)] if kind == "mobile" else [(False, 1)] * 10)
    assert (scenario.run.episodes, scenario.run.frames) == (episodes, scenes)
    assert [device.name for device in scenario.devices if device.role == "tx"] == ["bs"]
    if between_ms is not None:
        assert scenario.run.sampling_period_ns == between_ms * 1_000_000
    assert scenario.services["traffic"].settings["between_episodes_s"] == between_s
    keeps = {d.keeps_heading for d in scenario.devices if d.kind == "antenna" and d.on}
    assert keeps == ({name != "s011"} if kind == "mobile" else set())
    assert scenario.services["channel"].settings["rung"] == ("spherical" if name == "s012" else "siso-rt")


def test_a_preset_keeps_the_scene_it_is_applied_to() -> None:
    base = load_scenario("street-canyon")
    scenario = apply_preset(PRESETS["s011"], base)
    assert scenario.services["traffic"].settings["net"] == base.services["traffic"].settings["net"]
    assert scenario.carriers[0].bandwidth_hz == base.carriers[0].bandwidth_hz


def test_of_several_transmitters_a_preset_keeps_the_first_that_stands() -> None:
    assert further_transmitters(load_scenario("district-b")) == ["roof-1", "roof-2"]
    assert further_transmitters(load_scenario("canyon-mobile")) == []


@pytest.mark.parametrize(
    ("preset", "scenario", "words"),
    [
        (
            "s012",
            "street-canyon",
            r"street-canyon.toml: devices: s012 has 10 receivers that stand; the scenario has 0",
        ),
        (
            "s008",
            "canyon-fixed",
            r"s008 has 10 receivers on vehicles; the scenario has 10 antennas with role rx",
        ),
        ("s008", "smoke", r"s008 has 10 receivers on vehicles; the scenario has 2 antennas"),
    ],
)
def test_a_scenario_with_other_receivers_is_refused(preset: str, scenario: str, words: str) -> None:
    with pytest.raises(ScenarioError, match=words):
        apply_preset(PRESETS[preset], load_scenario(scenario))


def test_a_scenario_without_a_carrier_is_refused() -> None:
    base = load_scenario("canyon-mobile")
    with pytest.raises(ScenarioError, match="has no carrier"):
        apply_preset(PRESETS["s001"], replace(base, carriers=()))


def test_a_preset_that_is_misspelt_is_named() -> None:
    assert find_preset("s008") is PRESETS["s008"]
    assert find_preset("street-canyon") is None
    assert find_preset("cell") is None
    for name in ("s08", "S008", "s8", "s-008", "so08"):
        with pytest.raises(
            ScenarioError, match=f"no preset '{name}'; did you mean 's008'\\? presets: s001, s005"
        ):
            find_preset(name)
    with pytest.raises(ScenarioError, match=r"'s009'.*'s00"):
        find_preset("s009")


def test_episodes_have_a_traffic_of_their_own_where_that_is_asked_for() -> None:
    scenario = with_own_traffic(load_scenario("canyon-mobile"))
    assert "between_episodes_s" not in scenario.services["traffic"].settings
    assert scenario.services["traffic"].settings["begin_s"] == 60.0


def test_three_cameras_stand_beside_the_transmitter() -> None:
    base = load_scenario("canyon-mobile")
    scenario = prepare(with_cameras(base)).scenario
    cameras = [device for device in scenario.devices if device.kind == "camera"]
    assert [(camera.name, camera.yaw_deg, camera.size_px) for camera in cameras] == [
        ("left", 150.0, (960, 540)),
        ("centre", 90.0, (960, 540)),
        ("right", 30.0, (960, 540)),
    ]
    assert {camera.position_m for camera in cameras} == {(0.0, -8.3, 5.3)}
    assert scenario.run.record == (*base.run.record, "camera")
    assert scenario.services["camera"].use == "camera"


def test_with_cameras_all_stays_recorded_where_no_topic_is_named() -> None:
    base = load_scenario("canyon-mobile")
    scenario = with_cameras(replace(base, run=replace(base.run, record=())))
    assert set(scenario.run.record) == {"scene", "channel", "link", "action", "camera"}


def test_cameras_need_a_transmitter_that_stands() -> None:
    base = load_scenario("canyon-mobile")
    flying = tuple(replace(d, on="vehicle.bus-1") if d.role == "tx" else d for d in base.devices)
    with pytest.raises(ScenarioError, match="has no transmitter that stands"):
        with_cameras(replace(base, devices=flying))
