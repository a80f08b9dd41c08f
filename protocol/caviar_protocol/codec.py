"""Bytes to typed objects and back.

Nothing here trusts its input: sizes are checked before anything is decoded, and whatever is
wrong with the bytes comes out as a `ProtocolError`.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, TypeVar

import msgspec
import numpy as np

from caviar_protocol import limits
from caviar_protocol.arrays import MAX_DIMENSIONS, WIRE_DTYPES, Payload, require_finite
from caviar_protocol.errors import DecodeError, LimitError, PayloadError, VersionError
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
from caviar_protocol.topics import PAYLOADS

Buffer = bytes | bytearray | memoryview

_ALIGNMENT = 8
_encoder = msgspec.msgpack.Encoder()
_message_decoder: msgspec.msgpack.Decoder[Message] = msgspec.msgpack.Decoder(Message)


def encode_message(message: Message) -> bytes:
    """Header part of a message."""
    return _encoder.encode(message)


def decode_message(header: Buffer) -> Message:
    """Typed message of a header part.

    Raises
    ------
    LimitError
        The header is larger than `limits.MAX_HEADER` or nested too deeply.
    DecodeError
        The bytes are not a message of this protocol.
    """
    message = _decode(_message_decoder, header, "message header")
    if isinstance(message, Welcome):
        _check_nesting(message.settings, "WELCOME.settings")
        _check_nesting(message.scenario, "WELCOME.scenario")
    return message


def part_count(message: Message) -> int:
    """Number of parts that a message has on the wire, its header included."""
    match message:
        case Grant():
            return 1 + 2 * sum(entry.status is not Status.ABSENT for entry in message.inputs)
        case Done():
            return 1 + 2 * len(message.products)
        case AssetData() | Restore() | CheckpointDone():
            return 2
        case _:
            return 1


def check_parts(message: Message, parts: Sequence[Any]) -> None:
    """Raise `DecodeError` unless ``parts`` (header included) are as many as ``message`` announces."""
    expected = part_count(message)
    if len(parts) != expected:
        name = type(message).__struct_config__.tag
        raise DecodeError(f"{name} announces {expected} parts, {len(parts)} came")


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
    require_finite(payload)
    chunks: list[bytes] = []
    length = 0

    def place(value: Any) -> dict[str, Any]:
        nonlocal length
        if not isinstance(value, np.ndarray):
            raise PayloadError(f"{type(value).__name__} cannot travel in a payload")
        little = np.ascontiguousarray(value, dtype=value.dtype.newbyteorder("<"))
        padding = -length % _ALIGNMENT
        chunks.append(bytes(padding))
        chunks.append(little.tobytes())
        offset = length + padding
        length = offset + little.nbytes
        return {"dtype": little.dtype.str, "shape": value.shape, "offset": offset}

    header = msgspec.msgpack.Encoder(enc_hook=place).encode(payload)
    if len(header) > limits.MAX_HEADER:
        raise LimitError(f"payload header has {len(header)} B, at most {limits.MAX_HEADER} may travel")
    if length > limits.MAX_BODY:
        raise LimitError(f"payload body has {length} B, at most {limits.MAX_BODY} may travel")
    return header, b"".join(chunks)


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

    def take(_: type, reference: Any) -> Any:
        return _array_at(reference, view)

    return _decode(msgspec.msgpack.Decoder(cls, dec_hook=take), header, f"{topic} payload")


_T = TypeVar("_T")


def _decode(decoder: msgspec.msgpack.Decoder[_T], header: Buffer, what: str) -> _T:
    if len(header) > limits.MAX_HEADER:
        raise LimitError(f"{what} has {len(header)} B, at most {limits.MAX_HEADER} are accepted")
    try:
        return decoder.decode(header)
    except RecursionError as error:
        raise LimitError(f"{what} nests deeper than {limits.MAX_NESTING} levels") from error
    except PayloadError as error:
        raise DecodeError(f"{what}: {error}") from error
    except (msgspec.MsgspecError, ValueError, OverflowError) as error:
        raise DecodeError(f"{what}: {error}") from error


def _array_at(reference: Any, body: memoryview) -> Any:
    match reference:
        case {"dtype": str(code), "shape": list(shape), "offset": int(offset)}:
            pass
        case _:
            raise DecodeError("an array reference needs dtype, shape and offset")
    dtype = WIRE_DTYPES.get(code)
    if dtype is None:
        raise DecodeError(f"array dtype {code!r} is not one of {', '.join(WIRE_DTYPES)}")
    if len(shape) > MAX_DIMENSIONS:
        raise LimitError(f"array has {len(shape)} dimensions, at most {MAX_DIMENSIONS} are accepted")
    count = 1
    for size in shape:
        if not isinstance(size, int) or isinstance(size, bool) or not 0 <= size <= limits.MAX_BODY:
            raise DecodeError(f"array shape {shape!r} is not a list of sizes")
        count *= size
    if offset < 0 or offset % _ALIGNMENT or offset + count * dtype.itemsize > len(body):
        raise DecodeError(
            f"array of shape {shape} and dtype {code} at offset {offset} does not fit a body of {len(body)} B"
        )
    if dtype.kind == "b":
        raw = np.frombuffer(body, np.uint8, count, offset)
        if count and raw.max() > 1:
            raise DecodeError("a |b1 array holds a byte other than 0 and 1")
    return np.frombuffer(body, dtype, count, offset).reshape(shape)


def _check_nesting(value: Any, path: str, depth: int = 2) -> None:
    if depth > limits.MAX_NESTING:
        raise LimitError(f"{path} nests deeper than {limits.MAX_NESTING} levels")
    if isinstance(value, dict):
        for key, item in value.items():
            _check_nesting(item, f"{path}.{key}" if depth < 6 else path, depth + 1)
    elif isinstance(value, list | tuple):
        for item in value:
            _check_nesting(item, path, depth + 1)
