"""A scenario against its implementations: whose settings an unknown key is judged by."""

from __future__ import annotations

from pathlib import Path

import pytest

from caviar_clients.cli.scenarios import new_scenario
from caviar_clients.session.prepared import module_folders, prepare
from caviar_protocol.errors import ScenarioError
from caviar_protocol.scenario import parse_scenario


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
