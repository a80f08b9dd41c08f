"""Message headers to bytes and back, and messages as WebSocket frames.

Nothing here trusts its input: sizes are checked before anything is decoded, and whatever is wrong with the
bytes comes out as a `ProtocolError`. All functions may be called from any thread.

A message of several parts travels over a WebSocket as one binary frame (SPEC.md, section WebSocket)::

    u32  number of parts        little-endian, as all of these
    u32  length of each part    as many as there are parts
         the parts, one after the other

Bounded decoding of MessagePack from a peer, with errors that say what would be accepted.

The decoder recurses once a level and has a guard of its own, but that guard is made for the stack of a main
thread. So a header that could nest dangerously is first walked without recursion.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Sequence
from functools import cache
from types import NoneType
from typing import Any, TypeVar

import msgspec
from msgspec import inspect

from caviar_protocol.errors import DecodeError, LimitError, PayloadError, VersionError
from caviar_protocol.fields import MAX_ASSET_CHUNK, MAX_BODY, MAX_HEADER, MAX_NESTING, MAX_PARTS, Version
from caviar_protocol.messages import (
    PROTOCOL_VERSION,
    AssetData,
    CheckpointDone,
    Done,
    Grant,
    Message,
    Observe,
    Restore,
    Status,
    Welcome,
)

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


# On the path of every frame: a member that is looked up in its class costs four times as much.
_ABSENT = Status.ABSENT


class _Opening(msgspec.Struct):
    """Fields that HELLO and WELCOME have in every major version."""

    type: str
    version: Version


_message_encoder = msgspec.msgpack.Encoder(order="deterministic")  # sorts the keys of free maps
_message_decoder: msgspec.msgpack.Decoder[Message] = msgspec.msgpack.Decoder(Message)
_opening_decoder = msgspec.msgpack.Decoder(_Opening)


def encode_message(message: Message) -> bytes:
    """Encode the header part of a message.

    Args:
        message: Any message of the protocol.

    Returns:
        MessagePack bytes, the same for equal messages.

    Raises:
        PayloadError: A field holds a value that cannot travel.
        LimitError: The header is larger than `MAX_HEADER`.

    Example:
        >>> from caviar_protocol.messages import HeartbeatAck
        >>> decode_message(encode_message(HeartbeatAck(sequence=3)))
        HeartbeatAck(sequence=3)
    """
    # Settings alone have no declared type, so a Python object in them would be found by the peer only.
    if isinstance(message, Welcome):
        _check_settings(message, PayloadError)
    try:
        header = _message_encoder.encode(message)
    except (TypeError, ValueError, OverflowError, RecursionError) as error:
        raise PayloadError(f"{message_type(message)} holds a value that cannot travel: {error}") from error
    if len(header) > MAX_HEADER:
        raise LimitError(
            f"{message_type(message)} header has {len(header)} B, at most {MAX_HEADER} may travel"
        )
    return header


def decode_message(header: Buffer) -> Message:
    """Decode the header part of a message from a peer.

    Args:
        header: First part of the message, without the routing part.

    Raises:
        LimitError: The header is larger than `MAX_HEADER` or nested too deeply.
        VersionError: It is a HELLO or WELCOME of another major version, which this one cannot read.
        DecodeError: The bytes are not a message of this protocol.
    """
    if not len(header):
        raise DecodeError(
            "message header: the first part is empty; send the header first, from a DEALER socket: the empty "
            "delimiter of a REQ socket has no place in front of it"
        )
    try:
        message = decode_bounded(_message_decoder, header, "message header")
    # A peer of another major version gets a VersionError, not one about a malformed message.
    except DecodeError:
        _check_opening(header)
        raise
    if isinstance(message, Welcome):
        _check_settings(message, DecodeError)
    return message


def message_type(message: Message) -> str:
    """The word that stands in the field ``type`` of a message.

    Example:
        >>> from caviar_protocol.messages import HeartbeatAck
        >>> message_type(HeartbeatAck(sequence=3))
        'HEARTBEAT_ACK'
    """
    return str(type(message).__struct_config__.tag)


def part_count(message: Message) -> int:
    """Number of parts that a message has on the wire.

    Args:
        message: The decoded header, which is the first part.
    """
    match message:
        case Done():
            return 1 + 2 * len(message.products)
        # An absent input has provenance and no bytes.
        case Grant() | Observe():
            return 1 + 2 * sum([entry.status is not _ABSENT for entry in message.inputs])
        case AssetData() | Restore() | CheckpointDone():
            return 2
        case _:
            return 1


def check_parts(message: Message, parts: Sequence[Any]) -> None:
    """Check the parts that came with a message, without decoding them.

    Args:
        message: The decoded header.
        parts: All parts, the header included.

    Raises:
        DecodeError: They are not as many as the message announces, or reach beyond the end of an asset.
        LimitError: One of them is too large.
    """
    expected = part_count(message)
    if len(parts) != expected:
        raise DecodeError(f"{message_type(message)} announces {expected} parts, {len(parts)} came")
    if isinstance(message, AssetData):
        length = len(parts[1])
        if length > MAX_ASSET_CHUNK:
            raise LimitError(f"ASSET_DATA carries {length} B, at most {MAX_ASSET_CHUNK} are accepted")
        # A peer that sends more than it announced would fill the memory of the other.
        if message.offset + length > message.size:
            raise DecodeError(
                f"ASSET_DATA carries bytes {message.offset} to {message.offset + length} of an asset of "
                f"{message.size} B"
            )
        return
    # What fits the smallest limit fits all of them: one look in C at the parts of most messages.
    if max(map(len, parts)) <= MAX_HEADER:
        return
    # The only part of RESTORE and CHECKPOINT_DONE is a state, which is as large as a body.
    payload_header = MAX_HEADER if isinstance(message, (Grant, Done, Observe)) else MAX_BODY
    for index, part in enumerate(parts[1:], 1):
        limit = payload_header if index % 2 else MAX_BODY
        if len(part) > limit:
            raise LimitError(
                f"part {index} of {message_type(message)} has {len(part)} B, at most {limit} are accepted"
            )


def check_version(version: tuple[int, int]) -> None:
    """Check that a peer with this version can be talked to.

    Any minor version of our major version will do: what one side does not know, it ignores.

    Raises:
        VersionError: The major versions differ.
    """
    if version[0] != PROTOCOL_VERSION[0]:
        raise VersionError(
            f"the peer speaks protocol {version[0]}.{version[1]}, this side speaks "
            f"{PROTOCOL_VERSION[0]}.{PROTOCOL_VERSION[1]}: the major versions must be equal"
        )


def _check_opening(header: Buffer) -> None:
    """Raise `VersionError` where an unreadable header opens a connection in another major version."""
    try:
        opening = _opening_decoder.decode(header)
    except (msgspec.MsgspecError, ValueError, RecursionError):
        return
    # No other message has a version, so no other can blame it.
    if opening.type in ("HELLO", "WELCOME"):
        check_version(opening.version)


def _check_settings(message: Welcome, error: type[PayloadError] | type[DecodeError]) -> None:
    """Settings are plain data that every language has: what JSON has, with integers and floats apart."""
    for name in ("settings", "scenario"):
        _check_plain(getattr(message, name), f"WELCOME.{name}", 2, error)


_PLAIN = (str, int, float, bool, NoneType)


def _check_plain(value: Any, path: str, depth: int, error: type[PayloadError] | type[DecodeError]) -> None:
    if isinstance(value, _PLAIN):
        return
    if depth > MAX_NESTING:
        raise LimitError(f"{path} nests deeper than {MAX_NESTING} levels")
    if isinstance(value, dict):
        for key, item in value.items():
            if not isinstance(key, str):
                raise error(f"{path} has the key {key!r:.40}, keys are strings")
            if not isinstance(item, _PLAIN):
                _check_plain(item, f"{path:.200}.{key:.40}", depth + 1, error)
    elif isinstance(value, list | tuple):
        for item in value:
            if not isinstance(item, _PLAIN):
                _check_plain(item, path, depth + 1, error)
    else:
        raise error(f"{path} holds {type(value).__name__}, expected text, numbers, flags, lists and tables")


SUBPROTOCOL = "caviar.v1"
"""What a client may ask for in ``Sec-WebSocket-Protocol``."""
MAX_FRAME = 1 << 28
"""Bytes of a frame."""
BIG_ENDIAN = "; these numbers are big-endian, write them little-endian"
"""What is said of a frame whose numbers are right with their bytes reversed."""
_COUNT = struct.Struct("<I")


def join_parts(parts: Sequence[Buffer]) -> bytes:
    """Write a message of several parts as one WebSocket frame.

    Args:
        parts: Header, then payload headers and bodies, as on ZeroMQ.
    """
    # `len` of a memoryview counts elements, which need not be bytes.
    views = [memoryview(part) for part in parts]
    return struct.pack(f"<{len(views) + 1}I", len(views), *(view.nbytes for view in views)) + b"".join(views)


def split_frame(frame: Buffer) -> list[memoryview]:
    """Read the parts of the message in a WebSocket frame, without a copy.

    Args:
        frame: The bytes of a binary frame.

    Returns:
        Read-only views into ``frame``.

    Raises:
        DecodeError: The lengths of the parts do not add up to the frame.
        LimitError: The frame, or the number of its parts, is too large.

    Example:
        >>> [bytes(part) for part in split_frame(join_parts([b"header", b"", b"body"]))]
        [b'header', b'', b'body']
    """
    view = memoryview(frame).toreadonly().cast("B")
    if len(view) > MAX_FRAME:
        raise LimitError(f"a frame has {len(view)} B, at most {MAX_FRAME} are accepted")
    if len(view) < _COUNT.size:
        raise DecodeError(f"a frame has {len(view)} B, it begins with the number of its parts in 4 B")
    (count,) = _COUNT.unpack_from(view)
    if not 1 <= count <= MAX_PARTS:
        # JavaScript's DataView writes big-endian by default: the most frequent mistake.
        swapped = 1 <= int.from_bytes(view[: _COUNT.size], "big") <= MAX_PARTS
        text = f"a frame announces {count} parts, a message has 1 to {MAX_PARTS}"
        raise LimitError(text + BIG_ENDIAN * swapped)
    place = _COUNT.size * (1 + count)
    if len(view) < place:
        raise DecodeError(f"a frame of {len(view)} B has no room for the lengths of {count} parts")
    lengths = struct.unpack_from(f"<{count}I", view, _COUNT.size)
    if place + sum(lengths) != len(view):
        swapped = place + sum(struct.unpack_from(f">{count}I", view, _COUNT.size)) == len(view)
        text = f"a frame has {len(view)} B, its lengths add up to {place + sum(lengths)}"
        raise DecodeError(text + BIG_ENDIAN * swapped)
    parts = []
    for length in lengths:
        parts.append(view[place : place + length])
        place += length
    return parts
