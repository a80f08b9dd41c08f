"""A service's side of meshes that come and go while a run goes on (contract, clause 4).

`AnnouncedMeshes` is that of a world: what its steps say of meshes as `GeometryChange`. `FollowedMeshes` is
that of the services that load them: GEOMETRY says which there are from a frame on, the files are fetched
beside the frames, and the service uses them from that frame on.

Files fetched from the broker by digest: scenery, and files for one service alone.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias

from caviar_protocol import messages as m
from caviar_protocol.assets import AssetStore, IncomingAsset, wrong_name
from caviar_protocol.digest import geometry_digest
from caviar_protocol.errors import AssetError
from caviar_services.frame import StepResult
from caviar_services.service import Service


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


class AnnouncedMeshes:
    """What a world announced last.

    Args:
        store: Where the files go, for the broker to fetch.

    Example:
        >>> from caviar_protocol.assets import mesh_name
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
