"""Which beam of a DFT codebook points where. `Link` defines the beams by their index.

A beam is of one subarray, that is of one panel and one polarization (`caviar_protocol.subarrays`).
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from caviar_protocol.arrays import Float64Array
from caviar_protocol.coordinates import rotation_matrix
from caviar_protocol.subarrays import Subarray, coupled_polarizations, subarrays
from caviar_protocol.topics.scene import AntennaArray


def straight_beams(
    transmit: AntennaArray, towards_rx: Sequence[float], receive: AntennaArray, towards_tx: Sequence[float]
) -> tuple[int, int]:
    """Beams of two arrays along the straight line between them; directions in the axes of each device.

    Of dual polarizations those that couple best between upright devices.
    """
    sent = taken = 0
    if not (transmit.is_uniform and receive.is_uniform):
        sent, taken = coupled_polarizations(transmit, receive)
    return beam_towards(transmit, towards_rx, sent), beam_towards(receive, towards_tx, taken)


def beam_towards(array: AntennaArray, direction: Sequence[float], polarization: int = 0) -> int:
    """Beam with the greatest ``|c_k* a(k̂)|`` towards a direction, a unit vector in device axes.

    Of several panels the one that faces the direction most is taken, of dual polarizations the one of index
    ``polarization``.

    Along one axis of N elements with a spacing of d wavelengths, and u the direction's cosine,
    ``|c_k* a| = |sin(πNv)| / (sqrt(N)·|sin πv|)`` with ``v = d·u − k/N`` (Tse and Viswanath, section
    7.3.4). The numerator is the same for all k, so the best k is the one nearest to N·d·u, modulo N:
    wrapped beams, end-fire directions and grating lobes need no special cases. Of two beams with equal
    gain the one of lower index is taken.
    """
    if array.is_uniform:
        return _uniform_beam(array, direction)
    mine = subarrays(array)[polarization :: len(array.polarizations)]
    faced = max(mine, key=lambda part: part.towards(direction)[0])
    return faced.first + _uniform_beam(faced.array, faced.towards(direction))


def _uniform_beam(array: AntennaArray, direction: Sequence[float]) -> int:
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

    The array factor ``|sin(πNv)| / (N·|sin πv|)`` of `beam_towards` over columns times that over rows, of
    the beam's own subarray.
    """
    if not array.is_uniform:
        part, beam = subarray_of(array, beam)
        turned = rotation_matrix(part.orientation)
        array, directions = part.array, directions @ turned
    column, row = divmod(beam, array.rows)
    gain: Float64Array = _factor(
        array.columns, array.horizontal_spacing * directions[..., 1] - column / array.columns
    ) * _factor(array.rows, -array.vertical_spacing * directions[..., 2] - row / array.rows)
    return gain


def subarray_of(array: AntennaArray, beam: int) -> tuple[Subarray, int]:
    """The subarray that a beam is of, and the beam's index in its codebook."""
    number, own = divmod(beam, array.rows * array.columns)
    return subarrays(array)[number], own


def _factor(size: int, v: Float64Array) -> Float64Array:
    v = v - np.round(v)
    sine = np.sin(np.pi * v)
    peak = np.abs(sine) < 1e-9
    factor: Float64Array = np.where(
        peak, 1.0, np.abs(np.sin(np.pi * size * v)) / (size * np.abs(np.where(peak, 1.0, sine)))
    )
    return factor
