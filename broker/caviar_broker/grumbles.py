"""Notices about what can happen a thousand times a second, told often enough and not more often."""

from __future__ import annotations

PERIOD_NS = 10_000_000_000
"""[ns] between two notices of one kind."""


class Grumbles:
    """Counts repetitions: the first of a kind is told at once, later ones together, every `PERIOD_NS`.

    What a peer sends must never decide how much the broker writes; what is held back is counted.
    """

    def __init__(self) -> None:
        self._told: dict[str, tuple[int, int]] = {}

    def tell(self, kind: str, text: str, now: int) -> str:
        """The text to tell now, with the number of those held back; empty: hold it back."""
        last, held = self._told.get(kind, (None, 0))
        if last is not None and now - last < PERIOD_NS:
            self._told[kind] = (last, held + 1)
            return ""
        self._told[kind] = (now, 0)
        return f"{text} (and {held} more of this kind)" if held else text
