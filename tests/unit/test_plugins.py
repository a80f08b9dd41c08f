"""Plug-ins of other distributions: found by entry points, attached by the command line, named if broken."""

from __future__ import annotations

import tomllib
from collections.abc import Iterator
from importlib import metadata
from pathlib import Path

import pytest
from typer.testing import CliRunner

from caviar_broker.launch import _begun
from caviar_broker.launch import parser as broker_parser
from caviar_clients.cli.launch import Launcher
from caviar_clients.cli.main import app
from caviar_clients.session.prepared import prepare
from caviar_protocol import plugins
from caviar_protocol.errors import CaviarError, DeclarationError
from caviar_protocol.scenario import attached, load_scenario
from caviar_services.registry import load, registered
from caviar_services.world.quadrotor.airframe import Airframe, Plant, plant_named

ENTRY_POINTS = """
[caviar.attachments]
acme = acme_plugin:attach
acme-gone = acme_gone:attach
acme-nothing = acme_plugin:nothing
seed = acme_plugin:attach

[caviar.plants]
acme = acme_plugin:Heavy
acme-text = acme_plugin:__name__

[caviar.services]
agent:acme-gone = acme_gone:Agent
"""
PLUGIN = '''
from msgspec.structs import replace
from caviar_services.world.quadrotor.airframe import Plant

class Heavy(Plant):
    extra = "acme"

def attach(scenario, value):
    """NUMBER of frames, all of them attached.

    And more.
    """
    return replace(scenario, run=replace(scenario.run, frames=int(value)))

def nothing(scenario, value):
    return None
'''


@pytest.fixture
def acme(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """A distribution ``acme`` with plug-ins, some of them broken."""
    (tmp_path / "acme_plugin.py").write_text(PLUGIN)
    info = tmp_path / "acme-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: acme\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text(ENTRY_POINTS)
    monkeypatch.syspath_prepend(tmp_path)
    for cached in (plugins._all, plugins.plugins, registered):
        cached.cache_clear()
    yield
    for cached in (plugins._all, plugins.plugins, registered):
        cached.cache_clear()


def test_what_is_installed_registers_what_the_project_declares(repository: Path) -> None:
    """Else bridges are missing, and their tests with them: ``make setup`` installs again."""
    declared = tomllib.loads((repository / "pyproject.toml").read_text())["project"]["entry-points"]
    found = metadata.distribution("caviar-sim").entry_points
    for group, points in declared.items():
        assert {point.name: point.value for point in found.select(group=group)} == points


@pytest.mark.usefixtures("acme")
def test_launcher_and_broker_attach_the_same(tmp_path: Path) -> None:
    prepared = prepare("smoke", attachments=["acme=7"])
    scenario = prepared.scenario
    assert scenario.run.frames == 7
    launcher = Launcher(prepared, Path("smoke"), tmp_path, attachments=["acme=7"])
    record, *_ = _begun(broker_parser().parse_args(launcher._broker_arguments()))
    assert record.scenario == scenario


@pytest.mark.usefixtures("acme")
@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("acme", ["acme", "NAME=VALUE"]),
        ("acne=1", ["'acne'", "'acme'"]),
        ("acme-gone=1", ["acme-gone", "acme_gone:attach of acme"]),
        ("acme-nothing=1", ["acme-nothing=1", "acme_plugin:nothing of acme"]),
    ],
)
def test_what_cannot_be_attached_is_refused_by_name(text: str, words: list[str]) -> None:
    with pytest.raises(CaviarError) as caught:
        attached(load_scenario("smoke"), [text])
    assert all(word in str(caught.value) for word in words)


@pytest.mark.usefixtures("acme")
def test_an_attachment_is_an_option_of_its_name_unless_there_is_one(monkeypatch: pytest.MonkeyPatch) -> None:
    given = []
    monkeypatch.setattr("caviar_clients.cli.run.run_scenario", lambda *values: given.extend(values[-3]))
    runner = CliRunner()
    runner.invoke(app, ["run", "smoke", "--acme", "1", "--attach", "airsim=2", "--seed", "3", "--acme=4"])
    assert given == ["airsim=2", "acme=1", "acme=4"]
    shown = " ".join(runner.invoke(app, ["run", "-h"], env={"COLUMNS": "200", "TERM": "dumb"}).output.split())
    for text in ("NUMBER of frames, all of them attached", "acme_gone:attach of acme"):
        assert text in shown
    assert shown.count("--seed") == 1


@pytest.mark.usefixtures("acme")
def test_an_engine_of_another_distribution_moves_quadrotors() -> None:
    plant = plant_named("acme")(Airframe())
    assert (isinstance(plant, Plant), plant.extra) == (True, "acme")
    for engine, words in (("acmee", "'acme'"), ("acme-text", "acme_plugin:__name__ of acme")):
        with pytest.raises(DeclarationError) as caught:
            plant_named(engine)
        assert words in str(caught.value)


@pytest.mark.usefixtures("acme")
def test_a_service_that_cannot_be_loaded_is_named_with_its_distribution() -> None:
    with pytest.raises(DeclarationError) as caught:
        load("agent", "acme-gone")
    assert "acme_gone:Agent of acme" in str(caught.value)
