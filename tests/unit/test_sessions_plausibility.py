"""Values that are allowed and hardly meant: each is warned of with file, line and key."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

from caviar_clients.cli.run import run_scenario
from caviar_clients.envs.base import BeamSelectionEnv
from caviar_clients.session.prepared import prepare
from caviar_protocol.errors import ScenarioError
from caviar_protocol.scenario import shipped_scenarios
from caviar_space.meshes import Mesh, ply

pytestmark = pytest.mark.slow

SMOKE = Path(__file__).parents[2] / "deploy" / "caviar_scenarios" / "smoke.toml"
GROUND = 'use = "trajectory"\nbudget_ms = 20\n'
"""In the scenario, after which the settings of its world begin."""


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
        if name in ("airsim", "cameras", "uav-munich", "uav-path"):
            pytest.importorskip("sionna.rt", reason="sionna-rt is not installed")
        assert prepare(Path(name)).warnings == []


@pytest.mark.parametrize(
    ("hertz", "words"),
    [
        ("28", "is 28 Hz; .* 28 GHz is written 28e9"),
        ("2400.0", "is 2.4 kHz; .* 2400 MHz is written 2400e6"),
        ("60e3", "is 60 kHz; radio carriers are from 100 MHz to 1 THz; write it in Hz, as 28e9"),
    ],
)
def test_a_carrier_that_can_only_be_of_another_unit_is_refused(
    tmp_path: Path, hertz: str, words: str
) -> None:
    path = scenario(tmp_path, ("28e9", hertz))
    with pytest.raises(ScenarioError, match=rf":\d+: carriers\[0\]\.frequency_hz: {words}"):
        prepare(path)


@pytest.mark.parametrize(
    ("key", "old", "new", "words"),
    [
        ("carriers[0].frequency_hz", "28e9", "28e12", "is 28 THz; .* is it 28 GHz?"),
        ("carriers[0].bandwidth_hz", "100e6", "100", "is 100 Hz, narrower than any radio carrier"),
        ("carriers[0].bandwidth_hz", "100e6", "100e9", "is 100 GHz, more than half of the frequency, 28 GHz"),
        ("carriers[0].frequency_hz", "28e9", "50e6", "is 50 MHz; radio carriers are from 100 MHz to 1 THz$"),
        ("devices[0].power_dbm", "30.0", "150.0", "is 150 dBm, .*; 150 mW would be 21.8 dBm"),
        ("devices[0].power_dbm", "30.0", "-130.0", "is -130 dBm, beyond any transmitter's -100 to 90 dBm"),
    ],
)
def test_an_implausible_value_is_named_with_line_and_what_may_be_meant(
    tmp_path: Path, key: str, old: str, new: str, words: str
) -> None:
    name = key.rpartition(".")[2]
    path = scenario(tmp_path, (f"{name} = {old}", f"{name} = {new}"))
    (warning,) = prepare(path).warnings
    assert warning.startswith(f"{path}:{line_of(path, name)}: {key}: ")
    assert re.search(words, warning), warning


CARRIER = "bandwidth_hz = 100e6\n"
ARRAY = "array = { rows = 4, columns = 8 }"


@pytest.mark.parametrize(
    ("key", "line", "change", "words"),
    [
        (
            "carriers[0].subcarrier_spacing_hz",
            "subcarrier_spacing_hz",
            (CARRIER, f"{CARRIER}subcarriers = 64\nsubcarrier_spacing_hz = 120\n"),
            "is 120 Hz; OFDM has 1.25 kHz and more; 120 kHz is written 120e3",
        ),
        (
            "carriers[0].taps",
            "taps",
            (CARRIER, f"{CARRIER}taps = 2\n"),
            "is 2: taps begin 6 samples before the first path, so that these end before it; write 13 or more",
        ),
        (
            "carriers[0].slot_duration_s",
            "slot_duration_s",
            (CARRIER, f"{CARRIER}slots = 2\nslot_duration_s = 125\n"),
            "is 125 s: 2 slots take 250 s, a frame 0.1 s",
        ),
        (
            "devices[0].array",
            "array",
            (ARRAY, 'array = { rows = 1000, columns = 1000, polarization = "VH" }'),
            "has 2,000,000 elements \\(1000 rows × 1000 columns × 2 polarizations × 1 panels\\)",
        ),
        (
            "devices[0].array.panels[1]",
            "array",
            (ARRAY, "array = { panels = [{ yaw_deg = 30.0 }, { yaw_deg = 30.0 }] }"),
            "is at the place and in the direction of panels\\[0\\]",
        ),
        (
            "devices[0].array.panels[0].position_m",
            "array",
            (ARRAY, "array = { panels = [{ position_m = [0.0, 1e12, 0.0] }] }"),
            "is 1e\\+12 m from the device",
        ),
        (
            "devices[0].array.horizontal_spacing",
            "array",
            (ARRAY, "array = { columns = 8, horizontal_spacing = 500.0 }"),
            "is 500 wavelengths",
        ),
    ],
)
def test_values_of_another_unit_and_of_another_size_are_named(
    tmp_path: Path, key: str, line: str, change: tuple[str, str], words: str
) -> None:
    path = scenario(tmp_path, change)
    (warning,) = prepare(path).warnings
    assert warning.startswith(f"{path}:{line_of(path, line)}: {key}: ")
    assert re.search(words, warning), warning


def with_channel(folder: Path, use: str, settings: str) -> Path:
    """The scenario with another channel and its settings."""
    block = f'use = "{use}"\nbudget_ms = 20\n{settings}'
    return scenario(folder, ('use = "free-space"\nbudget_ms = 20\n', block))


def test_keys_of_materials_that_nothing_has_are_named(tmp_path: Path) -> None:
    """Objects are called car and uav, of the classes car and uav; a pattern that fits one passes."""
    keys = 'uva = "plastic"\n"cab*" = "plastic"\n"c*" = "glass"\nuav = "plastic"\n'
    path = with_channel(tmp_path, "sionna-rt", f"[services.channel.settings.object_materials]\n{keys}")
    typo, pattern = prepare(path).warnings
    key = "services.channel.settings.object_materials"
    assert typo == (
        f"{path}:{line_of(path, 'uva')}: {key}.uva: is no object, class of objects or piece of scenery of "
        "the run; did you mean 'uav'?"
    )
    assert f'{key}."cab*": is no object' in pattern


def test_a_reference_that_finds_less_than_a_rung_is_named(tmp_path: Path) -> None:
    ladder = """
[[services.channel.settings.ladder]]
label = "deep"
settings = { max_depth = 4 }
[services.channel.settings.reference]
label = "exact"
settings = { max_depth = 2 }
"""
    (warning,) = prepare(with_channel(tmp_path, "adaptive", ladder)).warnings
    assert "settings.reference: has paths of 2 interactions at most, fewer than deep" in warning


CAR_OF_TIN = '[services.channel.settings.object_materials]\ncar = "tin"\n'


@pytest.mark.parametrize(
    ("settings", "key", "words"),
    [
        (
            "[services.channel.settings.materials.tin]\nconductivity_s_per_m = 1e6\n" + CAR_OF_TIN,
            "services.channel.settings.materials.tin",
            "lacks relative_permittivity; 'tin' is no material of ITU-R P.2040, so it needs both",
        ),
        (
            "[services.channel.settings.materials.glass]\nrelative_permittivity = 0.2\n",
            "services.channel.settings.materials.glass.relative_permittivity",
            "is 0.2, write a number ≥ 1",
        ),
        (
            "[services.channel.settings.materials.skin]\nscattering_coefficient = 2.0\n",
            "services.channel.settings.materials.skin.scattering_coefficient",
            "is 2.0, write a number ≥ 0 and ≤ 1",
        ),
        (
            "[services.channel.settings.materials.glass]\nthickness_m = 0.0\n",
            "services.channel.settings.materials.glass.thickness_m",
            "is 0.0, write a number > 0",
        ),
        (
            '[services.channel.settings.object_materials]\ncar = "glas"\n',
            "services.channel.settings.object_materials.car",
            "there is no material 'glas'; did you mean 'glass'?",
        ),
        (
            "[services.channel.settings]\nsamples = 10\nray_spacing_deg = 1.0\n",
            "services.channel.settings.ray_spacing_deg",
            "is 1, and samples = 10: both say how many rays are launched",
        ),
    ],
)
def test_what_the_file_alone_says_is_refused_before_anything_starts(
    tmp_path: Path, settings: str, key: str, words: str
) -> None:
    path = with_channel(tmp_path, "sionna-rt", settings)
    with pytest.raises(ScenarioError) as refused:
        prepare(path)
    leaf = key.rpartition(".")[2]
    line = line_of(path, "[services.channel.settings.materials" if leaf == "tin" else leaf)
    assert str(refused.value).startswith(f"{path}:{line}: {key}: {words}")


def test_scenery_that_is_a_folder_is_refused_with_its_line(tmp_path: Path) -> None:
    town(tmp_path)
    change = GROUND, f'{GROUND}\n[services.world.settings]\nscenery = "file:{tmp_path}"\n'
    path = scenario(tmp_path, change)
    with pytest.raises(ScenarioError) as refused:
        prepare(path)
    assert str(refused.value) == (
        f"{path}:{line_of(path, 'scenery')}: services.world.settings.scenery: {tmp_path} is a folder; name "
        "the XML file of the scenery; there is town.xml"
    )


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
    (warning,) = prepare(path).warnings
    assert warning.startswith(f"{path}:{line_of(path, start)}: {key}: ")
    assert re.search(words, warning), warning


def test_places_in_the_scenery_are_not_warned_of_though_others_of_it_are_higher(tmp_path: Path) -> None:
    """At x = 80 m the ground is at z = −18 m, below that of the west."""
    path = scenario(
        tmp_path, town(tmp_path), ("position_m = [0.0, 0.0, 10.0]", "position_m = [80.0, 0, -5.0]")
    )
    assert prepare(path).warnings == []


def test_scenery_that_cannot_be_read_is_for_its_world_to_tell(tmp_path: Path) -> None:
    change = town(tmp_path)
    (tmp_path / "ground.ply").write_bytes(b"no mesh")
    assert prepare(scenario(tmp_path, change)).warnings == []


def test_a_run_with_a_warning_prints_it_keeps_it_and_ends_with_status_0(tmp_path: Path) -> None:
    path = scenario(tmp_path, ("28e9", "50e6"), ("power_dbm = 30.0", "power_dbm = -30.0"))
    console = Console(record=True, width=300)
    report = tmp_path / "summary.json"
    ended = run_scenario(path, tmp_path / "runs", console, frames=3, json_file=report, embedded=True)
    assert ended.status == 0
    summary = json.loads(report.read_text())
    (warning,) = summary["warnings"]
    assert "carriers[0].frequency_hz: is 50 MHz" in warning
    assert f"warning: {warning}\n" in console.export_text()


def test_an_environment_warns_too(tmp_path: Path) -> None:
    path = scenario(tmp_path, ("28e9", "50e6"))
    with pytest.warns(UserWarning, match="frequency_hz: is 50 MHz"):
        BeamSelectionEnv(path)
