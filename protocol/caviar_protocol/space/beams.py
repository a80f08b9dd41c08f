"""Pairs of beams of two arrays: |y| of all pairs, the best of them, and the pair along the straight line.

What one array's beams are says its codebook (`caviar_protocol.space.codebooks`).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from caviar_protocol.arrays import Complex128Array, Float64Array, Int32Array, Int64Array
from caviar_protocol.space.codebooks import DFT, codebook_of
from caviar_protocol.topics.scene import AntennaArray


def straight_beams(
    transmit: AntennaArray, towards_rx: Sequence[float], receive: AntennaArray, towards_tx: Sequence[float]
) -> tuple[int, int]:
    """Beams of two arrays along the straight line between them.

    Args:
        transmit: Array of the transmitter.
        towards_rx: Unit vector to the receiver, in the transmitter's axes.
        receive: Array of the receiver.
        towards_tx: Unit vector to the transmitter, in the receiver's axes.

    Returns:
        TX beam and RX beam; of dual polarizations those that couple best between upright devices.

    Example:
        >>> ahead = (1.0, 0.0, 0.0)
        >>> straight_beams(AntennaArray(columns=32), ahead, AntennaArray(columns=4), ahead)
        (0, 0)
    """
    sent = taken = 0
    if not (transmit.is_uniform and receive.is_uniform):
        sent, taken = coupled_polarizations(transmit, receive)
    at_tx, at_rx = codebook_of(transmit), codebook_of(receive)
    return at_tx.beam_towards(towards_rx, sent), at_rx.beam_towards(towards_tx, taken)


@lru_cache(maxsize=64)
def coupled_polarizations(transmit: AntennaArray, receive: AntennaArray) -> tuple[int, int]:
    """Polarizations that couple best between upright devices that face each other.

    A slant of +45° is one of −45° seen from the other side, so the first elements of two ``cross`` arrays do
    not hear each other; those of two ``circular`` arrays do.

    Args:
        transmit: Array of the transmitter.
        receive: Array of the receiver.

    Returns:
        Index among the polarizations of each array; of equal ones the first.

    Example:
        >>> coupled_polarizations(AntennaArray(polarization="cross"), AntennaArray(polarization="cross"))
        (0, 1)
    """
    pairs = [(t, r) for t in range(len(transmit.polarizations)) for r in range(len(receive.polarizations))]

    def coupling(pair: tuple[int, int]) -> float:
        sent, taken = jones(transmit.polarizations[pair[0]]), jones(receive.polarizations[pair[1]])
        return round(abs(sent[0] * taken[0] - sent[1] * taken[1]), 9)

    return max(pairs, key=coupling)  # the first of equal ones


def jones(polarization: str) -> tuple[complex, complex]:
    """Field of an element along θ̂ and φ̂, as parts of the amplitude of its pattern.

    Linear polarizations are those of model 2 of 3GPP TR 38.901, section 7.3.2, (cos ζ, sin ζ) at a slant of
    ζ. Circular ones follow IEEE Std 145 for waves exp(+j2πft): looking along the wave, RHCP turns clockwise.

    Args:
        polarization: ``V``, ``H``, ``-45``, ``+45``, ``RHCP`` or ``LHCP``.

    Example:
        >>> jones("H")
        (0.0, 1.0)
    """
    if polarization == "V":
        return 1.0, 0.0
    if polarization == "H":
        return 0.0, 1.0
    part = math.sqrt(0.5)
    return {"-45": (part, -part), "+45": (part, part), "RHCP": (part, -1j * part), "LHCP": (part, 1j * part)}[
        polarization
    ]


# --- all pairs of beams of a channel ------------------------------------------------------------------

SORTED_WHOLE = 256
"""Pairs up to which sorting all of them is faster than looking for the best first."""
SMALL = 32
"""Elements along an axis up to which a product of matrices is faster than a fast transform. From 64 on it
would be shared out to threads too, which on a busy machine wait for each other ten times as long."""


class BeamPairs(NamedTuple):
    """Beam pairs of U users, best first, Shape ``[U, k]`` each."""

    tx_beam: Int32Array
    rx_beam: Int32Array
    abs_y: Float64Array


def beam_gains(h: ArrayLike, tx: AntennaArray, rx: AntennaArray) -> Float64Array:
    """|y| of every pair of beams, the amplitude gain of the channel between them.

    y = wᴴ H f (paper, eq. 1) with w = c_r for the RX beam r and f = conj(c_t) for the TX beam t, where c_k is
    beam k of an array's codebook (`caviar_protocol.space.codebooks`): a transmitter sends conj(c_t), so that
    t means the direction that it means at a receiver. It is what `Link`, labels of datasets and agents count.

    Of DFT beams both conj(w) and f have entries exp(−j2πkn/N)/sqrt(N), so that all pairs are a Fourier
    transform over the columns and rows of both arrays, and no codebook of N² entries has to be formed. Of
    several panels or polarizations each block is transformed by itself.

    Args:
        h: Channel matrices, Shape ``[..., Nr, Nt]``.
        tx: Array of the transmitter, of Nt elements.
        rx: Array of the receiver, of Nr elements.

    Returns:
        |y| by TX beam and RX beam, Shape ``[..., Kt, Kr]``: K beams of each end, of the DFT as many as
        elements.

    Raises:
        ValueError: The arrays do not have the elements of ``h``.

    Example:
        >>> uniform = AntennaArray(rows=1, columns=4)
        >>> abs_y = beam_gains(np.ones((4, 4), np.complex128), uniform, uniform)  # in phase: boresight
        >>> round(float(abs_y[0, 0]), 6), round(float(abs_y[1, 1]), 6)
        (4.0, 0.0)
    """
    h = np.asarray(h)
    if h.shape[-2:] != (rx.size, tx.size):
        raise ValueError(
            f"H has the shape {h.shape}, arrays of {rx.size} receiving and {tx.size} transmitting elements "
            f"need [..., {rx.size}, {tx.size}]"
        )
    if tx.codebook != DFT or rx.codebook != DFT:
        y = codebook_of(rx).vectors.conj() @ h @ codebook_of(tx).vectors.conj().T
        return np.ascontiguousarray(np.abs(y).swapaxes(-1, -2))
    # Elements are numbered panel by panel, column by column (`AntennaArray`): so the axes
    # of the grid come out of a reshape, and the transform of one axis after the other is that of all.
    leading, grid = h.shape[:-2], _grid(tx, rx)
    y = h.reshape((*leading, *grid.shape))  # one element at each end: an array without axes
    for axis, size in grid.axes:
        if size > SMALL:
            y = np.fft.fft(y, axis=axis, out=np.empty(y.shape, np.complex128))  # it looks long for a type
        else:
            y = (y.swapaxes(axis, -1) @ _fourier(size)).swapaxes(axis, -1)
    magnitude: Float64Array = np.abs(y.reshape(*leading, rx.size, tx.size).swapaxes(-1, -2))
    if grid.scale != 1.0:
        magnitude *= grid.scale
    return magnitude


class _Grid(NamedTuple):
    """Grid in which H is transformed."""

    shape: tuple[int, ...]
    """By panels, columns and rows of RX, then of TX, without those that are 1."""
    axes: tuple[tuple[int, int], ...]
    """Axes of it, from the last one on, and their sizes, of columns and rows."""
    scale: float
    """What the fast transforms among them lack to be unitary."""


@lru_cache(maxsize=256)
def _grid(tx: AntennaArray, rx: AntennaArray) -> _Grid:
    sizes: list[tuple[int, bool]] = []
    for array in (rx, tx):
        panels = array.size // (array.columns * array.rows)
        sizes += [(panels, False), (array.columns, True), (array.rows, True)]
    kept = [(size, transformed) for size, transformed in sizes if size > 1]
    axes = [(n - len(kept), size) for n, (size, transformed) in enumerate(kept) if transformed]
    scale = math.prod(1 / math.sqrt(size) for _, size in axes if size > SMALL)
    return _Grid(tuple(size for size, _ in kept), tuple(axes), scale)


@lru_cache(maxsize=SMALL)
def _fourier(size: int) -> Complex128Array:
    """The unitary Fourier matrix, entries exp(−j2πkn/N)/sqrt(N)."""
    n = np.arange(size)
    matrix: Complex128Array = np.exp(-2j * np.pi * (np.outer(n, n) % size) / size) / np.sqrt(size)
    return matrix


def best_pairs(abs_y: Float64Array, k: int = 1) -> BeamPairs:
    """Find the pairs of beams with the greatest |y|.

    The first one is eq. (2) of the paper. Of equal ones the lowest pair index
    ``tx_beam·Nr + rx_beam`` comes first.

    Args:
        abs_y: |y| of all pairs, Shape ``[U, Nt, Nr]``.
        k: Number of pairs; all of them where there are fewer.

    Example:
        >>> best_pairs(np.array([[[1.0, 3.0], [2.0, 0.0]]]), 2).abs_y
        array([[3., 2.]])
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
        # `take` on one flat axis: `take_along_axis` forms index arrays of all axes first.
        order = order + np.arange(0, flat.size, flat.shape[1])[:, None]
    return BeamPairs(tx_beam, rx_beam, flat.take(order))


def _best_of_many(flat: Float64Array, k: int) -> Int64Array:
    """Indices of the ``k`` greatest, found without sorting all."""
    # A partition is linear in the number of pairs; only what reaches the k-th is sorted, equal ones included,
    # so that the order among them is that of a stable sort of all.
    threshold = np.partition(flat, flat.size - k)[flat.size - k]
    candidates = np.flatnonzero(flat >= threshold)
    order: Int64Array = candidates[np.argsort(-flat[candidates], kind="stable")][:k]
    return order
