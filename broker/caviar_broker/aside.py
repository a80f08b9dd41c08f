"""Calls that may wait for a disk, made by a thread, so that whoever asked for them need not."""

from __future__ import annotations

import threading
from collections.abc import Callable


class Aside:
    """Makes one call at a time. A thread that waits for a disk cannot be ended, and holds up nothing."""

    def __init__(self) -> None:
        self._free = threading.Event()
        self._free.set()

    @property
    def is_busy(self) -> bool:
        """Whether a call is under way."""
        return not self._free.is_set()

    def call(self, action: Callable[[], object], seconds: float) -> bool:
        """Make a call; whether it came to its end within so long [s]. False while another is under way.

        Raises the `OSError` that it raised in that time.
        """
        if self.is_busy:
            return False
        errors: list[OSError] = []
        self._free.clear()

        def body() -> None:
            try:
                action()
            except OSError as error:
                errors.append(error)
            finally:
                self._free.set()

        threading.Thread(target=body, name="aside", daemon=True).start()
        if not self._free.wait(seconds):
            return False
        if errors:
            raise errors[0]
        return True
