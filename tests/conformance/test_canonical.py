"""The kit says where a header leaves the canonical form, and what is needed there."""

from __future__ import annotations

from collections.abc import Callable

import msgpack
import pytest

from caviar_labs.conform import street
from caviar_labs.conform.canonical import (
    check_products,
    first_difference,
    not_canonical,
    pack,
    product_digest,
    unpack,
)
from caviar_labs.conform.client import Failed, Received

HEADER, BODY = street.product("scene", "traffic", 3)
POSITION = pack([0.0, -10.0, 9.0])
"""Of the first device, the base station."""


def _short_float(header: bytes) -> bytes:
    single = msgpack.Packer(use_single_float=True).pack(9.0)
    return header.replace(POSITION, POSITION[:-9] + single, 1)


def _whole_float(header: bytes) -> bytes:
    return header.replace(POSITION, POSITION[:-9] + pack(9), 1)


def _other_order(header: bytes) -> bytes:
    fields = unpack(header)
    fields["devices"][0] = dict(reversed(fields["devices"][0].items()))
    return pack(fields)


def _default(header: bytes) -> bytes:
    fields = unpack(header)
    fields["devices"][3]["array"]["rows"] = 1
    return pack(fields)


def _long_integer(header: bytes) -> bytes:
    return header.replace(pack("offset") + b"\x00", pack("offset") + b"\xcd\x00\x00", 1)


def _long_key(header: bytes) -> bytes:
    return header.replace(pack("dtype"), b"\xd9" + pack("dtype").replace(b"\xa5", b"\x05", 1), 1)


def _long_list(header: bytes) -> bytes:
    return header.replace(pack("names") + b"\x91", pack("names") + b"\xdc\x00\x01", 1)


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (_short_float, "devices[0].position[2]: a float as `ca` (5 bytes), needs `cb` (9 bytes)"),
        (
            _whole_float,
            "devices[0].position[2]: an integer as `09` (1 byte), needs a float as `cb` (9 bytes)",
        ),
        (_other_order, "devices[0]: keys are array, role, position, name, type, needs type, name, position"),
        (_default, "devices[3].array: rows equals its default and is to be left out"),
        (_long_integer, "position.offset: an integer as `cd` (3 bytes), needs `00` (1 byte)"),
        (_long_key, "position: the key 'dtype' is a string as `d9` (7 bytes), needs `a5` (6 bytes)"),
        (_long_list, "names: a list as `dc` (3 bytes), needs `91` (1 byte)"),
    ],
)
def test_a_product_that_is_not_canonical_is_told_by_its_field(
    spoil: Callable[[bytes], bytes], words: str
) -> None:
    header = spoil(HEADER)
    assert header != HEADER
    done = {"products": [{"topic": "scene", "digest": product_digest(header, BODY)}]}
    with pytest.raises(Failed) as failed:
        check_products(done, [b"", header, BODY], ["scene"])
    assert failed.value.got.startswith(words)


def test_the_byte_of_a_body_that_is_no_filling_is_told() -> None:
    header, body = street.product("link", "radio", 0)
    filling = body[:1] + b"\x07" + body[2:]
    done = {"products": [{"topic": "link", "digest": product_digest(header, filling)}]}
    with pytest.raises(Failed, match="byte 1 of the body is 0x07, needs 0x00"):
        check_products(done, [b"", header, filling], ["link"])


def test_the_headers_of_messages_are_told_likewise() -> None:
    done = {"type": "DONE", "epoch": 3, "attempt": 2, "episode": 0, "frame": 7}

    def told(header: bytes) -> str:
        return not_canonical(Received(b"", [header]))

    assert told(pack(done)) == ""
    assert told(pack({**done, "of a later version": {"b": 1, "a": 2.5}})) == ""
    measured = told(pack({**done, "measured": {"step": 2, "load": 1}}))
    assert measured == "DONE: measured: keys are step, load, needs load, step"
    long = pack(done).replace(b"frame\x07", b"frame\xcc\x07")
    assert told(long) == "DONE: frame: an integer as `cc` (2 bytes), needs `07` (1 byte)"
    twice = bytes([pack(done)[0] + 1]) + pack(done)[1:] + pack("frame") + b"\x07"
    assert told(twice) == "DONE: the key 'frame' occurs twice"


def test_equal_bytes_do_not_differ() -> None:
    assert first_difference(HEADER, HEADER) == ""
