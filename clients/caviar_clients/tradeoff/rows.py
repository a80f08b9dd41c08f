"""What a setting costs and how far off it is, as one row."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Annotated

import msgspec
import numpy as np

from caviar_clients.tradeoff.users import ANGLES, Difference, decibel
from caviar_protocol.arrays import quantity


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
