"""Payloads to bytes and back, in one canonical form (contract, clause 20).

The header has the fields in declared order after the tag, without those that equal their default, every
number as the type its field declares. Equal payloads therefore give equal bytes, however they were made:
`msgspec` alone leaves out a default only where it is the very same object.

The body has the arrays in the order in which their references stand in the header, each at the next multiple
of 8 bytes; what lies between is zero.
"""

from __future__ import annotations

import math
import operator
import threading
from collections.abc import Callable
from functools import cache
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, Union, get_args, get_origin, get_type_hints

import msgspec
import numpy as np
from numpy.typing import NDArray

from caviar_protocol.arrays import MAX_DIMENSIONS, WIRE_DTYPES, Payload, require_finite
from caviar_protocol.codec.messages import Buffer, decode_bounded
from caviar_protocol.errors import DecodeError, LimitError, PayloadError
from caviar_protocol.fields import MAX_BODY, MAX_HEADER
from caviar_protocol.topics import PAYLOADS

ALIGNMENT = 8
"""[B] Offsets are multiples of this."""

# [B] Arrays from this size on are copied once, into the body; of smaller ones a view costs more.
_VIEWED = 1 << 16


_CODES = {dtype: code for code, dtype in WIRE_DTYPES.items()}


class BodyWriter:
    """Lays arrays one after another."""

    def __init__(self) -> None:
        self._chunks: list[bytes | memoryview] = []
        self.length = 0

    def place(self, value: NDArray[Any]) -> dict[str, Any]:
        """Append an array.

        Returns:
            The reference that stands for the array in the header.

        Raises:
            PayloadError: Elements of this type, or so many dimensions, cannot travel.
        """
        # Equal dtypes hash alike whatever made them; arrays in native little-endian order take this way.
        code = _CODES.get(value.dtype)
        if code is None:
            dtype = value.dtype.newbyteorder("<")
            if dtype not in _CODES:
                raise PayloadError(f"dtype {dtype.str} cannot travel; one of {', '.join(WIRE_DTYPES)}")
            code, value = _CODES[dtype], value.astype(dtype)
        if value.ndim > MAX_DIMENSIONS:
            raise PayloadError(f"{value.ndim} dimensions cannot travel, at most {MAX_DIMENSIONS}")
        # A view keeps the producer's array alive until the body is joined, within this call.
        is_viewed = value.nbytes >= _VIEWED and value.flags.c_contiguous
        data = value.reshape(-1).view(np.uint8).data if is_viewed else value.tobytes()
        # Aligned elements are read in place; of others NumPy makes a copy for every operation.
        padding = -self.length % ALIGNMENT
        if padding:
            self._chunks.append(bytes(padding))
        offset = self.length + padding
        self._chunks.append(data)
        self.length = offset + len(data)
        return {"dtype": code, "shape": value.shape, "offset": offset}

    def body(self) -> bytes:
        """All arrays so far."""
        return b"".join(self._chunks)


class BodyReader:
    """Gives out read-only views into a body, each after the one before."""

    def __init__(self, body: memoryview) -> None:
        self._body = body
        self._end = 0

    def read(self, reference: Any) -> NDArray[Any]:
        """The array that a reference points to.

        Args:
            reference: What stands in a header for an array: a map with dtype, shape and offset.

        Raises:
            DecodeError: It is not well-formed, reaches out of the body, or overlaps the arrays taken before.
            LimitError: It has too many dimensions.
        """
        code, shape, offset = _reference(reference)
        dtype, count, room = WIRE_DTYPES[code], 1, 1
        # A shape may multiply to more than 64 bits, which Python's numbers hold and NumPy's do not.
        for size in shape:
            count *= size
            room *= size or 1
        if room > MAX_BODY:
            raise DecodeError(f"array shape {shape} is larger than any body")
        end = offset + count * dtype.itemsize
        if end > len(self._body):
            raise DecodeError(
                f"array of shape {shape} and dtype {code} at offset {offset} ends at byte {end} "
                f"of a body of {len(self._body)} B"
            )
        if offset < self._end:
            raise DecodeError(f"array at offset {offset} overlaps the one before, which ends at {self._end}")
        self._end = end
        array: NDArray[Any] = np.ndarray(shape, dtype, self._body, offset)
        # NumPy would take any other byte as true, and its digest would not be that of the array.
        if code == "|b1" and bytes(self._body[offset:end]).strip(b"\0\1"):
            raise DecodeError("a |b1 array holds a byte other than 0 and 1")
        return array


def _reference(reference: Any) -> tuple[str, list[int], int]:
    """Fields of an array reference, each checked by itself."""
    try:
        code, shape, offset = reference["dtype"], reference["shape"], reference["offset"]
    except (TypeError, KeyError, IndexError):
        raise DecodeError("an array is a map with dtype, shape and offset") from None
    # `isinstance` would let subclasses pass, and an unhashable code would raise in the lookup.
    if type(code) is not str or code not in WIRE_DTYPES:
        raise DecodeError(f"array dtype {code!r:.40} is not one of {', '.join(WIRE_DTYPES)}")
    if type(shape) is not list:
        raise DecodeError(f"array shape {shape!r:.80} is not a list of sizes")
    for size in shape:
        if type(size) is not int or not 0 <= size <= MAX_BODY:
            raise DecodeError(f"array shape {shape!r:.80} is not a list of sizes")
    if len(shape) > MAX_DIMENSIONS:
        raise LimitError(f"array has {len(shape)} dimensions, at most {MAX_DIMENSIONS} are accepted")
    if type(offset) is not int or offset < 0 or offset % ALIGNMENT:
        raise DecodeError(f"array offset {offset!r:.40} is not a multiple of {ALIGNMENT}")
    return code, shape, offset


Convert = Callable[[Any, BodyWriter], Any]
_payload_encoder = msgspec.msgpack.Encoder()


def encode_payload(payload: Payload) -> tuple[bytes, bytes]:
    """Encode a product.

    Args:
        payload: A payload of any topic.

    Returns:
        Header (the fields) and body (the arrays). Equal payloads give equal bytes.

    Raises:
        PayloadError: A value is not finite (contract, clause 21), or not of the type its field declares.
        LimitError: The product is too large to travel.

    Example:
        >>> from caviar_protocol.topics import Action, BeamChoice
        >>> header, body = encode_payload(Action(commands=(BeamChoice(tx="mast", rx="car", tx_beam=3),)))
        >>> decode_payload("action", header, body).commands[0].tx_beam
        3
    """
    writer = BodyWriter()
    fields = plain(payload, writer)
    try:
        header = _payload_encoder.encode(fields)
    except (TypeError, ValueError, OverflowError) as error:
        raise PayloadError(f"{type(payload).__name__} holds a value that cannot travel: {error}") from error
    if len(header) > MAX_HEADER:
        raise LimitError(f"payload header has {len(header)} B, at most {MAX_HEADER} may travel")
    if writer.length > MAX_BODY:
        raise LimitError(f"payload body has {writer.length} B, at most {MAX_BODY} may travel")
    return header, writer.body()


# msgspec hands a decoding hook the value alone, so the body has to come another way.
class _Reading(threading.local):
    """The body that this thread is decoding: decoders are shared, what they read is not."""

    reader: BodyReader


_reading = _Reading()


_making = threading.Lock()


@cache
def _payload_decoder(cls: type[Payload]) -> msgspec.msgpack.Decoder[Payload]:
    # msgspec has what it knows of a class in place before it is whole: a decoder that another thread makes
    # meanwhile would read past it, and Python would die.
    with _making:
        return msgspec.msgpack.Decoder(cls, dec_hook=lambda _, reference: _reading.reader.read(reference))


def decode_payload(topic: str, header: Buffer, body: Buffer) -> Payload:
    """Decode a product of a topic.

    Args:
        topic: Name of the topic, one of `PAYLOADS`.
        header: First part of the product.
        body: Second part of the product; the bytes of its arrays.

    Returns:
        The typed payload; its arrays are read-only views into ``body``.

    Raises:
        DecodeError: The topic is unknown, or the bytes are not a payload of it.
        LimitError: A size exceeds its limit.
    """
    cls = PAYLOADS.get(topic)
    if cls is None:
        raise DecodeError(f"unknown topic {topic!r}; one of {', '.join(PAYLOADS)}")
    view = memoryview(body).toreadonly().cast("B")
    if len(view) > MAX_BODY:
        raise LimitError(f"payload body has {len(view)} B, at most {MAX_BODY} are accepted")
    _reading.reader = BodyReader(view)
    try:
        return decode_bounded(_payload_decoder(cls), header, f"{topic} payload")
    finally:
        del _reading.reader


class _NonFiniteError(Exception):
    """A float that may not travel; `require_finite` then says which."""


def plain(payload: Payload, writer: BodyWriter) -> dict[str, Any]:
    """Turn a payload into plain objects, its arrays placed in ``writer``.

    Args:
        payload: The payload.
        writer: Takes the arrays; the plain objects refer to their places in it.

    Raises:
        PayloadError: A value is not finite (clause 21) or of the wrong type.
    """
    try:
        return _struct(type(payload))(payload, writer)  # type: ignore[no-any-return]
    # The path of the value is looked for only once it is known that there is one.
    except _NonFiniteError:
        require_finite(payload)
        raise


@cache
def _struct(cls: type[msgspec.Struct]) -> Convert:
    config = cls.__struct_config__
    hints = get_type_hints(cls, include_extras=True)
    fields = []
    for field in msgspec.structs.fields(cls):
        empty = field.default_factory() if field.default_factory is not msgspec.NODEFAULT else field.default
        converter = _converter(hints[field.name])
        # Not of texts, which are converted as quickly as they are found.
        hint = hints[field.name]
        if get_origin(hint) is tuple and get_args(hint)[0] is not str and _is_immutable(hint):
            converter = _encoded_once(converter)
        fields.append((field.name, empty, converter))

    def convert(value: Any, writer: BodyWriter) -> dict[str, Any]:
        found: dict[str, Any] = {config.tag_field: config.tag} if config.tag_field else {}
        for name, default, inner in fields:
            item = getattr(value, name)
            # Identity with the default saves a conversion; equality, which is looked at below, saves bytes.
            if item is default:
                continue
            try:
                converted = inner(item, writer)
            except PayloadError:
                raise
            except (TypeError, ValueError, OverflowError) as error:
                raise PayloadError(f"{cls.__name__}.{name} = {item!r:.80} cannot travel: {error}") from error
            if default is msgspec.NODEFAULT or default is None or item != default:
                found[name] = converted
        return found

    return convert


def _encoded_once(convert: Convert) -> Convert:
    """Encode a tuple of immutable values when it comes, and not again while the same object does.

    Devices, carriers and names of users stay the same objects from frame to frame; to convert them takes
    longer than everything else in the header of a scene.
    """
    # One tuple, replaced as a whole: threads that encode at the same time see a value and its own bytes.
    last: tuple[Any, Any] = (None, None)

    def encoded(value: Any, writer: BodyWriter) -> Any:
        nonlocal last
        known, raw = last
        if value is not known:
            raw = msgspec.Raw(_payload_encoder.encode(convert(value, writer)))
            # Fields are declared as tuples, and a list may stand in one all the same: it has no hash, and may
            # be another one in the next frame.
            try:
                hash(value)
            except TypeError:
                return raw
            last = value, raw
        return raw

    return encoded


def _is_immutable(hint: Any) -> bool:
    """Whether values of a type cannot change, and hold no array, which would have a place in the body."""
    hint = _without_alias(hint)
    origin, arguments = get_origin(hint), get_args(hint)
    if origin is Annotated:
        return _is_immutable(arguments[0])
    if origin in (Union, UnionType, tuple):
        return all(_is_immutable(argument) for argument in arguments if argument is not ...)
    if isinstance(hint, type) and issubclass(hint, msgspec.Struct):
        hints = get_type_hints(hint, include_extras=True)
        names = hint.__struct_fields__
        return bool(hint.__struct_config__.frozen) and all(_is_immutable(hints[name]) for name in names)
    return origin is Literal or hint in _SCALARS or hint is NoneType


def _converter(hint: Any) -> Convert:
    # Converters are made once a type, so that no value is looked at by its type at run time.
    hint = _without_alias(hint)
    origin, arguments = get_origin(hint), get_args(hint)
    if origin is Annotated:
        return _converter(arguments[0])
    if origin in (Union, UnionType):
        return _union(arguments)
    if origin is Literal:
        allowed = frozenset(arguments)

        def convert(value: Any, _: BodyWriter) -> Any:
            # msgspec checks literals when it decodes, not when it encodes.
            if value not in allowed:
                raise ValueError(f"expected one of {', '.join(sorted(map(str, allowed)))}")
            return value

        return convert
    if origin is tuple:
        return _sequence(arguments[0]) if arguments[1:] == (...,) else _tuple(arguments)
    if origin is np.ndarray:
        return _array
    if isinstance(hint, type) and issubclass(hint, msgspec.Struct):
        return lambda value, writer: _struct(hint)(_instance(value, hint), writer)
    return _SCALARS[hint]


def _without_alias(hint: Any) -> Any:
    """Type that a hint stands for where it is a `TypeAliasType`, as NDArray is from NumPy 2.5 on."""
    alias = get_origin(hint) or hint
    if not hasattr(alias, "__value__"):
        return hint
    arguments = get_args(hint)
    return _without_alias(alias.__value__[arguments] if arguments else alias.__value__)


def _instance(value: Any, cls: type) -> Any:
    if type(value) is not cls:
        raise TypeError(f"expected {cls.__name__}")
    return value


def _union(members: tuple[Any, ...]) -> Convert:
    converters = {_runtime_type(member): _converter(member) for member in members if member is not NoneType}

    def convert(value: Any, writer: BodyWriter) -> Any:
        if value is None and NoneType in members:
            return None
        inner = converters.get(type(value))
        if inner is None and len(converters) == 1:
            inner = next(iter(converters.values()))
        if inner is None:
            raise TypeError(f"expected one of {', '.join(cls.__name__ for cls in converters)}")
        return inner(value, writer)

    return convert


def _runtime_type(hint: Any) -> type:
    hint = _without_alias(hint)
    if get_origin(hint) is Annotated:
        return _runtime_type(get_args(hint)[0])
    found: type = get_origin(hint) or hint
    return found


def _sequence(item: Any) -> Convert:
    # Names are most of a header: a loop of their own saves a call for each.
    if item is str:
        return _strings
    inner = _converter(item)
    return lambda value, writer: [inner(entry, writer) for entry in value]


def _tuple(items: tuple[Any, ...]) -> Convert:
    converters = [_converter(item) for item in items]
    return lambda value, writer: [c(v, writer) for c, v in zip(converters, value, strict=True)]


def _array(value: Any, writer: BodyWriter) -> Any:
    # A sum of squares that is finite has none but finite terms, and is quicker than a look at each.
    if (
        value.dtype.kind in "fc"
        and not np.vdot(value, value).real < math.inf
        and not np.isfinite(value).all()
    ):
        raise _NonFiniteError
    return writer.place(value)


def _float(value: Any, _: BodyWriter) -> float:
    number = float(value)
    if not math.isfinite(number):
        raise _NonFiniteError
    return number


def _flag(value: Any, _: BodyWriter) -> bool:
    # `bool(2)` would be true: a number in a flag is a mistake of the producer.
    if not isinstance(value, bool | np.bool_):
        raise TypeError("expected true or false")
    return bool(value)


def _string(value: Any, _: BodyWriter) -> str:
    if not isinstance(value, str):
        raise TypeError("expected a string")
    return value


def _strings(value: Any, _: BodyWriter) -> Any:
    if not isinstance(value, tuple):
        raise TypeError("expected a tuple of strings")
    for entry in value:
        if type(entry) is not str:
            raise TypeError(f"expected a tuple of strings, it holds {entry!r:.40}")
    return value


_SCALARS: dict[Any, Convert] = {
    float: _float,
    int: lambda value, _: operator.index(value),
    bool: _flag,
    str: _string,
}
