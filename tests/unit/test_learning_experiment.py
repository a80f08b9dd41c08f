"""Files of experiments: what is read from them, and what is refused with its place."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import gymnasium
import pytest

from caviar_clients.learning.experiment import Dqn, Encoding, Ppo, load_experiment, parse_experiment
from caviar_protocol.errors import ScenarioError
from caviar_protocol.scenario import find_scenario

TEXT = """\
[experiment]
name = "beams"
seeds = [1, 2]
steps = 500

[environment]
id = "caviar/BeamSelection-v0"
members = 4

[environment.options]
scenario = "geometric"
observe = ["position", "last_beam"]

[algorithm]
name = "dqn"
gamma = 0.0
batch_size = 64

[network]
layers = [32, 16]

[features.position]
offset = [70.0, 0.0, 20.0]
scale = 50.0
waves = 4
"""


def test_an_experiment_is_read_with_its_defaults() -> None:
    found = parse_experiment(TEXT)
    assert isinstance(found.algorithm, Dqn)
    assert (found.algorithm.called, found.algorithm.library) == ("DQN", "stable-baselines3")
    # What the file leaves out is left to the library.
    assert found.algorithm.given() == {"gamma": 0.0, "batch_size": 64}
    assert found.features == {"position": Encoding(offset=(70.0, 0.0, 20.0), scale=50.0, waves=4)}
    assert (found.network.layers, found.network.activation) == ((32, 16), None)
    assert found.experiment.checkpoint_steps == 10_000


@pytest.mark.parametrize(
    ("old", "new", "expected"),
    [
        (
            "steps = 500",
            "step = 500",
            "my.toml:4: experiment.step: unknown key 'step'; did you mean 'steps'?",
        ),
        ("steps = 500", "steps = 0", "my.toml:4: experiment.steps: is 0, write a whole number ≥ 1"),
        ("seeds = [1, 2]", "seeds = []", "seeds is empty; write at least one"),
        ("seeds = [1, 2]", "seeds = [1, 1]", "has one twice"),
        ("seeds = [1, 2]", "seeds = [-1]", "my.toml:3: experiment.seeds[0]: is -1"),
        ('name = "beams"', 'name = "../beams"', "my.toml:2: experiment.name"),
        (
            "gamma = 0.0",
            "gama = 0.0",
            "my.toml:16: algorithm.gama: unknown key 'gama'; did you mean 'gamma'?",
        ),
        ("gamma = 0.0", "gamma = 1.5", "my.toml:16: algorithm.gamma: is 1.5, write a number ≥ 0"),
        ("gamma = 0.0", "clip_range = 0.2", "unknown key 'clip_range'"),
        (
            "gamma = 0.0",
            "learning_starts = 500",
            "algorithm.learning_starts: is 500, and 500 steps",
        ),
        ("gamma = 0.0", "train_freq = 1000000000", "algorithm.train_freq: is 1000000000, and 500 steps"),
        ("gamma = 0.0", "gradient_steps = 1000000000", "algorithm.gradient_steps: is 1000000000, write"),
        ("batch_size = 64", "batch_size = 1000000000000", "algorithm.batch_size: is 1000000000000, write"),
        ("members = 4", "members = 501", "environment.members: is 501, and 500 steps of all members"),
        ('name = "dqn"\n', "", "my.toml:14: algorithm: lacks 'name', write one of a2c, dqn, ppo"),
        ("layers = [32, 16]", "layers = [100000]", "network.layers[0]: is 100000, write"),
        ("layers = [32, 16]", "layers = [65536, 65536]", "has 2 layers, 4,294,967,296 weights between them"),
        ("scale = 50.0", "scale = inf", "features.position.scale: is inf, write numbers > 0"),
        ("scale = 50.0", "scale = 1e-320", "features.position.scale: is 1e-320, write numbers > 0"),
        (
            "offset = [70.0, 0.0, 20.0]",
            "offset = nan",
            "position.offset: is nan, write finite",
        ),
        ("caviar/BeamSelection-v0", ".:Mine-v0", "environment.id: module '.' cannot be imported: TypeError"),
        ('name = "dqn"', 'name = "dqm"', "my.toml:15: algorithm.name: is 'dqm'; did you mean 'dqn'?"),
        ('name = "dqn"', 'name = "dqn"\nlibrary = "rllib"', "algorithm.library"),
        ("layers = [32, 16]", "layers = [0]", "my.toml:20: network.layers[0]: is 0"),
        ("waves = 4", "wave = 4", "features.position.wave: unknown key 'wave'; did you mean 'waves'?"),
        ("scale = 50.0", "scale = 0.0", "features.position.scale"),
        (
            "observe = [",
            "obsrve = [",
            "environment.options.obsrve: unknown option 'obsrve'; did you mean 'obs",
        ),
        ('scenario = "geometric"\n', "", "my.toml:10: environment.options: lacks 'scenario'"),
        ("Selection-v0", "Selecton-v0", "did you mean 'caviar/BeamSelection-v0'?"),
        ("caviar/BeamSelection-v0", "no_such_module:Mine-v0", "module 'no_such_module' cannot be imported"),
        ('"geometric"', '"file:none.toml"', "environment.options.scenario: there is no "),
        ("members = 4", "members = 4\nmembers = 5", "my.toml:9: not TOML"),
    ],
)
def test_what_is_wrong_is_named_with_its_place(old: str, new: str, expected: str) -> None:
    assert old in TEXT
    with pytest.raises(ScenarioError) as refused:
        parse_experiment(TEXT.replace(old, new, 1), "my.toml")
    assert expected in str(refused.value)


def test_a_module_that_is_nowhere_is_named_with_the_places_looked_in() -> None:
    text = TEXT.replace("caviar/BeamSelection-v0", "no_such_module:Mine-v0")
    with pytest.raises(ScenarioError, match="beside the experiment"):
        parse_experiment(text, "my.toml")


def test_a_module_that_breaks_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "breaks_at_import.py").write_text("1 / 0\n")
    monkeypatch.syspath_prepend(tmp_path)
    text = TEXT.replace("caviar/BeamSelection-v0", "breaks_at_import:Mine-v0")
    with pytest.raises(ScenarioError, match=r"'breaks_at_import'.*ZeroDivisionError"):
        parse_experiment(text, "my.toml")


def test_an_environment_of_a_module_beside_the_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "path", sys.path[:])
    (tmp_path / "beside_the_file.py").write_text(
        "import gymnasium\n"
        "def made(length=3): ...\n"
        "gymnasium.register('BesideTheFile-v0', entry_point=made)\n"
    )
    file = tmp_path / "my.toml"
    text = TEXT.replace("caviar/BeamSelection-v0", "beside_the_file:BesideTheFile-v0")
    text = text.replace('scenario = "geometric"\nobserve = ["position", "last_beam"]\n', "length = 5\n")
    file.write_text(text)
    assert load_experiment(file).environment.options == {"length": 5}
    file.write_text(text.replace("BesideTheFile", "BesideFile"))
    with pytest.raises(ScenarioError, match=r"'beside_the_file'.*'BesideTheFile-v0'"):
        load_experiment(file)


def test_an_environment_of_a_notebook_is_no_candidate(monkeypatch: pytest.MonkeyPatch) -> None:
    """A function that was made from text belongs to no module."""
    names: dict[str, Any] = {"__name__": None}
    exec("def make(): ...", names)  # noqa: S102 - as a notebook does
    spec = gymnasium.envs.registration.EnvSpec("FromText-v0", entry_point=names["make"])
    monkeypatch.setitem(gymnasium.registry, "FromText-v0", spec)
    with pytest.raises(ScenarioError, match="did you mean 'caviar/BeamSelection-v0'"):
        parse_experiment(TEXT.replace("Selection-v0", "Selecton-v0"))


def test_a_file_that_is_not_there_is_named(tmp_path: Path) -> None:
    with pytest.raises(ScenarioError, match=r"none\.toml: .*No such file"):
        load_experiment(tmp_path / "none.toml")


def test_paths_of_options_are_relative_to_the_file(tmp_path: Path) -> None:
    (tmp_path / "mine.toml").write_text(find_scenario("geometric").read_text())
    (tmp_path / "experiment.toml").write_text(TEXT.replace('"geometric"', '"file:mine.toml"'))
    found = load_experiment(tmp_path / "experiment.toml")
    assert found.environment.options["scenario"] == str((tmp_path / "mine.toml").resolve())


def test_an_environment_that_takes_any_argument_is_not_judged_by_names() -> None:
    text = TEXT[: TEXT.index("[features")].replace("caviar/BeamSelection-v0", "CartPole-v1")
    text = text.replace(
        'scenario = "geometric"\nobserve = ["position", "last_beam"]\n', "sutton_barto_reward = true\n"
    )
    assert parse_experiment(text).environment.options == {"sutton_barto_reward": True}
    with pytest.raises(ScenarioError, match="'sutton_barto'"):
        parse_experiment(text.replace("sutton_barto_reward", "sutton_barto"))


def test_the_digest_is_of_what_decides_a_training(tmp_path: Path) -> None:
    mine = tmp_path / "mine.toml"
    mine.write_text(find_scenario("geometric").read_text())
    text = TEXT.replace('"geometric"', f'"{mine}"')
    digest = parse_experiment(text).digest()
    assert parse_experiment(text.replace("[1, 2]", "[1, 2, 3]")).digest() == digest
    for old, new in (
        ("gamma = 0.0", "gamma = 0.5"),
        ("steps = 500", "steps = 501"),
        ("waves = 4", "waves = 5"),
    ):
        assert parse_experiment(text.replace(old, new)).digest() != digest
    mine.write_text(mine.read_text().replace("components = 3", "components = 4"))
    assert parse_experiment(text).digest() != digest


def test_the_experiment_of_the_page_is_one(repository: Path) -> None:
    page = (repository / "docs" / "howto" / "experiments.md").read_text()
    found = parse_experiment(page.partition("```toml\n")[2].partition("```")[0], "beams.toml")
    assert (found.experiment.name, found.algorithm.called, len(found.features)) == ("beams", "DQN", 2)


def test_other_algorithms_have_keys_of_their_own() -> None:
    text = TEXT.replace('name = "dqn"', 'name = "ppo"\nclip_range = 0.1\nn_steps = 64')
    found = parse_experiment(text).algorithm
    assert isinstance(found, Ppo)
    assert found.given() == {"gamma": 0.0, "n_steps": 64, "batch_size": 64, "clip_range": 0.1}


@pytest.mark.parametrize(
    ("message", "key"),
    [
        ("no receiver of the scenario is last_beam", "my.toml:10: environment.options:"),
        ("observe=3: 3 is no text", "my.toml:12: environment.options.observe:"),
        ("observer is no option", "my.toml:10: environment.options:"),
        ("'last_beam' is of packets", "my.toml:12: environment.options.observe:"),
        ("'geometric' has no link", "my.toml:11: environment.options.scenario:"),
        ("'geometric' and 'last_beam' do not fit", "my.toml:10: environment.options:"),
    ],
)
def test_an_error_of_the_environment_is_placed_at_its_option(message: str, key: str) -> None:
    place = parse_experiment(TEXT, "my.toml").place_of_option(message)
    assert str(place.error(message)).startswith(key)
