"""Where waves end at edges: which of them there are beside the diffracted ones that make up for them.

Where a line of sight or a reflection ends at an edge, the diffracted field changes its sign, so that the sum
of both is continuous. That holds only if both go by one decision. A ray tracer in float32 decides about
lines of sight to some micrometres, and about reflections to a millimetre.

So the diffracted field's own angles, in float64, decide about lines of sight that pass an edge within
`_UNSURE`; about other waves there, it goes by what the ray tracer has decided.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from caviar_protocol.arrays import BoolArray, Float64Array, Int64Array, UInt8Array
from caviar_protocol.topics import Interaction
from caviar_services.channel.propagation.utd import IN_PLANE, Bends

_UNSURE = 2e-3
"""[m]; farther from an edge, a wave is there or not as the ray tracer says."""

_GRAZING = 1e-3
"""Sine of the angle to a face below which no reflection is traced that could end."""


@dataclass(frozen=True, eq=False)
class Chains:
    """What P paths meet."""

    pair: Int64Array
    """Shape ``[P]``."""
    types: UInt8Array
    """`Interaction` of each point, Shape ``[P, D]``."""
    planes: Int64Array
    """Plane that is met there, Shape ``[P, D]``; anything at an edge."""

    def key(self, path: int) -> tuple[tuple[int, int], ...]:
        """Type and plane of each interaction of a path."""
        met = zip(self.types[path].tolist(), self.planes[path].tolist(), strict=True)
        return tuple((kind, plane) for kind, plane in met if kind)


@dataclass(frozen=True)
class Sight:
    """The line of sight of a pair that passes edges closely."""

    lit: bool
    """Whether it does so on the lit side of each."""
    passed: frozenset[int]
    """The planes of their faces."""


def waves_beside(
    bends: Bends, faces: Int64Array, bent: Int64Array, chains: Chains
) -> tuple[Int64Array, dict[int, Sight]]:
    """Which of the waves there are that end near diffracted paths.

    Parameters
    ----------
    bends
        Of B diffracted paths.
    faces
        Planes of the two faces that each goes over, Shape ``[B, 2]``.
    bent
        Which of all paths these are, Shape ``[B]``.
    chains
        Of all paths; those of pair −1 count for none.

    Returns
    -------
    ``lit`` of `edge_fields`, Shape ``[B, 3]``, and the lines of sight that pass edges closely, by pair.
    """
    margins = bends.margins
    lit = np.zeros(margins.shape, np.int64)
    sights: dict[int, Sight] = {}
    near = np.abs(margins) * bends.spread[:, None] < _UNSURE
    near[:, 1:] &= _steep(bends)
    rows, waves = np.nonzero(near)
    if not len(rows):
        return lit, sights
    same = np.flatnonzero(np.isin(chains.pair, chains.pair[bent[rows]]))
    there = {(int(chains.pair[path]), chains.key(path)) for path in same.tolist()}
    for row, wave in zip(rows.tolist(), waves.tolist(), strict=True):
        path = int(bent[row])
        pair = int(chains.pair[path])
        key = _without_edge(chains.key(path), None if wave == 0 else int(faces[row, wave - 1]))
        if key:
            lit[row, wave] = 1 if (pair, key) in there else -1
        elif pair >= 0:
            before = sights.get(pair, Sight(True, frozenset()))
            passes = before.lit and bool(margins[row, 0] > -IN_PLANE)
            sights[pair] = Sight(passes, before.passed | set(faces[row].tolist()))
    return lit, sights


def _steep(bends: Bends) -> BoolArray:
    """Which of both faces, as they were given, rays do not merely graze, Shape ``[B, 2]``."""
    met = np.abs((bends.faces.normals * bends.k[:, None]).sum(-1)) > _GRAZING
    steep: BoolArray = np.where(bends.swapped[:, None], met[:, ::-1], met)
    return steep


def _without_edge(key: Sequence[tuple[int, int]], face: int | None) -> tuple[tuple[int, int], ...]:
    """The chain with a reflection at a face in place of the edge, or with nothing."""
    instead = [] if face is None else [(int(Interaction.REFLECTION), face)]
    bent = next(d for d, (kind, _) in enumerate(key) if kind == Interaction.DIFFRACTION)
    return (*key[:bent], *instead, *key[bent + 1 :])


def beyond_edges(points: Float64Array, ends: Float64Array) -> BoolArray:
    """Which points [m], Shape ``[B, 3]``, on the lines of edges ``[B, 2, 3]`` are beyond their ends.

    An edge has its first end and not its last one, so that of two in one line one has the place between.
    """
    line = ends[:, 1] - ends[:, 0]
    along = ((points - ends[:, 0]) * line).sum(1)
    beyond: BoolArray = (along < 0) | (along >= (line**2).sum(1))
    return beyond
