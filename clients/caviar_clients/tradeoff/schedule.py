"""Who is measured how often, and in which order, so that all fits a time."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from caviar_clients.tradeoff.ladder import Setting


def spread_order(count: int) -> list[int]:
    """All indices below ``count``, such that the first few of them lie far apart.

    Sorted by their binary digits reversed (van der Corput 1935).
    """
    digits = max(1, (count - 1).bit_length())
    return sorted(range(count), key=lambda i: int(f"{i:0{digits}b}"[::-1], 2))


def shares(costs_s: Sequence[float], most: Sequence[int], seconds: float) -> list[int]:
    """How often each is measured within ``seconds`` in all: at least once, at most ``most`` times.

    The time is shared out equally, and what the cheap ones leave goes to the dear ones.
    """
    counts, left = [0] * len(costs_s), seconds
    order = sorted(range(len(costs_s)), key=lambda i: costs_s[i] * most[i])
    for rank, i in enumerate(order):
        share = left / (len(order) - rank)
        counts[i] = max(1, min(most[i], int(share / costs_s[i]) if costs_s[i] > 0 else most[i]))
        left -= counts[i] * costs_s[i]
    return counts


@dataclass(frozen=True)
class Cost:
    """What one scene of a setting took [s]."""

    setting: Setting
    seconds: float


def predicted_s(setting: Setting, known: Sequence[Cost]) -> float | None:
    """What a scene of a setting of a table will take [s], from others of the same table; None: unknown.

    From the row of its column that was measured last: as much longer as the same two rows differ in the
    first column, or as there are more pairs of elements, or more samples, whichever says most.
    """
    column = [cost for cost in known if setting.column and cost.setting.column == setting.column]
    if not column:
        return None
    last = column[-1]
    first = known[0].setting.column
    by_row = {cost.setting.row: cost.seconds for cost in known if cost.setting.column == first}
    ratios = [
        _ratio(_pairs(setting), _pairs(last.setting)),
        _ratio(_samples(setting), _samples(last.setting)),
    ]
    if by_row.get(last.setting.row) and setting.row in by_row:
        ratios.append(by_row[setting.row] / by_row[last.setting.row])
    return last.seconds * max(ratios)


def _pairs(setting: Setting) -> int:
    return setting.elements[0] * setting.elements[1] if setting.elements else 1


def _samples(setting: Setting) -> int:
    settings: Mapping[str, object] = setting.settings
    samples = settings.get("samples", 1)
    return samples if isinstance(samples, int) else 1


def _ratio(more: int, less: int) -> float:
    return more / less
