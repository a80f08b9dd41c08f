"""Coplanar faces of bodies that touch or overlap one another or scenery: one surface.

Two lorries side by side with flush walls, or a kiosk flush with a façade, reflect as one wall does. Taken
for two planes, a wave would be reflected by each where both overlap, and by the one or the other, at random,
where a ray meets what coincides. So in each frame such faces are joined: they have one number, by which
chains of planes go, and one id.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from caviar_protocol.arrays import BoolArray, Float64Array, Int64Array
from caviar_space.planes import PlaneTable
from caviar_space.vectors import cross, ranges

COPLANAR = 1e-5
"""[m]; faces are in one plane to this, and `COPLANAR_RELATIVE` of their coordinates: about what float32 tells
apart. One that stands farther behind another is hidden by it where they overlap."""

COPLANAR_RELATIVE = 1.2e-7

# [rad]; between the normals of coplanar faces, at most.
_ANGLE = 3e-5

# [m]; boxes around faces that are nearer touch.
_TOUCHING = 1e-3


@dataclass(frozen=True, eq=False)
class JoinedFaces:
    """The faces of a frame that are one surface."""

    label: Int64Array
    """Of each plane, the number of the surface that it is of: that of its first plane, Shape ``[P]``."""
    groups: tuple[Int64Array, ...] = ()
    """Planes of each surface that is more than one, in ascending order: those of scenery come first."""
    scenery: dict[int, int] = field(default_factory=dict)
    """By label, the first triangle of scenery that a face touches, for surfaces that scenery is a part of."""


class CoplanarFaces:
    """Finds the faces of bodies that are one surface with others.

    Args:
        table: Planes of scenery, and after them those of bodies, body after body.
        first: Number of the first plane of a body.
        sizes: How many planes each body has, Shape ``[V]``.
        two_sided: Of each plane of a body, whether both of its sides reflect, Shape ``[P − first]``; of
            others that face away from each other one at most is seen.
    """

    def __init__(self, table: PlaneTable, first: int, sizes: Int64Array, two_sided: BoolArray) -> None:
        self._table, self._first, self._sizes, self._two_sided = table, first, sizes, two_sided
        self._begin = first + np.cumsum(sizes) - sizes
        # Random weights: planes that differ hardly ever have the same sum. The seed is fixed, as is the
        # order.
        rng = np.random.default_rng(0)
        self._direction = rng.standard_normal(4)
        self._direction /= np.abs(self._direction).sum()
        self._reach = float(np.abs(table.origin[:first]).max(initial=1.0))
        still = np.flatnonzero((table.normal[:first] != 0).any(1))
        order = np.argsort(self._projected(still))
        self._still, self._keys = still[order], self._projected(still)[order]
        self.none = JoinedFaces(np.arange(len(table.normal)))

    def find(self) -> JoinedFaces:
        """Faces that are one surface as the table stands."""
        table = self._table
        moving = np.arange(self._first, len(table.normal))
        moving = moving[(table.normal[moving] != 0).any(1)]
        one, other = self._of_bodies()
        together = self._coplanar(one, other)
        one, other = one[together], other[together]
        body, still = self._with_scenery(moving)
        together = self._coplanar(body, still)
        body, still = body[together], still[together]
        triangle = self._touched(body, still)
        touching = triangle >= 0
        body, still, triangle = body[touching], still[touching], triangle[touching]
        if not len(one) + len(body):
            return self.none
        pairs = np.column_stack([np.append(other, still), np.append(one, body)])
        return self._joined(pairs, still, triangle)

    def _joined(self, pairs: Int64Array, still: Int64Array, triangle: Int64Array) -> JoinedFaces:
        """Surfaces of planes that are one, pair by pair, and the triangles of planes of scenery that these
        touch."""
        label = self.none.label.copy()
        members = np.unique(pairs)
        while True:
            # Labels spread along the pairs until none changes.
            least = np.minimum(label[pairs[:, 0]], label[pairs[:, 1]])
            before = label[members].copy()
            for side in (0, 1):
                np.minimum.at(label, pairs[:, side], least)
            if (label[members] == before).all():
                break
        groups = tuple(members[label[members] == first] for first in np.unique(label[members]))
        # Descending: of equal labels the dictionary keeps the last, the lowest triangle.
        order = np.argsort(-triangle)
        touched = dict(zip(label[still[order]].tolist(), triangle[order].tolist(), strict=True))
        return JoinedFaces(label, groups, touched)

    def _of_bodies(self) -> tuple[Int64Array, Int64Array]:
        """Planes of one body and of another whose boxes touch, that may be coplanar."""
        none = np.zeros(0, np.int64)
        if len(self._sizes) < 2:
            return none, none
        table, begin = self._table, self._begin - self._first
        flat = (table.normal[self._first :] != 0).any(1)[:, None]
        low = np.minimum.reduceat(np.where(flat, table.low[self._first :], np.inf), begin)
        high = np.maximum.reduceat(np.where(flat, table.high[self._first :], -np.inf), begin)
        some = np.flatnonzero(np.isfinite(low).all(1))
        # Sorted along x, only bodies whose extents overlap there are compared.
        some = some[np.argsort(low[some, 0], kind="stable")]
        last = np.searchsorted(low[some, 0], high[some, 0] + _TOUCHING, side="right")
        place, behind = ranges(np.arange(len(some)) + 1, np.maximum(last - np.arange(len(some)) - 1, 0))
        one, other = some[place], some[behind]
        touch = ((low[one] <= high[other] + _TOUCHING) & (low[other] <= high[one] + _TOUCHING)).all(1)
        one, other = one[touch], other[touch]
        if not len(one):
            return none, none
        pair, first = ranges(self._begin[one], self._sizes[one])
        row, second = ranges(self._begin[other[pair]], self._sizes[other[pair]])
        one, other = first[row], second
        touch = (
            (table.low[one] <= table.high[other] + _TOUCHING)
            & (table.low[other] <= table.high[one] + _TOUCHING)
        ).all(1)
        one, other = one[touch], other[touch]
        same = np.einsum("nc,nc->n", table.normal[one], table.normal[other])
        seen = (same > 0) | self._two_sided[one - self._first] | self._two_sided[other - self._first]
        kept = seen & (np.abs(same) > 0.5)
        return one[kept], other[kept]

    def _with_scenery(self, moving: Int64Array) -> tuple[Int64Array, Int64Array]:
        """Planes of bodies and of scenery whose normals and offsets agree, about."""
        reach = 2.0 * _ANGLE
        found = [np.zeros((0, 2), np.int64)]
        for sign in (1.0, -1.0):
            key = sign * self._projected(moving)
            first = np.searchsorted(self._keys, key - reach)
            own, place = ranges(first, np.searchsorted(self._keys, key + reach, side="right") - first)
            found.append(np.column_stack([moving[own], self._still[place]]))
        body, still = np.concatenate(found).T
        table = self._table
        touch = (
            (table.low[body] <= table.high[still] + _TOUCHING)
            & (table.low[still] <= table.high[body] + _TOUCHING)
        ).all(1)
        return body[touch], still[touch]

    def _projected(self, planes: Int64Array) -> Float64Array:
        """Normals and offsets of planes as one number each, of opposite sign for the opposite normal: what
        hardly differs stands near in the order of these."""
        normal = self._table.normal[planes]
        offset = np.einsum("nc,nc->n", normal, self._table.origin[planes]) / self._reach
        projected: Float64Array = normal @ self._direction[:3] + offset * self._direction[3]
        return projected

    def _touched(self, body: Int64Array, still: Int64Array) -> Int64Array:
        """Of pairs of planes, the first triangle of scenery whose box the body's face touches; −1: none."""
        triangles, sizes = self._table.triangles_of(still)
        own = np.repeat(np.arange(len(still)), sizes)
        corners = self._table.corners_of(triangles)
        plane = body[own]
        touch = (corners.min(1) <= self._table.high[plane] + _TOUCHING) & (
            self._table.low[plane] <= corners.max(1) + _TOUCHING
        )
        hits = touch.all(1)
        found = np.full(len(body), np.iinfo(np.int64).max)
        np.minimum.at(found, own[hits], triangles[hits])
        return np.where(found < np.iinfo(np.int64).max, found, -1)

    def _coplanar(self, one: Int64Array, other: Int64Array) -> BoolArray:
        """Of pairs of planes, whether all corners of the one are in the other."""
        if not len(one):
            return np.zeros(0, np.bool_)
        table = self._table
        across = np.abs(cross(table.normal[one], table.normal[other])).max(1)
        within: BoolArray = across <= _ANGLE
        rows = np.flatnonzero(within)
        triangles, sizes = table.triangles_of(one[rows])
        own = np.repeat(rows, sizes)
        places = table.corners_of(triangles)
        height = np.einsum("ntc,nc->nt", places - table.origin[other[own]][:, None], table.normal[other[own]])
        slack = COPLANAR + COPLANAR_RELATIVE * np.abs(places).max((1, 2))
        off = np.abs(height).max(1) > slack
        within[own[off]] = False
        return within
