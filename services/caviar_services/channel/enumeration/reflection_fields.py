"""Fields of reflected and transmitted paths, in float64: coefficients of slabs (ITU-R P.2040-3)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from caviar_protocol.arrays import BoolArray, Complex128Array, Float64Array, Int64Array
from caviar_services.channel.propagation.utd import Media, Wall


def reflection_fields(
    corners: Float64Array,
    count: Int64Array,
    normals: Float64Array,
    through: BoolArray,
    media: Media,
    wavelengths: Sequence[float],
) -> Complex128Array:
    """Dyads of `PathTable`, Shape ``[C, P, 3, 3]``, with the spreading of the paths' lengths.

    Parameters
    ----------
    corners
        TX, points of interactions, and RX in all places behind the last one [m], Shape ``[P, D + 2, 3]``.
    count
        Interactions of each path, Shape ``[P]``.
    normals
        Unit, of the plane at each point, Shape ``[P, D, 3]``.
    through
        Which of them let the wave through, Shape ``[P, D]``; the others reflect it.
    media
        At each point.
    wavelengths
        Of the carriers [m].
    """
    steps = np.diff(corners, axis=1)
    lengths = np.sqrt(np.einsum("pdc,pdc->pd", steps, steps))
    directions = steps / np.where(lengths > 0, lengths, 1.0)[..., None]
    total = lengths.sum(1)
    first = directions[:, 0]
    transverse = np.eye(3) - first[:, :, None] * first[:, None]
    fields = np.empty((len(wavelengths), len(count), 3, 3), np.complex128)
    for carrier, wavelength in enumerate(wavelengths):
        field = transverse + 0j
        for d in range(normals.shape[1]):
            rows = np.flatnonzero(count > d)
            wall = Wall(
                media.permittivity[carrier, rows, d],
                media.conductivity[carrier, rows, d],
                media.thickness[rows, d],
                media.scattering[rows, d],
                wavelength,
            )
            dyad = wall.dyad(directions[rows, d], normals[rows, d], through[rows, d])
            field[rows] = dyad @ field[rows]
        fields[carrier] = field * (wavelength / (4 * np.pi) / total)[:, None, None]
    return fields
