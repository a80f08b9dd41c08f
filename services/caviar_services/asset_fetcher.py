"""Files fetched from the broker by digest: scenery, and files for one service alone."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple, TypeAlias

from caviar_protocol import messages as m
from caviar_protocol.assets import AssetStore, IncomingAsset
from caviar_protocol.errors import AssetError


class FetchedFile(NamedTuple):
    """What came of a file."""

    digest: str
    path: Path | None
    """Where it is; None: it could not be fetched."""
    reason: str = ""
    """Why it could not."""


Fetched: TypeAlias = Callable[[FetchedFile, float], None]
"""``fetched(file, now)``: takes a file that was fetched, or could not be."""


class _Wanted(NamedTuple):
    """A file that is to be fetched."""

    digest: str
    asset: m.Asset | None
    """Its description; None: what ASSET_DATA brings first says how large it is."""
    fetched: Fetched

    def __str__(self) -> str:
        return f"file {self.digest[:12]}…" if self.asset is None else f"asset {self.asset.name!r}"


class AssetFetcher:
    """Fetches files by ASSET_GET (contract, clause 4), one after the other.

    Args:
        store: Where files are kept; those that are there are not fetched.
        send: Sends a message to the broker.
        timeout_s: Time that the broker has for each chunk [s].
        progress: Called with the number of a file and how many there are, before it is fetched.

    Example:
        >>> sent = []
        >>> files = AssetFetcher(AssetStore(Path("empty")), lambda message, parts: sent.append(message), 30.0)
        >>> files.fetch(["00" * 32], lambda file, now: print(*file[1:]), now=0.0)
        >>> sent[0].offset, files.deadline
        (0, 30.0)
        >>> files.expire(31.0)
        None the broker did not deliver file 000000000000… within 30 s
    """

    def __init__(
        self,
        store: AssetStore,
        send: Callable[[m.Message, Sequence[object]], None],
        timeout_s: float,
        progress: Callable[[int, int], None] = lambda number, count: None,
    ) -> None:
        self._store, self._send, self._timeout_s, self._progress = store, send, timeout_s, progress
        self._waiting: list[_Wanted] = []
        self._count = 0
        self._incoming: IncomingAsset | None = None
        self.deadline: float | None = None
        """When the next chunk is due, on the clock of ``now`` [s]; None: nothing is awaited."""

    @property
    def awaited(self) -> str:
        """Digest of the file that is fetched; empty: none is."""
        return self._waiting[0].digest if self._waiting else ""

    @property
    def name(self) -> str:
        """What the file that is fetched is called in errors: ``asset 'scenery/town.xml'``."""
        return str(self._waiting[0])

    def fetch(self, files: Sequence[str | m.Asset], fetched: Fetched, now: float) -> None:
        """Fetch files; ``fetched`` is called for each of them, at once for those that are in the store.

        Args:
            files: Their descriptions; of those of which nothing else is known, the SHA-256.
            fetched: Called with what came of each.
            now: Time on any monotonic clock [s].
        """
        idle = not self._waiting
        for file in files:
            known = None if isinstance(file, str) else file
            self._waiting.append(_Wanted(file if isinstance(file, str) else file.digest, known, fetched))
        self._count = len(self._waiting)
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

    def stop(self) -> None:
        """Give up all files; nothing is called for them."""
        self._waiting.clear()
        self._incoming, self.deadline = None, None

    def expire(self, now: float) -> None:
        """Give up the file that has not come by `deadline`."""
        if self.deadline is not None and now >= self.deadline:
            self.fail(f"the broker did not deliver {self.name} within {self._timeout_s:g} s", now)

    def _next(self, now: float) -> None:
        while self._waiting and self.deadline is None:
            wanted = self._waiting[0]
            path, reason = self._store.path(wanted.digest), ""
            if not path.is_file() if wanted.asset is None else not self._store.holds(wanted.asset):
                self._progress(self._count - len(self._waiting) + 1, self._count)
                try:
                    self._incoming = IncomingAsset(self._store, wanted.asset) if wanted.asset else None
                except AssetError as error:
                    reason = str(error)
                else:
                    self._ask(now)
                    return
            self._deliver(None if reason else path, reason, now)

    def _deliver(self, path: Path | None, reason: str, now: float) -> None:
        wanted = self._waiting.pop(0)
        wanted.fetched(FetchedFile(wanted.digest, path, reason), now)

    def _done(self, path: Path | None, reason: str, now: float) -> None:
        self._incoming, self.deadline = None, None
        self._deliver(path, reason, now)
        self._next(now)  # nothing, where what was called has asked for more

    def _ask(self, now: float) -> None:
        # Chunk by chunk, each asked for: large files do not fill the queues that control messages take.
        self.deadline = now + self._timeout_s
        offset = self._incoming.offset if self._incoming is not None else 0
        self._send(m.AssetGet(digest=self.awaited, offset=offset), ())
