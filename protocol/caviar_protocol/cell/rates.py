"""Rates of a radio link: SINR, spectral efficiency, and the bits that a slot carries."""

from __future__ import annotations

from typing import TypeAlias

import numpy as np

from caviar_protocol.arrays import Float64Array, Int64Array

Numbers: TypeAlias = Float64Array | float

HIGHEST_SPECTRAL_EFFICIENCY = 7.4063
"""[bit/s/Hz] of the highest modulation and coding of 3GPP TS 38.214, table 5.1.3.1-2: 256-QAM at a code rate
of 948/1024."""


def sinr(signal: Numbers, interference: Numbers, noise: Numbers) -> Float64Array:
    """Ratio of signal to interference and noise, S/(I + N), which is linear.

    Args:
        signal: Received power [W].
        interference: Received power of the other transmitters [W].
        noise: Noise power [W], above 0.

    Example:
        >>> float(sinr(2e-9, 1e-9, 1e-9))
        1.0
    """
    ratio: Float64Array = np.asarray(signal / (interference + noise), np.float64)
    return ratio


def shannon(ratio: Numbers, highest: float | None = None) -> Float64Array:
    """Shannon's bound log2(1 + SINR), up to that of the highest modulation and coding.

    Args:
        ratio: SINR, linear.
        highest: Spectral efficiency of the highest modulation and coding [bit/s/Hz]; None: no bound.

    Returns:
        Spectral efficiency [bit/s/Hz].

    Example:
        >>> shannon(np.array([0.0, 3.0, 1023.0]), highest=7.4063).tolist()
        [0.0, 2.0, 7.4063]
    """
    efficiency: Float64Array = np.log2(1.0 + np.asarray(ratio, np.float64))
    return efficiency if highest is None else np.minimum(efficiency, highest)


def slot_bits(rate_bit_s: Numbers, slot_s: float) -> Int64Array:
    """Whole bits that a slot carries.

    Args:
        rate_bit_s: Bandwidth times spectral efficiency [bit/s].
        slot_s: Length of the slot [s].

    Example:
        >>> slot_bits(np.array([0.0, 200e6]), 125e-6).tolist()
        [0, 25000]
    """
    # A millionth of a bit more: 200e6 · 1e-3 and the like must not lose a bit to rounding.
    bits: Int64Array = np.floor(np.asarray(rate_bit_s * slot_s) + 1e-6).astype(np.int64)
    return bits
