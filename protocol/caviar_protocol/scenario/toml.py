"""TOML: a parser bounded in time and memory, the line of every key, and a writer.

`tomllib` recurses for every level, so that a few kilobytes of brackets end in a `RecursionError`, and takes
time quadratic in the parts of a dotted key. What no scenario needs is refused before. It does not keep line
numbers either: a scanner finds where the keys of an accepted document stand.
"""

from __future__ import annotations

import json
import re
import tomllib
from collections.abc import Mapping, Sequence
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
# A number of so many digits takes quadratic time to be read, and to be printed.
_LONG_WORD = re.compile(r"\w{1000}")
_LONG_KEY = re.compile(rf"(?<![\w-]){_PART}(?:[ \t]*\.[ \t]*{_PART}){{{MAX_DEPTH}}}")


def parse_toml(text: str) -> dict[str, Any]:
    """Parse TOML text from elsewhere.

    Raises:
        tomllib.TOMLDecodeError: It is no TOML, larger than `MAX_SIZE`, deeper than `MAX_DEPTH`, or has a
            number of a thousand digits. The text ends with the line where one is known.
    """
    # First, since all that follows takes time in proportion to it.
    if len(text) > MAX_SIZE:
        raise tomllib.TOMLDecodeError(f"{len(text)} characters, of which a file may have {MAX_SIZE}")
    # Strings keep their lines, so that places stay right.
    bare = _STRING_OR_COMMENT.sub(lambda found: '""' + "\n" * found[0].count("\n"), text)
    depth = 0
    # Before tomllib, whose recursion a few kilobytes of ``[`` exhaust.
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


KeyPath = tuple[str | int, ...]
"""Keys and array indices from the root of a document: ``("devices", 0, "array", "rows")``."""

_BLANK = re.compile(r"(?:[ \t\r\n]|#[^\n]*)*")
_SPACE = re.compile(r"[ \t]*")
_BARE_KEY = re.compile(r"[A-Za-z0-9_-]+")
_BARE_VALUE = re.compile(r"[^,\]}#\r\n]+")
_STRING = re.compile(
    r'"""(?:\\.|[^\\])*?"{3,5}(?!")'  # multi-line basic; may end in up to two quotes of its own
    r"|'''.*?'{3,5}(?!')"
    r'|"(?:\\.|[^"\\\n])*"'
    r"|'[^'\n]*'",
    re.DOTALL,
)


def dotted(path: KeyPath) -> str:
    """Write a key path as a dotted key.

    Example:
        >>> dotted(("devices", 0, "array", "rows"))
        'devices[0].array.rows'
    """
    text = ""
    for part in path:
        if isinstance(part, int):
            text += f"[{part}]"
        else:
            name = part if _BARE_KEY.fullmatch(part) else f'"{part}"'
            text += f".{name}" if text else name
    return text


def key_lines(text: str) -> dict[KeyPath, int]:
    r"""The 1-based line of every key, table and array element of a valid TOML document.

    Example:
        >>> key_lines("[run]\nframes = 3\n")
        {('run',): 1, ('run', 'frames'): 2}
    """
    return _Scanner(text).scan()


class _Scanner:
    """One pass over a document. ``at`` is the position of the next character to read."""

    def __init__(self, text: str) -> None:
        self.text = text
        self.at = 0
        self.line = 1
        self.counted = 0
        self.lines: dict[KeyPath, int] = {}
        self.elements: dict[KeyPath, int] = {}
        """Index of the last table of each array of tables."""

    def scan(self) -> dict[KeyPath, int]:
        table: KeyPath = ()
        while True:
            self.skip(_BLANK)
            if self.at == len(self.text):
                return self.lines
            if self.text[self.at] == "[":
                table = self.header()
            else:
                self.key_value(table)

    def skip(self, pattern: re.Pattern[str]) -> str:
        match = pattern.match(self.text, self.at)
        if match is None:
            raise ValueError(f"not a TOML document: stopped at line {self.current_line()}")
        self.at = match.end()
        return match.group()

    def current_line(self) -> int:
        # Counted from where the last count ended: from the beginning each time would be quadratic.
        self.line += self.text.count("\n", self.counted, self.at)
        self.counted = self.at
        return self.line

    def note(self, path: KeyPath) -> None:
        """Record the line of a path, and of each of its parents not seen before."""
        # A table that no header names (``[a.b]`` names ``a``) has the line of its first child.
        line = self.current_line()
        for depth in range(1, len(path) + 1):
            self.lines.setdefault(path[:depth], line)

    def header(self) -> KeyPath:
        is_array = self.text.startswith("[[", self.at)
        self.at += 2 if is_array else 1
        keys = self.key()
        path: KeyPath = ()
        for depth, key in enumerate(keys, 1):
            path = (*path, key)
            if is_array and depth == len(keys):
                self.elements[path] = self.elements.get(path, -1) + 1
            # A table below an array of tables is in the last of them (TOML 1.0).
            if path in self.elements:
                path = (*path, self.elements[path])
        self.note(path)
        self.at += 2 if is_array else 1
        return path

    def key(self) -> tuple[str, ...]:
        """A possibly dotted key, up to the ``=`` or ``]`` after it."""
        parts: list[str] = []
        while True:
            self.skip(_SPACE)
            if self.text[self.at] in "\"'":
                parsed: dict[str, Any] = tomllib.loads(f"key = {self.skip(_STRING)}")
                parts.append(str(parsed["key"]))
            else:
                parts.append(self.skip(_BARE_KEY))
            self.skip(_SPACE)
            if self.text[self.at] != ".":
                return tuple(parts)
            self.at += 1

    def key_value(self, table: KeyPath) -> None:
        path: KeyPath = (*table, *self.key())
        self.note(path)
        self.at += 1  # the equals sign
        self.skip(_SPACE)
        self.value(path)

    def value(self, path: KeyPath) -> None:
        match self.text[self.at]:
            case "[":
                self.array(path)
            case "{":
                self.inline_table(path)
            case '"' | "'":
                self.skip(_STRING)
            case _:
                self.skip(_BARE_VALUE)

    def array(self, path: KeyPath) -> None:
        self.at += 1
        index = 0
        while True:
            self.skip(_BLANK)
            if self.text[self.at] == "]":
                self.at += 1
                return
            element = (*path, index)
            self.note(element)
            self.value(element)
            self.skip(_BLANK)
            if self.text[self.at] == ",":
                self.at += 1
            index += 1

    def inline_table(self, path: KeyPath) -> None:
        self.at += 1
        while True:
            self.skip(_BLANK)
            if self.text[self.at] == "}":
                self.at += 1
                return
            self.key_value(path)
            self.skip(_BLANK)
            if self.text[self.at] == ",":
                self.at += 1


def toml_text(document: Mapping[str, Any]) -> str:
    """Write a document of tables and arrays of tables; tables within these are written in one line.

    Args:
        document: By name, a table or a list of tables of strings, numbers, flags, lists and tables.

    Example:
        >>> print(toml_text({"run": {"frames": 3}, "carriers": [{"name": "n257"}]}), end="")
        [run]
        frames = 3
        <BLANKLINE>
        [[carriers]]
        name = "n257"
    """
    tables = []
    for name, value in document.items():
        is_array = not isinstance(value, Mapping)
        for entry in value if is_array else [value]:
            lines = [f"{_key_text(key)} = {_value_text(item)}\n" for key, item in entry.items()]
            tables.append((f"[[{name}]]\n" if is_array else f"[{name}]\n") + "".join(lines))
    return "\n".join(tables)


def _value_text(value: Any) -> str:
    match value:
        case Mapping():
            inside = ", ".join(f"{_key_text(key)} = {_value_text(item)}" for key, item in value.items())
            return f"{{ {inside} }}" if inside else "{}"
        case str():
            # JSON's escapes are those of TOML but for DEL, and for characters beyond the basic plane.
            return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007F")
        case float():
            return repr(value)  # shortest digits that read back as the same number; inf and nan are TOML too
        case Sequence():
            return f"[{', '.join(map(_value_text, value))}]"
        case _:
            return json.dumps(value)


def _key_text(key: str) -> str:
    return key if _BARE_KEY.fullmatch(key) else _value_text(key)
