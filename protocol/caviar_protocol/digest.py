"""Digests: of a product, of scenery, and of a whole run (contract, clauses 4 and 20)."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable

from caviar_protocol.messages import Asset


def payload_digest(header: bytes | memoryview, body: bytes | memoryview) -> str:
    """SHA-256 of a product: header length (8 bytes, little-endian), header, body."""
    h = hashlib.sha256(len(header).to_bytes(8, "little"))
    h.update(header)
    h.update(body)
    return h.hexdigest()


def geometry_digest(assets: Iterable[Asset]) -> str:
    """SHA-256 over the assets sorted by name: ``name NUL digest NUL`` each; empty without assets."""
    ordered = sorted(assets, key=lambda asset: asset.name)
    if not ordered:
        return ""
    h = hashlib.sha256()
    for asset in ordered:
        h.update(f"{asset.name}\0{asset.digest}\0".encode())
    return h.hexdigest()


class RunDigest:
    """The chain over (episode, frame, topic, source, payload) that identifies a run's results.

    Starts from SHA-256 of ``caviar-run-1``; each fresh product sets
    ``h ← SHA-256(h ‖ episode NUL frame NUL topic NUL source NUL ‖ payload digest)`` with decimal
    numbers and raw digests, frames in order, within a frame sorted by (topic, source).
    """

    def __init__(self) -> None:
        self._state = hashlib.sha256(b"caviar-run-1").digest()

    def add_frame(self, episode: int, frame: int, products: Iterable[tuple[str, str, str]]) -> None:
        """Add the fresh products of one frame, each (topic, source, payload digest)."""
        for topic, source, digest in sorted(products):
            prefix = f"{episode}\0{frame}\0{topic}\0{source}\0".encode()
            self._state = hashlib.sha256(self._state + prefix + bytes.fromhex(digest)).digest()

    def hexdigest(self) -> str:
        """The digest so far."""
        return self._state.hex()
