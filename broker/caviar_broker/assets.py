"""Scenery on its way through the broker: taken from worlds, handed to whoever asks (clause 4)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Protocol

import zmq

from caviar_broker.core import events as ev
from caviar_broker.core.clock import FrameClock
from caviar_broker.core.transitions import ServiceState
from caviar_protocol import messages as m
from caviar_protocol.assets import AssetStore, Incoming
from caviar_protocol.errors import AssetError

FILES_AT_ONCE = 8
"""Files that a world is asked for at a time: a city has thousands, and queues are finite."""


class AssetTransfers:
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
            digest = next(iter(waiting))
            coming[digest] = Incoming(self._store, waiting.pop(digest))
            asked.append(m.AssetGet(digest=digest))
        return asked


class Reply(Protocol):
    """Sends a message to a service."""

    def __call__(self, service: str, message: m.Message, *parts: bytes) -> None:
        """Never waits."""


@dataclass
class AssetExchange:
    """Handles the messages of services about scenery, and holds back a READY until it is here."""

    exchange: AssetTransfers
    clock: FrameClock
    feed: Callable[[ev.Event], None]
    reply: Reply
    note: Callable[[str, str], None]
    _deferred: dict[str, m.Ready] = field(default_factory=dict)

    def offer(self, service: str, message: m.AssetOffer, _: Sequence[zmq.Frame]) -> None:
        """ASSET_OFFER: ask for what is not here yet."""
        peer = self.clock.peer(service)
        if peer is None or (message.epoch, message.attempt) != (self.clock.plan.epoch, peer.attempt):
            self.note(service, "offered scenery for another epoch or attempt; not used")
            return
        self.feed(ev.AssetsOffered(service, message.assets))  # says what is wrong with it, if anything
        if peer.role == "world" and peer.state is ServiceState.PREPARING:
            try:
                self._ask(service, self.exchange.offered(service, message.assets))
            except AssetError as error:
                self.feed(ev.Violated(service, f"offers wrong scenery: {error}"))

    def data(self, service: str, message: m.AssetData, parts: Sequence[zmq.Frame]) -> None:
        """ASSET_DATA: take it, and ask for the next."""
        try:
            self._ask(service, self.exchange.taken(service, message, parts[0].buffer))
        except AssetError as error:
            self.feed(ev.Violated(service, f"sent wrong scenery: {error}"))
            return
        if service in self._deferred and not self.exchange.owed(service):
            self.feed(ev.ReadyReceived(service, self._deferred.pop(service)))

    def get(self, service: str, message: m.AssetGet, _: Sequence[zmq.Frame]) -> None:
        """ASSET_GET: send the next chunk."""
        try:
            answer, chunk = self.exchange.read(message)
        except AssetError as error:
            text = str(error)
            refusal = m.Error(code="unknown-asset", of="ASSET_GET", subject=message.digest, message=text)
            self.reply(service, refusal)
        else:
            self.reply(service, answer, chunk)

    def ready(self, service: str, message: m.Ready, _: Sequence[zmq.Frame]) -> None:
        """READY: it counts once all scenery of the service is here."""
        owed = self.exchange.owed(service)
        if not owed:
            self.feed(ev.ReadyReceived(service, message))
            return
        self._deferred[service] = message
        self.note(service, f"is ready, but {len(owed)} files of its scenery are due, {owed[0].name!r} first")

    def undeliverable(self, service: str, error: m.Error) -> bool:
        """Whether an ERROR says that a world does not have what it offered; then the run ends."""
        for asset in self.exchange.owed(service):
            if asset.digest == error.subject:
                text = f"offered {asset.name!r} and cannot deliver it: {error.message}"
                self.feed(ev.Violated(service, text))
                return True
        return False

    def forget(self, service: str) -> None:
        """An incarnation of a service is gone."""
        self._deferred.pop(service, None)
        self.exchange.forget(service)

    def _ask(self, service: str, requests: Sequence[m.AssetGet]) -> None:
        for request in requests:
            self.reply(service, request)
