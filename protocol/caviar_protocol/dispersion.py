"""How paths spread in delay and Doppler shift: figures of a channel that follow from them alone.

Each function takes the paths of one or many users along the last axis, where NaN stands for a path that is
not there, as in the arrays of a recording: ``delay_spread(channel.a, channel.tau)``. Powers are those of
``a``, antenna elements included.
"""

from __future__ import annotations

import numpy as np

from caviar_protocol.arrays import BoolArray, Complex128Array, Float64Array

CORRELATION = 0.5
"""What is left of the correlation over the coherence bandwidth and time."""


def delay_spread(a: Complex128Array, tau: Float64Array) -> Float64Array:
    """RMS delay spread σ_τ [s] of amplitudes and delays [s], Shape ``[..., P]`` to ``[...]``; or NaN.

    Square root of the second central moment of the power delay profile (Rappaport, Wireless Communications,
    2nd ed., eq. 5.35).
    """
    return _spread(a, tau)


def doppler_spread(a: Complex128Array, doppler: Float64Array) -> Float64Array:
    """RMS Doppler spread σ_ν [Hz] of amplitudes and Doppler shifts [Hz], likewise."""
    return _spread(a, doppler)


def k_factor(a: Complex128Array, tau: Float64Array, los: BoolArray) -> Float64Array:
    """Ratio of the direct path's power to that of all others, Shape ``[..., P]`` to ``[...]``.

    The direct path is the earliest of a user with line of sight ``los``, Shape ``[...]``. NaN without line of
    sight, infinite where there is no other path.
    """
    power = np.nan_to_num(np.abs(a) ** 2)
    has_path = np.isfinite(tau).any(-1) & los
    direct = np.where(np.isfinite(tau), tau, np.inf).argmin(-1)[..., None] if tau.shape[-1] else None
    if direct is None:
        return np.full(tau.shape[:-1], np.nan)
    straight = np.take_along_axis(power, direct, -1)[..., 0]
    np.put_along_axis(power, direct, 0.0, -1)
    others = power.sum(-1)
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio: Float64Array = np.where(has_path, straight / others, np.nan)
    return ratio


def coherence(spread: Float64Array, correlation: float = CORRELATION) -> Float64Array:
    """Distance over which the channel stays correlated at least: arccos(c)/(2πσ), infinite for a spread of 0.

    Of a delay spread [s] it is a bandwidth [Hz], of a Doppler spread [Hz] a time [s]. It is a bound for
    uncorrelated paths of any profile (Fleury, "An uncertainty relation for WSS processes and its application
    to WSSUS systems", IEEE Trans. Commun. 44, 1996): 1/(6σ) for a correlation of 0.5.
    """
    with np.errstate(divide="ignore"):
        bound: Float64Array = np.arccos(correlation) / (2 * np.pi * np.asarray(spread, np.float64))
    return bound


def _spread(a: Complex128Array, of: Float64Array) -> Float64Array:
    """Standard deviation along the last axis, weighted with power."""
    power, value = np.nan_to_num(np.abs(a) ** 2), np.nan_to_num(of)
    with np.errstate(invalid="ignore"):
        share = power / power.sum(-1, keepdims=True)
    mean = (share * value).sum(-1, keepdims=True)
    spread: Float64Array = np.sqrt((share * (value - mean) ** 2).sum(-1))
    return np.where(power.sum(-1) > 0, spread, np.nan)
