"""What makes a message a right one: its header, its parts, its products. The judge of everything received."""

from __future__ import annotations

import hashlib
from typing import Any

import msgspec

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
    if pack(fields) != header:
        return f"{kind}: an integer, string, list or map is not in its shortest form, or a key occurs twice"
    known = {key: value for key, value in fields.items() if key in ("type", *message.__struct_fields__)}
    right = encode_message(message)
    if pack(known) != right:
        return f"{kind}: keys are {', '.join(known)}; {_difference(known, unpack(right))}"
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
                f"digest {right} over length, header and body of {topic!r}", str(entry["digest"]) or "none"
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


def _difference(got: Fields, right: Fields) -> str:
    superfluous = [key for key in got if key not in right]
    if superfluous:
        return f"{', '.join(superfluous)} equals its default and is to be left out"
    if list(got) != list(right):
        return f"the order of the table is {', '.join(right)}"
    wrong = [key for key in got if pack(got[key]) != pack(right[key])]
    return f"{', '.join(wrong)} is not canonical inside"


def _payload_difference(header: bytes, body: bytes, again: tuple[bytes, bytes]) -> str:
    if header == again[0]:
        return f"a body of {len(body)} B where {len(again[1])} B are canonical, or other filling than zeros"
    try:
        got: Any = unpack(header)
        return _difference(got, msgspec.msgpack.decode(again[0]))
    except (*BROKEN, msgspec.MsgspecError):
        return "other bytes in the header"
