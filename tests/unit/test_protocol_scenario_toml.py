"""TOML: the line of every key, and text from elsewhere that is refused before it costs time or memory."""

from __future__ import annotations

import random
import time
import tomllib
from collections.abc import Iterator
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from caviar_protocol.errors import ScenarioError
from caviar_protocol.scenario import load_scenario, parse_scenario, shipped_scenarios
from caviar_protocol.scenario.toml import MAX_DEPTH, MAX_SIZE, KeyPath, dotted, key_lines, parse_toml

DOCUMENT = '''\
# a comment with [brackets] and key = value
top = 1
a.b."c.d" = "dotted, with a quoted part"

[run]          # after a header
name = "x"
text = """
[not.a.table]
key = "nor a key" \\"""  escaped
ends in two quotes"""""
literal = \'\'\'
also = "not a key"
\'\'\'
numbers = [
    1,  # first ], not the end
    2,

    3,
]
when = 1979-05-27 07:32:00
inline = { p = 1, q = [ { r = "}" }, { r = ']' } ], "s t" = {} }

[[devices]]
name = "first"
[devices.array]
rows = 2
[[devices]]
name = "second"
[[devices.mounts]]
on = 1
[[devices.mounts]]
on = 2
[services.channel.settings]
x = 1
'''

EXPECTED: dict[KeyPath, int] = {
    ("top",): 2,
    ("a",): 3,
    ("a", "b"): 3,
    ("a", "b", "c.d"): 3,
    ("run",): 5,
    ("run", "name"): 6,
    ("run", "text"): 7,
    ("run", "literal"): 11,
    ("run", "numbers"): 14,
    ("run", "numbers", 0): 15,
    ("run", "numbers", 1): 16,
    ("run", "numbers", 2): 18,
    ("run", "when"): 20,
    ("run", "inline"): 21,
    ("run", "inline", "p"): 21,
    ("run", "inline", "q"): 21,
    ("run", "inline", "q", 0): 21,
    ("run", "inline", "q", 0, "r"): 21,
    ("run", "inline", "q", 1): 21,
    ("run", "inline", "q", 1, "r"): 21,
    ("run", "inline", "s t"): 21,
    ("devices",): 23,
    ("devices", 0): 23,
    ("devices", 0, "name"): 24,
    ("devices", 0, "array"): 25,
    ("devices", 0, "array", "rows"): 26,
    ("devices", 1): 27,
    ("devices", 1, "name"): 28,
    ("devices", 1, "mounts"): 29,
    ("devices", 1, "mounts", 0): 29,
    ("devices", 1, "mounts", 0, "on"): 30,
    ("devices", 1, "mounts", 1): 31,
    ("devices", 1, "mounts", 1, "on"): 32,
    ("services",): 33,
    ("services", "channel"): 33,
    ("services", "channel", "settings"): 33,
    ("services", "channel", "settings", "x"): 34,
}


def test_every_key_of_a_document_in_all_styles_has_its_line() -> None:
    tomllib.loads(DOCUMENT)
    assert key_lines(DOCUMENT) == EXPECTED


def test_the_end_of_the_file_may_lack_a_newline() -> None:
    assert key_lines("a = 1\n[b]\nc = 'x'") == {("a",): 1, ("b",): 2, ("b", "c"): 3}


@pytest.mark.parametrize(
    ("path", "text"),
    [
        (("devices", 0, "array", "rows"), "devices[0].array.rows"),
        (("a.b", "c"), '"a.b".c'),
        (("x", 1, 2), "x[1][2]"),
        ((), ""),
    ],
)
def test_a_path_is_written_as_in_the_file(path: KeyPath, text: str) -> None:
    assert dotted(path) == text


SCALARS = [
    "1",
    "-2.5e3",
    "true",
    "nan",
    "2020-01-01",
    '"#]}= \\" x"',
    "'#]}=\"'",
    '"""a\n"b" ]\n"""',
    "'''\n'c'\n'''",
]
KEYS = st.text("ab-_ .é#=", min_size=1, max_size=3)
TREES = st.recursive(
    st.sampled_from(SCALARS),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(KEYS, inner, max_size=3),
    max_leaves=12,
)


def _emit(value: Any, path: KeyPath, line: int, found: dict[KeyPath, int], rng: random.Random) -> str:
    """Text of a value whose first character stands in ``line``; notes the line of each key inside."""
    if isinstance(value, str):
        return value
    text, is_table = ("{", True) if isinstance(value, dict) else ("[", False)
    entries: list[tuple[str | int, Any]] = list(value.items()) if is_table else list(enumerate(value))
    for key, item in entries:
        if not is_table:  # only arrays may be broken into lines
            text += rng.choice(["", " ", "\n", " # ] [ {\n\n  "])
        here = line + text.count("\n")
        found[(*path, key)] = here
        text += f'"{key}" = ' if is_table else ""
        text += _emit(item, (*path, key), here, found, rng)
        text += ", " if key != entries[-1][0] else ""
    if not is_table:
        text += rng.choice(["", "\n", "  # end\n"])
    return text + ("}" if is_table else "]")


def _paths(value: Any, path: KeyPath = ()) -> Iterator[KeyPath]:
    entries = (
        value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    )
    for key, item in entries:
        yield (*path, key)
        yield from _paths(item, (*path, key))


@given(st.dictionaries(KEYS, TREES, max_size=4), st.integers(0, 2**32))
def test_generated_documents_have_the_lines_they_were_written_to(tree: dict[str, Any], seed: int) -> None:
    rng, expected, text = random.Random(seed), {}, "[table]\n"
    for key, value in tree.items():
        text += rng.choice(["", "\n", "# = [ \n"])
        line = 1 + text.count("\n")
        expected[("table", key)] = line
        text += f'"{key}" = {_emit(value, ("table", key), line, expected, rng)}\n'
    lines = key_lines(text)
    assert lines == expected | {("table",): 1}
    assert set(_paths(tomllib.loads(text))) == set(lines)


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
