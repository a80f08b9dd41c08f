"""Calls that may wait for a disk, made in a thread, so that the caller waits for a bounded time only."""

from __future__ import annotations

import threading
from collections.abc import Callable


def call_aside(action: Callable[[], object], seconds: float) -> bool:
    """Make a call in a thread of its own; whether it came to its end within so long [s].

    A thread that waits for a disk cannot be ended: it goes on, and holds up no caller and no exit.
    Raises the `OSError` that the call raised in that time.
    """
    errors: list[OSError] = []

    def body() -> None:
        try:
            action()
        except OSError as error:
            errors.append(error)

    thread = threading.Thread(target=body, name="aside", daemon=True)
    thread.start()
    thread.join(seconds)
    if thread.is_alive():
        return False
    if errors:
        raise errors[0]
    return True
