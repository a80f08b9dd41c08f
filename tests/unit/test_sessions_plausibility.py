"""Values that are allowed and hardly meant: each is warned of with file, line and key."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

from caviar_clients.cli.run import run_scenario
from caviar_clients.envs.beam_selection import BeamSelectionEnv
from caviar_clients.session.checks import checked_scenario, implausible_values
from caviar_protocol.scenario import shipped_scenarios
from caviar_services.mesh.shapes import Mesh, ply

SMOKE = Path(__file__).parents[2] / "deploy" / "caviar_scenarios" / "smoke.toml"
GROUND = 'use = "trajectory"\nbudget_ms = 20\n'
"""In the scenario, behind which the settings of its world begin."""


def scenario(folder: Path, *changes: tuple[str, str]) -> Path:
    """The smoke scenario, with some text replaced."""
    text = SMOKE.read_text()
    for old, new in changes:
        assert text.count(old) >= 1, f"{old!r} is not in the scenario"
        text = text.replace(old, new, 1)
    path = folder / "scenario.toml"
    path.write_text(text)
    return path


def town(folder: Path) -> tuple[str, str]:
    """Change that brings a scenery: ground from −100 m to 100 m in both directions, falling by 20 m to the
    east."""
    ground = np.array([[-100.0, -100, 0], [100, -100, -20], [100, 100, -20], [-100, 100, 0]])
    faces = np.array([[0, 1, 2], [0, 2, 3]], np.int32)
    (folder / "ground.ply").write_bytes(ply(Mesh(ground, faces)))
    (folder / "town.xml").write_text(
        '<scene version="2.1.0"><shape type="ply" id="ground">'
        '<string name="filename" value="ground.ply"/></shape></scene>'
    )
    return GROUND, f'{GROUND}\n[services.world.settings]\nscenery = "file:{folder}/town.xml"\n'


def line_of(path: Path, text: str) -> int:
    """1-based line of the first line that begins with a text."""
    lines = path.read_text().splitlines()
    return next(number for number, line in enumerate(lines, 1) if line.startswith(text))


def test_no_shipped_scenario_is_warned_of() -> None:
    for name in shipped_scenarios():
        if name in ("cameras", "uav-munich", "uav-path"):
            pytest.importorskip("sionna.rt", reason="sionna-rt is not installed")
        assert implausible_values(checked_scenario(Path(name))) == []


@pytest.mark.parametrize(
    ("key", "old", "new", "words"),
    [
        ("carriers[0].frequency_hz", "28e9", "28", "is 28 Hz; .* 28 GHz is written 28e9"),
        ("carriers[0].frequency_hz", "28e9", "2400.0", "is 2.4 kHz; .* 2400 MHz is written 2400e6"),
        ("carriers[0].frequency_hz", "28e9", "28e12", "is 28 THz; .* is it 28 GHz?"),
        ("carriers[0].bandwidth_hz", "100e6", "100", "is 100 Hz, narrower than any radio carrier"),
        ("carriers[0].bandwidth_hz", "100e6", "100e9", "is 100 GHz, more than half of the frequency, 28 GHz"),
        ("devices[0].power_dbm", "30.0", "1000.0", "is 1000 dBm, .*; 1000 mW would be 30.0 dBm"),
        ("devices[0].power_dbm", "30.0", "-130.0", "is -130 dBm, beyond any transmitter's -60 to 90 dBm"),
    ],
)
def test_an_implausible_value_is_named_with_line_and_what_may_be_meant(
    tmp_path: Path, key: str, old: str, new: str, words: str
) -> None:
    name = key.rpartition(".")[2]
    path = scenario(tmp_path, (f"{name} = {old}", f"{name} = {new}"))
    (warning,) = implausible_values(checked_scenario(path))
    assert warning.startswith(f"{path}:{line_of(path, name)}: {key}: ")
    assert re.search(words, warning), warning


@pytest.mark.parametrize(
    ("key", "start", "old", "new", "words"),
    [
        (
            "devices[0].position_m",
            "position_m",
            "position_m = [0.0, 0.0, 10.0]",
            "position_m = [10_000.0, 0.0, 10.0]",
            r"'bs' stands at \(10000, 0, 10\) m, outside the scenery, which reaches x -100 to 100 m",
        ),
        (
            "devices[0].position_m",
            "position_m",
            "position_m = [0.0, 0.0, 10.0]",
            "position_m = [-80.0, 0.0, -5.0]",
            "'bs' .* below the ground",
        ),
        (
            "devices[0].position_m",
            "position_m",
            "position_m = [0.0, 0.0, 10.0]",
            "position_m = [0.0, 0.0, 5e3]",
            "'bs' .* far above the scenery",
        ),
        (
            "services.world.settings.objects[0].waypoints",
            "waypoints",
            "[10.0, 40.0, 20.0, 0.75]",
            "[10.0, 40.0, 200.0, 0.75]",
            r"'car' stands at \(40, 200, 0.75\) m, outside the scenery",
        ),
    ],
)
def test_a_place_where_nothing_can_stand_is_named(
    tmp_path: Path, key: str, start: str, old: str, new: str, words: str
) -> None:
    path = scenario(tmp_path, town(tmp_path), (old, new))
    (warning,) = implausible_values(checked_scenario(path))
    assert warning.startswith(f"{path}:{line_of(path, start)}: {key}: ")
    assert re.search(words, warning), warning


def test_places_in_the_scenery_are_not_warned_of_though_others_of_it_are_higher(tmp_path: Path) -> None:
    """At x = 80 m the ground is at z = −18 m, below that of the west."""
    path = scenario(
        tmp_path, town(tmp_path), ("position_m = [0.0, 0.0, 10.0]", "position_m = [80.0, 0, -5.0]")
    )
    assert implausible_values(checked_scenario(path)) == []


def test_scenery_that_cannot_be_read_is_for_its_world_to_tell(tmp_path: Path) -> None:
    change = town(tmp_path)
    (tmp_path / "ground.ply").write_bytes(b"no mesh")
    assert implausible_values(checked_scenario(scenario(tmp_path, change))) == []


def test_a_run_with_a_warning_prints_it_keeps_it_and_ends_with_status_0(tmp_path: Path) -> None:
    path = scenario(tmp_path, ("28e9", "28"))
    console = Console(record=True, width=300)
    report = tmp_path / "summary.json"
    assert run_scenario(path, tmp_path / "runs", console, frames=3, json_file=report, embedded=True) == 0
    summary = json.loads(report.read_text())
    (warning,) = summary["warnings"]
    assert "carriers[0].frequency_hz: is 28 Hz" in warning
    assert f"warning: {warning}\n" in console.export_text()
    assert summary["outage"]["causes"] == {"too close": 6}
    assert summary["no_path_share"] == 1.0


def test_an_environment_warns_too(tmp_path: Path) -> None:
    path = scenario(tmp_path, ("28e9", "28"))
    with pytest.warns(UserWarning, match="frequency_hz: is 28 Hz"):
        BeamSelectionEnv(path)
