"""Bytes to typed objects and back: messages, payloads, frames of a WebSocket."""

from caviar_protocol.codec.messages import (
    BIG_ENDIAN,
    SUBPROTOCOL,
    Buffer,
    check_parts,
    check_version,
    decode_message,
    encode_message,
    join_parts,
    message_type,
    part_count,
    split_frame,
)
from caviar_protocol.codec.payloads import decode_payload, encode_payload
