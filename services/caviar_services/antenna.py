"""Uniform antenna arrays as the channel, the link and the agents all see them.

An array with dual polarization or several panels is a set of these (`caviar_protocol.space.beams`).

One phase convention for all of them. The element at ``r`` [wavelengths] sees a plane wave of
direction k̂ (unit vector from the array *towards* the other end, device axes) with the phase
``exp(+j2π k̂·r)``: an element nearer to the other end has the shorter path and, with
exp(−j2πfτ), the larger phase. At both ends the same vector applies, so a single path of
amplitude a has ``H = a · ar · atᵀ`` (Tse and Viswanath, Fundamentals of Wireless Communication,
section 7.2, with directions taken from each array outwards).
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from caviar_protocol.arrays import Complex128Array, Float64Array
from caviar_protocol.topics.scene import AntennaArray


def element_positions(array: AntennaArray) -> Float64Array:
    """Element positions [wavelengths] in device axes around the array's centre, Shape ``[N, 3]``.

    Element ``i`` is row ``i % rows`` of column ``i // rows``: rows from +z to −z, columns from
    −y to +y, boresight +x.
    """
    y, z = _grid(array)
    positions = np.zeros((array.size, 3))
    positions[:, 1] = np.repeat(y, array.rows)
    positions[:, 2] = np.tile(z, array.columns)
    return positions


def steering_vector(array: AntennaArray, directions: Float64Array) -> Complex128Array:
    """Phases ``exp(+j2π k̂·r)`` of the elements, Shape ``[..., N]``, each of magnitude 1.

    ``directions`` are unit vectors k̂ from the array towards the other end in device axes,
    Shape ``[..., 3]``. The element pattern is not part of it.
    """
    if array.size == 1:
        return np.ones((*directions.shape[:-1], 1), np.complex128)
    y, z = _phases(array)
    # k̂·r separates, so rows + columns exponentials do instead of rows · columns.
    columns: Complex128Array = np.exp(directions[..., 1, None] * y)
    if array.rows == 1:
        return columns
    rows = np.exp(directions[..., 2, None] * z)
    vector: Complex128Array = (columns[..., :, None] * rows[..., None, :]).reshape(
        *directions.shape[:-1], array.size
    )
    return vector


@lru_cache(maxsize=256)
def _grid(array: AntennaArray) -> tuple[Float64Array, Float64Array]:
    """y of each column and z of each row [wavelengths]."""
    y: Float64Array = (
        np.arange(array.columns, dtype=np.float64) - (array.columns - 1) / 2
    ) * array.horizontal_spacing
    z: Float64Array = (
        (array.rows - 1) / 2 - np.arange(array.rows, dtype=np.float64)
    ) * array.vertical_spacing
    return y, z


@lru_cache(maxsize=256)
def _phases(array: AntennaArray) -> tuple[Complex128Array, Complex128Array]:
    """j2π times the grid."""
    y, z = _grid(array)
    return np.multiply(2j * np.pi, y, dtype=np.complex128), np.multiply(2j * np.pi, z, dtype=np.complex128)
