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
from caviar_services.channel.enumeration.beam_ends import (
    SceneryViews,
    ends_at,
    ends_by_bodies,
    ends_by_scenery,
)
from caviar_services.channel.enumeration.image_beams import (
    Beams,
    Targets,
    first_beams,
    next_beams,
    scenery_beams,
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


def chain_pairs(
    targets: Targets,
    scenery: Int64Array,
    views: SceneryViews,
    transmitter: Float64Array,
    receivers: Float64Array,
) -> ChainPairs:
    """All pairs of a chain and a receiver that it may be a path to: no reflection, chains of scenery alone,
    and chains with a face of a body.

    Parameters
    ----------
    targets
        Faces of scenery, and behind them of bodies, body after body.
    scenery
        Chains of scenery alone that waves from the transmitter go along, with the beginnings of each, as
        faces, −1 behind the last, Shape ``[K, D]``.
    views
        Of all faces of these chains.
    transmitter
        [m], Shape ``[3]``.
    receivers
        [m], Shape ``[R, 3]``.
    """
    depth = scenery.shape[1]
    every = np.arange(len(receivers))
    found = [(np.zeros((len(receivers), 0), np.int64), every)]
    if not (depth and len(targets.faces) and len(receivers)):
        return ChainPairs.joined(found, depth)
    length = (scenery >= 0).sum(1)

    def add(beams: Beams) -> None:
        if len(beams):
            beam, receiver = ends_at(targets, beams, receivers)
            found.append((beams.chain[beam], receiver))

    beams = first_beams(targets, transmitter, scenery[length == 1, 0])
    add(beams)
    for n in range(2, depth):
        if len(beams):
            beams = next_beams(targets, beams, views.faces, scenery[length == n, :n])
            add(beams)
    if depth > 1 and len(beams):
        # The last reflection needs no beams of its own: its faces are held against the receivers at once.
        add(scenery_beams(targets, beams, scenery[length == depth]))
        for beam, face, receiver in (
            ends_by_scenery(targets, beams, receivers, views),
            ends_by_bodies(targets, beams, receivers),
        ):
            found.append((np.concatenate([beams.chain[beam], face[:, None]], axis=1), receiver))
    return ChainPairs.joined(found, depth)
