"""The JSON Schema of scenario files agrees with the reader of scenarios."""

from __future__ import annotations

import json
import sys
import tomllib
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import jsonschema
import pytest

from caviar_clients.cli import main as command
from caviar_protocol.errors import CaviarError
from caviar_protocol.scenario import find_scenario, parse_scenario, shipped_scenarios
from caviar_services.registry import scenario_schema

pytestmark = pytest.mark.slow

ROOT = Path(__file__).resolve().parents[2]
# Experiments, which `caviar policy train` takes, ship beside the scenarios.
SHIPPED = sorted((ROOT / "deploy" / "caviar_scenarios").rglob("*.toml"))
for template in ("district", "imported", "town"):  # commands and an example fill them in
    SHIPPED.remove(ROOT / f"deploy/caviar_scenarios/new/{template}.toml")
FILES = [
    *(path for path in SHIPPED if "experiment" not in tomllib.loads(path.read_text())),
    ROOT / "clients/minimal/world.toml",
]


@cache
def validator() -> jsonschema.Draft202012Validator:
    schema = scenario_schema()
    jsonschema.Draft202012Validator.check_schema(schema)
    return jsonschema.Draft202012Validator(schema)


def problems(table: dict[str, Any]) -> str:
    """What the schema finds wrong."""
    return "\n".join(f"{error.json_path}: {error.message}" for error in validator().iter_errors(table))


@pytest.mark.parametrize("file", FILES, ids=lambda path: path.stem)
def test_it_accepts_every_scenario_of_the_repository(file: Path) -> None:
    assert not problems(tomllib.loads(file.read_text()))


def test_it_accepts_noise_of_a_sensor_as_the_reader_does() -> None:
    text = noisy('use = "gaussian", range_std_m = 0.02, dropout = 0.01')
    checked(text)
    assert not problems(tomllib.loads(text))


def test_there_are_scenarios_to_accept() -> None:
    assert set(shipped_scenarios().values()) <= set(FILES)


def replaced(old: str, new: str, scenario: str = "smoke") -> str:
    text = find_scenario(scenario).read_text()
    assert old in text
    return text.replace(old, new, 1)


def noisy(table: str) -> str:
    """A scenario with noise of its LIDAR."""
    return replaced('use = "lidar"\n', f'use = "lidar"\nsettings.noise = {{ {table} }}\n', "cameras")


@pytest.mark.parametrize(
    ("text", "named"),
    [
        (lambda: replaced("frames = ", "framse = "), "framse"),
        (lambda: replaced("[run]", "[runs]"), "runs"),
        (lambda: replaced("budget_ms = ", "budget_ms = -"), "minimum"),
        (lambda: replaced('use = "free-space"', 'use = "free-spce"'), "free-spce"),
        (lambda: replaced('role = "channel"', 'role = "chanel"'), "chanel"),
        (lambda: replaced("max_depth = ", "max_depht = ", "street-canyon"), "max_depht"),
        (lambda: replaced('kind = "antenna"', 'kind = "antena"'), "antena"),
        (lambda: replaced('label = "', 'labl = "', "adaptive"), "labl"),
        (lambda: noisy('use = "gausian"'), "gausian"),
        (lambda: noisy('use = "gaussian", range_std_m = -1'), "range_std_m"),
    ],
    ids=["key", "table", "range", "implementation", "role", "setting", "word", "rung", "noise", "deviation"],
)
def test_it_refuses_what_the_reader_refuses(text: Callable[[], str], named: str) -> None:
    assert named in problems(tomllib.loads(text()))
    with pytest.raises(CaviarError):
        checked(text())


def checked(text: str) -> None:
    """Read a scenario as `caviar run` does, the settings of its services included."""
    from caviar_clients.session.prepared import prepare

    prepare(parse_scenario(text, folder=find_scenario("smoke").parent))


def test_instants_stand_in_place_of_frames() -> None:
    run = {"name": "x", "instants_s": "file:instants.csv"}
    table = tomllib.loads(find_scenario("smoke").read_text())
    assert not problems(table | {"run": run})
    assert not problems(table | {"run": {"name": "x", "instants_ns": [0, 5]}})
    assert problems(table | {"run": {"name": "x"}})


def test_keys_have_meanings_and_units() -> None:
    period = scenario_schema()["$defs"]["Run"]["properties"]["sampling_period_ns"]["description"]
    assert period.startswith("T_sam")
    assert period.endswith(" [ns]")


def test_the_command_prints_it_and_writes_it(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    for arguments in (["schema"], ["schema", "--out", str(tmp_path / "new" / "schema.json")]):
        monkeypatch.setattr(sys, "argv", ["caviar", *arguments])
        with pytest.raises(SystemExit) as ended:
            command.main()
        assert not ended.value.code
    printed = json.loads(capsys.readouterr().out)
    written = json.loads((tmp_path / "new" / "schema.json").read_text())
    assert printed == written == json.loads(json.dumps(scenario_schema()))
