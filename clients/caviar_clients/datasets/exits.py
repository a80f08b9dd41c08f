"""The processes of this machine that play episodes: Ctrl-C, how they are ended, and how they have ended."""

from __future__ import annotations

import functools
import os
import signal
import time
from collections.abc import MutableMapping
from contextlib import suppress
from typing import Any, ClassVar

KNOWN_S = 2.0
"""[s] within which an exit is noted, once the scheduler has noted the loss of its worker."""

exit_codes: MutableMapping[str, int] = {}
"""Status of each process that has ended, by the address of its worker; −N: it ended by signal N."""

_HINTS = {
    signal.SIGKILL: ", as by the system where memory lacks",
    signal.SIGSEGV: ", a fault in compiled code",
    signal.SIGABRT: ", a fault in compiled code",
    signal.SIGBUS: ", a fault in compiled code or a full memory disk",
}


@functools.cache
def noting_nanny() -> Any:
    """The class that starts the processes of a cluster on this machine.

    Dask is imported here, since it is of the extra ``datasets``.
    """
    from distributed import Nanny

    class NotingNanny(Nanny):  # type: ignore[misc]  # distributed has no types
        """Starts the process of a worker anew when it ends, as its base does, and notes how it ended.

        Ctrl-C in a terminal, which goes to all processes of the command, is left to the command.
        """

        at_once: ClassVar[bool] = False
        """Whether processes are ended without waiting for their steps: what is complete is in its place."""

        async def instantiate(self) -> Any:
            """Start the process."""
            # A process inherits what the thread that starts it blocks, here that of Dask's loop. A handler in
            # the process itself would come too late: it loads for a second.
            signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
            return await super().instantiate()

        async def kill(self, *arguments: Any, **named: Any) -> None:
            """End the process."""
            if self.at_once and self.pid is not None:
                with suppress(ProcessLookupError):
                    os.kill(self.pid, signal.SIGKILL)
            await super().kill(*arguments, **named)

        def _on_worker_exit_sync(self, exitcode: int) -> None:
            if address := self.worker_address:
                exit_codes[address] = exitcode
            super()._on_worker_exit_sync(exitcode)

    return NotingNanny


def exit_of(worker: str, wait_s: float = KNOWN_S) -> str:
    """Say how the process of a worker ended: its status, or the name of the signal.

    Args:
        worker: Its address.
        wait_s: For how long its exit may still be noted [s]; 0: another program started it.

    Returns:
        That it is not known, where another program started the process.
    """
    deadline = time.monotonic() + wait_s
    while worker not in exit_codes and time.monotonic() < deadline:
        time.sleep(0.02)
    code = exit_codes.get(worker)
    return f"how is in the log of the worker {worker}" if code is None else exit_text(code)


def exit_text(code: int) -> str:
    """Say what an exit code means.

    Args:
        code: Status of a process; −N: signal N ended it.

    Example:
        >>> print(exit_text(3))
        it exited with status 3 (no signal), as os._exit(3) does
        >>> print(exit_text(-9))
        signal SIGKILL ended it, as by the system where memory lacks
    """
    if code >= 0:
        return f"it exited with status {code} (no signal), as os._exit({code}) does"
    try:
        name = signal.Signals(-code)
    except ValueError:  # a real-time signal
        return f"signal {-code} ended it"
    return f"signal {name.name} ended it{_HINTS.get(name, '')}"
