"""Hypothesis strategies for every message and payload, made from their types."""

from __future__ import annotations

from enum import Enum
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, Union, get_args, get_origin, get_type_hints

import msgspec
import numpy as np
from hypothesis import strategies as st
from hypothesis.extra import numpy as npst

from caviar_protocol import fields
from caviar_protocol.arrays import WIRE_DTYPES, ArrayField, Payload, array_fields
from caviar_protocol.topics import Channel

TEXT = st.characters(exclude_categories=["Cs"])
PRINTABLE = st.characters(exclude_categories=["Cs", "Cc"])
FINITE = st.floats(allow_nan=False, allow_infinity=False)
DIGEST = st.text("0123456789abcdef", min_size=64, max_size=64)
SEGMENT = st.text(
    st.characters(exclude_categories=["Cs", "Cc"], exclude_characters="/\\"), min_size=1, max_size=20
).filter(lambda segment: segment not in (".", ".."))
PLAIN = st.recursive(
    st.none() | st.booleans() | st.integers(-(2**63), 2**64 - 1) | FINITE | st.text(TEXT, max_size=8),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(TEXT, max_size=4), inner, max_size=3),
    max_leaves=8,
)


def bounds(hint: Any) -> dict[str, Any]:
    """Constraints in the annotations of a type."""
    found: dict[str, Any] = {}
    for meta in get_args(hint)[1:]:
        if isinstance(meta, msgspec.Meta):
            names = ("ge", "gt", "le", "lt", "min_length", "max_length", "pattern")
            found |= {name: getattr(meta, name) for name in names if getattr(meta, name) is not None}
    return found


def pattern_of(hint: Any) -> str:
    """The regular expression that a shared type demands."""
    return str(bounds(hint)["pattern"])


BY_PATTERN = {
    pattern_of(fields.Digest): DIGEST,
    pattern_of(fields.DigestOrNone): st.just("") | DIGEST,
    pattern_of(fields.NewName): st.text(PRINTABLE, min_size=1, max_size=128),
    pattern_of(fields.AssetName): st.lists(SEGMENT, min_size=1, max_size=4).map("/".join),
}


def of_type(hint: Any, limits: dict[str, Any] | None = None) -> st.SearchStrategy[Any]:
    """Values of a type hint within its constraints."""
    limits = limits or {}
    origin, arguments = get_origin(hint), get_args(hint)
    if origin is Annotated:
        return of_type(arguments[0], bounds(hint))
    if origin in (Union, UnionType):
        return st.one_of(*(of_type(argument) for argument in arguments))
    if origin is Literal:
        return st.sampled_from(arguments)
    if origin is tuple and arguments[1:] == (...,):
        return st.lists(of_type(arguments[0]), max_size=3).map(tuple)
    if origin is tuple:
        return st.tuples(*(of_type(argument) for argument in arguments))
    if origin is dict:
        return st.dictionaries(of_type(arguments[0]), of_type(arguments[1]), max_size=3)
    if hint is str:
        return text(limits)
    if hint is int:
        return st.integers(limits.get("ge", -(2**63)), limits.get("le", 2**63 - 1))
    if hint is float:
        return st.floats(
            limits.get("gt", limits.get("ge")),
            limits.get("lt", limits.get("le")),
            exclude_min="gt" in limits,
            exclude_max="lt" in limits,
            allow_infinity=False,
            allow_nan=False,
        )
    if hint in (Any, bool, None, NoneType):
        return {Any: PLAIN, bool: st.booleans()}.get(hint, st.none())
    if issubclass(hint, Enum):
        return st.sampled_from(list(hint))
    return payload(hint) if issubclass(hint, Payload) else struct(hint)


def text(limits: dict[str, Any]) -> st.SearchStrategy[str]:
    """Strings within their constraints."""
    if "pattern" in limits:
        return BY_PATTERN[limits["pattern"]]
    return st.text(TEXT, min_size=limits.get("min_length", 0), max_size=min(limits.get("max_length", 12), 12))


def struct(cls: type[msgspec.Struct]) -> st.SearchStrategy[Any]:
    """Instances of a struct: each optional field is now left out, now given."""
    hints = get_type_hints(cls, include_extras=True)
    required = {f.name: of_type(hints[f.name]) for f in msgspec.structs.fields(cls) if f.required}
    optional = {f.name: of_type(hints[f.name]) for f in msgspec.structs.fields(cls) if not f.required}
    return st.fixed_dictionaries(required, optional=optional).map(lambda given: cls(**given))


@st.composite
def payload(draw: st.DrawFn, cls: type[Payload]) -> Any:
    """Instances of a payload class whose sizes agree, with arrays of none, one and a few elements."""
    hints = get_type_hints(cls, include_extras=True)
    sizes: dict[str, int] = {}
    given: dict[str, Any] = {}
    for size, names in cls.sizes_from.items():
        sizes[size] = draw(st.integers(0, 3))
        for name in names:
            item = get_args(hints[name])[0]
            given[name] = tuple(draw(of_type(item)) for _ in range(sizes[size]))
    if cls is Channel:
        sizes["L1"] = sizes["T"] * sizes["R"] + 1
    arrays = array_fields(cls)
    for field in msgspec.structs.fields(cls):
        if field.name in given or (not field.required and draw(st.booleans())):
            continue
        spec = arrays.get(field.name)
        given[field.name] = draw(of_type(hints[field.name]) if spec is None else array(spec, sizes, draw))
    if cls is Channel:
        steps = sorted(
            draw(st.lists(st.integers(0, sizes["P"]), min_size=sizes["L1"] - 1, max_size=sizes["L1"] - 1))
        )
        sizes["P"] = steps[-1] if steps else 0
        given = {name: cut(value, arrays.get(name), sizes) for name, value in given.items()}
        given["offsets"] = np.array([0, *steps], dtype=np.int64)
    return cls(**given)


def array(spec: ArrayField, sizes: dict[str, int], draw: st.DrawFn) -> st.SearchStrategy[Any]:
    """Finite arrays of a declared type and shape."""
    for name in spec.shape:
        if isinstance(name, str) and name not in sizes:
            sizes[name] = draw(st.integers(0, 3))
    shape = tuple(sizes[size] if isinstance(size, str) else size for size in spec.shape)
    dtype = WIRE_DTYPES[spec.dtype]
    elements = {"allow_nan": False, "allow_infinity": False} if dtype.kind in "fc" else {}
    return npst.arrays(dtype, shape, elements=npst.from_dtype(dtype, **elements))


def cut(value: Any, spec: ArrayField | None, sizes: dict[str, int]) -> Any:
    """The first ``P`` entries along every path axis."""
    if spec is None or "P" not in spec.shape:
        return value
    return value[tuple(slice(sizes["P"]) if size == "P" else slice(None) for size in spec.shape)]
