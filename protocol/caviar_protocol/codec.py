"""Bytes to typed objects and back.

Nothing here trusts its input: sizes are checked before anything is decoded, and whatever is
wrong with the bytes comes out as a `ProtocolError`. All functions may be called from any thread.
"""

from __future__ import annotations

import threading
from collections.abc import Sequence
from functools import cache
from types import NoneType
from typing import Any, TypeVar

import msgspec

from caviar_protocol import limits
from caviar_protocol.arrays import Payload
from caviar_protocol.body import BodyReader, BodyWriter
from caviar_protocol.canonical import plain
from caviar_protocol.choices import choices
from caviar_protocol.errors import DecodeError, LimitError, PayloadError, VersionError
from caviar_protocol.fields import Version
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
from caviar_protocol.nesting import check_nesting
from caviar_protocol.topics import PAYLOADS

# On the path of every frame: a member that is looked up in its class costs four times as much.
_ABSENT = Status.ABSENT

Buffer = bytes | bytearray | memoryview


class _Opening(msgspec.Struct):
    """What HELLO and WELCOME have in every major version."""

    type: str
    version: Version


_message_encoder = msgspec.msgpack.Encoder(order="deterministic")  # sorts the keys of free maps
_payload_encoder = msgspec.msgpack.Encoder()
_message_decoder: msgspec.msgpack.Decoder[Message] = msgspec.msgpack.Decoder(Message)
_opening_decoder = msgspec.msgpack.Decoder(_Opening)


def encode_message(message: Message) -> bytes:
    """Header part of a message.

    Raises `PayloadError` where a field holds what cannot travel, `LimitError` where the header
    gets too large.
    """
    if isinstance(message, Welcome):
        _check_settings(message, PayloadError)
    try:
        header = _message_encoder.encode(message)
    except (TypeError, ValueError, OverflowError, RecursionError) as error:
        raise PayloadError(f"{message_type(message)} holds a value that cannot travel: {error}") from error
    if len(header) > limits.MAX_HEADER:
        raise LimitError(
            f"{message_type(message)} header has {len(header)} B, at most {limits.MAX_HEADER} may travel"
        )
    return header


def decode_message(header: Buffer) -> Message:
    """Typed message of a header part.

    Raises
    ------
    LimitError
        The header is larger than `limits.MAX_HEADER` or nested too deeply.
    VersionError
        It is a HELLO or WELCOME of another major version, which this one cannot read.
    DecodeError
        The bytes are not a message of this protocol.
    """
    if not len(header):
        raise DecodeError(
            "message header: the first part is empty; send the header first, from a DEALER socket: the empty "
            "delimiter of a REQ socket has no place in front of it"
        )
    try:
        message = _decode(_message_decoder, header, "message header")
    except DecodeError:
        _check_opening(header)
        raise
    if isinstance(message, Welcome):
        _check_settings(message, DecodeError)
    return message


def message_type(message: Message) -> str:
    """The word that stands in the field ``type``: ``"GRANT"``."""
    return str(type(message).__struct_config__.tag)


def part_count(message: Message) -> int:
    """Number of parts that a message has on the wire, its header included."""
    match message:
        case Done():
            return 1 + 2 * len(message.products)
        case Grant():
            return 1 + 2 * sum([entry.status is not _ABSENT for entry in message.inputs])
        case AssetData() | Restore() | CheckpointDone():
            return 2
        case _:
            return 1


def check_parts(message: Message, parts: Sequence[Any]) -> None:
    """Check the parts (header included) that came with ``message``, without decoding them.

    Raises
    ------
    DecodeError
        They are not as many as the message announces, or reach beyond the end of an asset.
    LimitError
        One of them is too large.
    """
    expected = part_count(message)
    if len(parts) != expected:
        raise DecodeError(f"{message_type(message)} announces {expected} parts, {len(parts)} came")
    if isinstance(message, AssetData):
        _check_chunk(message, len(parts[1]))
        return
    payload_header = limits.MAX_HEADER if isinstance(message, (Grant, Done)) else limits.MAX_BODY
    for index, part in enumerate(parts[1:], 1):
        limit = payload_header if index % 2 else limits.MAX_BODY
        if len(part) > limit:
            raise LimitError(
                f"part {index} of {message_type(message)} has {len(part)} B, at most {limit} are accepted"
            )


def check_version(version: tuple[int, int]) -> None:
    """Raise `VersionError` unless a peer with this version can be talked to.

    Any minor version of our major version will do: what one side does not know, it ignores.
    """
    if version[0] != PROTOCOL_VERSION[0]:
        raise VersionError(
            f"the peer speaks protocol {version[0]}.{version[1]}, this side speaks "
            f"{PROTOCOL_VERSION[0]}.{PROTOCOL_VERSION[1]}: the major versions must be equal"
        )


def encode_payload(payload: Payload) -> tuple[bytes, bytes]:
    """Header and body of a product.

    Equal payloads give equal bytes. Raises `PayloadError` for a non-finite value (clause 21) and
    `LimitError` for a product too large to travel.
    """
    writer = BodyWriter()
    fields = plain(payload, writer)
    try:
        header = _payload_encoder.encode(fields)
    except (TypeError, ValueError, OverflowError) as error:
        raise PayloadError(f"{type(payload).__name__} holds a value that cannot travel: {error}") from error
    if len(header) > limits.MAX_HEADER:
        raise LimitError(f"payload header has {len(header)} B, at most {limits.MAX_HEADER} may travel")
    if writer.length > limits.MAX_BODY:
        raise LimitError(f"payload body has {writer.length} B, at most {limits.MAX_BODY} may travel")
    return header, writer.body()


class _Reading(threading.local):
    """The body that this thread is decoding: decoders are shared, what they read is not."""

    reader: BodyReader


_reading = _Reading()


@cache
def _payload_decoder(cls: type[Payload]) -> msgspec.msgpack.Decoder[Payload]:
    return msgspec.msgpack.Decoder(cls, dec_hook=lambda _, reference: _reading.reader.take(reference))


def decode_payload(topic: str, header: Buffer, body: Buffer) -> Payload:
    """Typed payload of a product; its arrays are read-only views into ``body``.

    Raises
    ------
    DecodeError
        The topic is unknown, or the bytes are not a payload of it.
    LimitError
        A size exceeds its limit.
    """
    cls = PAYLOADS.get(topic)
    if cls is None:
        raise DecodeError(f"unknown topic {topic!r}; one of {', '.join(PAYLOADS)}")
    view = memoryview(body).toreadonly().cast("B")
    if len(view) > limits.MAX_BODY:
        raise LimitError(f"payload body has {len(view)} B, at most {limits.MAX_BODY} are accepted")
    _reading.reader = BodyReader(view)
    try:
        return _decode(_payload_decoder(cls), header, f"{topic} payload")
    finally:
        del _reading.reader


_T = TypeVar("_T")


def _decode(decoder: msgspec.msgpack.Decoder[_T], header: Buffer, what: str) -> _T:
    if len(header) > limits.MAX_HEADER:
        raise LimitError(f"{what} has {len(header)} B, at most {limits.MAX_HEADER} are accepted")
    check_nesting(header, what)
    try:
        return decoder.decode(header)
    except RecursionError as error:
        raise LimitError(f"{what} nests deeper than {limits.MAX_NESTING} levels") from error
    except (PayloadError, msgspec.MsgspecError, ValueError, TypeError, OverflowError) as error:
        possible = choices(decoder.type, header, str(error))
        hint = f"; write one of {', '.join(possible)}" if possible else ""
        raise DecodeError(f"{what}: {error}{hint}") from error


def _check_opening(header: Buffer) -> None:
    """Raise `VersionError` where an unreadable header opens a connection in another major version."""
    try:
        opening = _opening_decoder.decode(header)
    except (msgspec.MsgspecError, ValueError, RecursionError):
        return
    if opening.type in ("HELLO", "WELCOME"):
        check_version(opening.version)


def _check_chunk(message: AssetData, length: int) -> None:
    if length > limits.MAX_ASSET_CHUNK:
        raise LimitError(f"ASSET_DATA carries {length} B, at most {limits.MAX_ASSET_CHUNK} are accepted")
    if message.offset + length > message.size:
        raise DecodeError(
            f"ASSET_DATA carries bytes {message.offset} to {message.offset + length} of an asset of "
            f"{message.size} B"
        )


def _check_settings(message: Welcome, error: type[PayloadError] | type[DecodeError]) -> None:
    """Settings are plain data that every language has: what JSON has, with integers and floats apart."""
    for name in ("settings", "scenario"):
        _check_plain(getattr(message, name), f"WELCOME.{name}", 2, error)


_PLAIN = (str, int, float, bool, NoneType)


def _check_plain(value: Any, path: str, depth: int, error: type[PayloadError] | type[DecodeError]) -> None:
    if isinstance(value, _PLAIN):
        return
    if depth > limits.MAX_NESTING:
        raise LimitError(f"{path} nests deeper than {limits.MAX_NESTING} levels")
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
