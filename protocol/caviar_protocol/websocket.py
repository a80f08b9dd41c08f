"""A message of several parts as one binary WebSocket frame (SPEC.md, section WebSocket).

::

    u32  number of parts        little-endian, as all of these
    u32  length of each part    as many as there are parts
         the parts, one after the other
"""

from __future__ import annotations

import struct
from collections.abc import Sequence

from caviar_protocol import limits
from caviar_protocol.codec import Buffer
from caviar_protocol.errors import DecodeError, LimitError

SUBPROTOCOL = "caviar.v1"
"""What a client may ask for in ``Sec-WebSocket-Protocol``."""
MAX_FRAME = 1 << 28
"""Bytes of a frame."""
BIG_ENDIAN = "; these numbers are big-endian, write them little-endian"
"""What is said of a frame whose numbers are right with their bytes reversed."""
_COUNT = struct.Struct("<I")


def join_parts(parts: Sequence[Buffer]) -> bytes:
    """The frame of a message."""
    views = [memoryview(part) for part in parts]
    return struct.pack(f"<{len(views) + 1}I", len(views), *(view.nbytes for view in views)) + b"".join(views)


def split_frame(frame: Buffer) -> list[memoryview]:
    """The parts of the message in a frame, without a copy.

    Raises `DecodeError` or `LimitError` where the bytes are no such frame.
    """
    view = memoryview(frame).toreadonly().cast("B")
    if len(view) > MAX_FRAME:
        raise LimitError(f"a frame has {len(view)} B, at most {MAX_FRAME} are accepted")
    if len(view) < _COUNT.size:
        raise DecodeError(f"a frame has {len(view)} B, it begins with the number of its parts in 4 B")
    (count,) = _COUNT.unpack_from(view)
    if not 1 <= count <= limits.MAX_PARTS:
        swapped = 1 <= int.from_bytes(view[: _COUNT.size], "big") <= limits.MAX_PARTS
        text = f"a frame announces {count} parts, a message has 1 to {limits.MAX_PARTS}"
        raise LimitError(text + BIG_ENDIAN * swapped)
    place = _COUNT.size * (1 + count)
    if len(view) < place:
        raise DecodeError(f"a frame of {len(view)} B has no room for the lengths of {count} parts")
    lengths = struct.unpack_from(f"<{count}I", view, _COUNT.size)
    if place + sum(lengths) != len(view):
        swapped = place + sum(struct.unpack_from(f">{count}I", view, _COUNT.size)) == len(view)
        text = f"a frame has {len(view)} B, its lengths add up to {place + sum(lengths)}"
        raise DecodeError(text + BIG_ENDIAN * swapped)
    parts = []
    for length in lengths:
        parts.append(view[place : place + length])
        place += length
    return parts
