"""Bounded decoding of MessagePack from a peer, with errors that say what would be accepted.

The decoder recurses once a level and has a guard of its own, but that guard is made for the stack of a main
thread. So a header that could nest dangerously is first walked without recursion.
"""

from __future__ import annotations

import re
from functools import cache
from typing import Any, TypeVar

import msgspec
from msgspec import inspect

from caviar_protocol.errors import DecodeError, LimitError, PayloadError
from caviar_protocol.fields import MAX_HEADER, MAX_NESTING

Buffer = bytes | bytearray | memoryview

HARMLESS = 256
"""Levels that fit the stack of any thread. A header with no more maps and arrays is not walked."""

_CONTAINERS = bytes([*range(0x80, 0xA0), *range(0xDC, 0xE0)])
_OTHERS = bytes(byte for byte in range(256) if byte not in _CONTAINERS)

# Bytes of a value by its first byte; 0 where it has a length field, or is a map or an array.
_FIXED = [0] * 256
for _byte in range(256):
    if _byte < 0x80 or _byte >= 0xE0 or 0xC0 <= _byte <= 0xC3:
        _FIXED[_byte] = 1
    elif 0xA0 <= _byte < 0xC0:
        _FIXED[_byte] = 1 + (_byte & 0x1F)
_FIXED[0xCA:0xD4] = [5, 9, 2, 3, 5, 9, 2, 3, 5, 9]  # floats, unsigned and signed integers
_FIXED[0xD4:0xD9] = [3, 4, 6, 10, 18]  # extensions of fixed size

_LENGTH_FIELD = {
    0xC4: (1, 0), 0xC5: (2, 0), 0xC6: (4, 0),  # binary
    0xC7: (1, 1), 0xC8: (2, 1), 0xC9: (4, 1),  # extension, with its type
    0xD9: (1, 0), 0xDA: (2, 0), 0xDB: (4, 0),  # text
}  # fmt: skip


def check_nesting(header: bytes | bytearray | memoryview, what: str) -> None:
    """Refuse a header that nests so deep that decoding it could exhaust a stack.

    Up to `HARMLESS` maps and arrays in all are let pass unseen; with more, a depth beyond
    `MAX_NESTING` is refused. Bytes that are not msgpack are left to the decoder.

    Args:
        header: MessagePack bytes from a peer.
        what: What the error calls them.

    Raises:
        LimitError: Maps and arrays are nested in more than `MAX_NESTING` levels.
    """
    # A pass in C counts the bytes that may open a container, text included: few mean shallow.
    data = header if isinstance(header, bytes) else bytes(header)
    if len(data) <= HARMLESS or len(data.translate(None, _OTHERS)) <= HARMLESS:
        return
    if _deeper_than(data, MAX_NESTING):
        raise LimitError(f"{what} nests deeper than {MAX_NESTING} levels")


def _deeper_than(data: bytes, limit: int) -> bool:
    """Walk the values of a header; True at the first that stands in more than ``limit`` containers."""
    position, end = 0, len(data)
    due: list[int] = []  # how many values each open container still lacks
    left = 1
    # Bytes that end early are left to the decoder, which says where.
    while left and position < end:
        left -= 1
        byte = data[position]
        if size := _FIXED[byte]:
            position += size
        elif byte in _LENGTH_FIELD:
            width, extra = _LENGTH_FIELD[byte]
            position += 1 + width + extra + int.from_bytes(data[position + 1 : position + 1 + width], "big")
        else:
            position, children = _open(data, position, byte)
            due.append(left)
            left = children
            if len(due) > limit:
                return True
        # A container that is full closes all those of which it was the last value.
        while not left and due:
            left = due.pop()
    return False


def _open(data: bytes, position: int, byte: int) -> tuple[int, int]:
    """Position of the first value in a container, and how many there are (keys count too)."""
    # fixmap and fixarray have their size in the low bits; the others in two or four bytes after.
    if byte < 0xA0:
        return position + 1, (byte & 0x0F) * (1 if byte >= 0x90 else 2)
    width = 2 if byte in (0xDC, 0xDE) else 4
    count = int.from_bytes(data[position + 1 : position + 1 + width], "big")
    return position + 1 + width, count * (1 if byte < 0xDE else 2)


# msgspec raises one class for all that is wrong: only the text says which kind and where.
_INVALID = re.compile(r"Invalid (?:enum )?value .* - at `\$(?P<path>.*)`", re.DOTALL)
_STEP = re.compile(r"\.([A-Za-z0-9_]+)|\[(\d+)\]")


def choices(kind: Any, encoded: bytes | bytearray | memoryview, complaint: str) -> tuple[str, ...]:
    """The words that may stand where a value of type ``kind`` has another one; empty where that is not known.

    Args:
        kind: Type that was decoded: a struct, or a union of structs with tags.
        encoded: The MessagePack bytes that could not be decoded.
        complaint: What msgspec says about them: ``Invalid enum value 'worldd' - at `$.role```.
    """
    found = _INVALID.fullmatch(complaint)
    if found is None:
        return ()
    try:
        value = msgspec.msgpack.decode(encoded)
    except (msgspec.MsgspecError, ValueError, RecursionError):
        # The complaint was about these bytes, so they decode without a type; else no word can be named.
        return ()
    # msgspec names the place as JSON Path does: `$.inputs[2].topic`.
    steps = [name or int(number) for name, number in _STEP.findall(found["path"])]
    expected = _at(_type_info(kind), value, steps)
    match expected:
        case tuple():
            return expected
        case inspect.LiteralType(values=values):
            return tuple(map(str, values))
        case inspect.EnumType(cls=cls):
            return tuple(str(member.value) for member in cls)
        case _:
            return ()


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
        members = expected.types if isinstance(expected, inspect.UnionType) else (expected,)
        structs = [member for member in map(_bare, members) if isinstance(member, inspect.StructType)]
        tags = {struct.tag_field: struct for struct in structs}
        if step in tags and number == len(steps) - 1:
            return tuple(str(struct.tag) for struct in structs)
        fields = value if isinstance(value, dict) else {}
        # Of a union the member with this tag; without a tag any, of which msgspec allows one.
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


def _element(expected: inspect.Type | None, index: int) -> inspect.Type | None:
    match expected:
        case inspect.VarTupleType(item_type=element) | inspect.ListType(item_type=element):
            return element
        case inspect.TupleType(item_types=elements) if index < len(elements):
            return elements[index]
        case _:
            return None


_T = TypeVar("_T")


def decode_bounded(decoder: msgspec.msgpack.Decoder[_T], header: Buffer, what: str) -> _T:
    """Decode MessagePack from a peer, after a check of its size and depth.

    Args:
        decoder: Decoder of the expected type.
        header: The bytes.
        what: What an error calls them: ``"message header"``.

    Raises:
        LimitError: They are larger than `MAX_HEADER`, or nest deeper than `MAX_NESTING`.
        DecodeError: They are not of the expected type; the text lists what is accepted where that is known.
    """
    if len(header) > MAX_HEADER:
        raise LimitError(f"{what} has {len(header)} B, at most {MAX_HEADER} are accepted")
    check_nesting(header, what)
    try:
        return decoder.decode(header)
    # What the walk let pass (few containers) may still be deeper than a small thread's stack.
    except RecursionError as error:
        raise LimitError(f"{what} nests deeper than {MAX_NESTING} levels") from error
    except (PayloadError, msgspec.MsgspecError, ValueError, TypeError, OverflowError) as error:
        possible = choices(decoder.type, header, str(error))
        hint = f"; write one of {', '.join(possible)}" if possible else ""
        raise DecodeError(f"{what}: {error}{hint}") from error
