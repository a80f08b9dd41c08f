"""Parsing TOML from elsewhere in bounded time and memory.

`tomllib` recurses for every level, so that a few kilobytes of brackets end in a `RecursionError`, and takes
time quadratic in the parts of a dotted key. What no scenario needs is refused before.
"""

from __future__ import annotations

import re
import tomllib
from typing import Any

MAX_SIZE = 1 << 20
"""Characters of a file."""
MAX_DEPTH = 32
"""Levels of arrays and tables, and parts of a dotted key."""

_STRING_OR_COMMENT = re.compile(
    r'"""(?:\\.|[^\\])*?"""|' + r"'''.*?'''|" + r'"(?:\\.|[^"\\\n])*"|' + r"'[^'\n]*'|#[^\n]*", re.DOTALL
)
_BRACKET = re.compile(r"[][{}]")
_PART = r'(?:[\w-]++|"")'
_LONG_WORD = re.compile(r"\w{1000}")
"""A number of so many digits takes quadratic time to be read, and to be printed."""
_LONG_KEY = re.compile(rf"(?<![\w-]){_PART}(?:[ \t]*\.[ \t]*{_PART}){{{MAX_DEPTH}}}")


def parse_toml(text: str) -> dict[str, Any]:
    """The table that TOML text is.

    Raises `tomllib.TOMLDecodeError`, whose text ends with the line where one is known, for what is no TOML,
    larger than `MAX_SIZE`, deeper than `MAX_DEPTH`, or has a number of a thousand digits.
    """
    if len(text) > MAX_SIZE:
        raise tomllib.TOMLDecodeError(f"{len(text)} characters, of which a file may have {MAX_SIZE}")
    # Strings keep their lines, so that places stay right.
    bare = _STRING_OR_COMMENT.sub(lambda found: '""' + "\n" * found[0].count("\n"), text)
    depth = 0
    for bracket in _BRACKET.finditer(bare):
        depth += 1 if bracket[0] in "[{" else -1
        if depth > MAX_DEPTH:
            raise _refused(f"arrays and tables are nested in more than {MAX_DEPTH} levels", bare, bracket)
    if (key := _LONG_KEY.search(bare)) is not None:
        raise _refused(f"a key has more than {MAX_DEPTH} parts", bare, key)
    if (word := _LONG_WORD.search(bare)) is not None:
        raise _refused("a number or a key has more than 1000 characters", bare, word)
    return tomllib.loads(text)


def _refused(what: str, text: str, found: re.Match[str]) -> tomllib.TOMLDecodeError:
    line = text.count("\n", 0, found.start()) + 1
    column = found.start() - text.rfind("\n", 0, found.start())
    return tomllib.TOMLDecodeError(f"{what} (at line {line}, column {column})")
