"""How often settings are measured, and what is expected of those that were not yet."""

from __future__ import annotations

import pytest

from caviar_labs.tradeoff.campaign import Cost, predicted_s, shares, spread_order
from caviar_labs.tradeoff.ladder import (
    BASELINES,
    LADDER,
    REFERENCES,
    Setting,
    array_settings,
    convergence_settings,
    samples_of,
    spacing_settings,
)
from caviar_protocol.scenario.conversion import Place, convert_settings
from caviar_services.channel.sionna.settings import SionnaSettings


def test_what_the_cheap_leave_goes_to_the_dear() -> None:
    """10 s: the first two need 0.1 s and 1 s at most, so the third gets the 8.9 s that are left."""
    assert shares([0.01, 0.1, 1.0], [10, 10, 100], 10.0) == [10, 10, 8]


def test_time_is_shared_out_equally_where_it_is_short() -> None:
    assert shares([1.0, 1.0, 2.0], [50, 50, 50], 12.0) == [4, 4, 2]


def test_each_is_measured_once_though_there_is_no_time() -> None:
    assert shares([5.0, 1.0, 0.0], [9, 9, 9], 0.0) == [1, 1, 9]


@pytest.mark.parametrize("count", [1, 2, 3, 12, 17])
def test_all_scenes_are_in_the_order(count: int) -> None:
    assert sorted(spread_order(count)) == list(range(count))


def test_the_first_scenes_lie_far_apart() -> None:
    assert spread_order(8) == [0, 4, 2, 6, 1, 5, 3, 7]


def line(column: str, row: str, samples: int, elements: tuple[int, int] | None = None) -> Setting:
    return Setting(
        label=f"{column} {row}",
        use="x",
        settings={"samples": samples},
        column=column,
        row=row,
        elements=elements,
    )


def test_the_first_of_a_column_is_not_expected_to_take_anything() -> None:
    assert predicted_s(line("mimo", "1", 10), [Cost(line("siso", "1", 10), 3.0)]) is None
    assert predicted_s(Setting(label="alone", use="x"), []) is None


def test_time_is_expected_to_grow_as_in_the_first_column() -> None:
    known = [
        Cost(line("siso", "1", 10), 2.0),
        Cost(line("siso", "0.5 (diffuse)", 10), 14.0),
        Cost(line("mimo", "1", 10), 5.0),
    ]
    assert predicted_s(line("mimo", "0.5 (diffuse)", 10), known) == pytest.approx(35.0)


def test_time_is_expected_to_grow_with_samples_and_with_pairs_of_elements() -> None:
    known = [Cost(line("mimo", "a", 10, (64, 2)), 1.5)]
    assert predicted_s(line("mimo", "b", 10, (64, 64)), known) == pytest.approx(1.5 * 32)
    assert predicted_s(line("mimo", "b", 100, (64, 2)), known) == pytest.approx(15.0)


def test_rays_of_a_spacing() -> None:
    """1° is π/180 rad: 4π·(180/π)² = 41,252.96 rays."""
    assert samples_of(1.0) == 41_253
    assert samples_of(0.1) == 4_125_296


def test_labels_are_unique_and_those_of_the_defaults_exist() -> None:
    every = [*LADDER, *spacing_settings(), *array_settings(), *convergence_settings(3)]
    labels = [setting.label for setting in every]
    assert len(labels) == len(set(labels))
    assert {*REFERENCES, *BASELINES} <= {setting.label for setting in LADDER}


def test_what_traces_every_pair_comes_after_what_is_cheap() -> None:
    labels = [setting.label for setting in spacing_settings()]
    assert labels.index("spherical 0.25°") < labels.index("mimo-rt 1°") < labels.index("mimo-rt 0.5°")
    assert labels.index("spherical 0.5° (diffuse, 500 paths)") < labels.index("mimo-rt 1°")
    assert labels.index("mimo-rt 0.5°") < labels.index("siso-rt 0.5° (diffuse)")
    assert labels.index("mimo-rt 0.25°") < labels.index("spherical 0.5° (diffuse)")
    assert labels[-1] == "mimo-rt 0.5° (diffuse)"
    assert [setting.label for setting in array_settings()][-3:] == [
        "mimo-rt 64×2",
        "mimo-rt 64×8",
        "mimo-rt 64×64",
    ]


CHOSEN = {
    "rung": "spherical",
    "diffraction": True,
    "free_edges": True,
    "edges_within_m": 200.0,
    "scattering": True,
    "scattering_samples": 1000,
    "scattering_paths": 10,
    "ray_spacing_deg": 0.5,
}


@pytest.mark.parametrize("chosen", [CHOSEN, {"follow": 4}], ids=["choices", "follow"])
def test_no_choice_of_the_scenario_keeps_a_setting_from_being_measured(chosen: dict[str, object]) -> None:
    """Choices that exclude each other, and those that need what a setting switches off."""
    settings = (*LADDER, *spacing_settings(), *array_settings(), *convergence_settings(1))
    for setting in (setting for setting in settings if setting.use == "sionna-rt"):
        known = convert_settings(SionnaSettings, setting.over(chosen))
        known.check(Place("settings"))
        assert known.rung == setting.settings.get("rung", "siso-rt")
        if setting.settings["diffraction"]:
            assert known.free_edges == chosen.get("free_edges", False)
