"""The sweep over all beam pairs, and the best of them (paper, eq. 1 and 2)."""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np

from caviar_protocol.arrays import Complex128Array, Float64Array, Int32Array, Int64Array
from caviar_protocol.topics.scene import AntennaArray

SORTED_WHOLE = 256
"""Pairs up to which sorting all of them is faster than looking for the best first."""
SMALL = 32
"""Elements along an axis up to which a product of matrices is faster than a fast transform. From 64 on it
would be shared out to threads too, which on a busy machine wait for each other ten times as long."""


class Pairs(NamedTuple):
    """Beam pairs of U users, best first, Shape ``[U, k]`` each."""

    tx_beam: Int32Array
    rx_beam: Int32Array
    abs_y: Float64Array


def sweep(h: Complex128Array, tx: AntennaArray, rx: AntennaArray) -> Float64Array:
    """|y| of every pair of DFT beams, Shape ``[..., Nr, Nt]`` to ``[..., Nt, Nr]``.

    y = w* H f (paper, eq. 1) with the beams of `codebook.dft_codebook`. Both conj(w) and f have
    entries exp(−j2πkn/N)/sqrt(N), so the product over all pairs is a Fourier transform over the
    columns and rows of both arrays, and no codebook of N² entries has to be formed. Of several panels or
    polarizations each block is transformed by itself.
    """
    leading = h.shape[:-2]
    grids = (rx.size // (rx.columns * rx.rows), rx.columns, rx.rows)
    elements = h.reshape(*leading, *grids, tx.size // (tx.columns * tx.rows), tx.columns, tx.rows)
    y = elements
    for axis in (-5, -4, -2, -1):
        size = elements.shape[axis]
        if size > SMALL:
            y = np.fft.fft(y, axis=axis, norm="ortho")
        elif size > 1:
            y = (y.swapaxes(axis, -1) @ _fourier(size)).swapaxes(axis, -1)
    y = y.reshape(*leading, rx.size, tx.size)
    magnitude: Float64Array = np.abs(y.swapaxes(-1, -2))
    return magnitude


@lru_cache(maxsize=SMALL)
def _fourier(size: int) -> Complex128Array:
    """The unitary Fourier matrix, entries exp(−j2πkn/N)/sqrt(N)."""
    n = np.arange(size)
    matrix: Complex128Array = np.exp(-2j * np.pi * (np.outer(n, n) % size) / size) / np.sqrt(size)
    return matrix


def best_pairs(abs_y: Float64Array, k: int) -> Pairs:
    """The ``k`` pairs with the greatest |y|, Shape ``[U, Nt, Nr]``; all of them where there are fewer.

    The first one is eq. (2) of the paper. Of equal ones the lowest pair index
    ``tx_beam·Nr + rx_beam`` comes first.
    """
    flat = abs_y.reshape(len(abs_y), -1)
    k = min(k, flat.shape[1])
    if flat.shape[1] <= SORTED_WHOLE:
        order = (-flat).argsort(-1, "stable")[:, :k]
    else:
        order = np.array([_best_of_many(row, k) for row in flat])
    tx_beam, rx_beam = order.astype(np.int32), np.zeros(order.shape, np.int32)
    if abs_y.shape[2] > 1:
        tx_beam, rx_beam = np.divmod(tx_beam, np.int32(abs_y.shape[2]))
    if len(flat) > 1:
        order = order + np.arange(0, flat.size, flat.shape[1])[:, None]
    return Pairs(tx_beam, rx_beam, flat.take(order))


def _best_of_many(flat: Float64Array, k: int) -> Int64Array:
    """Indices of the ``k`` greatest, found without sorting all."""
    threshold = np.partition(flat, flat.size - k)[flat.size - k]
    candidates = np.flatnonzero(flat >= threshold)
    order: Int64Array = candidates[np.argsort(-flat[candidates], kind="stable")][:k]
    return order
