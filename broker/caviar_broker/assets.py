"""Assets on their way through the broker: taken from worlds, handed to the services that ask (clause 4)."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol

import msgspec
import zmq

from caviar_broker.core import events as ev
from caviar_broker.core.clock import FrameClock
from caviar_broker.core.geometry import GEOMETRY, has_capability
from caviar_broker.core.plan import PatternFile
from caviar_broker.core.transitions import ServiceState
from caviar_protocol import messages as m
from caviar_protocol.assets import MAX_ASSET, MAX_FACES, AssetStore, IncomingAsset, MeshCheck, wrong_name
from caviar_protocol.errors import AssetError
from caviar_protocol.scenario import Scenario
from caviar_protocol.scenario.rules import world_of
from caviar_protocol.scenario.schema import pattern_asset
from caviar_protocol.space.codebooks import CODEBOOKS_FOLDER, FILE, codebook_digest, codebook_file

FILES_AT_ONCE = 8
"""Files that a world is asked for at a time: a city has thousands, and queues are finite."""


def pattern_files(scenario: Scenario, store: AssetStore) -> tuple[PatternFile, ...]:
    """The files of a scenario's antennas, put into the store: worlds need not bring them.

    Patterns of elements, and codebooks.

    Args:
        scenario: With absolute paths, as it is loaded.
        store: That of the broker.

    Raises:
        AssetError: A file cannot be read or stored, or is too large.
    """
    found: dict[str, PatternFile] = {}
    for index, device in enumerate(scenario.devices):
        if device.array is not None and device.array.pattern_file:
            path = device.array.pattern_file
            name, key = pattern_asset(path), f"devices[{index}].array.pattern_file"
            # A replayed world brings what was recorded, whatever the file has become since.
            known = scenario.replay is None and Path(path).is_file()
            asset = store.add(name, Path(path)) if known else None
            found.setdefault(name, PatternFile(name, key, path, world_of(scenario, index), asset))
        if device.array is not None and (digest := codebook_digest(device.array)):
            # Named by its content, so that what was recorded cannot be another one.
            content, name = codebook_file(device.array), CODEBOOKS_FOLDER + digest
            key, path = f"devices[{index}].array.codebook", device.array.codebook.removeprefix(FILE)
            asset = None if content is None else store.add(name, content)
            found.setdefault(name, PatternFile(name, key, path, world_of(scenario, index), asset))
    return tuple(found.values())


class Reply(Protocol):
    """Sends a message to a service."""

    def __call__(self, service: str, message: m.Message, *parts: bytes) -> None:
        """Never waits."""


@dataclass
class _Delivery:
    """Files of the scenery that a world announced and still owes."""

    # By digest: not asked for yet.
    waiting: dict[str, m.Asset]
    # By digest: asked for.
    coming: dict[str, IncomingAsset] = field(default_factory=dict)

    @property
    def owed(self) -> tuple[m.Asset, ...]:
        """All files that are owed, those asked for first."""
        return (*(incoming.asset for incoming in self.coming.values()), *self.waiting.values())


@dataclass
class AssetExchange:
    """Handles the messages of services about assets; holds back READY and DONE until their files are here.

    Args:
        store: Where assets are kept.
        clock: Which service is in which state.
        feed: Gives the clock an event, and does what it wants.
        reply: Sends a message to a service.
        note: Tells the user something about a service.
    """

    store: AssetStore
    clock: FrameClock
    feed: Callable[[ev.Event], None]
    reply: Reply
    note: Callable[[str, str], None]
    _deliveries: dict[str, _Delivery] = field(default_factory=dict)
    max_faces: int = MAX_FACES
    """Triangles that a mesh may have which is announced while the run goes on."""
    _deferred: dict[str, m.Ready] = field(default_factory=dict)
    # Of worlds whose meshes are on their way: their DONEs, the one that announced them first.
    _answers: dict[str, deque[ev.DoneReceived]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self._meshes = MeshCheck(self.store, self.max_faces)

    def handle_offer(self, service: str, message: m.AssetOffer, _: Sequence[zmq.Frame]) -> None:
        """Ask for the files of an ASSET_OFFER that are not here yet."""
        member = self.clock.member(service)
        if member is None or (message.epoch, message.attempt) != (self.clock.plan.epoch, member.attempt):
            self.note(service, "offered scenery for another epoch or attempt; not used")
            return
        self.feed(ev.AssetsOffered(service, message.assets))  # says what is wrong with it, if anything
        if member.role != "world" or member.state is not ServiceState.PREPARING:
            return
        try:
            _check_names(message.assets)
            missing = {asset.digest: asset for asset in message.assets if not self.store.holds(asset)}
            self._deliveries[service] = _Delivery(missing)
            self._ask_for_more(service)
        except AssetError as error:
            self.feed(ev.Violated(service, f"offers wrong scenery: {error}"))

    def handle_data(self, service: str, message: m.AssetData, parts: Sequence[zmq.Frame]) -> None:
        """Store a chunk of ASSET_DATA, and ask for the next."""
        delivery = self._deliveries.get(service)
        incoming = delivery.coming.get(message.digest) if delivery is not None else None
        if delivery is None or incoming is None:
            text = f"sent wrong scenery: the broker did not ask for asset {message.digest[:12]}…"
            self.feed(ev.Violated(service, text))
            return
        try:
            if not incoming.add_chunk(message.offset, message.size, parts[0].buffer):
                self.reply(service, m.AssetGet(digest=message.digest, offset=incoming.offset))
                return
            del delivery.coming[message.digest]
            self._ask_for_more(service)
        except AssetError as error:
            self.feed(ev.Violated(service, f"sent wrong scenery: {error}"))
            return
        if delivery.owed:
            return
        if service in self._deferred:
            self.feed(ev.ReadyReceived(service, self._deferred.pop(service)))
        self._pass_on(service)

    def handle_get(self, service: str, message: m.AssetGet, _: Sequence[zmq.Frame]) -> None:
        """Answer ASSET_GET with the next chunk of a file."""
        try:
            chunk, size = self.store.read(message.digest, message.offset)
        except AssetError as error:
            text = str(error)
            self.reply(
                service, m.Error(code="unknown-asset", of="ASSET_GET", subject=message.digest, message=text)
            )
        else:
            self.reply(service, m.AssetData(digest=message.digest, offset=message.offset, size=size), chunk)

    def handle_ready(self, service: str, message: m.Ready, _: Sequence[zmq.Frame]) -> None:
        """Let READY count once all scenery of the service is here."""
        owed = self._owed(service)
        if not owed:
            self.feed(ev.ReadyReceived(service, message))
            return
        self._deferred[service] = message
        self.note(service, f"is ready, but {len(owed)} files of its scenery are due, {owed[0].name!r} first")

    def holds_back(self, event: ev.DoneReceived) -> bool:
        """Whether a DONE of a world has to wait for the meshes that it, or the one before, announces.

        Args:
            event: With the DONE. It is fed to the clock once the meshes are here.
        """
        service, message = event.service, event.message
        waiting = self._answers.get(service)
        if waiting:
            waiting.append(event)
            return True
        if message.geometry is None or not self._may_announce(service, message):
            return False
        self._answers[service] = deque([event])
        self._pass_on(service)
        return True

    def _may_announce(self, service: str, message: m.Done) -> bool:
        """Whether meshes of a DONE may be used; else the clock says why not."""
        member = self.clock.member(service)
        return (
            member is not None
            and member.role == "world"
            and has_capability(member, GEOMETRY)
            and (message.epoch, message.attempt) == (self.clock.plan.epoch, member.attempt)
        )

    def _pass_on(self, service: str) -> None:
        """Feed the DONEs of a world to the clock, up to the first one whose meshes are not here."""
        waiting = self._answers.get(service)
        while waiting:
            event = waiting[0]
            change = event.message.geometry
            if change is not None:
                # Meshes that are to be asked for, by digest; those of wrong names and sizes are refused
                # unseen.
                if missing := {
                    asset.digest: asset
                    for asset in change.assets
                    if not wrong_name(asset) and asset.size <= MAX_ASSET and not self.store.holds(asset)
                }:
                    self._deliveries[service] = _Delivery(missing)
                    self._ask_for_more(service)
                    return
                event = msgspec.structs.replace(event, refused=self._meshes.refusals(change.assets))
            waiting.popleft()
            self.feed(event)
            waiting = self._answers.get(service)
        self._answers.pop(service, None)

    def handle_error(self, service: str, error: m.Error) -> bool:
        """Whether an ERROR says that a world does not have what it offered; then the run ends."""
        for asset in self._owed(service):
            if asset.digest == error.subject:
                text = f"offered {asset.name!r} and cannot deliver it: {error.message}"
                self.feed(ev.Violated(service, text))
                return True
        return False

    def forget(self, service: str) -> None:
        """Forget an incarnation of a service that is gone: what it owes will not come."""
        self._deferred.pop(service, None)
        self._answers.pop(service, None)
        self._deliveries.pop(service, None)

    def _owed(self, service: str) -> tuple[m.Asset, ...]:
        delivery = self._deliveries.get(service)
        return delivery.owed if delivery is not None else ()

    def _ask_for_more(self, service: str) -> None:
        delivery = self._deliveries[service]
        while delivery.waiting and len(delivery.coming) < FILES_AT_ONCE:
            digest = next(iter(delivery.waiting))
            delivery.coming[digest] = IncomingAsset(self.store, delivery.waiting.pop(digest))
            self.reply(service, m.AssetGet(digest=digest))


def _check_names(assets: Sequence[m.Asset]) -> None:
    named: dict[str, m.Asset] = {}
    for asset in assets:
        if named.setdefault(asset.name, asset) != asset:
            raise AssetError(f"two different files are named {asset.name!r}")
