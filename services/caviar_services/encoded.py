"""Products that are on the wire already: a recorded one is sent as it was, not decoded and made again."""

from __future__ import annotations

from caviar_protocol.arrays import Payload
from caviar_protocol.codec import decode_payload, encode_payload


class Encoded(Payload, frozen=True, kw_only=True):
    """Stands in `StepResult.products` for a payload; only its bytes are known."""

    topic: str
    header: bytes
    body: bytes
    fidelity: str = ""


def encoded(payload: Payload) -> tuple[bytes, bytes]:
    """Header and body of a product (`caviar_protocol.codec.payloads.encode_payload`)."""
    return (payload.header, payload.body) if isinstance(payload, Encoded) else encode_payload(payload)


def decoded(payload: Payload) -> Payload:
    """The product for a consumer in the same process."""
    if isinstance(payload, Encoded):
        return decode_payload(payload.topic, payload.header, payload.body)
    return payload
