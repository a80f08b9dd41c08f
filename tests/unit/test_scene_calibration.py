"""Calibration: planted constants are found, what data do not tell is named, bad tables are refused."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from caviar_clients.cli.main import app
from caviar_clients.session.scenes import Scenes, scene_at
from caviar_protocol.errors import AssetError
from caviar_scenes.calibration import Fitted, FixedPaths, Measurements, calibrate, read_measurements
from caviar_space.imported_scenes import ImportedScene, Piece, write_scene
from caviar_space.meshes import box
from caviar_space.mitsuba_xml import RadioMaterial

pytestmark = [pytest.mark.slow, pytest.mark.channel]

SCENARIO = """
[run]
name = "calibration"
frames = 1
[[carriers]]
name = "c"
frequency_hz = 28e9
[services.world]
role = "world"
use = "trajectory"
budget_ms = 20
[services.world.settings]
scenery = "file:scene/scene.xml"
[services.radio]
role = "channel"
use = "sionna-rt"
budget_ms = 300
[services.radio.settings]
max_depth = 1
candidates = "launched"
samples = 20000
[[devices]]
name = "bs"
kind = "antenna"
role = "tx"
position_m = [-30.0, 0.0, 6.0]
power_dbm = 30.0
array = { polarization = "H" }
[[devices]]
name = "ue"
kind = "antenna"
role = "rx"
position_m = [10.0, 1.5, 1.5]
array = { polarization = "H" }
"""
PLANTED = {"brick": 3.1, "glass": 7.4, "concrete": 6.5}


@pytest.fixture(scope="module")
def scenarios(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """A street of three materials, with a plate in the direct path: as in ITU-R P.2040, and planted."""
    folder = tmp_path_factory.mktemp("calibration")
    names = ("brick", "glass", "concrete", "marble", "metal")
    scene = ImportedScene(name="street", materials={name: RadioMaterial(name, 0.3) for name in names})
    scene.materials["ground"] = RadioMaterial("asphalt_concrete", 0.3)
    for name, mesh, material in (
        ("ground", box((-60, 60), (-60, 60), (-1, 0)), "ground"),
        ("north", box((-40, 40), (12, 20), (0, 15)), "brick"),
        ("south west", box((-40, 0), (-20, -12), (0, 15)), "glass"),
        ("south east", box((0, 40), (-20, -12), (0, 15)), "concrete"),
        ("plate", box((-28, -27.98), (-0.6, 0.6), (5.0, 6.1)), "metal"),
        ("far", box((200, 210), (200, 210), (0, 5)), "marble"),
    ):
        scene.pieces[name] = Piece(mesh, material, "building", "test", 1)
    write_scene(scene, folder / "scene")
    (folder / "known.toml").write_text(SCENARIO)
    planted = [
        f"[services.radio.settings.materials.{name}]\nrelative_permittivity = {value}\n"
        for name, value in PLANTED.items()
    ]
    (folder / "true.toml").write_text(SCENARIO + "".join(planted))
    return folder / "known.toml", folder / "true.toml"


@pytest.fixture(scope="module")
def truth(scenarios: tuple[Path, Path]) -> tuple[Scenes, Measurements, FixedPaths]:
    """The scenario as it is known; powers of the true one at 200 places, and its paths."""
    rng = np.random.default_rng(2)
    position = np.column_stack([rng.uniform(-2, 38, 200), rng.uniform(-5, 5, 200), rng.uniform(1.2, 2, 200)])
    paths = FixedPaths(scene_at(scenarios[1]), position)
    power = 30 + 10 * np.log10(paths.power(paths.amplitude)) + rng.normal(0, 1, 200)
    measured = Measurements(position=position, transmitter=("",) * 200, power_dbm=power, response=None)
    return scene_at(scenarios[0]), measured, paths


def by_name(parameters: tuple[Fitted, ...]) -> dict[tuple[str, str], Fitted]:
    return {(one.material, one.parameter.split("_", maxsplit=1)[0]): one for one in parameters}


def test_planted_permittivities_are_found_and_an_unseen_material_is_named(
    truth: tuple[Scenes, Measurements, FixedPaths],
) -> None:
    scenes, measured, _ = truth
    found = calibrate(scenes, measured, [*PLANTED, "marble"])
    assert found.agreement < 1e-3
    assert found.after < 1.2 < found.before
    assert (found.places, found.without, found.service) == (200, 0, "radio")
    fitted = by_name(found.parameters)
    for name, planted in PLANTED.items():
        one = fitted[name, "relative"]
        assert one.identified
        assert one.value == pytest.approx(planted, rel=0.05)
        assert one.low < one.value < one.high
    assert not fitted["marble", "relative"].identified
    assert fitted["marble", "relative"].why == "unseen: no path at these places is by way of it"
    assert fitted["brick", "scattering"].why == "the channel has no diffuse paths (scattering = false)"
    assert not fitted["glass", "conductivity"].identified


def test_responses_tell_more_than_powers(truth: tuple[Scenes, Measurements, FixedPaths]) -> None:
    """Of twenty noiseless responses, which are another run's of the channel, permittivities are exact."""
    scenes, measured, paths = truth
    some = Measurements(
        position=measured.position[:20],
        transmitter=("bs",) * 20,
        power_dbm=None,
        response=paths.response(paths.amplitude)[:20],
    )
    fitted = by_name(calibrate(scenes, some, list(PLANTED), 0.05).parameters)
    for name, planted in PLANTED.items():
        assert fitted[name, "relative"].value == pytest.approx(planted, rel=2e-3)


def test_the_command_writes_settings_of_a_scenario(
    truth: tuple[Scenes, Measurements, FixedPaths], scenarios: tuple[Path, Path], tmp_path: Path
) -> None:
    _, measured, _ = truth
    assert measured.power_dbm is not None
    rows = np.column_stack([measured.position, measured.power_dbm])[:60]
    table = tmp_path / "measured.csv"
    table.write_text(
        "x_m,y_m,z_m,power_dbm\n" + "".join(",".join(f"{v:.6g}" for v in row) + "\n" for row in rows)
    )
    out = tmp_path / "fitted.toml"
    given = ["scene", "calibrate", str(scenarios[0]), str(table), "--materials", "brick", "--out", str(out)]
    done = CliRunner().invoke(app, given)
    assert done.exit_code == 0, done.output
    assert "60 places, 0 without a path" in done.output
    (scenarios[0].parent / "again.toml").write_text(SCENARIO + out.read_text())
    settings = scene_at(scenarios[0].parent / "again.toml").services["radio"].settings
    assert set(settings["materials"]) == {"brick"}
    unknown = CliRunner().invoke(app, [*given[:5], "brik"])
    assert unknown.exit_code != 0


def test_names_and_places_that_are_not_there(truth: tuple[Scenes, Measurements, FixedPaths]) -> None:
    scenes, measured, _ = truth
    few = replace(
        measured,
        position=measured.position[:2],
        transmitter=("bs", "mast"),
        power_dbm=np.array([-80.0, -80.0]),
    )
    with pytest.raises(AssetError, match="no surface is of 'brik'; did you mean 'brick'"):
        calibrate(scenes, few, ["brik"])
    with pytest.raises(AssetError, match="no transmitter 'mast'"):
        calibrate(scenes, few, ["brick"])
    buried = replace(few, position=few.position * 0 + [10.0, 15.0, 5.0], transmitter=("bs", "bs"))
    with pytest.raises(AssetError, match="none of the 2 places has a path"):
        calibrate(scenes, buried, ["brick"])


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("", "m.csv:1: there is no column x_m, y_m, z_m"),
        ("x_m,y_m,z_m,power_dbm\n", "m.csv has no measurements"),
        ("x_m,y_m,z_m\n1,2,3\n", "give either the column power_dbm, or re and im"),
        ("x_m,y_m,z_m,re\n1,2,3,4\n", "give either the column power_dbm, or re and im"),
        ("x_m,y_m,z_m,power_dbm\n1,2,3,-80\n1,2,3,nan\n", "m.csv:3: power_dbm is 'nan'; write a number"),
        ("x_m,y_m,z_m,power_dbm\n1,here,3,-80\n", "m.csv:2: y_m is 'here'"),
        ("x_m,y_m,z_m,power_dbm\n1,2,3\n", "m.csv:2: 3 values, the head has 4 columns"),
    ],
)
def test_damaged_tables_of_measurements(tmp_path: Path, text: str, expected: str) -> None:
    (tmp_path / "m.csv").write_text(text)
    with pytest.raises(AssetError) as caught:
        read_measurements(tmp_path / "m.csv")
    assert expected in str(caught.value)
