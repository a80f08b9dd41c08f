"""Pairs of many by many that pass a test, in the ray tracer's arrays: the lanes of a kernel."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from caviar_protocol.arrays import Int64Array

_LANES = 1 << 23
"""Pairs that are looked at together at most."""


def pairs(first: int, second: int, test: Callable[[Any, Any], Any]) -> tuple[Any, Any]:
    """Which pairs of numbers below ``first`` and below ``second`` pass a test, as `mitsuba.UInt`."""
    import drjit as dr
    import mitsuba as mi

    parts = []
    at_once = max(1, _LANES // max(second, 1))
    many = dr.opaque(mi.UInt, second)
    for begin in range(0, first if second else 0, at_once):
        count = min(at_once, first - begin)
        lane = dr.arange(mi.UInt, count * second)
        start = dr.opaque(mi.UInt, begin)
        kept: Any = dr.compress(test(start + lane // many, lane % many))
        if dr.width(kept):
            parts.append((start + kept // many, kept % many))
    if not parts:
        return mi.UInt(), mi.UInt()
    if len(parts) == 1:
        return parts[0]
    return dr.concat([one for one, _ in parts]), dr.concat([other for _, other in parts])


def filtered(test: Callable[[Any, Any], Any], numbers: tuple[Any, Any]) -> tuple[Any, Any]:
    """Those of pairs of numbers that pass a test."""
    import drjit as dr

    if not dr.width(numbers[0]):
        return numbers
    kept = dr.compress(test(*numbers))
    found = gathered(numbers[0], kept), gathered(numbers[1], kept)
    dr.eval(found)
    return found


def gathered(column: Any, index: Any) -> Any:
    """Elements of a column of the ray tracer, by index."""
    import drjit as dr

    return dr.gather(type(column), column, index)


def opaque(number: int) -> Any:
    """A number that a kernel reads: as a constant of the kernel, each would be another kernel."""
    import drjit as dr
    import mitsuba as mi

    return dr.opaque(mi.UInt, number)


def numbers(indices: Any) -> Int64Array:
    """Indices of the ray tracer for NumPy, Shape ``[N]``."""
    found: Int64Array = indices.numpy().astype(np.int64)
    return found
