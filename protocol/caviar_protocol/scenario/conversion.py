"""Checks of scenario tables against the schema, and their conversion to structs; errors say what to write."""

from __future__ import annotations

import csv
import math
import re
import threading
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import msgspec
from msgspec import inspect

from caviar_protocol.errors import ScenarioError, suggestion
from caviar_protocol.fields import PRINTABLE

T = TypeVar("T", bound=msgspec.Struct)

FILE = "file:"
"""Before a path that is relative to the folder of the scenario."""
_NAME = r'([A-Za-z0-9_-]+|"[^"]*")'
# A dotted key.
_KEY = re.compile(rf"{_NAME}(\.{_NAME}|\[\d+\])*")

_ARRAYS = (inspect.VarTupleType, inspect.ListType, inspect.TupleType)


class Source(msgspec.Struct, frozen=True, kw_only=True):
    """The file a scenario was read from, and where its keys stand. Empty: built in Python.

    Example:
        >>> Source(file="my.toml", lines={"run": 1, "run.seed": 3}).line("run.frames")  # where to write it
        1
    """

    file: str = ""
    lines: dict[str, int] = {}
    """1-based line of each key, by its dotted path: ``devices[0].array.rows``."""

    def line(self, key: str) -> int | None:
        """Line of a key, or of the nearest table around it that stands in the file.

        Args:
            key: Dotted: ``devices[0].array.rows``.
        """
        while key:
            if key in self.lines:
                return self.lines[key]
            # Missing keys have no line: that of the nearest table around is where to write them.
            key = re.sub(r"(^|\.)([^.\"\[]+|\"[^\"]*\")$|\[\d+\]$", "", key)
        return None

    def holds(self, key: str) -> bool:
        """Return whether the file has this very key, or one below it.

        Args:
            key: Dotted: ``devices[0].array``.
        """
        return any(line == key or line.startswith((f"{key}.", f"{key}[")) for line in self.lines)


class Place(msgspec.Struct, frozen=True):
    """Place of a value: a dotted key in a file that may be unknown.

    Example:
        >>> source = Source(file="my.toml", lines={"devices[0].on": 12})
        >>> print(Place("devices", source).at(0).at("on").error("is empty"))
        my.toml:12: devices[0].on: is empty
    """

    key: str = ""
    source: Source = Source()

    def at(self, name: str | int) -> Place:
        """The place of an entry of the table or array at this place.

        Args:
            name: Key of a table, or index of an array.
        """
        if isinstance(name, int):
            return Place(f"{self.key}[{name}]", self.source)
        # Quoted as TOML needs it, since a user copies the key from the error into the file.
        bare = name if re.fullmatch(r"[A-Za-z0-9_-]+", name) else f'"{name}"'
        return Place(f"{self.key}.{bare}" if self.key else bare, self.source)

    def error(self, message: str) -> ScenarioError:
        """Make an error that names this place.

        Args:
            message: What is wrong, and what to write instead.
        """
        return ScenarioError(message, self.source.file, self.key, self.source.line(self.key))


def located(text: str, service: str, source: Source) -> str:
    """Put file and line before what a service says about the scenario.

    A key that begins with ``settings``, or that the file has only among the service's settings, is one of the
    service's own.

    Args:
        text: ``KEY: message``. A text that begins with no key of the file comes back as it is.
        service: Name of the service.
        source: The file of the scenario.

    Example:
        >>> source = Source(file="my.toml", lines={"services.channel.settings.samples": 20})
        >>> located("settings.samples: is 0, write a whole number ≥ 1", "channel", source)
        'my.toml:20: services.channel.settings.samples: is 0, write a whole number ≥ 1'
    """
    # A service knows its own keys only; the file is on the machine of the broker.
    key, separator, message = text.partition(": ")
    if not separator or _KEY.fullmatch(key) is None:
        return text
    own = Place("services").at(service).key
    if re.match(r"settings(?![A-Za-z0-9_-])", key):
        key = f"{own}.{key}"
    elif source.line(key) is None and source.holds(f"{own}.settings.{key}"):
        key = f"{own}.settings.{key}"
    place = Place(key, source)
    return str(place.error(message)) if source.file and source.line(key) is not None else text


_ONE_AT_A_TIME = threading.RLock()
# msgspec builds what it knows of a struct at its first use. Where threads do so at once the process dies of a
# segmentation fault: with msgspec 0.22, in 19 of 30 processes of six threads.


def convert_settings(cls: type[T], settings: Mapping[str, Any], place: Place | None = None) -> T:
    """Convert the settings of a service to its implementation's ``Settings`` struct.

    Args:
        cls: The struct.
        settings: As they stand in the scenario.
        place: Where they stand (`caviar_protocol.scenario.rules.settings_place`); a service that was handed
            its settings leaves it out.

    Raises:
        ScenarioError: A setting is unknown, missing or out of range; the text has the key, file and line
            where they are known, the value and what to write instead.

    Example:
        >>> class Settings(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
        ...     users: int = 1
        >>> convert_settings(Settings, {"users": 4}).users
        4
        >>> convert_settings(Settings, {"user": 4})
        Traceback (most recent call last):
            ...
        caviar_protocol.errors.ScenarioError: settings.user: unknown key 'user'; did you mean 'users'?
    """
    return convert_table(cls, settings, place or Place("settings"))


def convert_table(cls: type[T], table: object, place: Place) -> T:
    """Convert a TOML table to a struct.

    Args:
        cls: The struct; ``unknown_key_hint`` of it is added to errors about unknown keys, and fields in its
            ``not_in_file`` are unknown.
        table: As `tomllib` gives it.
        place: Where it stands.

    Raises:
        ScenarioError: The first thing wrong with it.
    """
    try:
        with _ONE_AT_A_TIME:
            # Checked before msgspec, whose errors have neither unit nor suggestion.
            _check(table, inspect.type_info(cls), place)
            return msgspec.convert(table, cls)
    except msgspec.ValidationError as error:  # a rule of the struct's own, in its __post_init__
        message, _, where = str(error).partition(" - at `$")
        for name in re.findall(r"\.([A-Za-z0-9_-]+)", where):
            place = place.at(name)
        raise place.error(message) from error


def _check(value: object, expected: inspect.Type, place: Place) -> None:
    """Raise `ScenarioError` for whatever in ``value`` does not fit the expected type."""
    unit = ""
    while isinstance(expected, inspect.Metadata):
        unit = str((expected.extra or {}).get("unit", "")) or unit
        expected = expected.type
    match expected:
        case inspect.StructType():
            _check_struct(value, expected, place)
        case inspect.DictType(value_type=entry):
            for name, item in _table(value, place).items():
                _check(item, entry, place.at(name))
        case inspect.VarTupleType(item_type=element) | inspect.ListType(item_type=element):
            bracket = f"[[{place.key}]]" if isinstance(element, inspect.StructType) else "[ … ]"
            for index, item in enumerate(_array(value, place, bracket)):
                _check(item, element, place.at(index))
        case inspect.TupleType(item_types=elements):
            items = _array(value, place)
            if len(items) != len(elements):
                raise place.error(f"has {len(items)} elements, write {len(elements)}{_in(unit)}")
            for index, (item, element) in enumerate(zip(items, elements, strict=True)):
                _check(item, element, place.at(index))
        case inspect.UnionType(types=choices):
            _check_union(value, choices, place)
        case inspect.LiteralType(values=choices):
            if value not in choices:
                shown = [str(choice) for choice in choices if choice != ""]
                hint = suggestion(str(value), shown)
                others = f" One of {', '.join(shown)}." if hint.startswith("did") else ""
                raise place.error(f"{show(value)} is not possible here; {hint}{others}")
        case inspect.BoolType() | inspect.StrType() | inspect.IntType() | inspect.FloatType():
            if not _fits(value, expected):
                raise place.error(f"is {show(value)}, write {_describe(expected)}{_in(unit)}")


def _check_struct(value: object, expected: inspect.StructType, place: Place) -> None:
    table = _table(value, place)
    fields = {field.encode_name: field for field in expected.fields}
    # What the loader fills in is a field and no key.
    hidden: tuple[str, ...] = getattr(expected.cls, "not_in_file", ())
    known = [name for name in fields if name not in hidden]
    if expected.tag_field is not None:
        known.append(expected.tag_field)
    # Before what is below any of them: a table that is misspelt leaves gaps elsewhere, which are none.
    for name in table:
        if name not in known:
            hint = getattr(expected.cls, "unknown_key_hint", "")
            raise place.at(name).error(
                f"unknown key {name!r}; {suggestion(name, known)}" + (f" ({hint})" if hint else "")
            )
    for name, item in table.items():
        if name in fields:
            _check(item, fields[name].type, place.at(name))
    for name, field in fields.items():
        if field.required and name not in table:
            what = "" if place.key else "the file "
            raise place.error(f"{what}lacks {name!r}, write {_example(field, place.at(name))}")


def _check_union(value: object, choices: tuple[inspect.Type, ...], place: Place) -> None:
    structs = [choice for choice in choices if isinstance(choice, inspect.StructType)]
    if not isinstance(value, dict) or not structs:
        plain = [choice for choice in choices if not isinstance(choice, inspect.NoneType)]
        if isinstance(value, list):
            plain = [choice for choice in plain if isinstance(choice, _ARRAYS)] or plain
        words = [choice for choice in plain if isinstance(choice, inspect.LiteralType)]
        if plain and len(words) == len(plain):
            plain = [inspect.LiteralType(tuple(word for choice in words for word in choice.values))]
        if len(plain) == 1:
            _check(value, plain[0], place)
        elif len(plain) == 2 and isinstance(plain[0], inspect.LiteralType):
            _check_word_or(value, plain[0], plain[1], place)
        return  # what remains is left to msgspec, which knows every type
    if len(structs) == 1:
        _check_struct(value, structs[0], place)
        return
    # By tag and not by trial: the errors are those of the type that was meant.
    tag_field = structs[0].tag_field or "type"
    by_tag = {str(choice.tag): choice for choice in structs}
    tag = value.get(tag_field)
    if tag is None and tag_field not in value:
        raise place.error(f"lacks {tag_field!r}, write one of {', '.join(sorted(by_tag))}")
    if tag not in by_tag:
        raise place.at(tag_field).error(f"is {show(tag)}; {suggestion(str(tag), by_tag)}")
    _check_struct(value, by_tag[tag], place)


def _check_word_or(value: object, words: inspect.LiteralType, other: inspect.Type, place: Place) -> None:
    """Check a value that is one of some words, or no text."""
    if isinstance(value, str) and value in words.values:
        return
    while isinstance(other, inspect.Metadata):
        other = other.type
    if not _fits(value, other):
        shown = ", ".join(f'"{word}"' for word in words.values)
        raise place.error(f"is {show(value)}, write {_describe(other)}, or one of {shown}")


def _table(value: object, place: Place) -> dict[str, object]:
    if not isinstance(value, Mapping):
        raise place.error(f"is {show(value)}, write a table: [{place.key}]")
    return dict(value)


def _array(value: object, place: Place, written: str = "[ … ]") -> list[object]:
    if not isinstance(value, list | tuple):
        raise place.error(f"is {show(value)}, write an array: {written}")
    return list(value)


def _fits(value: object, expected: inspect.Type) -> bool:
    # bool is a subclass of int, and `frames = true` is a mistake.
    if isinstance(value, bool) or isinstance(expected, inspect.BoolType):
        return isinstance(value, bool) and isinstance(expected, inspect.BoolType)
    match expected:
        case inspect.StrType(min_length=low, max_length=high, pattern=pattern):
            return (
                isinstance(value, str)
                and (low is None or len(value) >= low)
                and (high is None or len(value) <= high)
                and (pattern is None or re.search(pattern, value) is not None)
            )
        case inspect.IntType():
            # TOML's integers are 64-bit ones, Python's are not.
            return isinstance(value, int) and -(2**63) <= value < 2**63 and _in_range(value, expected)
        case inspect.FloatType():
            return isinstance(value, int | float) and math.isfinite(value) and _in_range(value, expected)
    return False


def _in_range(value: float, expected: inspect.IntType | inspect.FloatType) -> bool:
    return (
        (expected.gt is None or value > expected.gt)
        and (expected.ge is None or value >= expected.ge)
        and (expected.lt is None or value < expected.lt)
        and (expected.le is None or value <= expected.le)
    )


def _describe(expected: inspect.Type) -> str:
    match expected:
        case inspect.BoolType():
            return "true or false"
        case inspect.StrType(min_length=low, max_length=high, pattern=pattern) if pattern == PRINTABLE:
            return f"{_describe(inspect.StrType(low, high))} without control characters"
        case inspect.StrType(pattern=pattern) if pattern is not None:
            return f"a string that matches {pattern}"
        case inspect.StrType(min_length=low, max_length=high) if low or high:
            return f"a string of {low or 0} to {'any number of' if high is None else high} characters"
        case inspect.StrType():
            return "a string"
        case inspect.IntType() | inspect.FloatType():
            noun = "a whole number" if isinstance(expected, inspect.IntType) else "a number"
            limits = (("> ", expected.gt), ("≥ ", expected.ge), ("< ", expected.lt), ("≤ ", expected.le))
            bounds = [f"{sign}{limit}" for sign, limit in limits if limit is not None]
            return " ".join([noun, " and ".join(bounds)]).strip()
    return "something else"


def _in(unit: str) -> str:
    return f" [{unit}]" if unit and unit != "1" else ""


def _example(field: inspect.Field, place: Place) -> str:
    """Example of what to write for a key that is missing."""
    kind = field.type
    while isinstance(kind, inspect.Metadata):
        kind = kind.type
    match kind:
        case inspect.StructType():
            return f"[{place.key}]"
        case inspect.DictType():
            return f"[{place.key}.NAME]"
        case inspect.VarTupleType(item_type=inspect.StructType()):
            return f"[[{place.key}]]"
        case inspect.LiteralType(values=choices):
            return f"{field.encode_name} = … (one of {', '.join(map(str, choices))})"
        case inspect.BoolType() | inspect.StrType() | inspect.IntType() | inspect.FloatType():
            return f"{field.encode_name} = … ({_describe(kind)})"
    return f"{field.encode_name} = …"


class CsvRow(NamedTuple):
    """A row of a CSV file that a scenario names."""

    number: int
    """Of its line, from 1."""
    text: str
    """The whole line."""
    cells: list[str]
    """Without the spaces around them."""


def csv_rows(
    path: Path, place: Place, headers: Sequence[Sequence[str]], what: str = "", form: str = ""
) -> list[CsvRow]:
    """Read a CSV file; empty lines and those that begin with ``#`` are left out.

    Args:
        path: The file.
        place: Key of the scenario that names it, for the error.
        headers: What may stand in the first row.
        what: Stands before the file's name in an error.
        form: What to write as the first row; empty: the first of ``headers``.

    Returns:
        The rows, the header first; none of a file without any.

    Raises:
        ScenarioError: The file cannot be read, or begins with another row; names file and line.

    Example:
        >>> _ = Path("video.csv").write_text("t_s,rate\\n# at night\\n0, 2e6\\n")
        >>> [(row.number, row.cells) for row in csv_rows(Path("video.csv"), Place("file"), [("t_s", "rate")])]
        [(1, ['t_s', 'rate']), (3, ['0', '2e6'])]
    """
    try:
        # Spreadsheets write a mark before the first letter.
        lines = path.read_text(encoding="utf-8-sig").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        why = error.strerror if isinstance(error, OSError) else "not UTF-8 text"
        raise place.error(f"{what}{path} cannot be read: {why}; name a CSV file") from error
    rows = []
    # Line by line, not the file at once: an error names the line, comments and empty ones counted.
    for number, line in enumerate(lines, 1):
        if not line.strip() or line.lstrip().startswith("#"):
            continue
        try:
            cells = next(csv.reader([line]))
        except csv.Error as error:  # a field is longer than 131,072 letters
            raise ScenarioError(f"is no CSV: {error}", str(path), line=number) from error
        rows.append(CsvRow(number, line, [cell.strip() for cell in cells]))
    if rows and rows[0].cells not in [list(header) for header in headers]:
        text = f"the first line is {rows[0].text!r}; write {form or ','.join(headers[0])}"
        raise ScenarioError(text, str(path), line=rows[0].number)
    return rows


def show(value: object) -> str:
    """A value as it would stand in the file.

    Args:
        value: What `tomllib` read.

    Example:
        >>> show(True), show([1, 2]), show("x")
        ('true', 'an array of 2', "'x'")
    """
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, Mapping):
        return "a table"
    return f"{value!r}" if not isinstance(value, list | tuple) else f"an array of {len(value)}"
