"""Sums over the paths of a pair."""

from __future__ import annotations

import numpy as np

from caviar_protocol.arrays import Complex128Array

_PRODUCTS = 32_768
"""Products of elements that are summed together: OpenBLAS shares twice as many out to threads."""


def summed(receive: Complex128Array, transmit: Complex128Array) -> Complex128Array:
    """Σ_p receive[p, m] · transmit[p, n], Shape ``[Nr, Nt]``, of Shapes ``[P, Nr]`` and ``[P, Nt]``.

    In blocks: NumPy's library shares a larger product out to threads of its own, which beside those of the
    ray tracer wait for a processor a hundred times as long as the product takes.
    """
    total = np.zeros((receive.shape[1], transmit.shape[1]), np.complex128)
    size = max(4, _PRODUCTS // max(total.size, 1))
    for begin in range(0, len(receive), size):
        block = slice(begin, begin + size)
        total += receive[block].T @ transmit[block]
    return total
