"""What a channel is summed up to, and how far two such sums are apart. Pure functions of arrays."""

from __future__ import annotations

import numpy as np

from caviar_protocol.arrays import Complex128Array, Float64Array

FLOOR_DB = -200.0
"""[dB] What equal channels are said to differ by: float64 carries no more than −313 dB, and no text reads
well with −∞ in it."""


def path_gain_db(a: Complex128Array) -> float:
    """Path gain of one pair [dB]: the sum of its paths' powers, whatever their phases.

    10·log10 Σ|a_p|² (Recommendation ITU-R P.1407-8, the integral over the power delay profile). −∞ without
    a path.
    """
    power = float((np.abs(a) ** 2).sum())
    return 10 * float(np.log10(power)) if power > 0 else -np.inf


def delay_spread_s(tau: Float64Array, power: Float64Array) -> float:
    """Root mean square delay spread [s] (Recommendation ITU-R P.1407-8, second central moment).

    S = sqrt(Σ P_p τ_p² / ΣP − (Σ P_p τ_p / ΣP)²), here taken about the mean, which loses no digits. 0 for a
    single path.
    """
    total = power.sum()
    mean = (power * tau).sum() / total
    return float(np.sqrt((power * (tau - mean) ** 2).sum() / total))


def angular_spread_rad(angle: Float64Array, power: Float64Array) -> float:
    """Circular angular spread [rad] (3GPP TR 38.901, annex A.1).

    AS = sqrt(−2·ln |Σ exp(jφ_p)·P_p / ΣP|): it depends neither on the zero of the angle nor on where it
    wraps. Powers that cancel, as of two equal waves from opposite directions, have no bound; then the
    spread is that of the smallest resultant float64 can hold.
    """
    resultant = abs((np.exp(1j * angle) * power).sum()) / power.sum()
    # A single wave's resultant may be above 1 by rounding.
    return float(np.sqrt(-2 * np.log(min(1.0, max(resultant, np.finfo(np.float64).tiny)))))


def nmse(h: Complex128Array, reference: Complex128Array) -> float:
    """Normalised squared error ‖H − H_ref‖_F² / ‖H_ref‖_F², phases included.

    1 for H = 0. Its mean over channels is the NMSE as usually defined, E[‖H − H_ref‖² / ‖H_ref‖²].
    """
    return float((np.abs(h - reference) ** 2).sum() / (np.abs(reference) ** 2).sum())


def decibel(ratio: float) -> float:
    """Ratio of powers in dB, not below `FLOOR_DB`."""
    return max(FLOOR_DB, 10 * float(np.log10(ratio))) if ratio > 0 else FLOOR_DB


def capacity_bps_hz(h: Complex128Array, power_over_noise: float) -> float:
    """Capacity [bit/s/Hz] with equal power on all transmit elements and H known to the receiver alone.

    C = log2 det(I + P/(N_t·N)·H·H*) (Telatar, "Capacity of multi-antenna Gaussian channels", 1999,
    theorem 1 for a fixed H), from the singular values of H. P/N: ``power_over_noise``.
    """
    singular = np.linalg.svd(h, compute_uv=False)
    return float(np.log2(1 + power_over_noise / h.shape[1] * singular**2).sum())


def top_k(abs_y: Float64Array, k: int) -> list[int]:
    """Flat indices of the ``k`` greatest |y|, greatest first; of equal ones the lowest first."""
    return [int(i) for i in np.argsort(-abs_y.ravel(), kind="stable")[:k]]


def hit(ranked: list[int], reference: list[int], k: int) -> bool:
    """Whether the reference's best pair is among the first ``k`` (top-k accuracy)."""
    return reference[0] in ranked[:k]


def pair_loss_db(reference_abs_y: Float64Array, chosen: int) -> float:
    """What is lost by serving a user of the reference channel with pair ``chosen`` [dB], ≥ 0.

    20·log10(max |y| / |y_chosen|): near 0 where pairs are about as good as each other, so that choosing
    another one does no harm.
    """
    flat = reference_abs_y.ravel()
    best, got = float(flat.max()), float(flat[chosen])
    return 20 * float(np.log10(best / got)) if got > 0 else -FLOOR_DB
