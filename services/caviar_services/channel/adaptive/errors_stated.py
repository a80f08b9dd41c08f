"""What error a rung is expected to have, learned from frames that the highest rung computed too.

The error of a frame is the normalised mean square error of its matrices against those of the
highest rung, over all carriers and pairs: Σ‖H − Hᵣ‖² / Σ‖Hᵣ‖², in dB. Stated is the ⌈0.9 (n + 1)⌉-th
smallest of the last n errors (or the largest, for n < 9): were errors exchangeable, a further one would
be no larger in nine of ten cases (split conformal prediction: Vovk, Gammerman and Shafer, "Algorithmic
Learning in a Random World", 2005). Those of scenes that change are not, so how often it held is counted.
"""

from __future__ import annotations

import math
from collections import deque

import msgspec
import numpy as np

from caviar_protocol.topics import Channel

SHARE = 0.9
"""Of errors that what is stated shall bound."""

NEEDED = 3
"""Errors that must be known before one is stated."""

WINDOW = 100
"""Errors that are remembered."""

FLOOR_DB = -200.0
"""An error of nothing at all."""


def nmse_db(channel: Channel, reference: Channel) -> float | None:
    """NMSE of the matrices of a product [dB]; None where the reference has no path at all.

    Both are of the same scene, with matrices.
    """
    error = power = 0.0
    for mine, true in zip(channel.h, reference.h, strict=True):
        error += float((np.abs(mine.h - true.h) ** 2).sum())
        power += float((np.abs(true.h) ** 2).sum())
    if power == 0.0:
        return None
    return max(10 * math.log10(error / power), FLOOR_DB) if error > 0 else FLOOR_DB


class ErrorState(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A `StatedError` between two frames."""

    errors_db: tuple[float, ...]
    checks: int
    covered: int


class StatedError:
    """What is stated of one rung, and how often it held."""

    def __init__(self, declared_db: float | None = None) -> None:
        self._declared = declared_db
        self._errors: deque[float] = deque(maxlen=WINDOW)
        self.checks = 0
        """Errors that were measured when one was stated."""
        self.covered = 0
        """Of these, those no larger than stated."""

    @property
    def measured(self) -> int:
        """Errors that are remembered."""
        return len(self._errors)

    @property
    def stated_db(self) -> float | None:
        """Rounded up to 0.1 dB; None while nothing is known."""
        count = len(self._errors)
        if count < NEEDED:
            return self._declared
        rank = min(math.ceil(SHARE * (count + 1)), count)
        return math.ceil(sorted(self._errors)[rank - 1] * 10) / 10

    def check(self, error_db: float) -> bool | None:
        """Take note of a measured error. Whether what was stated held; None where nothing was."""
        stated = self.stated_db
        self._errors.append(error_db)
        if stated is None:
            return None
        self.checks += 1
        held = error_db <= stated
        self.covered += held
        return held

    @property
    def state(self) -> ErrorState:
        """What was measured."""
        return ErrorState(errors_db=tuple(self._errors), checks=self.checks, covered=self.covered)

    def go_on(self, state: ErrorState) -> None:
        """Know what another one knew."""
        self._errors = deque(state.errors_db, maxlen=WINDOW)
        self.checks, self.covered = state.checks, state.covered

    def reset(self) -> None:
        """Forget what was measured."""
        self._errors.clear()
        self.checks = self.covered = 0
