"""Files for one service alone, fetched from the broker by digest: before it prepares, or beside frames."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TypeAlias

from caviar_protocol import messages as m
from caviar_protocol.assets import AssetStore, IncomingAsset
from caviar_protocol.errors import AssetError

Fetched: TypeAlias = Callable[[str, "Path | None", str, float], None]
"""``fetched(digest, path, reason, now)``: a file is here, or ``path`` is None and ``reason`` says why."""


class OwnFiles:
    """Fetches files by ASSET_GET (contract, clause 4), one after the other.

    Only their digests are known: what ASSET_DATA brings first says how large a file is.

    Args:
        store: Where files are kept; those that are there are not fetched.
        send: Sends a message to the broker.
        timeout_s: Time that the broker has for each chunk [s].

    Example:
        >>> sent = []
        >>> files = OwnFiles(AssetStore(Path("empty")), lambda message, parts: sent.append(message), 30.0)
        >>> files.fetch(["00" * 32], lambda digest, path, reason, now: print(path, reason), now=0.0)
        >>> sent[0].offset, files.deadline
        (0, 30.0)
        >>> files.expire(31.0)
        None the broker did not deliver file 000000000000… within 30 s
    """

    def __init__(
        self, store: AssetStore, send: Callable[[m.Message, Sequence[object]], None], timeout_s: float
    ) -> None:
        self._store, self._send, self._timeout_s = store, send, timeout_s
        self._waiting: list[tuple[str, Fetched]] = []
        self._incoming: IncomingAsset | None = None
        self.deadline: float | None = None
        """When the next chunk is due, on the clock of ``now`` [s]; None: nothing is awaited."""

    @property
    def awaited(self) -> str:
        """Digest of the file that is fetched; empty: none is."""
        return self._waiting[0][0] if self._waiting else ""

    def fetch(self, digests: Sequence[str], fetched: Fetched, now: float) -> None:
        """Fetch files; ``fetched`` is called for each of them, at once for those that are in the store.

        Args:
            digests: SHA-256 of each.
            fetched: Called with what came of each.
            now: Time on any monotonic clock [s].
        """
        idle = not self._waiting
        self._waiting += [(digest, fetched) for digest in digests]
        if idle:
            self._next(now)

    def data(self, data: m.AssetData, chunk: bytes | memoryview, now: float) -> None:
        """Take ASSET_DATA of the file that is `awaited`."""
        try:
            if self._incoming is None:
                asset = m.Asset(name=f"files/{data.digest}", digest=data.digest, size=data.size)
                self._incoming = IncomingAsset(self._store, asset)
            complete = self._incoming.add_chunk(data.offset, data.size, chunk)
        except AssetError as error:
            self.fail(str(error), now)
            return
        if complete:
            self._done(self._store.path(data.digest), "", now)
        else:
            self._ask(now)

    def fail(self, reason: str, now: float) -> None:
        """Give up the file that is `awaited`, and go on with the next."""
        self._done(None, reason, now)

    def expire(self, now: float) -> None:
        """Give up the file that has not come by `deadline`."""
        if self.deadline is not None and now >= self.deadline:
            what = f"file {self.awaited[:12]}…"
            self.fail(f"the broker did not deliver {what} within {self._timeout_s:g} s", now)

    def _next(self, now: float) -> None:
        while self._waiting:
            path = self._store.path(self.awaited)
            if not path.is_file():
                self._ask(now)
                return
            self._deliver(path, "", now)

    def _deliver(self, path: Path | None, reason: str, now: float) -> None:
        digest, fetched = self._waiting.pop(0)
        fetched(digest, path, reason, now)

    def _done(self, path: Path | None, reason: str, now: float) -> None:
        self._incoming, self.deadline = None, None
        self._deliver(path, reason, now)
        if self.deadline is None:  # what was called may have asked for more
            self._next(now)

    def _ask(self, now: float) -> None:
        self.deadline = now + self._timeout_s
        offset = self._incoming.offset if self._incoming is not None else 0
        self._send(m.AssetGet(digest=self.awaited, offset=offset), ())
