"""Message headers to bytes and back, and messages as WebSocket frames.

Nothing here trusts its input: sizes are checked before anything is decoded, and whatever is wrong with the
bytes comes out as a `ProtocolError`. All functions may be called from any thread.

A message of several parts travels over a WebSocket as one binary frame (SPEC.md, section WebSocket)::

    u32  number of parts        little-endian, as all of these
    u32  length of each part    as many as there are parts
         the parts, one after the other
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from types import NoneType
from typing import Any

import msgspec

from caviar_protocol.codec.decoding import Buffer, decode_bounded
from caviar_protocol.errors import DecodeError, LimitError, PayloadError, VersionError
from caviar_protocol.fields import MAX_ASSET_CHUNK, MAX_BODY, MAX_HEADER, MAX_NESTING, MAX_PARTS, Version
from caviar_protocol.messages import (
    PROTOCOL_VERSION,
    AssetData,
    CheckpointDone,
    Done,
    Grant,
    Message,
    Restore,
    Status,
    Welcome,
)

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
        case Grant():
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
    payload_header = MAX_HEADER if isinstance(message, (Grant, Done)) else MAX_BODY
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
