"""Digests: of a product, of scenery, and of a whole run (contract, clauses 4 and 20)."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable
from pathlib import Path

from caviar_protocol.files import open_regular
from caviar_protocol.messages import Asset

MOST_WAITING = 64
"""Frames that a `RunDigest` keeps unhashed."""


def payload_digest(header: bytes | memoryview, body: bytes | memoryview) -> str:
    """SHA-256 of a product: header length (8 bytes, little-endian), header, body.

    Args:
        header: The encoded fields of the payload.
        body: Its arrays.

    Returns:
        64 lower-case hexadecimal digits.

    Example:
        >>> payload_digest(b"", b"")
        'af5570f5a1810b7af78caf4bc70a660f0df51e42baf91d4de5b2328de0e83dfc'
    """
    h = hashlib.sha256(len(header).to_bytes(8, "little"))
    h.update(header)
    h.update(body)
    return h.hexdigest()


def file_digest(path: Path) -> str:
    """SHA-256 of the content of a regular file.

    Args:
        path: The file.

    Returns:
        64 lower-case hexadecimal digits.

    Raises:
        OSError: It cannot be read, or is no file.
    """
    with open_regular(path) as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def geometry_digest(assets: Iterable[Asset]) -> str:
    """SHA-256 of the scenery of a run: of the text ``name NUL digest NUL`` for each asset, sorted by name.

    Args:
        assets: Files of scenery, in any order.

    Returns:
        64 lower-case hexadecimal digits; empty without assets.

    Example:
        >>> geometry_digest([])
        ''
        >>> wall = Asset(name="wall.ply", digest="00" * 32, size=0)
        >>> geometry_digest([wall])[:16]
        'd600750886a72caa'
    """
    ordered = sorted(assets, key=lambda asset: asset.name)
    if not ordered:
        return ""
    h = hashlib.sha256()
    for asset in ordered:
        h.update(f"{asset.name}\0{asset.digest}\0".encode())
    return h.hexdigest()


class RunDigest:
    """The chain over (episode, frame, topic, source, payload) that identifies a run's results.

    It starts from SHA-256 of ``caviar-run-1``. Each fresh product sets
    ``h ← SHA-256(h ‖ episode NUL frame NUL topic NUL source NUL ‖ payload digest)``, with decimal numbers and
    raw digests, frames in order, within a frame sorted by (topic, source).

    Args:
        begun: Digest of the frames before, to continue a chain; empty: begin one.

    Example:
        >>> chain = RunDigest()
        >>> chain.add_frame(0, 0, [("scene", "world", payload_digest(b"header", b"body"))])
        >>> rest = RunDigest(begun=chain.hexdigest())  # goes on where the other one is
        >>> rest.hexdigest() == chain.hexdigest()
        True
    """

    def __init__(self, begun: str = "") -> None:
        """Begin a chain, or continue after the digest ``begun``."""
        self._state = bytes.fromhex(begun) or hashlib.sha256(b"caviar-run-1").digest()
        # Hashing waits until no service waits for a grant: it is no part of a frame's latency.
        self._waiting: list[tuple[int, int, list[tuple[str, str, str]]]] = []

    def add_frame(self, episode: int, frame: int, products: Iterable[tuple[str, str, str]]) -> None:
        """Add the fresh products of one frame.

        They are hashed by the next `fold`, or once `MOST_WAITING` frames wait for it.

        Args:
            episode: Number of the episode.
            frame: Number of the frame in it.
            products: (topic, source, payload digest) of each fresh product, in any order.
        """
        self._waiting.append((episode, frame, list(products)))
        if len(self._waiting) >= MOST_WAITING:
            self.fold()

    def fold(self) -> None:
        """Hash the frames that wait. The broker calls it while no service waits for a grant."""
        state = self._state
        for episode, frame, products in self._waiting:
            # Services finish in another order in every run; the digest must not depend on it.
            for topic, source, digest in sorted(products):
                prefix = f"{episode}\0{frame}\0{topic}\0{source}\0".encode()
                state = hashlib.sha256(state + prefix + bytes.fromhex(digest)).digest()
        self._state = state
        self._waiting.clear()

    def hexdigest(self) -> str:
        """The digest so far."""
        self.fold()
        return self._state.hex()
