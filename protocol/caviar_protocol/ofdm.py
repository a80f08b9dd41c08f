"""OFDM numerology of a carrier, and what paths add to its subcarriers and taps.

Paths have amplitudes a, which contain exp(−j2πf_c·τ), absolute delays τ and Doppler shifts ν at the carrier
frequency f_c. A delay changes with time at the rate −ν/f_c, so Δt after the frame's instant and Δf from the
carrier the baseband channel is (Tse and Viswanath, Fundamentals of Wireless Communication, eq. 2.16 and 2.34)

    H(Δf, Δt) = Σ_p a_p · exp(j2πν_p·Δt) · exp(−j2πΔf·(τ_p − Δt·ν_p/f_c)),

and its samples behind an ideal low-pass filter of bandwidth W (eq. 2.35)

    h_l(Δt) = Σ_p a_p · exp(j2πν_p·Δt) · sinc(l − W·(τ_p − Δt·ν_p/f_c)).

Amplitudes are those at f_c: that coefficients and λ/(4πd) differ within the band is left out.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import msgspec
import numpy as np

from caviar_protocol.arrays import Complex128Array, Float64Array, Int64Array
from caviar_protocol.tables import Place
from caviar_protocol.topics.channel import Carrier

TAPS_BEFORE = 6
"""Taps before that of the earliest path: what an ideal low-pass filter lets through ahead of it has fallen to
−25 dB there. Sionna RT has as many (``l_min = -6``)."""


def with_numerology(carrier: Carrier, sampling_period_ns: int | None, place: Place) -> Carrier:
    """The carrier with the spacing, number or slot duration that follows from its other keys.

    Parameters
    ----------
    carrier
        As the scenario has it.
    sampling_period_ns
        Between frames [ns]; None where it is not the same between all of them.
    place
        Where the carrier stands in the scenario.

    Raises
    ------
    ScenarioError
        Naming the key, where subcarriers do not fit into the bandwidth, or slots have no duration.
    """
    count, spacing, bandwidth = carrier.subcarriers, carrier.subcarrier_spacing_hz, carrier.bandwidth_hz
    if spacing and not count:
        count = math.floor(bandwidth / spacing * (1 + 1e-12))
        if not count:
            raise place.at("subcarrier_spacing_hz").error(
                f"is {spacing:g} Hz, wider than bandwidth_hz = {bandwidth:g}; write at most the bandwidth"
            )
    elif count and not spacing:
        spacing = bandwidth / count
    if count * spacing > bandwidth * (1 + 1e-9):
        raise place.at("subcarriers").error(
            f"{count} subcarriers of {spacing:g} Hz take {count * spacing:g} Hz, more than bandwidth_hz = "
            f"{bandwidth:g}; write bandwidth_hz = {count * spacing:g}, or at most "
            f"{math.floor(bandwidth / spacing)} subcarriers"
        )
    duration = carrier.slot_duration_s
    if carrier.slots > 1 and not duration:
        if sampling_period_ns is None:
            raise place.at("slots").error(
                f"are {carrier.slots}, and run.instants_s has no period that they could share; write "
                "slot_duration_s"
            )
        duration = sampling_period_ns * 1e-9 / carrier.slots
    return msgspec.structs.replace(
        carrier, subcarriers=count, subcarrier_spacing_hz=spacing, slot_duration_s=duration
    )


def undefined_part(part: str, carriers: Sequence[Carrier]) -> str:
    """What to write where no carrier says what a wideband part consists of; empty: one does."""
    if part == "hf" and not any(c.subcarriers or c.subcarrier_spacing_hz for c in carriers):
        return (
            "channel.hf needs a carrier with subcarriers; write, for instance, subcarriers = 264 and "
            "subcarrier_spacing_hz = 120e3 below [[carriers]]"
        )
    if part == "taps" and not any(c.taps for c in carriers):
        return "channel.taps needs a carrier with taps; write, for instance, taps = 64 below [[carriers]]"
    return ""


def subcarrier_offsets(carrier: Carrier) -> Float64Array:
    """Frequency of each subcarrier from the carrier's centre [Hz], Shape ``[K]``; that of index K//2 is 0."""
    steps = np.arange(carrier.subcarriers, dtype=np.float64) - carrier.subcarriers // 2
    offsets: Float64Array = steps * carrier.subcarrier_spacing_hz
    return offsets


def slot_offsets(carrier: Carrier) -> Float64Array:
    """Begin of each slot from the frame's instant [s], Shape ``[S]``."""
    offsets: Float64Array = np.arange(carrier.slots, dtype=np.float64) * carrier.slot_duration_s
    return offsets


def first_tap(carrier: Carrier, tau: Float64Array) -> int:
    """Sample of the first tap of paths with these delays [s]: `TAPS_BEFORE` that of the earliest."""
    return math.floor(carrier.bandwidth_hz * float(tau.min())) - TAPS_BEFORE if tau.size else 0


def subcarrier_weights(carrier: Carrier, tau: Float64Array, doppler: Float64Array) -> Complex128Array:
    """What each path's amplitude is multiplied with on each subcarrier.

    Parameters
    ----------
    carrier
        With its numerology.
    tau
        Delays [s], Shape ``[...]``.
    doppler
        Doppler shifts at the carrier frequency [Hz], of a shape that broadcasts to that of ``tau``.

    Returns
    -------
    Complex128Array
        Shape ``[S, K, ...]``, each of magnitude 1.
    """
    count, ahead = carrier.subcarriers, carrier.subcarriers // 2
    drifting, turning = _in_slots(carrier, tau, doppler)
    step = carrier.subcarrier_spacing_hz * drifting
    # Frequencies are evenly spaced: of blocks and of places within a block √K phases each make all K.
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
    """What each path's amplitude is multiplied with in each tap, Shape ``[S, L, ...]``.

    ``first`` is the sample of the first tap, one for all paths or of a shape that broadcasts to that of
    ``tau``; the rest is as for `subcarrier_weights`.
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
    angle = (turns - np.round(turns)) * (-2 * np.pi)
    phasor = np.empty(angle.shape, np.complex128)
    np.cos(angle, out=phasor.real)
    np.sin(angle, out=phasor.imag)
    return phasor
