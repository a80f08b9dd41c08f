"""Errors of a channel setting: figures of a user's channel, differences of two channels, rows of a report.

A user is a pair of devices on one carrier. `user_channels` computes what each user of a scene gets,
`differences` compares that with the reference, and `error_fields` takes means over all users.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Annotated, Any, NamedTuple

import msgspec
import numpy as np

from caviar_clients.session.scenes import Scenes
from caviar_protocol.arrays import Complex128Array, Float64Array, quantity
from caviar_protocol.multipath import power_spread
from caviar_protocol.scenario.conversion import convert_settings
from caviar_protocol.space.beams import beam_gains
from caviar_protocol.topics import Channel, Scene
from caviar_services.link.base import User, channels_of, users_of
from caviar_services.link.beams import BeamLinkSettings
from caviar_services.link.link_budget import noise_power, transmit_power

FLOOR_DB = -200.0
"""[dB] Difference of equal channels: float64 carries no more than −313 dB, and no text reads well with −∞."""


def path_gain_db(a: Complex128Array) -> float:
    """Compute the path gain of a pair [dB]: the sum of its paths' powers, whatever their phases.

    10·log10 Σ|a_p|² (Recommendation ITU-R P.1407-8, the integral over the power delay profile). −∞ without
    a path.

    Args:
        a: Amplitudes of the paths, Shape ``[P]``.

    Example:
        >>> round(path_gain_db(np.array([0.003, 0.004j])), 2)
        -46.02
    """
    power = float((np.abs(a) ** 2).sum())
    return 10 * float(np.log10(power)) if power > 0 else -np.inf


def angular_spread_rad(angle: Float64Array, power: Float64Array) -> float:
    """Compute the circular angular spread [rad] (3GPP TR 38.901, annex A.1).

    AS = sqrt(−2·ln |Σ exp(jφ_p)·P_p / ΣP|): it depends neither on the zero of the angle nor on where it
    wraps. Powers that cancel, as of two equal waves from opposite directions, have no bound; then the
    spread is that of the smallest resultant float64 can hold.

    Args:
        angle: Angles of the paths [rad], Shape ``[P]``.
        power: Their powers, Shape ``[P]``.

    Example:
        >>> spread = angular_spread_rad(np.radians([-30.0, 30.0]), np.array([1.0, 1.0]))
        >>> round(math.degrees(spread), 2)
        30.73
    """
    resultant = abs((np.exp(1j * angle) * power).sum()) / power.sum()
    # The resultant of a single wave may be above 1 by rounding, and its logarithm positive.
    return float(np.sqrt(-2 * np.log(min(1.0, max(resultant, np.finfo(np.float64).tiny)))))


def nmse(h: Complex128Array, reference: Complex128Array) -> float:
    """Compute the normalised squared error ‖H − H_ref‖_F² / ‖H_ref‖_F², phases included.

    1 for H = 0. Its mean over channels is the NMSE as usually defined, E[‖H − H_ref‖² / ‖H_ref‖²].

    Example:
        >>> round(nmse(np.array([[1.1 + 0j]]), np.array([[1.0 + 0j]])), 6)
        0.01
    """
    return float((np.abs(h - reference) ** 2).sum() / (np.abs(reference) ** 2).sum())


def decibel(ratio: float) -> float:
    """Convert a ratio of powers to dB, not below `FLOOR_DB`.

    Example:
        >>> round(decibel(0.5), 2), decibel(0.0)
        (-3.01, -200.0)
    """
    return max(FLOOR_DB, 10 * float(np.log10(ratio))) if ratio > 0 else FLOOR_DB


def capacity_bps_hz(h: Complex128Array, power_over_noise: float) -> float:
    """Compute the capacity [bit/s/Hz] with equal power on all transmit elements, H known at the receiver.

    C = log2 det(I + P/(N_t·N)·H·H*) (Telatar, "Capacity of multi-antenna Gaussian channels", 1999,
    theorem 1 for a fixed H), from the singular values of H.

    Args:
        h: The channel, Shape ``[N_r, N_t]``.
        power_over_noise: P/N.

    Example:
        >>> round(capacity_bps_hz(np.eye(2, dtype=complex), 10.0), 3)
        5.17
    """
    # Without H·H*: its condition is that of H squared.
    singular = np.linalg.svd(h, compute_uv=False)
    return float(np.log2(1 + power_over_noise / h.shape[1] * singular**2).sum())


def top_k(abs_y: Float64Array, k: int) -> list[int]:
    """Rank the ``k`` greatest |y|: flat indices, greatest first; of equal ones the lowest first.

    Example:
        >>> top_k(np.array([[0.1, 0.9], [0.4, 0.2]]), 2)
        [1, 2]
    """
    return [int(i) for i in np.argsort(-abs_y.ravel(), kind="stable")[:k]]


def hit(ranked: list[int], reference: list[int], k: int) -> bool:
    """Tell whether the reference's best pair is among the first ``k`` (top-k accuracy).

    Example:
        >>> hit([1, 2], [2, 1], 1), hit([1, 2], [2, 1], 2)
        (False, True)
    """
    return reference[0] in ranked[:k]


def pair_loss_db(reference_abs_y: Float64Array, chosen: int) -> float:
    """Compute the loss [dB] of serving a user of the reference channel with another pair of beams, ≥ 0.

    20·log10(max |y| / |y_chosen|): near 0 where pairs are about as good as each other, so that choosing
    another one does no harm.

    Args:
        reference_abs_y: |y| of all pairs of beams in the reference, Shape ``[Nt, Nr]``.
        chosen: Flat index of the pair that is chosen.

    Example:
        >>> round(pair_loss_db(np.array([[1.0, 0.5]]), 1), 2)
        6.02
    """
    flat = reference_abs_y.ravel()
    best, got = float(flat.max()), float(flat[chosen])
    return 20 * float(np.log10(best / got)) if got > 0 else -FLOOR_DB


Key = tuple[int, str, str, str]
"""Frame, transmitter, receiver, carrier."""

ANGLES = ("aod_zenith", "aod_azimuth", "aoa_zenith", "aoa_azimuth")
"""Order of angular spreads."""


@dataclass(frozen=True)
class Noise:
    """Settings of the link that the capacity depends on; see `BeamLinkSettings`."""

    figure_db: float
    temperature_k: float

    @classmethod
    def of(cls, scenes: Scenes) -> Noise:
        """Take the noise of the scenario's link ``beams``, else the link's default."""
        settings = convert_settings(BeamLinkSettings, scenes.settings_of("link", "beams"))
        return cls(settings.noise_figure_db, settings.temperature_k)


@dataclass(frozen=True, kw_only=True, eq=False)
class UserChannel:
    """A user's channel and the figures that follow from it.

    Args:
        los: Whether there is a line of sight.
        path_gain_db: Path gain [dB]; −∞ without a path.
        delay_spread_s: Delay spread [s]; None without a path.
        angular_spread_rad: Spreads of `ANGLES` [rad], Shape ``[4]``; None without a path.
        h: H, Shape ``[Nr, Nt]``; None without a path.
        capacity_bps_hz: Capacity [bit/s/Hz]; 0 without a path.
        abs_y: |y| of all pairs of beams, Shape ``[Nt, Nr]``; None without a path.
        ranked: The five best pairs, best first; empty without a path.
    """

    los: bool
    path_gain_db: float = -np.inf
    delay_spread_s: float | None = None
    angular_spread_rad: Float64Array | None = None
    h: Complex128Array | None = None
    capacity_bps_hz: float = 0.0
    abs_y: Float64Array | None = None
    ranked: list[int] = field(default_factory=list)


def user_channels(frame: int, scene: Scene, channel: Channel, noise: Noise) -> dict[Key, UserChannel]:
    """Compute the channels of all users of a scene.

    Args:
        frame: Number of the frame, for the keys.
        scene: Devices of the users.
        channel: Paths and H.
        noise: Noise of the receivers, for the capacity.
    """
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
        return UserChannel(los=los)
    paths = channel.pair(user.tx.name, user.rx.name)
    a = channel.a[channel.carriers.index(user.carrier), paths]
    # Spreads are weighted by power, as measured ones are: weak paths far away count little.
    power = np.abs(a) ** 2
    directions = np.concatenate([channel.aod[paths], channel.aoa[paths]], axis=1)
    noise_w = noise_power(user.carrier, noise.figure_db, noise.temperature_k)
    abs_y = beam_gains(h, user.tx.array, user.rx.array)
    return UserChannel(
        los=los,
        path_gain_db=path_gain_db(a),
        delay_spread_s=float(power_spread(power, channel.tau[paths])),
        angular_spread_rad=np.array([angular_spread_rad(angle, power) for angle in directions.T]),
        h=h,
        capacity_bps_hz=capacity_bps_hz(h, transmit_power(user) / noise_w),
        abs_y=abs_y,
        ranked=top_k(abs_y, 5),
    )


class Difference(NamedTuple):
    """Differences of a user's channel from the reference's; None where one of them has no path."""

    missed: bool
    """The reference has a path, the channel none."""
    invented: bool
    """The channel has a path, the reference none."""
    los_agrees: bool
    path_gain_db: float | None
    delay_spread_s: float | None
    angular_spread_rad: Float64Array | None
    nmse: float | None
    """None where the reference has no path."""
    capacity_bps_hz: float
    top1: bool | None
    top5: bool | None
    pair_loss_db: float | None


def difference(found: UserChannel, reference: UserChannel) -> Difference:
    """Compare a user's channel with the reference's: found minus reference."""
    has, should = found.h is not None, reference.h is not None
    value, top1, top5, loss = None, None, None, None
    if reference.h is not None and reference.abs_y is not None:
        # A channel without a path is H = 0; for one that the reference does not have there is no ratio.
        value = 1.0 if found.h is None else nmse(found.h, reference.h)
        top1, top5 = (hit(found.ranked, reference.ranked, k) for k in (1, 5))
        loss = pair_loss_db(reference.abs_y, found.ranked[0]) if found.ranked else None
    return Difference(
        missed=should and not has,
        invented=has and not should,
        los_agrees=found.los == reference.los,
        path_gain_db=found.path_gain_db - reference.path_gain_db if has and should else None,
        delay_spread_s=_minus(found.delay_spread_s, reference.delay_spread_s),
        angular_spread_rad=_minus(found.angular_spread_rad, reference.angular_spread_rad),
        nmse=value,
        capacity_bps_hz=found.capacity_bps_hz - reference.capacity_bps_hz,
        top1=top1,
        top5=top5,
        pair_loss_db=loss,
    )


def _minus(found: Any, reference: Any) -> Any:
    return None if found is None or reference is None else found - reference


def differences(found: Mapping[Key, UserChannel], reference: Mapping[Key, UserChannel]) -> list[Difference]:
    """Compare all users that both know."""
    return [difference(channel, reference[key]) for key, channel in found.items() if key in reference]


class Row(msgspec.Struct, frozen=True, kw_only=True):
    """Cost and errors of a setting.

    Errors are against the reference, over all users of all scenes that both have; None where there are none.
    """

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
    """Compute the fields of a `Row` that state errors, over all users.

    Args:
        found: Differences of the users; without any, all errors are None.
    """
    gains = _values(found, lambda d: d.path_gain_db)
    delays = _values(found, lambda d: d.delay_spread_s)
    # The mean of ratios, not the ratio of means: in that the users with the strongest channels decide alone.
    nmse = _values(found, lambda d: d.nmse)
    capacity = _values(found, lambda d: d.capacity_bps_hz)
    angles = {
        f"{name}_spread_error_deg": mean_or_none(
            [math.degrees(abs(d.angular_spread_rad[i])) for d in found if d.angular_spread_rad is not None]
        )
        for i, name in enumerate(ANGLES)
    }
    return {
        "users": len(found),
        "path_gain_error_db": mean_or_none([abs(gain) for gain in gains]),
        "path_gain_bias_db": mean_or_none(gains),
        "path_gain_error_db_p95": _percentile([abs(gain) for gain in gains], 95),
        "delay_spread_error_ns": mean_or_none([abs(delay) * 1e9 for delay in delays]),
        **angles,
        "nmse_db": _decibel(mean_or_none(nmse)),
        # A user without its line of sight has an NMSE of about 1 and decides the mean: hence the median.
        "nmse_db_median": _decibel(_percentile(nmse, 50)),
        "nmse_db_p95": _decibel(_percentile(nmse, 95)),
        "capacity_error_bps_hz": mean_or_none([abs(error) for error in capacity]),
        "capacity_bias_bps_hz": mean_or_none(capacity),
        "beam_top1": mean_or_none(_values(found, lambda d: d.top1)),
        "beam_top5": mean_or_none(_values(found, lambda d: d.top5)),
        "beam_loss_db": mean_or_none(_values(found, lambda d: d.pair_loss_db)),
        "los_agreement": mean_or_none(_values(found, lambda d: d.los_agrees)),
        "missed": mean_or_none(_values(found, lambda d: d.missed)),
        "invented": mean_or_none(_values(found, lambda d: d.invented)),
    }


def _values(found: Sequence[Difference], of: Callable[[Difference], float | None]) -> list[float]:
    return [float(value) for d in found if (value := of(d)) is not None]


def mean_or_none(values: Sequence[float]) -> float | None:
    """Return the mean of some values; None where there are none."""
    return sum(values) / len(values) if values else None


def _percentile(values: Sequence[float], percent: float) -> float | None:
    return float(np.percentile(values, percent)) if values else None


def _decibel(ratio: float | None) -> float | None:
    return None if ratio is None else decibel(ratio)
