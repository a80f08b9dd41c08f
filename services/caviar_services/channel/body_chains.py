"""Chains of reflections with faces of moving bodies, enumerated, and the receivers they may end at.

Where bodies are small, rays rarely meet them, so a launch misses most chains by way of them. Here every
sequence of faces is a candidate that has a face of a body in it; what beams cannot reach is left out
(`image_beams`). Of B, a face of a body, and S, one of scenery, that is to a depth of three: B, SB, BS, BB,
SSB, SBS, SBB, BSS, BSB, BBS and BBB.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from caviar_protocol.arrays import Float64Array, Int64Array
from caviar_services.channel.face_rectangles import FaceRectangles
from caviar_services.channel.image_beams import (
    Targets,
    by_scenery,
    ends_at,
    first_beams,
    lit_bodies,
    next_beams,
    through_faces,
)


@dataclass(frozen=True, eq=False)
class ChainPairs:
    """N pairs of a chain and a receiver."""

    chain: Int64Array
    """Faces, −1 behind the last, Shape ``[N, D]``."""
    receiver: Int64Array
    """Shape ``[N]``."""

    @classmethod
    def joined(cls, parts: list[tuple[Int64Array, Int64Array]], depth: int) -> ChainPairs:
        """Of chains of any length up to ``depth``."""
        chains = [np.full((0, depth), -1, np.int64)]
        chains += [
            np.pad(chain, ((0, 0), (0, depth - chain.shape[1])), constant_values=-1) for chain, _ in parts
        ]
        receivers = [np.zeros(0, np.int64), *(receiver for _, receiver in parts)]
        return cls(np.concatenate(chains), np.concatenate(receivers))


def body_chains(
    faces: FaceRectangles,
    sizes: Int64Array,
    scenery: Int64Array,
    transmitter: Float64Array,
    receivers: Float64Array,
) -> ChainPairs:
    """All pairs of a chain with a face of a body and a receiver that it may be a path to.

    Parameters
    ----------
    faces
        Of scenery, and behind them of bodies, body after body.
    sizes
        How many of the last ones each body has, Shape ``[V]``.
    scenery
        Chains of scenery alone that waves from the transmitter go along, with the beginnings of each, as
        faces, −1 behind the last, Shape ``[K, D]``.
    transmitter
        [m], Shape ``[3]``.
    receivers
        [m], Shape ``[R, 3]``.
    """
    depth = scenery.shape[1]
    if not (depth and len(sizes) and len(receivers)):
        return ChainPairs.joined([], depth)
    targets = Targets(faces, sizes)
    used = np.unique(scenery[scenery >= 0])
    length = (scenery >= 0).sum(1)
    beams = first_beams(targets, transmitter, scenery[length == 1, 0])
    beam, receiver = ends_at(targets, beams, receivers)
    found = [(beams.chain[beam], receiver)]
    for n in range(2, depth):
        beams = next_beams(targets, beams, used, scenery[length == n, :n])
        beam, receiver = ends_at(targets, beams, receivers)
        found.append((beams.chain[beam], receiver))
    if depth > 1:
        # The last reflection needs no beams of its own: its faces are held against the receivers at once.
        last = (by_scenery(targets, beams, used), True), (lit_bodies(targets, beams), False)
        for ways, large in last:
            beam, face, receiver = through_faces(targets, beams, ways, receivers, large=large)
            found.append((np.concatenate([beams.chain[beam], face[:, None]], axis=1), receiver))
    return ChainPairs.joined(found, depth)
