"""MessagePack with the plain ``msgpack`` package: nothing of the product's codec."""

from __future__ import annotations

from typing import Any

import msgpack  # type: ignore[import-untyped]

BROKEN = (ValueError, TypeError, RecursionError, msgpack.exceptions.UnpackException)
"""What `unpack` raises for bytes that are no MessagePack."""


def pack(value: Any) -> bytes:
    """The bytes of a value, everything in its shortest form, floats in nine bytes."""
    packed: bytes = msgpack.packb(value)
    return packed


def unpack(data: bytes) -> Any:
    """The value of all these bytes; raises one of `BROKEN`."""
    return msgpack.unpackb(data, raw=False)


def in_order(value: Any) -> Any:
    """A plain value whose maps have their keys in the order of the canonical form."""
    if isinstance(value, dict):
        return {key: in_order(value[key]) for key in sorted(value, key=str.encode)}
    return [in_order(item) for item in value] if isinstance(value, list) else value
