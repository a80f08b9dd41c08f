"""Which rung the next frame is computed on: down at once, up with patience."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import msgspec


@dataclass(frozen=True, kw_only=True)
class Choice:
    """A rung by its place on the ladder, 0 the lowest."""

    rung: int
    fits: bool
    """Whether the frame is expected to be done in time."""


class ControllerState(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A `Controller` between two frames."""

    current: int | None
    streaks: tuple[int, ...]


class Controller:
    """The most accurate rung whose predicted duration fits, with hysteresis.

    A predicted miss leads down in the same frame. Up it goes only to a rung that would have fitted, with
    ``margin`` to spare, in each of the last ``patience`` frames. So noise about a border does not make the
    products change their quality from frame to frame.

    Parameters
    ----------
    share
        Of the budget that a prediction may take: the rest is for decoding, encoding, and surprises.
    margin
        Share of that which must be spare before going up.
    patience
        Frames in a row that must have it.
    """

    def __init__(self, share: float, margin: float, patience: int) -> None:
        self._share, self._margin, self._patience = share, margin, patience
        self._current: int | None = None
        self._streaks: list[int] = []

    def reset(self) -> None:
        """Forget everything: the next frame is the first."""
        self._current, self._streaks = None, []

    @property
    def state(self) -> ControllerState:
        """The rung, and for how long others would have fitted."""
        return ControllerState(current=self._current, streaks=tuple(self._streaks))

    def go_on(self, state: ControllerState) -> None:
        """Be where another one was."""
        self._current, self._streaks = state.current, list(state.streaks)

    def choose(self, predicted_ns: Sequence[float], budget_ns: int) -> Choice:
        """The rung for a frame, from the duration predicted for each, lowest rung first.

        ``budget_ns`` 0 is no limit.
        """
        limit = budget_ns * self._share if budget_ns else float("inf")
        fits = [predicted <= limit for predicted in predicted_ns]
        spare = [predicted <= limit * (1 - self._margin) for predicted in predicted_ns]
        streaks = self._streaks or [self._patience] * len(fits)  # nothing is known: what fits may be taken
        self._streaks = [streak + 1 if ok else 0 for streak, ok in zip(streaks, spare, strict=True)]
        if self._current is None:
            return self._take(self._highest(fits), fits)
        current = self._current
        if not fits[current]:
            return self._take(self._highest(fits[:current]), fits)
        return self._take(max(current, self._highest([s >= self._patience for s in self._streaks])), fits)

    def impose(self, rung: int) -> None:
        """This rung was computed, whoever decided it."""
        if rung != self._current:
            self._streaks = [0] * len(self._streaks)
        self._current = rung

    def _take(self, rung: int, fits: Sequence[bool]) -> Choice:
        if rung != self._current:
            self._streaks = [0] * len(fits)
        self._current = rung
        return Choice(rung=rung, fits=fits[rung])

    @staticmethod
    def _highest(possible: Sequence[bool]) -> int:
        """The last that is possible; the lowest rung where none is."""
        return max((rung for rung, ok in enumerate(possible) if ok), default=0)
