"""What a setting costs and how far off it is, as one row.

What a user (a pair of devices on one carrier) gets from a channel, and how two channels differ for it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, NamedTuple

import msgspec
import numpy as np

from caviar_clients.tradeoff.scenes import Scenes
from caviar_protocol.arrays import Complex128Array, Float64Array, quantity
from caviar_protocol.scenario.conversion import convert_settings
from caviar_protocol.topics import Channel, Scene
from caviar_services.link.base import User, channels_of, noise_power, transmit_power, users_of
from caviar_services.link.beam_sweep import BeamLinkSettings, sweep

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


Key = tuple[int, str, str, str]
"""Frame, transmitter, receiver, carrier."""

ANGLES = ("aod_zenith", "aod_azimuth", "aoa_zenith", "aoa_azimuth")


@dataclass(frozen=True)
class Noise:
    """What the capacity takes from the link's settings; see `BeamLinkSettings`."""

    figure_db: float
    temperature_k: float

    @classmethod
    def of(cls, scenes: Scenes) -> Noise:
        """That of the scenario's link ``beams``, else the link's default."""
        settings = convert_settings(BeamLinkSettings, scenes.settings_of("link", "beams"))
        return cls(settings.noise_figure_db, settings.temperature_k)


@dataclass(frozen=True, kw_only=True, eq=False)
class UserChannel:
    """One user's channel and what follows from it; no path, no spread: None."""

    los: bool
    path_gain_db: float
    """−∞ without a path."""
    delay_spread_s: float | None
    angular_spread_rad: tuple[float, ...] | None
    """In the order of `ANGLES`."""
    h: Complex128Array | None
    capacity_bps_hz: float
    abs_y: Float64Array | None
    """|y| of all pairs of beams, Shape ``[Nt, Nr]``."""
    ranked: list[int]
    """The five best pairs, best first; none without a path."""


def user_channels(frame: int, scene: Scene, channel: Channel, noise: Noise) -> dict[Key, UserChannel]:
    """The channels of all users of a scene."""
    users = users_of(scene, channel.carriers)
    looked_up = channels_of(channel, users)
    return {
        (frame, user.tx.name, user.rx.name, user.carrier.name): _user_channel(
            user, channel, bool(los), h, noise
        )
        for user, los, h in zip(users, looked_up.los, looked_up.h, strict=True)
    }


def _user_channel(
    user: User, channel: Channel, los: bool, h: Complex128Array | None, noise: Noise
) -> UserChannel:
    if h is None:
        return UserChannel(
            los=los,
            path_gain_db=-np.inf,
            delay_spread_s=None,
            angular_spread_rad=None,
            h=None,
            capacity_bps_hz=0.0,
            abs_y=None,
            ranked=[],
        )
    paths = channel.pair(user.tx.name, user.rx.name)
    a = channel.a[channel.carriers.index(user.carrier), paths]
    power = np.abs(a) ** 2
    directions = np.concatenate([channel.aod[paths], channel.aoa[paths]], axis=1)
    noise_w = noise_power(user.carrier, noise.figure_db, noise.temperature_k)
    abs_y = sweep(h, user.tx.array, user.rx.array)
    return UserChannel(
        los=los,
        path_gain_db=path_gain_db(a),
        delay_spread_s=delay_spread_s(channel.tau[paths], power),
        angular_spread_rad=tuple(angular_spread_rad(angle, power) for angle in directions.T),
        h=h,
        capacity_bps_hz=capacity_bps_hz(h, transmit_power(user) / noise_w),
        abs_y=abs_y,
        ranked=top_k(abs_y, 5),
    )


class Difference(NamedTuple):
    """How far a user's channel is from the reference's; None where one of them has no path."""

    missed: bool
    """The reference has a path, the channel none."""
    invented: bool
    """The other way round."""
    los_agrees: bool
    path_gain_db: float | None
    delay_spread_s: float | None
    angular_spread_rad: tuple[float, ...] | None
    nmse: float | None
    """None where the reference has no path."""
    capacity_bps_hz: float
    top1: bool | None
    top5: bool | None
    pair_loss_db: float | None


def difference(found: UserChannel, reference: UserChannel) -> Difference:
    """Found minus reference."""
    has, should = found.h is not None, reference.h is not None
    spreads = None
    if found.angular_spread_rad is not None and reference.angular_spread_rad is not None:
        pairs = zip(found.angular_spread_rad, reference.angular_spread_rad, strict=True)
        spreads = tuple(got - expected for got, expected in pairs)
    delay = None
    if found.delay_spread_s is not None and reference.delay_spread_s is not None:
        delay = found.delay_spread_s - reference.delay_spread_s
    value, top1, top5, loss = None, None, None, None
    if reference.h is not None and reference.abs_y is not None:
        value = 1.0 if found.h is None else nmse(found.h, reference.h)
        top1, top5 = (hit(found.ranked, reference.ranked, k) for k in (1, 5))
        loss = pair_loss_db(reference.abs_y, found.ranked[0]) if found.ranked else None
    return Difference(
        missed=should and not has,
        invented=has and not should,
        los_agrees=found.los == reference.los,
        path_gain_db=found.path_gain_db - reference.path_gain_db if has and should else None,
        delay_spread_s=delay,
        angular_spread_rad=spreads,
        nmse=value,
        capacity_bps_hz=found.capacity_bps_hz - reference.capacity_bps_hz,
        top1=top1,
        top5=top5,
        pair_loss_db=loss,
    )


def differences(found: Mapping[Key, UserChannel], reference: Mapping[Key, UserChannel]) -> list[Difference]:
    """Of all users that both know."""
    return [difference(channel, reference[key]) for key, channel in found.items() if key in reference]


class Row(msgspec.Struct, frozen=True, kw_only=True):
    """One setting. Errors are against the reference, over all users of all scenes that both have."""

    setting: str
    block: str
    column: str
    row: str
    rung: str
    """As the product says."""
    time_ms_median: Annotated[float, quantity("ms", "wall time of a scene")]
    time_ms_p99: Annotated[float, quantity("ms", "of as many measurements as there are")]
    factor: Annotated[float, quantity("1", "median time over the baseline's, measured by turns")]
    memory_mib: Annotated[float | None, quantity("MiB", "resident, growth at the peak of a scene")]
    loaded_mib: Annotated[float | None, quantity("MiB", "resident, growth by loading and warming up")]
    prepare_s: Annotated[float, quantity("s", "loading, compilation and the first scene")]
    measurements: int
    scenes: int
    receivers: Annotated[float, quantity("1", "of a scene, mean")]
    paths: Annotated[float, quantity("1", "of a scene, mean")]
    users: int
    """Users that errors are taken over."""
    path_gain_error_db: Annotated[float | None, quantity("dB", "mean absolute error")]
    path_gain_bias_db: Annotated[float | None, quantity("dB", "mean error")]
    path_gain_error_db_p95: Annotated[float | None, quantity("dB", "95 % of users are nearer")]
    delay_spread_error_ns: Annotated[float | None, quantity("ns", "mean absolute error")]
    aod_zenith_spread_error_deg: Annotated[float | None, quantity("°", "mean absolute error")]
    aod_azimuth_spread_error_deg: Annotated[float | None, quantity("°", "mean absolute error")]
    aoa_zenith_spread_error_deg: Annotated[float | None, quantity("°", "mean absolute error")]
    aoa_azimuth_spread_error_deg: Annotated[float | None, quantity("°", "mean absolute error")]
    nmse_db: Annotated[float | None, quantity("dB", "mean over users of ‖H − H_ref‖²/‖H_ref‖²")]
    nmse_db_median: Annotated[float | None, quantity("dB", "of the median user")]
    nmse_db_p95: Annotated[float | None, quantity("dB", "95 % of users are better")]
    capacity_error_bps_hz: Annotated[float | None, quantity("bit/s/Hz", "mean absolute error")]
    capacity_bias_bps_hz: Annotated[float | None, quantity("bit/s/Hz", "mean error")]
    beam_top1: Annotated[float | None, quantity("1", "share whose best pair is the reference's")]
    beam_top5: Annotated[float | None, quantity("1", "share with the reference's among their best 5")]
    beam_loss_db: Annotated[float | None, quantity("dB", "mean loss of |y| by the best pair found")]
    los_agreement: Annotated[float | None, quantity("1", "share of equal LOS states")]
    missed: Annotated[float | None, quantity("1", "share with a path in the reference alone")]
    invented: Annotated[float | None, quantity("1", "share with a path here alone")]
    with_bound: Annotated[
        float | None, quantity("1", "share of interpolated channels whose bound is finite")
    ] = None
    within_bound: Annotated[float | None, quantity("1", "of those, share whose error keeps within it")] = None
    note: str = ""


def error_fields(found: Sequence[Difference]) -> dict[str, float | int | None]:
    """The fields of a `Row` that say how far off a setting is."""
    gains = _values(found, lambda d: d.path_gain_db)
    delays = _values(found, lambda d: d.delay_spread_s)
    nmse = _values(found, lambda d: d.nmse)
    capacity = _values(found, lambda d: d.capacity_bps_hz)
    angles = {
        f"{name}_spread_error_deg": _mean(
            [math.degrees(abs(d.angular_spread_rad[i])) for d in found if d.angular_spread_rad is not None]
        )
        for i, name in enumerate(ANGLES)
    }
    return {
        "users": len(found),
        "path_gain_error_db": _mean([abs(gain) for gain in gains]),
        "path_gain_bias_db": _mean(gains),
        "path_gain_error_db_p95": _percentile([abs(gain) for gain in gains], 95),
        "delay_spread_error_ns": _mean([abs(delay) * 1e9 for delay in delays]),
        **angles,
        "nmse_db": _decibel(_mean(nmse)),
        "nmse_db_median": _decibel(_percentile(nmse, 50)),
        "nmse_db_p95": _decibel(_percentile(nmse, 95)),
        "capacity_error_bps_hz": _mean([abs(error) for error in capacity]),
        "capacity_bias_bps_hz": _mean(capacity),
        "beam_top1": _mean(_values(found, lambda d: d.top1)),
        "beam_top5": _mean(_values(found, lambda d: d.top5)),
        "beam_loss_db": _mean(_values(found, lambda d: d.pair_loss_db)),
        "los_agreement": _mean(_values(found, lambda d: d.los_agrees)),
        "missed": _mean(_values(found, lambda d: d.missed)),
        "invented": _mean(_values(found, lambda d: d.invented)),
    }


def _values(found: Sequence[Difference], of: Callable[[Difference], float | None]) -> list[float]:
    return [float(value) for d in found if (value := of(d)) is not None]


def _mean(values: Sequence[float]) -> float | None:
    return sum(values) / len(values) if values else None


def _percentile(values: Sequence[float], percent: float) -> float | None:
    return float(np.percentile(values, percent)) if values else None


def _decibel(ratio: float | None) -> float | None:
    return None if ratio is None else decibel(ratio)
