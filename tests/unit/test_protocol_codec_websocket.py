"""One binary WebSocket frame a message: its layout, and what is refused."""

from __future__ import annotations

import json
import struct
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from caviar_protocol.codec import join_parts, split_frame
from caviar_protocol.errors import DecodeError, LimitError, ProtocolError
from caviar_protocol.fields import MAX_PARTS

VECTORS = Path(__file__).parents[2] / "protocol" / "vectors"
FRAMES = sorted(VECTORS.glob("*.frame"))


@given(st.lists(st.binary(max_size=50), min_size=1, max_size=20))
def test_a_frame_holds_the_parts_that_it_was_made_of(parts: list[bytes]) -> None:
    assert [bytes(part) for part in split_frame(join_parts(parts))] == parts


def test_the_layout_is_that_of_the_specification() -> None:
    assert join_parts([b"abc", b""]) == b"\x02\0\0\0" + b"\x03\0\0\0" + b"\0\0\0\0" + b"abc"


@pytest.mark.parametrize("path", FRAMES, ids=lambda path: path.stem)
def test_a_frame_vector_is_the_message_of_its_json_with_its_parts(path: Path) -> None:
    stated = json.loads(path.with_suffix(".json").read_text("utf-8"))
    parts = [path.with_suffix(".msgpack").read_bytes()]
    if "product" in stated:
        product = path.with_name(f"{stated['product']}.msgpack")
        body = product.with_suffix(".body")
        parts += [product.read_bytes(), body.read_bytes() if body.exists() else b""]
    assert join_parts(parts) == path.read_bytes()
    assert [bytes(part) for part in split_frame(path.read_bytes())] == parts


def test_there_are_frame_vectors_with_and_without_products() -> None:
    assert len(FRAMES) >= 2
    counts = {struct.unpack_from("<I", path.read_bytes())[0] for path in FRAMES}
    assert counts >= {1, 3}


@pytest.mark.parametrize(
    ("frame", "error"),
    [
        (b"", DecodeError),
        (b"\x01\0\0", DecodeError),
        (struct.pack("<I", 0), LimitError),
        (struct.pack("<I", MAX_PARTS + 1), LimitError),
        (struct.pack("<I", 0xFFFFFFFF), LimitError),
        (struct.pack("<II", 2, 1), DecodeError),
        (struct.pack("<II", 1, 2) + b"x", DecodeError),
        (struct.pack("<II", 1, 2) + b"xyz", DecodeError),
        (struct.pack("<III", 2, 0xFFFFFFFF, 0xFFFFFFFF) + b"xyz", DecodeError),
    ],
)
def test_what_is_no_frame_is_refused(frame: bytes, error: type[ProtocolError]) -> None:
    with pytest.raises(error):
        split_frame(frame)


@pytest.mark.parametrize("frame", [struct.pack(">II", 1, 3) + b"abc", struct.pack("<I", 1) + b"\0\0\0\3abc"])
def test_big_endian_numbers_are_called_so(frame: bytes) -> None:
    with pytest.raises(ProtocolError, match="big-endian"):
        split_frame(frame)


@given(st.binary(max_size=40))
def test_any_bytes_are_a_frame_or_are_refused(frame: bytes) -> None:
    try:
        parts = split_frame(frame)
    except ProtocolError:
        return
    assert join_parts(parts) == frame
