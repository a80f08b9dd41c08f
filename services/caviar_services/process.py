"""How a service process ends: on SIGTERM, by force after a grace, and with which exit status."""

from __future__ import annotations

import os
import select
import signal
import sys
import threading

from caviar_protocol.messages import RUN_COMPLETE, STOPPED_BY

TERMINATION_GRACE_S = 1.5
"""[s] from SIGTERM until the process is ended by force, so that it is gone within 2 s."""

TERMINATED = 128 + signal.SIGTERM
"""Exit status of a service that a signal ended."""


class Termination:
    """The order to end, as a flag, and as a certain end of the process.

    Example:
        >>> termination = Termination()
        >>> termination.requested
        False
        >>> termination.enforce(60.0, 1, "too slow").set()  # called off
    """

    def __init__(self) -> None:
        self.requested = False
        self._called_off: list[threading.Event] = []

    def enforce(self, grace_s: float, status: int, last_words: str) -> threading.Event:
        """See to it that the process ends, unless it does so itself in time.

        Args:
            grace_s: Time until it is ended by force [s].
            status: Its exit status then.
            last_words: What it writes to standard error then.

        Returns:
            Set this event to call it off.
        """
        called_off = threading.Event()
        self._called_off.append(called_off)

        def end() -> None:
            if not called_off.wait(grace_s):
                self.end(status, last_words)

        threading.Thread(target=end, name="end", daemon=True).start()
        return called_off

    def end(self, status: int, last_words: str) -> None:
        """End the process at once.

        Args:
            status: Exit status.
            last_words: Written to standard error.
        """
        sys.stderr.write(f"{last_words}\n")
        # Not `sys.exit`: a thread that is not the main one would end alone, and a call that does not return
        # keeps the interpreter from ending.
        os._exit(status)

    def finished(self) -> None:
        """Everything is closed; the process ends by itself."""
        for called_off in self._called_off:
            called_off.set()


class SignalTermination(Termination):
    """SIGTERM and SIGINT as such an order.

    A Python signal handler does not run while the main thread is inside a compiled call, so a
    thread of its own hears of the signal through ``set_wakeup_fd``, and ends the process when the
    main thread has not done so in time. Against a call that holds the interpreter's lock not even
    that helps: then the process ends as soon as the lock is free, or its parent kills it.

    Args:
        status: Exit status of a process that ends so.
    """

    def __init__(self, status: int = TERMINATED) -> None:
        super().__init__()
        self._status = status
        self._read, write = os.pipe2(os.O_NONBLOCK | os.O_CLOEXEC)
        signal.set_wakeup_fd(write, warn_on_full_buffer=False)
        for number in (signal.SIGTERM, signal.SIGINT):
            signal.signal(number, self._handle)
        threading.Thread(target=self._watch, name="termination", daemon=True).start()

    def finished(self) -> None:
        """Everything is closed; the process ends by itself, with a status of its own."""
        super().finished()
        # The interpreter puts handlers back to the default while it ends: a late SIGTERM would be the status.
        signal.signal(signal.SIGTERM, signal.SIG_IGN)

    def _handle(self, *_: object) -> None:
        self.requested = True

    def _watch(self) -> None:
        while True:
            select.select([self._read], [], [])
            if {signal.SIGTERM, signal.SIGINT} & set(os.read(self._read, 64)):
                self.requested = True
                words = "ended by SIGTERM in the middle of a call that does not return"
                self.enforce(TERMINATION_GRACE_S, self._status, words)
                return


def restart_status(status: int, ended: str) -> int:
    """Status 0 where the work is done or was called off; 1 where another run may follow.

    Args:
        status: What the runner returned.
        ended: Why the broker ended the run; "" where it did not.

    Example:
        >>> restart_status(0, RUN_COMPLETE), restart_status(0, "world was lost"), restart_status(143, "")
        (0, 1, 0)
    """
    if status == TERMINATED:
        return 0
    failed = bool(ended) and ended != RUN_COMPLETE and not ended.startswith(STOPPED_BY)
    return 1 if failed else status
