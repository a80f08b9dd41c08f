"""Judgement of received messages: canonical MessagePack, header fields, parts, products.

Reads with the plain ``msgpack`` package, so that a defect of the product's codec cannot hide itself. A header
is canonical where encoding it again gives the same bytes; `first_difference` says in words where it is not.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from itertools import zip_longest
from typing import Any

import msgpack  # type: ignore[import-untyped]

from caviar_labs.conform.client import BROKEN, Failed, Fields, Received, pack, unpack
from caviar_protocol.codec import (
    check_parts,
    decode_message,
    decode_payload,
    encode_message,
    encode_payload,
    message_type,
)
from caviar_protocol.errors import PayloadError, ProtocolError

KINDS = {dict: "map", list: "list", str: "string", bool: "boolean", int: "integer", float: "float"}


@dataclass(frozen=True)
class _Node:
    """A value and how it is written: ``raw`` is all of a scalar, or the head of a list or map."""

    raw: bytes
    value: Any
    """A scalar, a list of nodes, or a list of pairs of nodes for a map."""
    kind: str

    @property
    def shortest(self) -> bytes:
        """Canonical form of a scalar, or of the head of a list or map."""
        packer = msgpack.Packer()
        if self.kind == "map":
            return bytes(packer.pack_map_header(len(self.value)))
        if self.kind == "list":
            return bytes(packer.pack_array_header(len(self.value)))
        return pack(self.value)

    @property
    def keys(self) -> list[Any]:
        """Keys of a map, in the order in which they stand."""
        return [key.value for key, _ in self.value]


def first_difference(got: bytes, right: bytes, ignored: frozenset[str] = frozenset()) -> str:
    """Describe the first field that is not written as in the canonical form of the same header.

    Args:
        got: The header as it came.
        right: Its canonical form.
        ignored: Fields of the outermost map, as those of a later version, that only have to be in their
            shortest form.

    Returns:
        Place, form found and form needed; empty where nothing differs.

    Example:
        >>> first_difference(bytes.fromhex("81a166cd0001"), bytes.fromhex("81a16601"))
        'f: an integer as `cd` (3 bytes), needs `01` (1 byte)'
    """
    return _walk(_read(got), _read(right), "", ignored)


def _read(data: bytes) -> _Node:
    # The unpacker reads one value after the other and states how far it is, which `unpackb` does not.
    unpacker = msgpack.Unpacker(raw=False, strict_map_key=False, max_buffer_size=0)
    unpacker.feed(data)
    return _node(unpacker, data)


def _node(unpacker: Any, data: bytes) -> _Node:
    start = unpacker.tell()
    # Heads of maps: fixmap 0x80–0x8f, map 16, map 32; of lists: fixarray 0x90–0x9f, array 16, array 32.
    head = data[start]
    if head & 0xF0 == 0x80 or head in (0xDE, 0xDF):
        count = unpacker.read_map_header()
        raw = data[start : unpacker.tell()]
        return _Node(raw, [(_node(unpacker, data), _node(unpacker, data)) for _ in range(count)], "map")
    if head & 0xF0 == 0x90 or head in (0xDC, 0xDD):
        count = unpacker.read_array_header()
        raw = data[start : unpacker.tell()]
        return _Node(raw, [_node(unpacker, data) for _ in range(count)], "list")
    value = unpacker.unpack()
    return _Node(data[start : unpacker.tell()], value, KINDS.get(type(value), "value"))


def _walk(got: _Node, right: _Node | None, path: str, ignored: frozenset[str] = frozenset()) -> str:
    """The first difference at or below ``path``; without ``right`` only forms are looked at."""
    place = f"{path}: " if path else ""
    if right is not None and got.kind != right.kind:
        return f"{place}{_form(got.kind, got.raw)}, needs {_form(right.kind, right.raw)}"
    if got.raw != got.shortest:
        return f"{place}{_form(got.kind, got.raw)}, needs {_form('', got.shortest)}"
    if got.kind == "map":
        return _walk_map(got, right, path, ignored)
    if got.kind == "list":
        return _walk_list(got, right, path)
    if right is not None and got.raw != right.raw:
        return f"{place}{got.value!r}, needs {right.value!r}"
    return ""


def _walk_map(got: _Node, right: _Node | None, path: str, ignored: frozenset[str]) -> str:
    place = f"{path}: " if path else ""
    # First of all: of two values under one key a decoder keeps either.
    for number, key in enumerate(got.keys):
        if key in got.keys[:number]:
            return f"{place}the key {key!r} occurs twice"
    for key, _ in got.value:
        if key.raw != key.shortest:
            return (
                f"{place}the key {key.value!r} is {_form('string', key.raw)}, needs {_form('', key.shortest)}"
            )
    expected = {} if right is None else {key.value: value for key, value in right.value}
    if right is not None:
        known = [key for key in got.keys if key not in ignored]
        if superfluous := [key for key in known if key not in expected]:
            return f"{place}{', '.join(map(str, superfluous))} equals its default and is to be left out"
        if known != right.keys:
            return f"{place}keys are {', '.join(map(str, known))}, needs {', '.join(map(str, right.keys))}"
    walked = (
        _walk(value, expected.get(key.value), f"{path}.{key.value}" if path else str(key.value))
        for key, value in got.value
    )
    return next(filter(None, walked), "")


def _walk_list(got: _Node, right: _Node | None, path: str) -> str:
    expected = [] if right is None else right.value
    if right is not None and len(got.value) != len(expected):
        return f"{path}: {len(got.value)} items, needs {len(expected)}"
    walked = (_walk(a, b, f"{path}[{i}]") for i, (a, b) in enumerate(zip_longest(got.value, expected)))
    return next(filter(None, walked), "")


def _form(kind: str, raw: bytes) -> str:
    """«a float as `ca` (5 bytes)»."""
    article = f"{'an' if kind[0] in 'aeiou' else 'a'} {kind} as " if kind else ""
    return f"{article}`{raw[0]:02x}` ({len(raw)} byte{'s' if len(raw) > 1 else ''})"


@dataclass(frozen=True)
class Answer:
    """A message on the ordered connection that was read and judged."""

    kind: str
    fields: Fields
    parts: list[bytes]

    def product(self, topic: str) -> tuple[bytes, bytes] | None:
        """Header and body of the product of a topic; None where the message has none."""
        topics = [entry["topic"] for entry in self.fields.get("products", [])]
        if topic not in topics:
            return None
        place = 1 + 2 * topics.index(topic)
        return self.parts[place], self.parts[place + 1]

    def __str__(self) -> str:
        shown = ("code", "message", "frame")
        words = {key: str(value)[:300] for key, value in self.fields.items() if key in shown}
        return f"{self.kind} {words}" if words else self.kind


def product_digest(header: bytes, body: bytes) -> str:
    """Compute the digest of a product as SPEC.md says, section Digests.

    SHA-256 of the length of the header (8 bytes, little-endian), the header and the body.

    Example:
        >>> product_digest(b"\\x80", b"")[:16]
        '7adad23172bd9288'
    """
    return hashlib.sha256(len(header).to_bytes(8, "little") + header + body).hexdigest()


def checked(received: Received) -> Fields:
    """Read the header of a message that a client may send.

    Raises:
        Failed: The header is no map of MessagePack, the message is none of the protocol, or its parts are
            not those that its header announces.
    """
    parts = received.parts
    try:
        fields = unpack(parts[0])
    except BROKEN as error:
        raise Failed("a MessagePack map as header", f"{parts[0][:40]!r}: {error}") from error
    try:
        check_parts(decode_message(parts[0]), parts)
    except ProtocolError as error:
        kind = fields.get("type", "no type") if isinstance(fields, dict) else "no map"
        raise Failed(
            "a message of the protocol, with its parts", f"{kind} in {len(parts)} parts: {error}"
        ) from error
    header: Fields = fields
    return header


def not_canonical(received: Received) -> str:
    """Say why the header of a message is not in canonical form.

    Args:
        received: A message that `checked` let pass.

    Returns:
        Kind of the message, place, form found and form needed; empty where the form is canonical.
    """
    header = received.parts[0]
    fields = unpack(header)
    message = decode_message(header)
    kind = message_type(message)
    if next(iter(fields)) != "type":
        return f"{kind}: the first key is {next(iter(fields))!r}, not 'type'"
    unknown = frozenset(fields).difference(("type", *message.__struct_fields__))
    known = {key: value for key, value in fields.items() if key not in unknown}
    right = encode_message(message)
    # Two comparisons: all that came is in its shortest form, and of the fields that this version knows none
    # equals its default or is out of order. Of those of a later version no default is known.
    if pack(fields) != header or pack(known) != right:
        return f"{kind}: {_difference(header, right, unknown)}"
    return ""


def check_products(done: Fields, parts: list[bytes], outputs: list[str]) -> dict[str, bytes]:
    """Check the products of a DONE.

    Args:
        done: Its header.
        parts: All of its parts, the header first.
        outputs: Topics that the client declared.

    Returns:
        Header and body, joined, of each product by its topic.

    Raises:
        Failed: A product was not declared, comes twice, has another digest, or is no canonical payload.
    """
    found: dict[str, bytes] = {}
    for number, entry in enumerate(done.get("products", [])):
        topic, header, body = entry["topic"], parts[1 + 2 * number], parts[2 + 2 * number]
        if topic not in outputs:
            raise Failed(f"products of the declared outputs {outputs}", f"one of topic {topic!r}")
        if topic in found:
            raise Failed("at most one product a topic", f"two of topic {topic!r}")
        right = product_digest(header, body)
        if entry["digest"] != right:
            raise Failed(
                f"digest {right} of {topic!r}: hash the length of the header (8 bytes, little-endian), "
                "the header and the body",
                str(entry["digest"]) or "none",
            )
        # Of payloads the product's own types are the judge: their codec is held to the vectors by its tests.
        try:
            payload = decode_payload(topic, header, body)
            again = encode_payload(payload)
        except (ProtocolError, PayloadError) as error:
            raise Failed(f"a payload of topic {topic!r}", str(error)) from error
        if again != (header, body):
            raise Failed(f"{topic!r} in canonical form", _payload_difference(header, body, again))
        found[topic] = header + body
    return found


def _difference(header: bytes, right: bytes, unknown: frozenset[str] = frozenset()) -> str:
    try:
        found = first_difference(header, right, unknown)
    except BROKEN:  # nested too deep to walk through
        found = ""
    return found or "other bytes in the header"


def _payload_difference(header: bytes, body: bytes, again: tuple[bytes, bytes]) -> str:
    if header != again[0]:
        return _difference(header, again[0])
    if len(body) != len(again[1]):
        return f"a body of {len(body)} B where {len(again[1])} B are canonical"
    place = next(place for place, pair in enumerate(zip(body, again[1], strict=True)) if pair[0] != pair[1])
    return f"byte {place} of the body is {body[place]:#04x}, needs {again[1][place]:#04x}"
