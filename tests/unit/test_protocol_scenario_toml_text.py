"""TOML from elsewhere: what would take all time or memory is refused, with its line."""

from __future__ import annotations

import time
import tomllib

import pytest

from caviar_protocol.errors import ScenarioError
from caviar_protocol.scenario import load_scenario, parse_scenario, shipped_scenarios
from caviar_protocol.scenario.toml import MAX_DEPTH, MAX_SIZE, parse_toml

BOMBS = {
    "arrays": ("# one\na = " + "[" * 100_000 + "]" * 100_000, r":2: not TOML: arrays and tables are nested"),
    "tables": ("a = " + "{a=" * 50_000 + "1" + "}" * 50_000, r":1: .* nested in more than 32 levels"),
    "dotted key": (".".join(["a"] * 200_000) + " = 1", r":1: .*a key has more than 32 parts"),
    "quoted key": (".".join(['"a"'] * 100_000) + " = 1", r":1: .*a key has more than 32 parts"),
    "headers": ("\n".join(f"[{'a.' * 1000}b{i}]" for i in range(300)), r"a key has more than 32 parts"),
    "digits": ("[run]\nframes = " + "9" * 200_000, r":2: .*more than 1000 characters"),
    "hexadecimal": ("[run]\nframes = 0x" + "f" * 900_000, r":2: .*more than 1000 characters"),
    "exponent": ("[run]\nframes = 1e999999", r":2: run\.frames: is inf"),
    "text": ('[run]\nname = "' + "x" * MAX_SIZE + '"', r"of which a file may have 1048576"),
    "quotes": ('"' * 50_000, r"not TOML"),
}


@pytest.mark.parametrize("name", BOMBS)
def test_a_bomb_is_refused_at_once(name):
    text, message = BOMBS[name]
    began = time.process_time()
    with pytest.raises(ScenarioError, match=message):
        parse_scenario(text, "bomb.toml")
    assert time.process_time() - began < 3


def test_a_file_without_end_is_not_read_to_its_end(tmp_path):
    with (tmp_path / "endless.toml").open("wb") as file:
        file.truncate(1 << 32)
    with pytest.raises(ScenarioError, match="of which a file may have"):
        load_scenario(tmp_path / "endless.toml")


def test_what_only_looks_deep_is_read():
    deep = "[" * (MAX_DEPTH - 1) + "]" * (MAX_DEPTH - 1)
    text = "\n".join(
        [
            'text = "' + "[" * 100 + "a." * 100 + '"',
            "many = '''\n" + "[{" * 100 + "\n'''",
            f"a = {deep} # " + "{" * 100,
        ]
    )
    assert parse_toml(text) == tomllib.loads(text)
    for file in shipped_scenarios().values():
        assert parse_toml(file.read_text()) == tomllib.loads(file.read_text())
