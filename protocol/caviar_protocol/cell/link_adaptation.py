"""Transport blocks: effective SINR, error probability, choice of modulation and coding, outer loop.

The error probabilities of a modulation and coding scheme (MCS) stand in tables over the effective SINR. Where
the SINR differs over the band, the effective one is that of a channel without fading on which as many blocks
fail (exponential effective SINR mapping). The scheme of a block is the highest of which, at the SINR that the
transmitter knows, no more fail than the target; an offset to that SINR follows the acknowledgements, so that
in the long run as many fail as the target says. All three are those of `sionna.sys` (EESM, PHYAbstraction,
OuterLoopLinkAdaptation), as functions of arrays.

Rates of a radio link: SINR, spectral efficiency, and the bits that a slot carries.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
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


_HIGHEST = 1e3
"""Effective SINR beyond which tables have no entries, 30 dB; the least is as far below 0 dB."""

Offsets: TypeAlias = Float64Array
"""[dB] that the SINR is taken to be lower by, one for each user."""


@dataclass(frozen=True, eq=False)
class BlockTable:
    """Transport blocks of M schemes on a given number of resource elements, MCS 0 first."""

    bits: Int64Array
    """Information bits of a block, Shape ``[M]``."""
    error: Float64Array
    """Probability that a block fails, by scheme and effective SINR, Shape ``[M, G]``; 2 where it is unknown,
    which keeps a scheme from being chosen."""
    least_db: float
    """Effective SINR of the first column [dB]."""
    step_db: float
    """From one column to the next [dB]."""
    beta: Float64Array
    """Parameter of the effective SINR mapping of each scheme, Shape ``[M]``."""

    @cached_property
    def lowest(self) -> int:
        """The first scheme whose errors are known."""
        return int((self.error <= 1).all(1).argmax())

    def error_of(self, scheme: Int64Array, sinr: Float64Array) -> Float64Array:
        """Look up how likely a block of each user fails.

        Args:
            scheme: MCS of each user, Shape ``[U]``.
            sinr: On each part of the band, linear, Shape ``[U, K]``.

        Returns:
            Shape ``[U]``; 1 where it is unknown.
        """
        effective_db = 10 * np.log10(effective_sinr(sinr, self.beta[scheme]))
        found: Float64Array = np.minimum(self.error[scheme, self._columns(effective_db)], 1.0)
        return found

    def choose(self, sinr: Float64Array, offset_db: Offsets, target: float) -> Int64Array:
        """Choose the highest scheme that is expected to fail no more often than the target.

        Args:
            sinr: On each part of the band as far as it is known, linear, Shape ``[U, K]``.
            offset_db: By how much the effective SINR of each user is taken to be lower [dB], Shape ``[U]``.
            target: Share of blocks that may fail.

        Returns:
            MCS of each user, Shape ``[U]``; the lowest known one where all fail more often.
        """
        if sinr.shape[-1] == 1:
            # The effective SINR of a flat channel is that of all schemes.
            effective_db = 10 * np.log10(effective_sinr(sinr, self.beta[:1]))
            good = self.error[:, self._columns(effective_db - offset_db)] <= target
        else:
            effective_db = 10 * np.log10(effective_sinr(sinr, self.beta[:, None]))
            schemes = np.arange(len(self.error))[:, None]
            good = self.error[schemes, self._columns(effective_db - offset_db)] <= target
        last = len(good) - 1 - good[::-1].argmax(0)
        return np.where(good.any(0), last, self.lowest)

    def _columns(self, effective_db: Float64Array) -> Int64Array:
        places = np.rint((effective_db - self.least_db) / self.step_db)
        columns: Int64Array = np.minimum(np.maximum(places, 0), self.error.shape[1] - 1).astype(np.int64)
        return columns


def effective_sinr(sinr: Float64Array, beta: Float64Array) -> Float64Array:
    """Exponential effective SINR mapping: −β·log(mean(exp(−SINR/β))) over the band.

    Y. Blankenship et al., "Link error prediction methods for multicarrier systems", VTC Fall 2004, eq. 7.

    Args:
        sinr: On each part of the band, linear, Shape ``[U, K]``.
        beta: Of the scheme of each user, Shape ``[U]``, or of all schemes, Shape ``[M, 1]``.

    Returns:
        Linear, from −30 to 30 dB, Shape ``[U]`` or ``[M, U]``.

    Example:
        >>> effective_sinr(np.array([[4.0, 4.0], [1.0, 7.0]]), np.array([2.0, 2.0])).round(3).tolist()
        [4.0, 2.289]
    """
    mapped = least = sinr.min(-1)
    if sinr.shape[-1] > 1:
        # From the least one on: the exponentials of great SINRs would all be 0.
        scaled = (least[:, None] - sinr) / beta[..., None]
        mapped = least - beta * np.log(np.exp(scaled).mean(-1))
    bounded: Float64Array = np.minimum(np.maximum(mapped, 1 / _HIGHEST), _HIGHEST)
    return bounded


def outer_loop(
    offset_db: Offsets, received: Int64Array, failed: Int64Array, step_db: float, target: float
) -> Offsets:
    """Move the offset of each user by the acknowledgements of its blocks.

    A failed block raises it by the step Δ, one that was received lowers it by Δ·t/(1 − t) with the target t:
    it stays where it is on average where a share t fails (A. Sampath, P. Kumar and J. Holtzman, "On setting
    reverse link target SIR in a CDMA system", 1997).

    Args:
        offset_db: Before [dB], Shape ``[U]``.
        received: Blocks that were decoded, Shape ``[U]``.
        failed: Blocks that were not, Shape ``[U]``.
        step_db: Δ [dB].
        target: t, share of blocks that may fail.

    Returns:
        After [dB], from −20 to 20, Shape ``[U]``.

    Example:
        >>> outer_loop(np.array([0.0, 0.0]), np.array([9, 0]), np.array([1, 1]), 1.0, 0.1).round(9).tolist()
        [0.0, 1.0]
    """
    moved: Float64Array = offset_db + step_db * (failed - received * (target / (1 - target)))
    return np.clip(moved, -20.0, 20.0)
