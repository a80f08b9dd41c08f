"""Interaction points of specular paths in float64, by the image method.

A ray tracer's points are float32: some 1e-5 m at 100 m, which is 0.01 rad of phase at 60 GHz and grows with
the coordinates. Which surfaces a path meets is known exactly, so its points can be computed again.
"""

from __future__ import annotations

import numpy as np

from caviar_protocol.arrays import BoolArray, Float64Array, UInt8Array
from caviar_protocol.topics import Interaction

_FARTHEST_CORRECTION = 0.05
"""[m]; a point that would move more is at a grazing plane and stays as traced."""


def refined_points(
    start: Float64Array,
    points: Float64Array,
    end: Float64Array,
    types: UInt8Array,
    plane: tuple[Float64Array, Float64Array],
) -> Float64Array:
    """Points of the paths start → points → end, those of purely specular paths computed anew.

    Parameters
    ----------
    start, end
        TX and RX position [m], Shape ``[P, 3]``.
    points
        Traced points [m], Shape ``[P, D, 3]``.
    types
        `Interaction` at each, Shape ``[P, D]``. Paths with diffraction or scattering stay as they are.
    plane
        A point [m] of the plane at each interaction and its normal of any length, each of Shape
        ``[P, D, 3]``.

    Notes
    -----
    The transmitter is mirrored at one plane after the other; from the receiver, the line to the last
    image meets the last plane at the last point, and so on back. Transmission does not bend a path.
    """
    specular = ((types == 0) | (types == Interaction.REFLECTION) | (types == Interaction.TRANSMISSION)).all(1)
    some = np.flatnonzero(specular & (types != 0).any(1))
    if not len(some):
        return points
    found = image_points(start[some], end[some], types[some], plane[0][some], plane[1][some])
    shift = np.abs(found - points[some]).max(-1)
    good: BoolArray = ((shift < _FARTHEST_CORRECTION) | (types[some] == 0)).all(1)
    refined = points.copy()
    refined[some[good]] = found[good]
    return refined


def image_points(
    start: Float64Array, end: Float64Array, types: UInt8Array, origin: Float64Array, normal: Float64Array
) -> Float64Array:
    """Points where paths start → end meet their planes, Shape ``[P, D, 3]``; 0 where ``types`` is.

    The parameters are those of `refined_points`, with the plane in two. Not finite at a plane seen edge-on.
    """
    depth = types.shape[1]
    images = [start]
    for d in range(depth):
        offset = ((images[-1] - origin[:, d]) * normal[:, d]).sum(-1) / _squared(normal[:, d])
        mirrored = images[-1] - 2 * offset[:, None] * normal[:, d]
        images.append(np.where((types[:, d] == Interaction.REFLECTION)[:, None], mirrored, images[-1]))
    found = np.zeros((len(start), depth, 3))
    here = end
    with np.errstate(invalid="ignore", divide="ignore"):  # a grazing plane gives no point, and is left out
        for d in reversed(range(depth)):
            line = images[d + 1] - here
            along = ((origin[:, d] - here) * normal[:, d]).sum(-1) / (line * normal[:, d]).sum(-1)
            met = here + along[:, None] * line
            used = (types[:, d] != 0)[:, None]
            found[:, d] = np.where(used, met, 0.0)
            here = np.where(used, met, here)
    return found


def _squared(vectors: Float64Array) -> Float64Array:
    square: Float64Array = (vectors**2).sum(-1)
    return np.where(square > 0, square, 1.0)
