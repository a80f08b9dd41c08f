"""Chains that are followed from frame to frame, so that a frame need not launch all rays.

What takes longest is to find out which planes a transmitter's rays go along; from one frame to the next that
hardly changes. So each frame launches a part of the rays, and offers the receivers what any of the
last launches met: the image method and the test for occlusion, with everything where it is now, decide
which of that is a path. No two launches are quite the same, so that in time they meet what no single one of
them would.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Literal, cast

import msgspec
import numpy as np

from caviar_protocol.arrays import BoolArray, Float64Array, Int64Array, UInt64Array
from caviar_protocol.codec import decode_payload, encode_payload
from caviar_protocol.topics import Scene
from caviar_services.channel.sionna import mi
from caviar_services.channel.sionna.candidates import MANY_RAYS, Candidates, Chains, Met, Offer, chains_of
from caviar_services.channel.sionna.ray_launcher import (
    REFLECTED,
    REFRACTED,
    Bounce,
    Launch,
    LaunchOptions,
    PartedLauncher,
    scattered_of,
)
from caviar_services.channel.sionna.scene import SionnaScene
from caviar_services.checkpoint import Packed
from caviar_services.drjit_setup import aligned_columns, aligned_indices, positions
from caviar_space.vectors import Rows

# [m] A transmitter that has moved farther since the frame before is looked for anew.
_JUMP = 20.0

# Steps by which rays on moving objects are widened to both sides: seven rays beside each.
_BESIDE = (1, 2, 4)

# Rounds of launches after which a chain that none of them met is forgotten.
_KEPT = 5


@dataclass(frozen=True, eq=False)
class _Table(Rows):
    """K chains of at most D interactions, with the triangles that some ray met."""

    depth: Int64Array
    """Shape ``[K]``."""
    kind: Int64Array
    """Flag of each interaction, 0 past the last, Shape ``[K, D]``."""
    triangle: Int64Array
    """Number of the triangle, through all shapes, Shape ``[K, D]``."""
    probability: Float64Array
    """That this kind of interaction was drawn, Shape ``[K, D]``."""
    seen: Int64Array
    """Number of the last launch that met it, Shape ``[K]``."""


# Of each column, the type of its numbers in a saved state and in a table.
_STORED: dict[str, tuple[Literal["<f8", "<i8", "<i4"], type[np.generic]]] = {
    "depth": ("<i4", np.int64),
    "kind": ("<i4", np.int64),
    "triangle": ("<i4", np.int64),
    "probability": ("<f8", np.float64),
    "seen": ("<i8", np.int64),
}


class TableState(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Chains in a saved state; the columns are those of a table."""

    depth: Packed
    kind: Packed
    triangle: Packed
    probability: Packed
    seen: Packed

    @classmethod
    def of(cls, table: _Table) -> TableState:
        """The state of a table.

        Args:
            table: The chains.
        """
        return cls(**{name: Packed.of(getattr(table, name), kind) for name, (kind, _) in _STORED.items()})

    def table(self) -> _Table:
        """The table."""
        return _Table(**{name: getattr(self, name).array(kind) for name, (_, kind) in _STORED.items()})


class FollowedState(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A `Followed` between two frames."""

    number: int
    known: TableState | None
    names: tuple[str, ...]
    came_from: Packed
    rays: int
    """Of a launch; 0 before the first."""
    on_object: Packed
    """Numbers of those that met a moving object."""


class Followed:
    """The chains of one transmitter, from the beginning of an episode on.

    The first frame launches all rays, and so does one in which the transmitter has jumped. All others launch
    every ``parts``-th of them, in turn, and those on or beside moving objects: there paths come and go.

    Args:
        parts: Launches until every ray was launched once.
    """

    def __init__(self, parts: int) -> None:
        self._parts = parts
        self._number = 0
        self._known: _Table | None = None
        self._names: tuple[str, ...] = ()
        # Where the last launch came from [m].
        self._from = np.zeros(3)
        # Which rays met a moving object when they were launched last.
        self._on_object: BoolArray = np.zeros(0, np.bool_)

    @property
    def state(self) -> FollowedState:
        """All that the chains of the next frame follow from, beside its scene."""
        return FollowedState(
            number=self._number,
            known=None if self._known is None else TableState.of(self._known),
            names=self._names,
            came_from=Packed.of(self._from, "<f8"),
            rays=len(self._on_object),
            on_object=Packed.of(np.flatnonzero(self._on_object), "<i4"),
        )

    @classmethod
    def resumed(cls, parts: int, state: FollowedState) -> Followed:
        """The chains of a saved state.

        Args:
            parts: As for the class.
            state: Of `state`.
        """
        made = cls(parts)
        made._number, made._names = state.number, state.names
        made._known = None if state.known is None else state.known.table()
        made._from = state.came_from.array(np.float64)
        made._on_object = np.zeros(state.rays, np.bool_)
        made._on_object[state.on_object.array(np.int64)] = True
        return made

    def offer(
        self,
        launcher: PartedLauncher,
        transmitter: Float64Array,
        scene: SionnaScene,
        names: tuple[str, ...],
        options: LaunchOptions,
    ) -> Offer:
        """Launch a part of the rays, and offer what the last launches met.

        Args:
            launcher: Of all rays.
            transmitter: Where it is, relative to the scene's centre [m], Shape ``[3]``.
            scene: As it stands in the frame.
            names: What `SionnaScene.place` returned for the frame.
            options: What is launched.
        """
        jumped = self._known is not None and np.linalg.norm(transmitter - self._from) > _JUMP
        known, number, source = None if jumped else self._known, self._number, positions(transmitter[None])
        # Nothing is known at the beginning, nor where the transmitter has jumped: then all rays are launched.
        rays = None if known is None else self._rays(number)
        if rays is None:
            self._on_object = np.zeros(options.samples, np.bool_)

        def look(some: Int64Array, launch: Launch) -> _Table:
            self._on_object[some] = _on_object(launch, scene, len(some))
            return _met(launch, chains_of(launch, scene, options.max_depth), scene, number)

        met, *others = launcher.each(look, source, rays, number)
        for other in others:
            met = _Table.joined([met, other.take(~np.isin(_keys(other, scene), _keys(met, scene)))])
        if known is not None:
            triangle = scene.moved_triangles(known.triangle, self._names, names)
            recent = known.seen > number - _KEPT * self._parts
            known = replace(known, triangle=triangle).take((triangle >= 0).all(1) & recent)
            met = _Table.joined([met, known.take(~np.isin(_keys(known, scene), _keys(met, scene)))])
        self._known, self._names, self._number, self._from = met, names, number + 1, transmitter
        return FollowedOffer(met, scene, source, options)

    def _rays(self, number: int) -> Int64Array:
        """Numbers of the rays of a part, and of those on or beside moving objects."""
        chosen = self._on_object.copy()
        # Neighbours in the lattice's order point into neighbouring directions.
        for shift in _BESIDE:
            chosen[shift:] |= chosen[:-shift].copy()
            chosen[:-shift] |= chosen[shift:].copy()
        # Every part-th ray, another one in each frame: after so many frames all have been launched.
        chosen[number % self._parts :: self._parts] = True
        return np.flatnonzero(chosen)


class FollowedOffer(Offer):
    """Known chains in place of those of a launch.

    Args:
        table: The chains.
        scene: As it stands.
        source: The transmitter, a `mitsuba.Point3f` of width 1.
        options: What is traced.
    """

    @classmethod
    def again(
        cls, state: TableState, transmitter: Float64Array, scene: SionnaScene, options: LaunchOptions
    ) -> FollowedOffer:
        """Offer from a position when the scene was as it is now.

        Args:
            state: The chains.
            transmitter: Relative to the scene's centre [m], Shape ``[3]``.
            scene, options: As for the class.
        """
        return cls(state.table(), scene, positions(transmitter[None]), options)

    @property
    def state(self) -> TableState:
        """Chains on offer."""
        return TableState.of(self._table)

    def __init__(self, table: _Table, scene: SionnaScene, source: Any, options: LaunchOptions) -> None:
        straight = (table.kind == 0) | (table.kind == REFLECTED) | (table.kind == REFRACTED)
        planes = _planes(table, scene).astype(np.int32)
        count = len(table.depth)
        chains = Chains(np.arange(count), table.depth, planes, straight.all(1), np.full(count, MANY_RAYS))
        nothing = Launch((), None)
        super().__init__(scene, Met(nothing, chains, scattered_of(nothing)), source, options)
        self._scene, self._table = scene, table

    def candidates(self, targets: Any, count: int) -> tuple[Candidates, Launch, int]:
        """As `Offer.candidates`, with a launch that has one ray for each candidate.

        Args:
            targets, count: See `Offer.candidates`.
        """
        found, _, lost = super().candidates(targets, count)
        return replace(found, ray=np.arange(len(found.ray))), self._launch_of(found.ray), lost

    def _launch_of(self, chains: Int64Array) -> Launch:
        """Rays that met what these of the chains on offer meet."""
        if not len(self._table.depth):
            return Launch((), None)
        table = self._table.take(chains)
        bounces = []
        for d in range(table.kind.shape[1]):
            shape, primitive = self._scene.shapes_of(table.triangle[:, d])
            # The image method mirrors at the plane through this point, which has moved with its object.
            corner = self._scene.planes(shape, primitive)[0] - self._scene.centre
            point, probability = aligned_columns(corner.T), aligned_columns(table.probability[None, :, d])
            bounces.append(
                Bounce(
                    kind=mi.UInt(aligned_indices(table.kind[:, d])),
                    shape=mi.UInt(aligned_indices(shape)),
                    primitive=mi.UInt(aligned_indices(primitive)),
                    point=mi.Point3f(*map(mi.Float, point)),
                    normal=None,
                    probability=mi.Float(probability[0]),
                )
            )
        return Launch(tuple(bounces), None)


def _on_object(launch: Launch, scene: SionnaScene, rays: int) -> BoolArray:
    """Mask of so many rays that met a moving object, in any pass."""
    met = np.zeros(rays, np.bool_)
    for bounce in launch.bounces:
        on_body = (bounce.kind.numpy() != 0) & scene.is_body(bounce.shape.numpy())
        met |= on_body.reshape(-1, rays).any(0)
    return met


def _met(launch: Launch, chains: Chains, scene: SionnaScene, number: int) -> _Table:
    """The chains of a launch, with one ray's interactions."""
    count, depth = chains.planes.shape
    kind, triangle = np.zeros((count, depth), np.int64), np.zeros((count, depth), np.int64)
    probability = np.zeros((count, depth))
    for d, bounce in enumerate(launch.bounces):
        used = chains.depth > d
        rays = chains.ray[used]
        kind[used, d] = bounce.kind.numpy()[rays]
        shape, primitive = bounce.shape.numpy()[rays], bounce.primitive.numpy()[rays]
        triangle[used, d] = scene.triangle_numbers(shape.astype(np.int64), primitive.astype(np.int64))
        probability[used, d] = bounce.probability.numpy()[rays]
    return _Table(chains.depth, kind, triangle, probability, np.full(count, number, np.int64))


def _planes(table: _Table, scene: SionnaScene) -> Int64Array:
    """Plane of each interaction that is a reflection, −1 elsewhere, Shape ``[K, D]``."""
    return np.where(table.kind == REFLECTED, scene.surface_of[table.triangle], -1)


def _keys(table: _Table, scene: SionnaScene) -> UInt64Array:
    """Keys that tell chains apart, one number each: the kinds of their interactions and reflecting planes."""
    keys = np.zeros(len(table.depth), np.uint64)
    for kind, plane in zip(table.kind.T, _planes(table, scene).T, strict=True):
        keys ^= (kind + 16 * (plane + 1)).astype(np.uint64)
        # Finaliser of SplitMix64 (Steele, Lea, Flood 2014): a bijection that spreads every bit.
        keys = (keys ^ (keys >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
        keys = (keys ^ (keys >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
        keys += np.uint64(0x9E3779B97F4A7C15)
    return keys


class FollowingState(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """State of all that is followed; empty where each frame stands on its own."""

    followed: dict[str, FollowedState] = {}
    """By transmitter."""
    scene: tuple[bytes, bytes] | None = None
    """That the bodies stand in, header and body; None: they have been moved since."""
    offers: tuple[tuple[bytes, TableState], ...] = ()
    """What is on offer while nothing moves, and the position that it was launched from; oldest first."""


class Following:
    """The chains of all transmitters of a channel.

    Args:
        parts: Launches until every ray was launched once.
        scene: Of the channel. Other channels may move the bodies of the same scene.
        without_body: Classes of objects that have no body.
    """

    def __init__(self, parts: int, scene: SionnaScene, without_body: frozenset[str]) -> None:
        self._parts, self._scene, self._without_body = parts, scene, without_body
        self._followed: dict[str, Followed] = {}
        # What the bodies were moved to last, with the version that the scene then had.
        self._placed: tuple[Scene, int] | None = None

    def clear(self) -> None:
        """Know nothing, as at the beginning of an episode."""
        self._followed.clear()
        self._placed = None

    def chains_from(self, transmitter: str) -> Followed:
        """The chains of a transmitter.

        Args:
            transmitter: Its name.
        """
        return self._followed.setdefault(transmitter, Followed(self._parts))

    def place(self, scene: Scene) -> tuple[tuple[str, ...], Float64Array]:
        """Move the bodies; see `SionnaScene.place`.

        Args:
            scene: The scene of a frame.
        """
        placed = self._scene.place(scene, self._without_body)
        self._placed = scene, self._scene.version
        return placed

    def state(self, offers: tuple[tuple[bytes, TableState], ...]) -> FollowingState:
        """All that the next frame's chains follow from, beside its scene.

        Args:
            offers: Of the tracer.
        """
        followed = {name: one.state for name, one in self._followed.items()}
        if self._placed is None or self._placed[1] != self._scene.version:
            return FollowingState(followed=followed)
        return FollowingState(followed=followed, scene=encode_payload(self._placed[0]), offers=offers)

    def resume(self, state: FollowingState) -> None:
        """Take over a state; the tracer is then to offer what it says again.

        Args:
            state: Of another channel with the same settings.
        """
        self._followed = {name: Followed.resumed(self._parts, one) for name, one in state.followed.items()}
        if state.scene is not None:
            self.place(cast(Scene, decode_payload("scene", *state.scene)))
