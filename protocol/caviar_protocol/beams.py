"""Which beam of a DFT codebook points where. `Link` defines the beams by their index."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from caviar_protocol.arrays import Float64Array
from caviar_protocol.topics.scene import AntennaArray


def beam_towards(array: AntennaArray, direction: Sequence[float]) -> int:
    """Beam with the greatest ``|c_k* a(k̂)|`` towards a direction, a unit vector in device axes.

    Along one axis of N elements with a spacing of d wavelengths, and u the direction's cosine,
    ``|c_k* a| = |sin(πNv)| / (sqrt(N)·|sin πv|)`` with ``v = d·u − k/N`` (Tse and Viswanath, section
    7.3.4). The numerator is the same for all k, so the best k is the one nearest to N·d·u, modulo N:
    wrapped beams, end-fire directions and grating lobes need no special cases. Of two beams with equal
    gain the one of lower index is taken.
    """
    _, y, z = direction
    column = _nearest(array.columns, array.horizontal_spacing * y)
    row = _nearest(array.rows, -array.vertical_spacing * z)  # rows count from +z to −z
    return column * array.rows + row


def _nearest(size: int, turns: float) -> int:
    """The k of 0 … size − 1 with the least ``|turns − k/size|`` modulo 1."""
    exact = size * turns
    below = math.ceil(exact - 0.5)
    is_tie = exact - below == 0.5
    beam = below % size
    return 0 if is_tie and beam == size - 1 else beam


def beam_gain(array: AntennaArray, beam: int, directions: Float64Array) -> Float64Array:
    """Amplitude of a beam towards unit vectors in device axes, 1 at its greatest; ``[..., 3]`` to ``[...]``.

    The array factor ``|sin(πNv)| / (N·|sin πv|)`` of `beam_towards` over columns times that over rows.
    """
    column, row = divmod(beam, array.rows)
    gain: Float64Array = _factor(
        array.columns, array.horizontal_spacing * directions[..., 1] - column / array.columns
    ) * _factor(array.rows, -array.vertical_spacing * directions[..., 2] - row / array.rows)
    return gain


def _factor(size: int, v: Float64Array) -> Float64Array:
    v = v - np.round(v)
    sine = np.sin(np.pi * v)
    peak = np.abs(sine) < 1e-9
    factor: Float64Array = np.where(
        peak, 1.0, np.abs(np.sin(np.pi * size * v)) / (size * np.abs(np.where(peak, 1.0, sine)))
    )
    return factor
