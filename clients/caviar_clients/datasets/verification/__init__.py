"""Verification of a dataset: what is missing, altered, or does not follow from physics.

`verify` compares files with the catalogue, looks at what each recording has to have, and at the content of
each scene (`physics`, `channel_checks`), computed anew from positions, scenery and H. A `Finding` is
something that is wrong.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import asdict, dataclass
from typing import Any

SHOWN_RANGES = 5
"""Ranges of numbers that a text lists."""


@dataclass(frozen=True)
class Finding:
    """Something that is wrong."""

    episode: int
    """Of several episodes the first; −1: of the dataset as a whole."""
    scene: int | None
    """None: of the episode as a whole."""
    user: str
    """Receiver; empty: of the scene as a whole."""
    what: str
    expected: str
    found: str


def as_rows(findings: Iterable[Finding]) -> list[dict[str, Any]]:
    """Findings as plain values, for a file."""
    return [asdict(one) for one in findings]


def gaps(numbers: Iterable[int], count: int) -> list[range]:
    """Ranges of 0 … count − 1 that lack, in order; the cost is that of the numbers that are there.

    Args:
        numbers: Those that are there, ascending.
        count: How many there shall be.

    Example:
        >>> gaps([1, 2, 5], 10**9)
        [range(0, 1), range(3, 5), range(6, 1000000000)]
    """
    found, start = [], 0
    for number in numbers:
        stop = min(number, count)
        if stop > start:
            found.append(range(start, stop))
        start = max(start, number + 1)
    if count > start:
        found.append(range(start, count))
    return found


def runs(numbers: Iterable[int]) -> list[range]:
    """Ascending numbers as ranges without a gap.

    Example:
        >>> runs([1, 2, 5])
        [range(1, 3), range(5, 6)]
    """
    found: list[range] = []
    for number in numbers:
        if found and found[-1].stop == number:
            found[-1] = range(found[-1].start, number + 1)
        else:
            found.append(range(number, number + 1))
    return found


def listed(ranges: list[range], what: str) -> str:
    """Name ranges of numbers, and how many numbers they are.

    Args:
        ranges: In order.
        what: One of the numbers is.

    Example:
        >>> listed([range(12, 2086)], "episode"), listed([range(3, 4)], "scene")
        ('episodes 12–2085 (2,074)', 'scene 3')
    """
    # By their ends: a range of more than 2**63 numbers has no `len`.
    count = sum(one.stop - one.start for one in ranges)
    shown = [
        str(one.start) if one.stop - one.start == 1 else f"{one.start}–{one.stop - 1}"
        for one in ranges[:SHOWN_RANGES]
    ]
    if len(ranges) > SHOWN_RANGES:
        shown.append("…")
    return f"{what} {shown[0]}" if count == 1 else f"{what}s {', '.join(shown)} ({count:,})"
