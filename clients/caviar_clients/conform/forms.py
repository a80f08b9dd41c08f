"""What makes a message a right one: its header, its parts, its products. The judge of everything received."""

from __future__ import annotations

import hashlib

from caviar_clients.conform.canonical import first_difference
from caviar_clients.conform.case import Failed
from caviar_clients.conform.packing import BROKEN, pack, unpack
from caviar_clients.conform.wire import Fields, Received
from caviar_protocol.codec import (
    check_parts,
    decode_message,
    decode_payload,
    encode_message,
    encode_payload,
    message_type,
)
from caviar_protocol.errors import PayloadError, ProtocolError

ABSENT = "absent"


def product_digest(header: bytes, body: bytes) -> str:
    """As SPEC.md, section Digests, says."""
    return hashlib.sha256(len(header).to_bytes(8, "little") + header + body).hexdigest()


def checked(received: Received) -> Fields:
    """The header of a message that a client may send, or `Failed`."""
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
    """Why the header of a message that `checked` let pass is not in canonical form; empty: it is."""
    header = received.parts[0]
    fields = unpack(header)
    message = decode_message(header)
    kind = message_type(message)
    if next(iter(fields)) != "type":
        return f"{kind}: the first key is {next(iter(fields))!r}, not 'type'"
    unknown = frozenset(fields).difference(("type", *message.__struct_fields__))
    known = {key: value for key, value in fields.items() if key not in unknown}
    right = encode_message(message)
    if pack(fields) != header or pack(known) != right:
        return f"{kind}: {_difference(header, right, unknown)}"
    return ""


def check_products(done: Fields, parts: list[bytes], outputs: list[str]) -> dict[str, bytes]:
    """Header and body, joined, of each product of a DONE; `Failed` where one is wrong."""
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
