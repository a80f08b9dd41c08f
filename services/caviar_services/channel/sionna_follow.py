"""Chains that are followed from frame to frame, so that a frame need not launch all rays.

What takes a transmitter's rays longest is to find out which planes reflect to whom; from one frame to the next
that hardly changes. So each frame launches a part of the rays, and offers the receivers what any of the
last launches met: the image method and the test for occlusion, with everything where it is now, decide
which of that is a path. New paths are found within one round of launches, those of large planes at once.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from caviar_protocol.arrays import BoolArray, Float64Array, Int64Array, UInt64Array
from caviar_services.channel.sionna_candidates import Chains, chains_of
from caviar_services.channel.sionna_launch import REFLECTED, REFRACTED, Bounce, Launch, Launcher
from caviar_services.channel.sionna_scene import SionnaScene
from caviar_services.columns import aligned_columns, aligned_indices

_KEPT = 5
"""Rounds of launches after which a chain that none of them met is forgotten."""


@dataclass(frozen=True, eq=False)
class _Table:
    """K chains of at most D interactions, with the interactions of a ray that went along each."""

    depth: Int64Array
    """Shape ``[K]``."""
    kind: Int64Array
    """Flag of each interaction, 0 behind the last, Shape ``[K, D]``."""
    triangle: Int64Array
    """Number of the triangle that was met, through all shapes, Shape ``[K, D]``."""
    probability: Float64Array
    """That this kind of interaction was drawn, Shape ``[K, D]``."""
    seen: Int64Array
    """Number of the last launch that met it, Shape ``[K]``."""

    def take(self, which: BoolArray | Int64Array) -> _Table:
        """These chains."""
        return _Table(
            self.depth[which],
            self.kind[which],
            self.triangle[which],
            self.probability[which],
            self.seen[which],
        )

    def with_those(self, other: _Table) -> _Table:
        """These chains and others."""
        return _Table(
            *(
                np.concatenate([getattr(self, name), getattr(other, name)])
                for name in ("depth", "kind", "triangle", "probability", "seen")
            )
        )


class Followed:
    """The chains of one transmitter, from the beginning of an episode on.

    The first frame launches all rays. After that, each launches every ``parts``-th of them, in turn, and what
    ``parts`` launches in a row have not met is forgotten.

    Parameters
    ----------
    parts
        Launches until every ray was launched once.
    """

    def __init__(self, parts: int) -> None:
        self._parts = parts
        self._number = 0
        self._known: _Table | None = None
        self._names: tuple[str, ...] = ()

    def step(
        self, launcher: Launcher, source: Any, scene: SionnaScene, names: tuple[str, ...]
    ) -> tuple[Launch, Chains]:
        """What there is to offer to the receivers of the next frame; ``names`` is what `SionnaScene.place`
        returned for it."""
        known = self._known
        part = (0, 1) if known is None else (self._number % self._parts, self._parts)
        launch = launcher(source, part)
        chains = chains_of(launch, scene)
        met = _met(launch, chains, scene, self._number)
        if known is not None:
            triangle = scene.moved_triangles(known.triangle, self._names, names)
            known = _Table(
                known.depth, known.kind, triangle, known.probability, known.seen
            ).take((triangle >= 0).all(1) & (known.seen > self._number - _KEPT * self._parts))
            met = met.with_those(known.take(~np.isin(_keys(known, scene), _keys(met, scene))))
        self._known, self._names, self._number = met, names, self._number + 1
        offered = _for_all_alike(met, scene)
        return _as_launch(offered, scene), _as_chains(offered, scene)


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


def _for_all_alike(table: _Table, scene: SionnaScene) -> _Table:
    """These chains, and those with one moving object in them for all others with the same mesh.

    What one car reflects to whom, another will where it drives next: nobody has to be found twice.
    """
    moving = scene.is_of_body(table.triangle) & (table.kind != 0)
    single = np.flatnonzero(moving.sum(1) == 1)
    if not len(single):
        return table
    where = moving[single].argmax(1)
    which, triangle = scene.twins(table.triangle[single, where])
    twins = table.take(single[which])
    twins.triangle[np.arange(len(which)), where[which]] = triangle
    both = twins.with_those(table.take(np.flatnonzero(moving.sum(1) != 1)))
    _, first = np.unique(_keys(both, scene), return_index=True)
    return both.take(np.sort(first))


def _planes(table: _Table, scene: SionnaScene) -> Int64Array:
    """Plane of each interaction that is a reflection, −1 elsewhere, Shape ``[K, D]``."""
    return np.where(table.kind == REFLECTED, scene.plane_of[table.triangle], -1)


def _keys(table: _Table, scene: SionnaScene) -> UInt64Array:
    """What tells chains apart, as one number each: the kinds of their interactions and reflecting planes."""
    keys = np.zeros(len(table.depth), np.uint64)
    for kind, plane in zip(table.kind.T, _planes(table, scene).T, strict=True):
        keys ^= (kind + 16 * (plane + 1)).astype(np.uint64)
        # Finaliser of SplitMix64 (Steele, Lea, Flood 2014): a bijection that spreads every bit.
        keys = (keys ^ (keys >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
        keys = (keys ^ (keys >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
        keys += np.uint64(0x9E3779B97F4A7C15)
    return keys


def _as_launch(table: _Table, scene: SionnaScene) -> Launch:
    """A launch whose rays are these chains, one each."""
    import mitsuba as mi

    bounces = []
    for d in range(table.kind.shape[1]):
        shape, primitive = scene.shapes_of(table.triangle[:, d])
        # The image method mirrors at the plane through this point, which has moved with its object.
        corner, _ = scene.planes(shape, primitive)
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


def _as_chains(table: _Table, scene: SionnaScene) -> Chains:
    specular = (table.kind == 0) | (table.kind == REFLECTED) | (table.kind == REFRACTED)
    return Chains(
        ray=np.arange(len(table.depth)),
        depth=table.depth,
        planes=_planes(table, scene).astype(np.int32),
        straight=specular.all(1),
    )
