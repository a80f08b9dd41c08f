"""A scenario against its implementations: whose settings an unknown key is judged by."""

from __future__ import annotations

from pathlib import Path

import pytest

from caviar_clients.cli.scenarios import new_scenario
from caviar_clients.session.checks import checked_scenario
from caviar_protocol.errors import ScenarioError


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
        checked_scenario(path)
