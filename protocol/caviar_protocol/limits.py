"""Limits of the protocol, the same on both sides (SPEC.md, section Limits)."""

from __future__ import annotations

MAX_HEADER = 1 << 20
"""Bytes of a message header or payload header."""

MAX_BODY = 1 << 30
"""Bytes of the body of one product."""

MAX_PARTS = 513
"""Parts of a message without its routing part: a header and 256 products."""

MAX_NESTING = 32
"""Depth of maps and arrays in a header."""

MAX_ASSET_CHUNK = 4 << 20
"""Bytes of the data part of an ASSET_DATA."""

MAX_IN_FLIGHT = 64
"""Grants that a service may be asked to queue."""

MAX_SUBCARRIERS = 65536
"""Subcarriers of a carrier."""
