"""The one form of a payload on the wire (contract, clause 20).

Fields in declared order behind the tag, without those that equal their default, every number as
the type its field declares. Equal payloads therefore give equal bytes, however they were made:
`msgspec` alone leaves out a default only where it is the very same object.
"""

from __future__ import annotations

import math
import operator
from collections.abc import Callable
from functools import cache
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, Union, get_args, get_origin, get_type_hints

import msgspec
import numpy as np

from caviar_protocol.arrays import Payload, require_finite
from caviar_protocol.body import BodyWriter
from caviar_protocol.errors import PayloadError

Convert = Callable[[Any, BodyWriter], Any]


class _NonFiniteError(Exception):
    """A float that may not travel; `require_finite` then says which."""


def plain(payload: Payload, writer: BodyWriter) -> dict[str, Any]:
    """Header of a payload as plain objects, its arrays placed in ``writer``.

    Raises `PayloadError` for a non-finite value (clause 21) or one of the wrong type.
    """
    try:
        return _struct(type(payload))(payload, writer)  # type: ignore[no-any-return]
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
        fields.append((field.name, empty, _converter(hints[field.name])))

    def convert(value: Any, writer: BodyWriter) -> dict[str, Any]:
        found: dict[str, Any] = {config.tag_field: config.tag} if config.tag_field else {}
        for name, default, inner in fields:
            item = getattr(value, name)
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


def _converter(hint: Any) -> Convert:
    hint = _without_alias(hint)
    origin, arguments = get_origin(hint), get_args(hint)
    if origin is Annotated:
        return _converter(arguments[0])
    if origin in (Union, UnionType):
        return _union(arguments)
    if origin is Literal:
        return _literal(frozenset(arguments))
    if origin is tuple:
        return _sequence(arguments[0]) if arguments[1:] == (...,) else _tuple(arguments)
    if origin is np.ndarray:
        return _array
    if isinstance(hint, type) and issubclass(hint, msgspec.Struct):
        return lambda value, writer: _struct(hint)(_instance(value, hint), writer)
    return _SCALARS[hint]


def _without_alias(hint: Any) -> Any:
    """What a hint stands for where it is a `TypeAliasType`, as NDArray is from NumPy 2.5 on."""
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


def _literal(allowed: frozenset[Any]) -> Convert:
    def convert(value: Any, _: BodyWriter) -> Any:
        if value not in allowed:
            raise ValueError(f"expected one of {', '.join(sorted(map(str, allowed)))}")
        return value

    return convert


def _sequence(item: Any) -> Convert:
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
