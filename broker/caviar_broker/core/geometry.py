"""Meshes that worlds announce while an episode goes on, and which services hold them (contract, clause 4).

A world names meshes with its answer to a frame, and the frame from which on scenes may name them. GEOMETRY
tells the services that trace rays or record; each loads them and answers with the digest of all that it
holds. Under the policies ``wait`` and ``abort`` a service is not granted the frame before. Under the others
it computes with what it has, says so with its answer, and its products carry that digest.

What a world announced lasts until the episode ends: an episode follows from its seed alone.
"""

from __future__ import annotations

from bisect import bisect_right
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from caviar_broker.core.run import Member, Run
from caviar_broker.core.transitions import ServiceState
from caviar_protocol.assets import wrong_name
from caviar_protocol.digest import geometry_digest
from caviar_protocol.messages import (
    Asset,
    Done,
    Error,
    Geometry,
    GeometryChange,
    GeometryDone,
    Refuse,
)

GEOMETRY = "geometry"
"""Capability of worlds that announce meshes while a run goes on, and of services that load them then."""
GEOMETRY_SINCE = (1, 6)
"""Version of the protocol that brought it."""
REFUSED = "refused-mesh"
"""Code of the ERROR that tells a world of a mesh that is not used."""


_IN_EPISODE = (ServiceState.ACTIVE, ServiceState.RESETTING, ServiceState.RESTORING)


def has_capability(member: Member, capability: str) -> bool:
    """Whether a service named a capability in its HELLO."""
    return member.hello is not None and capability in member.hello.capabilities


def _assets_at(changes: Sequence[GeometryChange], frame: int) -> tuple[Asset, ...]:
    """Meshes of a world in a frame; its changes are in ascending order of frames."""
    until = bisect_right(changes, frame, key=lambda change: change.frame)
    return changes[until - 1].assets if until else ()


@dataclass(frozen=True)
class _Awaited:
    """A GEOMETRY that is not answered yet."""

    frame: int
    digest: str
    since: int


class GeometryLedger:
    """Meshes by frame of the episode, and those that services have yet to load.

    Args:
        run: The run.
    """

    def __init__(self, run: Run) -> None:
        self._run = run
        # By world, in ascending order of frames.
        self._changes: dict[str, list[GeometryChange]] = {}
        # By service, in the order in which they were sent.
        self._awaited: dict[str, deque[_Awaited]] = {}
        # Services that were sent what there was when they were reset, and are sent what comes since.
        self._following: set[str] = set()
        # Digests of meshes that a world was told are refused.
        self._refused: set[tuple[str, str]] = set()
        # Of the geometry from each frame on in which it changes, in ascending order.
        self._digests: list[tuple[int, str]] = []
        self.has_changed = False
        """Whether any frame of the episode has other geometry than its scenery."""

    def begin_episode(self) -> None:
        """Start with scenery alone, or with what another broker left of the episode."""
        self._changes.clear()
        self._awaited.clear()
        self._following.clear()
        self._refused.clear()
        before = self._run.resumption
        for world, change in before.geometry if before is not None else ():
            self._put(world, change)
        self._note_digests()

    def digest_at(self, frame: int) -> str:
        """Digest of the geometry of a frame; empty where the run has none."""
        found = bisect_right(self._digests, frame, key=lambda known: known[0])
        return self._digests[found - 1][1] if found else geometry_digest(self._run.scenery())

    def meshes_at(self, frame: int) -> tuple[Asset, ...]:
        """Meshes of a frame beyond its scenery, of all worlds, sorted by name."""
        found: dict[str, Asset] = {}
        for changes in self._changes.values():
            found |= {asset.name: asset for asset in _assets_at(changes, frame)}
        return tuple(found[name] for name in sorted(found))

    # --- worlds --------------------------------------------------------------------------------------

    def announce(
        self, member: Member, message: Done, refused: Mapping[str, str], needed: int, now: int
    ) -> GeometryChange | None:
        """Take the meshes of a world's DONE, and tell the services that load them.

        Args:
            member: The world.
            message: Its answer.
            refused: Why a file is no mesh, by name.
            needed: First frame that may be granted again: what was before is not kept.
            now: The time [ns].

        Returns:
            What was taken; None where nothing changes.
        """
        offered = message.geometry
        if offered is None:
            return None
        if problem := self._wrong(member, offered, message.frame):
            self._refuse(member, message.frame, "", problem)
            return None
        taken = []
        for asset in offered.assets:
            why = wrong_name(asset) or refused.get(asset.name, "")
            if why:
                self._refuse(member, message.frame, asset.digest, f"{asset.name}: {why}")
            else:
                taken.append(asset)
        change = GeometryChange(frame=offered.frame, assets=tuple(sorted(taken, key=lambda a: a.name)))
        known = self._changes.get(member.name, [])
        # A world that was started again says what it said before: nothing follows from that.
        if change.assets == _assets_at(known, change.frame):
            return None
        if known and change.frame < known[-1].frame:
            why = (
                f"meshes for frame {change.frame} came after those for frame {known[-1].frame}, which they "
                "would replace: name frames in ascending order"
            )
            self._refuse(member, message.frame, "", why)
            return None
        self._put(member.name, change)
        # Forget what was replaced before a frame: no grant needs it any more.
        for changes in self._changes.values():
            while len(changes) > 1 and changes[1].frame <= needed:
                del changes[0]
        self._note_digests()
        run = self._run
        run.enter_journal("geometry", member.name, message.frame, now, geometry=change)
        for name in sorted(self._following):
            self._tell(run.members[name], change.frame, now)
        return change

    def _wrong(self, member: Member, offered: GeometryChange, frame: int) -> str:
        """Reason why a world cannot announce meshes; empty: it can."""
        if member.role != "world":
            return "only a world announces meshes"
        if not has_capability(member, GEOMETRY):
            return f"HELLO did not name the capability {GEOMETRY!r}, without which meshes are announced once"
        if not self._takes_changes():
            return "PREPARE said max_faces 0: a service of the run does not know meshes that come later"
        if offered.frame < frame:
            return f"meshes for frame {offered.frame} came with frame {frame}: name that one, or a later one"
        return ""

    def _takes_changes(self) -> bool:
        """Whether every service that consumes scenes knows meshes that come while the run goes on."""
        hellos = [p.hello for p in self._run.members.values() if p.hello is not None]
        return all(
            hello.version >= GEOMETRY_SINCE
            for hello in hellos
            if any(entry.topic in ("scene", "*") for entry in hello.inputs)
        )

    def _refuse(self, member: Member, frame: int, digest: str, why: str) -> None:
        """Tell a world, once, that a mesh is not used; the run goes on."""
        key = member.name, digest or why
        if key in self._refused:
            return
        self._refused.add(key)
        self._run.notice("refused", member.name, f"{why}; its objects are boxes", frame)
        self._run.send(member, Error(code=REFUSED, of="DONE", subject=digest, message=why))

    def _put(self, world: str, change: GeometryChange) -> None:
        """Note what a world has from a frame on; a second change for one frame replaces the first."""
        changes = self._changes.setdefault(world, [])
        while changes and changes[-1].frame >= change.frame:
            changes.pop()
        changes.append(change)

    def _note_digests(self) -> None:
        scenery = self._run.scenery()
        frames = sorted({change.frame for changes in self._changes.values() for change in changes})
        self._digests = [(frame, geometry_digest([*scenery, *self.meshes_at(frame)])) for frame in frames]
        self.has_changed = bool(frames)

    # --- services that load them ---------------------------------------------------------------------

    def bring_back(self, member: Member, frame: int, now: int) -> bool:
        """Send a service that was reset the meshes of its next frame, and of those after it.

        Args:
            member: The service.
            frame: The first one that it is granted.
            now: The time [ns].

        Returns:
            Whether it has to load any before it goes on.
        """
        self.forget(member)
        if member.role == "world" or not has_capability(member, GEOMETRY):
            return False
        self._following.add(member.name)
        if self.meshes_at(frame):
            self._send(member, frame, now)
        self._tell(member, frame + 1, now)
        return member.name in self._awaited

    def forget(self, member: Member) -> None:
        """Forget what a service was sent: it is reset, and brought back by `bring_back`."""
        self._awaited.pop(member.name, None)
        self._following.discard(member.name)

    def end_episode(self) -> None:
        """Wait for no service any more: what it loads is for frames that are over."""
        self._awaited.clear()
        self._following.clear()

    def _tell(self, member: Member, frame: int, now: int) -> None:
        """Send a service the meshes from a frame on, for each frame in which they change."""
        # One that is gone gets them once it is back, after RESET.
        if member.state not in _IN_EPISODE:
            return
        for changed, _ in self._digests:
            if changed >= frame:
                self._send(member, changed, now)

    def _send(self, member: Member, frame: int, now: int) -> None:
        order = Geometry(**self._run.ids(member), frame=frame, assets=self.meshes_at(frame))
        self._run.send(member, order)
        awaited = _Awaited(frame, self.digest_at(frame), now)
        self._awaited.setdefault(member.name, deque()).append(awaited)

    def handle_done(self, member: Member, message: GeometryDone, now: int) -> bool:
        """Take GEOMETRY_DONE: whether it was waited for. Another digest than the worlds' ends the run."""
        run = self._run
        if not run.current(member, message.epoch, message.attempt, "GEOMETRY_DONE"):
            return False
        awaited = self._awaited.get(member.name)
        if message.episode < run.episode:
            return False  # the episode ended while it loaded them
        if message.episode != run.episode or not awaited or awaited[0].frame != message.frame:
            what = f"GEOMETRY_DONE for episode {message.episode} frame {message.frame}"
            run.stale(member, "GEOMETRY_DONE", what, awaited[0].frame if awaited else -1)
            return False
        expected = awaited.popleft().digest
        if not awaited:
            del self._awaited[member.name]
        if message.geometry != expected:
            text = (
                f"{member} holds geometry {message.geometry[:12] or 'none'}… for frame {message.frame}, the "
                f"worlds announced {expected[:12]}…; clear its asset cache and start it again"
            )
            run.send(member, Refuse(code=GEOMETRY, message=text))
            run.fail(text, member.name, now)
            return False
        return True

    def is_lacking(self, service: str, frame: int) -> bool:
        """Whether a service has yet to load the meshes of a frame."""
        awaited = self._awaited.get(service)
        return awaited is not None and any(order.frame <= frame for order in awaited)

    def awaited_since(self, member: Member) -> int | None:
        """Since when a service loads meshes that it was sent [ns]; None: it has all."""
        awaited = self._awaited.get(member.name)
        return awaited[0].since if awaited else None

    def used_by(self, member: Member, message: Done) -> str:
        """Digest of the geometry that an answer was made with, where that is not the frame's.

        Args:
            member: The service.
            message: Its DONE.
        """
        ready = member.ready
        used = message.geometry_digest or (ready.geometry if ready is not None else "")
        # A service without geometry says none, and a world holds its own files alone.
        if not used or member.role == "world":
            return ""
        return "" if used == self.digest_at(message.frame) else used

    def validate(self) -> None:
        """Check cross-field invariants; raises AssertionError naming the one that is broken."""
        for world, changes in self._changes.items():
            frames = [change.frame for change in changes]
            assert frames == sorted(set(frames)), f"meshes of {world} are out of order"
        for name in self._awaited:
            state = self._run.members[name].state
            assert state is not ServiceState.LEFT, f"{name} is to load meshes and has left"
