"""How deep a header nests is found without recursion, and rightly."""

from __future__ import annotations

from typing import Any

import msgpack
import pytest
from hypothesis import given
from hypothesis import strategies as st

from caviar_protocol.codec import decode_message
from caviar_protocol.codec.messages import HARMLESS, _deeper_than, check_nesting
from caviar_protocol.errors import LimitError
from caviar_protocol.fields import MAX_NESTING

pytestmark = pytest.mark.slow

SCALARS = (
    st.none()
    | st.booleans()
    | st.integers(-(2**63), 2**64 - 1)
    | st.floats()
    | st.text(max_size=300)
    | st.binary(max_size=300)
    | st.builds(msgpack.ExtType, st.integers(0, 127), st.binary(max_size=20))
)
VALUES = st.recursive(
    SCALARS,
    lambda inner: st.lists(inner, max_size=20) | st.dictionaries(st.text(max_size=4), inner, max_size=20),
    max_leaves=60,
)


def depth(value: Any) -> int:
    """Levels of containers, counted by recursion."""
    if isinstance(value, dict):
        return 1 + max(map(depth, value.values()), default=0)
    return 1 + max(map(depth, value), default=0) if isinstance(value, list) else 0


@given(VALUES)
def test_the_walk_tells_the_depth_of_any_value(value: Any) -> None:
    data, deep = msgpack.packb(value), depth(value)
    assert not _deeper_than(data, deep)
    assert deep == 0 or _deeper_than(data, deep - 1)


@given(st.binary(max_size=400))
def test_the_walk_ends_on_any_bytes(data: bytes) -> None:
    assert _deeper_than(data, 10) in (True, False)


def nested(levels: int, siblings: int) -> bytes:
    """A value some levels deep, beside many empty maps."""
    opening = b"\xdc" + (siblings + 1).to_bytes(2, "big")
    return opening + b"\x80" * siblings + b"\x91" * (levels - 1) + b"\xc0"


def test_depth_counts_and_not_number() -> None:
    check_nesting(nested(MAX_NESTING, 2000), "header")
    with pytest.raises(LimitError, match="header nests deeper than 32"):
        check_nesting(nested(MAX_NESTING + 1, 2000), "header")


@pytest.mark.parametrize("kind", [bytes, bytearray, memoryview])
def test_any_buffer_is_walked(kind: Any) -> None:
    with pytest.raises(LimitError):
        check_nesting(kind(b"\x91" * 1000), "header")


def test_what_cannot_exhaust_a_stack_is_left_to_the_decoder() -> None:
    """An unknown field that nests more deeply than we write is skipped while it is harmless."""
    unknown = b"\x91" * (HARMLESS - 10) + b"\xc0"
    decode_message(b"\x83\xa4type\xa9HEARTBEAT\xa8sequence\x01\xa1x" + unknown)
