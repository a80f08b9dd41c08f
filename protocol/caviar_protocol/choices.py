"""The values that were possible at the place where a decoder found another one."""

from __future__ import annotations

import re
from functools import cache
from typing import Any

import msgspec
from msgspec import inspect

_INVALID = re.compile(r"Invalid (?:enum )?value .* - at `\$(?P<path>.*)`", re.DOTALL)
_STEP = re.compile(r"\.([A-Za-z0-9_]+)|\[(\d+)\]")


def choices(kind: Any, encoded: bytes | bytearray | memoryview, complaint: str) -> tuple[str, ...]:
    """The words that may stand where a value of type ``kind`` has another one; empty where that is not known.

    Parameters
    ----------
    kind
        Type that was decoded: a struct, or a union of structs with tags.
    encoded
        The MessagePack bytes that could not be decoded.
    complaint
        What msgspec says about them: ``Invalid enum value 'worldd' - at `$.role```.
    """
    found = _INVALID.fullmatch(complaint)
    if found is None:
        return ()
    try:
        value = msgspec.msgpack.decode(encoded)
    except (msgspec.MsgspecError, ValueError, RecursionError):
        return ()
    steps = [name or int(number) for name, number in _STEP.findall(found["path"])]
    return _words(_at(_type_info(kind), value, steps))


_type_info = cache(inspect.type_info)


def _at(
    expected: inspect.Type | None, value: Any, steps: list[str | int]
) -> inspect.Type | tuple[str, ...] | None:
    """Type at the end of a path; of a tag, the tags there are."""
    for number, step in enumerate(steps):
        expected = _bare(expected)
        if isinstance(step, int):
            expected = _element(expected, step)
            value = value[step] if isinstance(value, list) and step < len(value) else None
            continue
        structs = _structs(expected)
        tags = {struct.tag_field: struct for struct in structs}
        if step in tags and number == len(steps) - 1:
            return tuple(str(struct.tag) for struct in structs)
        fields = value if isinstance(value, dict) else {}
        matching = [s for s in structs if s.tag_field is None or fields.get(s.tag_field) == s.tag] or structs[
            :1
        ]
        by_name = {field.encode_name: field.type for struct in matching[:1] for field in struct.fields}
        expected, value = by_name.get(step), fields.get(step)
    return _bare(expected)


def _bare(expected: inspect.Type | None) -> inspect.Type | None:
    while isinstance(expected, inspect.Metadata):
        expected = expected.type
    return expected


def _structs(expected: inspect.Type | None) -> list[inspect.StructType]:
    members = expected.types if isinstance(expected, inspect.UnionType) else (expected,)
    return [member for member in map(_bare, members) if isinstance(member, inspect.StructType)]


def _element(expected: inspect.Type | None, index: int) -> inspect.Type | None:
    match expected:
        case inspect.VarTupleType(item_type=element) | inspect.ListType(item_type=element):
            return element
        case inspect.TupleType(item_types=elements) if index < len(elements):
            return elements[index]
        case _:
            return None


def _words(expected: inspect.Type | tuple[str, ...] | None) -> tuple[str, ...]:
    match expected:
        case tuple():
            return expected
        case inspect.LiteralType(values=values):
            return tuple(map(str, values))
        case inspect.EnumType(cls=cls):
            return tuple(str(member.value) for member in cls)
        case _:
            return ()
