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
    ends_at,
    first_beams,
    next_beams,
    through_bodies,
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
    none = np.full(len(receivers), -1)
    beams = first_beams(targets, transmitter, scenery[length == 1, 0])
    found: list[tuple[Int64Array, Int64Array]] = []
    # A chain of one face begins with none: only it needs no beam before the face of the body.
    beam, receiver = ends_at(targets, beams, receivers, none)
    found.append((beams.chain[beam], receiver))
    for n in range(1, depth):
        if n > 1:
            beams = next_beams(targets, beams, used, scenery[length == n, :n])
            beam, receiver = ends_at(targets, beams, receivers, none)
            found.append((beams.chain[beam], receiver))
    if depth > 1:
        images, mirrors = _images(faces, receivers, used)
        beam, point = ends_at(targets, beams, images, mirrors)
        found.append((_longer(beams.chain[beam], mirrors[point]), point // max(len(used), 1)))
        beam, face, receiver = through_bodies(targets, beams, receivers)
        found.append((_longer(beams.chain[beam], face), receiver))
    return ChainPairs.joined(found, depth)


def _images(
    faces: FaceRectangles, points: Float64Array, mirrors: Int64Array
) -> tuple[Float64Array, Int64Array]:
    """Images of all points in all of some faces, point after point, and the face of each."""
    which = np.tile(mirrors, len(points))
    return faces.mirrored(np.repeat(points, len(mirrors), axis=0), which), which


def _longer(chain: Int64Array, face: Int64Array) -> Int64Array:
    return np.concatenate([chain, face[:, None]], axis=1)
