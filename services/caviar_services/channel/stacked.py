"""Sums over the paths of a pair."""

from __future__ import annotations

import numpy as np

from caviar_protocol.arrays import Complex128Array

_BLOCK = 256
"""Paths that are summed together."""


def summed(receive: Complex128Array, transmit: Complex128Array) -> Complex128Array:
    """Σ_p receive[p, m] · transmit[p, n], Shape ``[Nr, Nt]``.

    In blocks: of larger matrices NumPy's library makes a product with threads of its own, which wait for
    those of the ray tracer a hundred times as long as the product takes.
    """
    total = np.zeros((receive.shape[1], transmit.shape[1]), np.complex128)
    for begin in range(0, len(receive), _BLOCK):
        block = slice(begin, begin + _BLOCK)
        total += receive[block].T @ transmit[block]
    return total
