"""A service's side of meshes that come and go while a run goes on (contract, clause 4).

`AnnouncedMeshes` is that of a world: what its steps say of meshes as `GeometryChange`. `FollowedMeshes` is
that of the services that load them: GEOMETRY says which there are from a frame on, the files are fetched
beside the frames, and the service uses them from that frame on.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

from caviar_protocol import messages as m
from caviar_protocol.assets import AssetStore
from caviar_protocol.digest import geometry_digest
from caviar_protocol.errors import AssetError
from caviar_protocol.geometry import wrong_name
from caviar_services.asset_fetcher import AssetFetcher, FetchedFile
from caviar_services.frame import StepResult
from caviar_services.service import Service


class AnnouncedMeshes:
    """What a world announced last.

    Args:
        store: Where the files go, for the broker to fetch.

    Example:
        >>> from caviar_protocol.geometry import mesh_name
        >>> announced = AnnouncedMeshes(AssetStore(Path("cache")))
        >>> change = announced.change(7, StepResult(meshes={mesh_name(b"ply"): b"ply"}))
        >>> change.frame, len(change.assets), announced.change(8, StepResult())
        (7, 1, None)
    """

    def __init__(self, store: AssetStore) -> None:
        self._store = store
        self._known: dict[str, m.Asset] = {}

    def reset(self) -> None:
        """Forget what was announced: an episode begins without."""
        self._known.clear()

    def change(self, frame: int, result: StepResult) -> m.GeometryChange | None:
        """What DONE says of meshes; None where the step said nothing.

        Args:
            frame: That was computed.
            result: What the world made of it.

        Raises:
            AssetError: A file cannot be read or stored, or has another name than its SHA-256.
        """
        if result.meshes is None:
            return None
        known = {name: self._known.get(name) or self._add(name, file) for name, file in result.meshes.items()}
        self._known = known
        assets = tuple(known[name] for name in sorted(known))
        return m.GeometryChange(frame=frame if result.meshes_from < 0 else result.meshes_from, assets=assets)

    def _add(self, name: str, content: Path | bytes) -> m.Asset:
        asset = self._store.add(name, content)
        if problem := wrong_name(asset):
            raise AssetError(f"mesh {name!r} comes while the run goes on: {problem}")
        return asset


@dataclass(eq=False)
class _Order:
    """A GEOMETRY, and its files as far as they have come."""

    message: m.Geometry
    files: dict[str, Path] = field(default_factory=dict)
    missing: int = 0


class FollowedMeshes:
    """Which meshes a service uses, and which it has been sent for later frames.

    Args:
        store: Where the files are.
        fetcher: Fetches those that are not there.
        service: The service, once it is made.
        loaded: Called with a GEOMETRY whose meshes the service holds, and the digest of all it holds then.
    """

    def __init__(
        self,
        store: AssetStore,
        fetcher: AssetFetcher,
        service: Callable[[], Service[Any]],
        loaded: Callable[[m.Geometry, str], None],
    ) -> None:
        self._store, self._fetcher, self._service, self._loaded = store, fetcher, service, loaded
        self._scenery: tuple[m.Asset, ...] = ()
        self._in_use: tuple[m.Asset, ...] = ()
        # Loaded, for later frames, in ascending order.
        self._later: list[_Order] = []
        # Sent and not loaded, in the order in which they came.
        self._loading: list[_Order] = []
        self.completed = -1
        """Last frame that the service was granted; −1: none since RESET."""
        self.digest = ""
        """Of the geometry in use; empty: that of READY."""

    def begin(self, scenery: Sequence[m.Asset]) -> None:
        """Note the scenery that the service was prepared with."""
        self._scenery = tuple(scenery)

    def reset(self) -> None:
        """Use scenery alone: an episode begins."""
        self._later.clear()
        self._loading.clear()
        self.completed = -1
        if self._in_use:
            self._use((), {})

    def order(self, message: m.Geometry, now: float) -> None:
        """Take GEOMETRY: fetch its files, and use them from its frame on.

        Raises:
            AssetError: The service cannot load a file.
        """
        order = _Order(message, missing=len(message.assets))
        self._loading.append(order)
        names = {asset.digest: asset.name for asset in message.assets}
        if names:
            self._fetcher.fetch(message.assets, partial(self._take_file, order, names), now)
        self._advance()

    def begin_frame(self, frame: int) -> None:
        """Use what there is for a frame that is computed next.

        Raises:
            AssetError: The service cannot load a file.
        """
        self.completed = frame
        self._apply(frame)

    def _take_file(self, order: _Order, names: Mapping[str, str], file: FetchedFile, _: float) -> None:
        if order not in self._loading:
            return  # of an episode that is over
        if file.path is None:
            raise AssetError(file.reason)
        order.files[names[file.digest]] = file.path
        order.missing -= 1
        if not order.missing:
            self._advance()

    def _advance(self) -> None:
        """Answer the orders that are complete, in the order in which they came."""
        while self._loading and not self._loading[0].missing:
            order = self._loading.pop(0)
            # One that came later says all of its frame, and of those after it until the next.
            frame = order.message.frame
            self._later = sorted(
                [*(o for o in self._later if o.message.frame != frame), order], key=lambda o: o.message.frame
            )
            # Where no earlier frame is to come, now: the frame itself then need not wait for it.
            self._apply(self.completed + 1)
            self._loaded(order.message, geometry_digest([*self._scenery, *order.message.assets]))

    def _apply(self, frame: int) -> None:
        due = [order for order in self._later if order.message.frame <= frame]
        if due:
            # The newest is kept: a change for its frame that comes now is told from one for a later frame.
            self._later = self._later[len(due) :]
            if due[-1].message.assets != self._in_use:
                self._use(due[-1].message.assets, due[-1].files)

    def _use(self, assets: tuple[m.Asset, ...], files: Mapping[str, Path]) -> None:
        self._service().use_meshes(files)
        self._in_use = assets
        self.digest = geometry_digest([*self._scenery, *assets]) if assets else ""
