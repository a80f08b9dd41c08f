"""Frames at instants that the scenario lists, in place of a sampling period."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from decimal import Decimal
from itertools import pairwise
from typing import Any

from caviar_protocol.tables import Place

KEY = "instants_s"
REPLACED = ("frames", "sampling_period_ns")
"""What the instants tell, too."""

_LATEST_S = 2**63 // 10**9


def instants_ns(instants_s: Iterable[float]) -> tuple[int, ...]:
    """Instants [ns] of decimal numbers of seconds, without the error of binary fractions."""
    return tuple(int(_nanoseconds(value)) for value in instants_s)


def with_instants(table: Mapping[str, Any], place: Place) -> dict[str, Any]:
    """The table ``run`` of a scenario with ``frames`` and ``sampling_period_ns`` from its instants.

    The period is the greatest common divisor of the instants, so that each is a multiple of it.
    Raises `ScenarioError` for instants that are no strictly increasing whole nanoseconds, or beside
    a key that they replace. A table without instants, or with ones of a wrong type, is left alone.
    """
    values = table.get(KEY)
    if values is None:
        return dict(table)
    for key in REPLACED:
        if key in table:
            raise place.at(key).error(f"follows from {KEY}; remove one of both keys")
    if not isinstance(values, list) or not all(type(value) in (int, float) for value in values):
        return {**table, "frames": 1}  # so that its own type is what is found wrong
    here = place.at(KEY)
    if not values:
        raise here.error("is empty, write the instant of each frame: [0.0, 0.1, 0.35]")
    for index, value in enumerate(values):
        if not 0 <= value < _LATEST_S or _nanoseconds(value) % 1:
            raise here.at(index).error(f"is {value}, write seconds ≥ 0 with at most 9 decimals")
    for index, (before, value) in enumerate(pairwise(values), 1):
        if value <= before:
            raise here.at(index).error(f"{value} does not come after {before}; order the instants by time")
    instants = instants_ns(values)
    period = math.gcd(*instants)
    return {**table, "frames": len(instants), **({"sampling_period_ns": period} if period else {})}


def _nanoseconds(seconds: float) -> Decimal:
    return Decimal(repr(seconds)).scaleb(9)
