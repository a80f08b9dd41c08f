"""Where the bytes of a header first leave the canonical form: the field, what is there, what is needed."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import zip_longest
from typing import Any

import msgpack  # type: ignore[import-untyped]

from caviar_clients.conform.packing import pack

KINDS = {dict: "map", list: "list", str: "string", bool: "boolean", int: "integer", float: "float"}


@dataclass(frozen=True)
class _Node:
    """A value and how it is written: ``raw`` is all of a scalar, or the head of a list or map."""

    raw: bytes
    value: Any
    """A scalar, a list of nodes, or a list of pairs of nodes for a map."""
    kind: str

    @property
    def shortest(self) -> bytes:
        """How it has to be written."""
        packer = msgpack.Packer()
        if self.kind == "map":
            return bytes(packer.pack_map_header(len(self.value)))
        if self.kind == "list":
            return bytes(packer.pack_array_header(len(self.value)))
        return pack(self.value)

    @property
    def keys(self) -> list[Any]:
        """Of a map, as they stand."""
        return [key.value for key, _ in self.value]


def first_difference(got: bytes, right: bytes, ignored: frozenset[str] = frozenset()) -> str:
    """The first field that is not written as in ``right``, the canonical form of the same header.

    Fields of the outermost map that are ``ignored``, as those of a later version are, only have to be in
    their shortest form. Empty where nothing differs.
    """
    return _walk(_read(got), _read(right), "", ignored)


def _read(data: bytes) -> _Node:
    unpacker = msgpack.Unpacker(raw=False, strict_map_key=False, max_buffer_size=0)
    unpacker.feed(data)
    return _node(unpacker, data)


def _node(unpacker: Any, data: bytes) -> _Node:
    start = unpacker.tell()
    head = data[start]
    if head & 0xF0 == 0x80 or head in (0xDE, 0xDF):
        count = unpacker.read_map_header()
        raw = data[start : unpacker.tell()]
        return _Node(raw, [(_node(unpacker, data), _node(unpacker, data)) for _ in range(count)], "map")
    if head & 0xF0 == 0x90 or head in (0xDC, 0xDD):
        count = unpacker.read_array_header()
        raw = data[start : unpacker.tell()]
        return _Node(raw, [_node(unpacker, data) for _ in range(count)], "list")
    value = unpacker.unpack()
    return _Node(data[start : unpacker.tell()], value, KINDS.get(type(value), "value"))


def _walk(got: _Node, right: _Node | None, path: str, ignored: frozenset[str] = frozenset()) -> str:
    """The first difference at or below ``path``; without ``right`` only forms are looked at."""
    place = f"{path}: " if path else ""
    if right is not None and got.kind != right.kind:
        return f"{place}{_form(got.kind, got.raw)}, needs {_form(right.kind, right.raw)}"
    if got.raw != got.shortest:
        return f"{place}{_form(got.kind, got.raw)}, needs {_form('', got.shortest)}"
    if got.kind == "map":
        return _walk_map(got, right, path, ignored)
    if got.kind == "list":
        return _walk_list(got, right, path)
    if right is not None and got.raw != right.raw:
        return f"{place}{got.value!r}, needs {right.value!r}"
    return ""


def _walk_map(got: _Node, right: _Node | None, path: str, ignored: frozenset[str]) -> str:
    place = f"{path}: " if path else ""
    for number, key in enumerate(got.keys):
        if key in got.keys[:number]:
            return f"{place}the key {key!r} occurs twice"
    for key, _ in got.value:
        if key.raw != key.shortest:
            return (
                f"{place}the key {key.value!r} is {_form('string', key.raw)}, needs {_form('', key.shortest)}"
            )
    expected = {} if right is None else {key.value: value for key, value in right.value}
    if right is not None:
        known = [key for key in got.keys if key not in ignored]
        if superfluous := [key for key in known if key not in expected]:
            return f"{place}{', '.join(map(str, superfluous))} equals its default and is to be left out"
        if known != right.keys:
            return f"{place}keys are {', '.join(map(str, known))}, needs {', '.join(map(str, right.keys))}"
    walked = (
        _walk(value, expected.get(key.value), f"{path}.{key.value}" if path else str(key.value))
        for key, value in got.value
    )
    return next(filter(None, walked), "")


def _walk_list(got: _Node, right: _Node | None, path: str) -> str:
    expected = [] if right is None else right.value
    if right is not None and len(got.value) != len(expected):
        return f"{path}: {len(got.value)} items, needs {len(expected)}"
    walked = (_walk(a, b, f"{path}[{i}]") for i, (a, b) in enumerate(zip_longest(got.value, expected)))
    return next(filter(None, walked), "")


def _form(kind: str, raw: bytes) -> str:
    """«a float as `ca` (5 bytes)»."""
    article = f"{'an' if kind[0] in 'aeiou' else 'a'} {kind} as " if kind else ""
    return f"{article}`{raw[0]:02x}` ({len(raw)} byte{'s' if len(raw) > 1 else ''})"
