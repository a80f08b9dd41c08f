"""A sign of life for whoever watches a process from outside, such as the health check of a container."""

from __future__ import annotations

import contextlib
import os
import time
from pathlib import Path

VARIABLE = "CAVIAR_ALIVE"
"""Environment variable with the path of the file; without it no sign is given."""
INTERVAL_S = 1.0
"""[s] between signs at least."""


class SignOfLife:
    """A file that is as old as the last sign of life."""

    def __init__(self) -> None:
        name = os.environ.get(VARIABLE, "")
        self._path = Path(name) if name else None
        self._due = 0.0

    def give(self) -> None:
        """Touch the file, unless that has just been done.

        A file that cannot be written is no reason to end a run: the health check tells of it.
        """
        now = time.monotonic()
        if self._path is None or now < self._due:
            return
        self._due = now + INTERVAL_S
        with contextlib.suppress(OSError):
            self._path.touch()
