"""Scenery on its way through the broker: taken from worlds, handed to whoever asks (clause 4)."""

from __future__ import annotations

from caviar_protocol import messages as m
from caviar_protocol.assets import AssetStore, Incoming
from caviar_protocol.errors import AssetError


class SceneryExchange:
    """Which files each world still owes, and the store they go to."""

    def __init__(self, store: AssetStore) -> None:
        self._store = store
        self._owed: dict[str, dict[str, Incoming]] = {}

    def offered(self, world: str, assets: tuple[m.Asset, ...]) -> list[m.AssetGet]:
        """A world announced its scenery: what to ask it for."""
        self._owed[world] = {
            asset.digest: Incoming(self._store, asset)
            for asset in assets
            if not self._store.has(asset.digest)
        }
        return [m.AssetGet(digest=digest) for digest in self._owed[world]]

    def taken(self, world: str, message: m.AssetData, chunk: bytes | memoryview) -> m.AssetGet | None:
        """A chunk came: what to ask for next, if anything. `AssetError` where it was not asked for."""
        owed = self._owed.get(world, {})
        incoming = owed.get(message.digest)
        if incoming is None:
            raise AssetError(f"nobody asked {world!r} for asset {message.digest[:12]}…")
        if incoming.take(message.offset, message.size, chunk):
            del owed[message.digest]
            return None
        return m.AssetGet(digest=message.digest, offset=incoming.offset)

    def complete(self, world: str) -> bool:
        """Whether nothing is owed by this world."""
        return not self._owed.get(world)

    def read(self, request: m.AssetGet) -> tuple[m.AssetData, bytes]:
        """Answer to an ASSET_GET. `AssetError` where the file is not here."""
        chunk, size = self._store.read(request.digest, request.offset)
        return m.AssetData(digest=request.digest, offset=request.offset, size=size), chunk
