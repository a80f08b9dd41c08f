"""Scenery on its way through the broker: taken from worlds, handed to whoever asks (clause 4)."""

from __future__ import annotations

from caviar_protocol import messages as m
from caviar_protocol.assets import AssetStore, Incoming
from caviar_protocol.errors import AssetError

FILES_AT_ONCE = 8
"""Files that a world is asked for at a time: a city has thousands, and queues are finite."""


class SceneryExchange:
    """Which files each world still owes, and the store they go to."""

    def __init__(self, store: AssetStore) -> None:
        self._store = store
        self._waiting: dict[str, dict[str, m.Asset]] = {}
        self._coming: dict[str, dict[str, Incoming]] = {}

    def offered(self, world: str, assets: tuple[m.Asset, ...]) -> list[m.AssetGet]:
        """A world announced its scenery: what to ask it for.

        Raises `AssetError` where the announcement contradicts itself.
        """
        named: dict[str, m.Asset] = {}
        for asset in assets:
            if named.setdefault(asset.name, asset) != asset:
                raise AssetError(f"two different files are named {asset.name!r}")
        self._waiting[world] = {a.digest: a for a in assets if not self._store.holds(a)}
        self._coming[world] = {}
        return self._more(world)

    def taken(self, world: str, message: m.AssetData, chunk: bytes | memoryview) -> list[m.AssetGet]:
        """A chunk came: what to ask for next. `AssetError` where it is not the one asked for."""
        coming = self._coming.get(world, {})
        incoming = coming.get(message.digest)
        if incoming is None:
            raise AssetError(f"nobody asked for asset {message.digest[:12]}…")
        if incoming.take(message.offset, message.size, chunk):
            del coming[message.digest]
            return self._more(world)
        return [m.AssetGet(digest=message.digest, offset=incoming.offset)]

    def complete(self, world: str) -> bool:
        """Whether nothing is owed by this world."""
        return not self._coming.get(world)

    def owed(self, world: str) -> tuple[m.Asset, ...]:
        """The files that a world still has to deliver, those asked for first."""
        coming = [incoming.asset for incoming in self._coming.get(world, {}).values()]
        return (*coming, *self._waiting.get(world, {}).values())

    def forget(self, world: str) -> None:
        """The world is gone: what it owed will not come from this incarnation of it."""
        self._waiting.pop(world, None)
        self._coming.pop(world, None)

    def read(self, request: m.AssetGet) -> tuple[m.AssetData, bytes]:
        """Answer to an ASSET_GET. `AssetError` where the file is not here."""
        chunk, size = self._store.read(request.digest, request.offset)
        return m.AssetData(digest=request.digest, offset=request.offset, size=size), chunk

    def _more(self, world: str) -> list[m.AssetGet]:
        waiting, coming = self._waiting[world], self._coming[world]
        asked = []
        while waiting and len(coming) < FILES_AT_ONCE:
            digest, asset = waiting.popitem()
            coming[digest] = Incoming(self._store, asset)
            asked.append(m.AssetGet(digest=digest))
        return asked
