"""Figures that follow from a channel's paths: OFDM responses, taps, spreads, births and deaths.

Paths have amplitudes a, which contain exp(−j2πf_c·τ), absolute delays τ and Doppler shifts ν at the carrier
frequency f_c. A delay changes with time at the rate −ν/f_c, so Δt after the frame's instant and Δf from the
carrier the baseband channel is (Tse and Viswanath, Fundamentals of Wireless Communication, eq. 2.16 and 2.34)

    H(Δf, Δt) = Σ_p a_p · exp(j2πν_p·Δt) · exp(−j2πΔf·(τ_p − Δt·ν_p/f_c)),

and its samples after an ideal low-pass filter of bandwidth W (eq. 2.35)

    h_l(Δt) = Σ_p a_p · exp(j2πν_p·Δt) · sinc(l − W·(τ_p − Δt·ν_p/f_c)).

Amplitudes are those at f_c: that coefficients and λ/(4πd) differ within the band is left out.

`delay_spread`, `doppler_spread` and `k_factor` take the paths of one or many users along the last axis, where
NaN stands for a path that is not there, as in the arrays of a recording: ``delay_spread(channel.a,
channel.tau)``. Powers are those of ``a``, antenna elements included.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from caviar_protocol.arrays import BoolArray, Complex128Array, Float64Array, Int64Array
from caviar_protocol.topics.channel import Carrier, Channel

TAPS_BEFORE = 6
"""Taps before that of the earliest path: what an ideal low-pass filter lets through ahead of it has fallen to
−25 dB there. Sionna RT has as many (``l_min = -6``)."""


def subcarrier_offsets(carrier: Carrier) -> Float64Array:
    """Frequency of each subcarrier from the carrier's centre [Hz], Shape ``[K]``; that of index K//2 is 0.

    Args:
        carrier: With its numerology.

    Example:
        >>> carrier = Carrier(name="n257", frequency_hz=28e9, subcarriers=4, subcarrier_spacing_hz=120e3)
        >>> subcarrier_offsets(carrier).tolist()
        [-240000.0, -120000.0, 0.0, 120000.0]
    """
    # As in 3GPP TS 38.211, section 5.3, and `numpy.fft.fftshift`: one more below the centre for even K.
    steps = np.arange(carrier.subcarriers, dtype=np.float64) - carrier.subcarriers // 2
    offsets: Float64Array = steps * carrier.subcarrier_spacing_hz
    return offsets


def slot_offsets(carrier: Carrier) -> Float64Array:
    """Begin of each slot from the frame's instant [s], Shape ``[S]``.

    Args:
        carrier: With its slots.

    Example:
        >>> slot_offsets(Carrier(name="n257", frequency_hz=28e9, slots=3, slot_duration_s=0.5)).tolist()
        [0.0, 0.5, 1.0]
    """
    offsets: Float64Array = np.arange(carrier.slots, dtype=np.float64) * carrier.slot_duration_s
    return offsets


def first_tap(carrier: Carrier, tau: Float64Array) -> int:
    """Sample of the first tap: `TAPS_BEFORE` samples before that of the earliest path.

    Args:
        carrier: With its bandwidth.
        tau: Delays [s] of the paths.

    Example:
        >>> carrier = Carrier(name="n257", frequency_hz=28e9, bandwidth_hz=100e6)
        >>> first_tap(carrier, np.array([1e-6, 3e-6]))
        94
    """
    return math.floor(carrier.bandwidth_hz * float(tau.min())) - TAPS_BEFORE if tau.size else 0


def subcarrier_weights(carrier: Carrier, tau: Float64Array, doppler: Float64Array) -> Complex128Array:
    """Factors of each path's amplitude on each subcarrier.

    Args:
        carrier: With its numerology.
        tau: Delays [s], Shape ``[...]``.
        doppler: Doppler shifts at the carrier frequency [Hz], of a shape that broadcasts to that of ``tau``.

    Returns:
        Shape ``[S, K, ...]``, each of magnitude 1.

    Example:
        >>> carrier = Carrier(name="n257", frequency_hz=28e9, subcarriers=264, subcarrier_spacing_hz=120e3)
        >>> subcarrier_weights(carrier, np.array([1e-7, 3e-7]), np.zeros(2)).shape
        (1, 264, 2)
    """
    count, ahead = carrier.subcarriers, carrier.subcarriers // 2
    drifting, turning = _in_slots(carrier, tau, doppler)
    step = carrier.subcarrier_spacing_hz * drifting
    # Frequencies are evenly spaced: of blocks and of places within a block √K phases each make all K.
    # 264 subcarriers of 1000 paths: 33 exponentials a path in place of 264.
    block = max(1, math.isqrt(count))
    blocks = -(-count // block)
    shape = (-1, *(1,) * step.ndim)
    coarse = _phasor((np.arange(blocks) * block - ahead).reshape(shape) * step) * turning
    fine = _phasor(np.arange(block).reshape(shape) * step)
    weights = (coarse[:, None] * fine).reshape(blocks * block, *step.shape)[:count]
    return weights.swapaxes(0, 1)


def tap_weights(
    carrier: Carrier, tau: Float64Array, doppler: Float64Array, first: int | Int64Array
) -> Complex128Array:
    """Factors of each path's amplitude in each tap.

    Args:
        carrier: With its numerology.
        tau: Delays [s], Shape ``[...]``.
        doppler: Doppler shifts at the carrier frequency [Hz], of a shape that broadcasts to that of ``tau``.
        first: Sample of the first tap, one for all paths or of a shape that broadcasts to that of ``tau``.

    Returns:
        Shape ``[S, L, ...]``.

    Example:
        >>> carrier = Carrier(name="n257", frequency_hz=28e9, bandwidth_hz=100e6, taps=16)
        >>> weights = tap_weights(carrier, np.array([1e-6]), np.zeros(1), 94)
        >>> int(abs(weights[0, :, 0]).argmax())  # tap 6 is at the delay of the path
        6
    """
    drifting, turning = _in_slots(carrier, tau, doppler)
    samples = np.arange(carrier.taps).reshape(-1, *(1,) * tau.ndim) + first
    weights: Complex128Array = np.sinc(samples - carrier.bandwidth_hz * drifting[:, None]) * turning[:, None]
    return weights


def _in_slots(
    carrier: Carrier, tau: Float64Array, doppler: Float64Array
) -> tuple[Float64Array, Complex128Array]:
    """Delays [s] in each slot, and by how much the phase has turned at the carrier, Shape ``[S, ...]``."""
    doppler = np.broadcast_to(doppler, tau.shape)
    slots = slot_offsets(carrier).reshape(-1, *(1,) * tau.ndim)
    cycles = slots * doppler
    return tau - cycles / carrier.frequency_hz, _phasor(-cycles)


def _phasor(turns: Float64Array) -> Complex128Array:
    """exp(−j2π·turns)."""
    # At 28 GHz and 1 µs a phase has 28,000 turns: whole ones go first, or the cosine loses 5 digits.
    angle = (turns - np.round(turns)) * (-2 * np.pi)
    phasor = np.empty(angle.shape, np.complex128)
    np.cos(angle, out=phasor.real)
    np.sin(angle, out=phasor.imag)
    return phasor


CORRELATION = 0.5
"""What is left of the correlation over the coherence bandwidth and time."""


def delay_spread(a: Complex128Array, tau: Float64Array) -> Float64Array:
    """RMS delay spread σ_τ: square root of the second central moment of the power delay profile.

    Rappaport, Wireless Communications, 2nd ed., eq. 5.35.

    Args:
        a: Amplitudes of the paths, Shape ``[..., P]``; NaN: no path.
        tau: Delays [s], likewise.

    Returns:
        σ_τ [s], Shape ``[...]``; NaN without a path.

    Example:
        >>> float(delay_spread(np.array([1.0, 1.0], complex), np.array([0.0, 2e-7])))  # two equal paths
        1e-07
    """
    return power_spread(np.abs(a) ** 2, tau)


def doppler_spread(a: Complex128Array, doppler: Float64Array) -> Float64Array:
    """RMS Doppler spread σ_ν.

    Args:
        a: Amplitudes of the paths, Shape ``[..., P]``; NaN: no path.
        doppler: Doppler shifts [Hz], likewise.

    Returns:
        σ_ν [Hz], Shape ``[...]``; NaN without a path.

    Example:
        >>> float(doppler_spread(np.array([1.0, 1.0], complex), np.array([-50.0, 50.0])))
        50.0
    """
    return power_spread(np.abs(a) ** 2, doppler)


def k_factor(a: Complex128Array, tau: Float64Array, los: BoolArray) -> Float64Array:
    """Ratio of the direct path's power to that of all others, which is linear.

    Args:
        a: Amplitudes of the paths, Shape ``[..., P]``; NaN: no path.
        tau: Delays [s], likewise; the direct path is the earliest.
        los: Whether the user has line of sight, Shape ``[...]``.

    Returns:
        Shape ``[...]``; NaN without line of sight, infinite where there is no other path.

    Example:
        >>> a, tau = np.array([2.0, 1.0], complex), np.array([1e-7, 2e-7])
        >>> float(k_factor(a, tau, np.array(True)))
        4.0
    """
    # `np.put_along_axis` below writes into this copy, never into the caller's amplitudes.
    power = np.nan_to_num(np.abs(a) ** 2)
    has_path = np.isfinite(tau).any(-1) & los
    direct = np.where(np.isfinite(tau), tau, np.inf).argmin(-1)[..., None] if tau.shape[-1] else None
    if direct is None:
        return np.full(tau.shape[:-1], np.nan)
    straight = np.take_along_axis(power, direct, -1)[..., 0]
    np.put_along_axis(power, direct, 0.0, -1)
    # Summed without the direct path: its difference from the sum of all would lose small ones.
    others = power.sum(-1)
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio: Float64Array = np.where(has_path, straight / others, np.nan)
    return ratio


def coherence(spread: Float64Array, correlation: float = CORRELATION) -> Float64Array:
    """Distance over which the channel stays correlated at least: arccos(c)/(2πσ).

    It is a bound for uncorrelated paths of any profile (Fleury, "An uncertainty relation for WSS processes
    and its application to WSSUS systems", IEEE Trans. Commun. 44, 1996): 1/(6σ) for a correlation of 0.5.

    Args:
        spread: σ, a delay spread [s] or a Doppler spread [Hz].
        correlation: c, what is left of the correlation.

    Returns:
        A bandwidth [Hz] of a delay spread, a time [s] of a Doppler spread; infinite for a spread of 0.

    Example:
        >>> float(coherence(np.array(1e-7)).round())  # [Hz], of a delay spread of 100 ns
        1666667.0
    """
    with np.errstate(divide="ignore"):
        bound: Float64Array = np.arccos(correlation) / (2 * np.pi * np.asarray(spread, np.float64))
    return bound


def power_spread(power: Float64Array, values: Float64Array) -> Float64Array:
    """Standard deviation of values, weighted with power.

    Args:
        power: Of the paths, Shape ``[..., P]``; NaN: no path.
        values: Of the paths, likewise.

    Returns:
        Shape ``[...]``; NaN without a path.
    """
    power, values = np.nan_to_num(power), np.nan_to_num(values)
    total = power.sum(-1)
    # 0/0: a user without a path has no spread, and 0 would be that of one path.
    with np.errstate(invalid="ignore"):
        mean = (power * values).sum(-1) / total
        # About the mean: the difference of two squares of a microsecond keeps no picoseconds.
        spread: Float64Array = np.sqrt((power * (values - mean[..., None]) ** 2).sum(-1) / total)
    return spread


@dataclass(frozen=True, eq=False)
class Changes:
    """Births and deaths of paths between two products."""

    born: BoolArray
    """Which paths of the later product the earlier one does not have, Shape ``[P]`` of the later."""
    died: BoolArray
    """Which paths of the earlier product the later one does not have, Shape ``[P]`` of the earlier."""

    @property
    def births(self) -> int:
        """Number of paths that appeared."""
        return int(np.count_nonzero(self.born))

    @property
    def deaths(self) -> int:
        """Number of paths that vanished."""
        return int(np.count_nonzero(self.died))


def changes(before: Channel, after: Channel) -> Changes:
    """Births and deaths of paths from one product to a later one.

    A path is the same where TX, RX and ``id`` are; all paths of a pair that came or left are born or
    died with it.

    Args:
        before: The earlier product.
        after: The later product, of the same source.

    Example:
        >>> from caviar_protocol.recording import Recording
        >>> recording = Recording("runs/smoke-20261122-101500")
        >>> channel = recording["channel"]
        >>> changes(channel[6], channel[7]).births
        0
    """
    # Where no path changed, two comparisons take the place of a sort.
    same = before.tx == after.tx and before.rx == after.rx
    if same and np.array_equal(before.offsets, after.offsets) and np.array_equal(before.id, after.id):
        return Changes(np.zeros(len(after.id), np.bool_), np.zeros(len(before.id), np.bool_))
    # Numbers that two paths of the products, Shape ``[P]`` each, have in common where they are the same.
    channels = (before, after)
    tx, rx = (
        {name: number for number, name in enumerate(dict.fromkeys(names))}
        for names in (before.tx + after.tx, before.rx + after.rx)
    )
    numbers, places = np.unique(np.concatenate([c.id for c in channels]), return_inverse=True)
    pairs = [
        np.repeat([tx[t] * len(rx) + rx[r] for t in c.tx for r in c.rx], np.diff(c.offsets)).astype(np.int64)
        for c in channels
    ]
    keys = np.concatenate(pairs) * len(numbers) + places.reshape(-1)
    earlier, later = keys[: len(before.id)], keys[len(before.id) :]
    return Changes(~np.isin(later, earlier), ~np.isin(earlier, later))
