"""What more samples of the launch bring: error against many, and how far seeds are apart."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import combinations
from typing import Annotated

import msgspec
import numpy as np

from caviar_clients.tradeoff.campaign import Measured
from caviar_clients.tradeoff.ladder import TRUTH
from caviar_clients.tradeoff.rows import error_fields
from caviar_clients.tradeoff.users import Key, UserChannel, differences
from caviar_protocol.arrays import quantity


class Point(msgspec.Struct, frozen=True, kw_only=True):
    """All seeds with one number of samples. A pair is two of the seeds, over all users."""

    paths: str
    """``specular`` or ``diffuse``."""
    samples: Annotated[int, quantity("1", "rays launched per transmitter")]
    seeds: int
    time_ms_median: Annotated[float, quantity("ms", "wall time of a scene")]
    nmse_db: tuple[float, ...]
    """Of each seed against the most samples [dB], as `Row.nmse_db`; none for diffuse paths."""
    pair_nmse_db: Annotated[float | None, quantity("dB", "NMSE of H between the seeds of a pair")]
    pair_gain_db_p95: Annotated[float | None, quantity("dB", "95 % of pairs differ by less in path gain")]
    pair_beam_top1: Annotated[float | None, quantity("1", "share of pairs with the same best beam pair")]
    users: Annotated[int, quantity("1", "user pairs compared")]


def points(measured: Sequence[Measured]) -> list[Point]:
    """One point for each kind of path and number of samples."""
    groups: dict[tuple[str, str], list[Measured]] = {}
    truth: dict[Key, UserChannel] = {}
    for entry in measured:
        if entry.setting.label == TRUTH:
            truth = entry.users
        else:
            groups.setdefault((entry.setting.column, entry.setting.row), []).append(entry)
    return [_point(kind, int(row), group, truth) for (kind, row), group in groups.items()]


def _point(kind: str, samples: int, group: Sequence[Measured], truth: Mapping[Key, UserChannel]) -> Point:
    pairs = [d for one, other in combinations(group, 2) for d in differences(one.users, other.users)]
    between = error_fields(pairs)
    against = [error_fields(differences(entry.users, truth))["nmse_db"] for entry in group]
    return Point(
        paths=kind,
        samples=samples,
        seeds=len(group),
        time_ms_median=float(np.median([ms for entry in group for ms in entry.times_ms])),
        # Specular paths become more and more the same; diffuse ones are drawn anew with each seed.
        nmse_db=tuple(v for v in against if v is not None) if kind == "specular" else (),
        pair_nmse_db=between["nmse_db"],
        pair_gain_db_p95=between["path_gain_error_db_p95"],
        pair_beam_top1=between["beam_top1"],
        users=len(pairs),
    )
