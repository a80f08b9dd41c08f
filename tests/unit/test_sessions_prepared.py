"""A scenario made ready: checked against its implementations once, and in the same way by every door."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
from rich.console import Console
from typer.testing import CliRunner

from caviar_clients.cli.main import app
from caviar_clients.cli.run import run_scenario
from caviar_clients.cli.scenarios import new_scenario
from caviar_clients.datasets.directory import DatasetDirectory, writing_dataset
from caviar_clients.datasets.episode import EpisodeTask, play_episode
from caviar_clients.datasets.plan import plan_dataset
from caviar_clients.envs.base import BeamSelectionEnv
from caviar_clients.envs.vector import BeamSelectionVectorEnv
from caviar_clients.session.prepared import implemented, module_folders, prepare
from caviar_clients.session.scenes import scene_at
from caviar_protocol.errors import ScenarioError
from caviar_protocol.scenario import load_scenario, parse_scenario
from caviar_services.world.trajectory import TrajectoryWorld


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        (
            'use = "geometric"',
            'use = "sionna-rt"',
            r"normalization: unknown key 'normalization'; it is a setting of 'geometric'; 'sionna-rt' has",
        ),
        ("nlos =", "nloss =", r"nloss: unknown key 'nloss'; did you mean 'nlos'\? 'geometric' has: .*nlos"),
        ("nlos =", "colour =", r"colour: unknown key 'colour'; 'geometric' has: .*nlos"),
    ],
)
def test_an_unknown_setting_names_the_implementation_and_what_it_has(
    tmp_path: Path, old: str, new: str, words: str
) -> None:
    path = new_scenario(str(tmp_path / "mine"))
    path.write_text(path.read_text().replace(old, new, 1))
    with pytest.raises(ScenarioError, match=rf"^{path}:\d+: services\.channel\.settings\.{words}"):
        prepare(path)


def test_modules_of_rungs_are_looked_for_beside_the_scenario_too(tmp_path: Path) -> None:
    text = """
[run]
name = "x"
frames = 1
[[carriers]]
name = "c"
frequency_hz = 1e9
[services.world]
role = "world"
use = "trajectory"
budget_ms = 5
[services.channel]
role = "channel"
use = "adaptive"
budget_ms = 5
[[services.channel.settings.ladder]]
label = "one"
use = "mine:Channel"
"""
    file = str(tmp_path / "x.toml")
    assert module_folders(parse_scenario(text, file)) == (tmp_path, Path.cwd())
    assert module_folders(parse_scenario(text.replace("mine:Channel", "free-space"), file)) == ()


def generate(path: Path) -> object:
    """Call the command; its error is raised."""
    called = CliRunner().invoke(
        app, ["dataset", "generate", str(path), "--out", str(path.parent / "dataset")]
    )
    if called.exception is not None:
        raise called.exception
    return called


@pytest.mark.parametrize(
    "enter",
    [
        pytest.param(lambda path: run_scenario(path, path.parent, Console(quiet=True)), id="run"),
        pytest.param(
            lambda path: run_scenario(path, path.parent, Console(quiet=True), embedded=True), id="embedded"
        ),
        pytest.param(BeamSelectionEnv, id="environment"),
        pytest.param(lambda path: BeamSelectionVectorEnv(2, path), id="vector environment"),
        pytest.param(generate, id="generate"),
        pytest.param(scene_at, id="map"),
    ],
)
@pytest.mark.parametrize(
    ("old", "new", "key"),
    [
        ("nlos =", "nloss =", "services.channel.settings.nloss: unknown key 'nloss'; did you mean 'nlos'?"),
        ('use = "geometric"', 'use = "geometrik"', "services.channel.use: no channel is named 'geometrik'"),
        ("frequency_hz = 28e9", "frequency_hz = 28", "carriers[0].frequency_hz: is 28 Hz; "),
    ],
)
def test_a_wrong_value_is_refused_with_the_same_place_by_every_door(
    tmp_path: Path, enter: Callable[[Path], object], old: str, new: str, key: str
) -> None:
    path = new_scenario(str(tmp_path / "mine"))
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1))
    line = path.read_text()[: path.read_text().index(new)].count("\n") + 1
    with pytest.raises(ScenarioError) as refused:
        enter(path)
    assert str(refused.value).startswith(f"{path}:{line}: {key}")
    assert sorted(tmp_path.iterdir()) == [path]


def test_a_dataset_is_checked_where_it_is_planned_and_not_again_by_its_episodes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    checked: list[object] = []
    monkeypatch.setattr(TrajectoryWorld, "check_scenario", lambda *given: checked.append(given))
    plan = plan_dataset(load_scenario("smoke"), episodes=2, scenes=2)
    with writing_dataset(DatasetDirectory(tmp_path)):
        for number in range(plan.episodes):
            assert not play_episode(EpisodeTask(plan.scenario, number, str(tmp_path))).error
    assert len(checked) == 1


def test_a_class_is_loaded_and_its_settings_are_converted_once() -> None:
    prepared = prepare("geometric")
    channel = prepared.services["channel"]
    assert channel.settings is channel.settings
    assert implemented(prepared) is prepared
    assert [world.name for world in prepared.of_role("world")] == ["world"]
    assert isinstance(channel.settings, channel.cls.Settings)
