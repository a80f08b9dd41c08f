"""Processes of a run: how one is started and ended, and what Ctrl-C during ``caviar run`` does."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import dropwhile
from pathlib import Path
from types import FrameType
from typing import Any

from caviar_protocol.files import open_to_append

KILLED_S = 2.0
"""[s] within which a process ends that is killed, unless it waits for a disk."""
TAIL = 1 << 16
"""[B] of a log that are looked at for its last line."""
_CRASH = "Fatal Python error: "
_AFTER_A_CRASH = ("Extension modules: ", "  File ", "  Binary file ")
ORDERS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
"""Signals that end a run: of the terminal, of a supervisor, of a terminal that is closed."""
PYTHON_S = 0.5
"""[s] that the interpreter has to handle a signal: while a service computes in a library of C, it handles
none."""


@dataclass
class Child:
    """The process of one service."""

    name: str
    process: subprocess.Popen[bytes]
    log: Path
    pidfd: int
    """Readable once the process is dead."""

    @classmethod
    def start(cls, name: str, command: Sequence[str], log: Path, environment: Mapping[str, str]) -> Child:
        """Start a process.

        Args:
            name: Of the service.
            command: Program and arguments.
            log: Gets what the process prints, after what a process before it printed.
            environment: All of its environment.
        """
        with open_to_append(log) as file:
            process = subprocess.Popen(  # noqa: S603  # our own module with checked arguments
                command,
                stdin=subprocess.DEVNULL,
                stdout=file,
                stderr=file,
                start_new_session=True,  # Ctrl-C is the launcher's, which ends the run in order
                env=environment,
            )
        # A process id may be another process's a moment later; the descriptor stays that of this one.
        return cls(name, process, log, os.pidfd_open(process.pid))

    def last_line(self) -> str:
        """The last line that the process printed, or what it died of in a library; empty if it printed
        nothing."""
        if not self.log.exists():  # the run's directory was deleted
            return ""
        with self.log.open("rb") as file:
            file.seek(max(0, file.seek(0, os.SEEK_END) - TAIL))
            lines = file.read().decode(errors="replace").strip().splitlines()
        if not lines:
            return ""
        # After a crash faulthandler lists all threads and libraries; what counts stands above them.
        if lines[-1].startswith(_AFTER_A_CRASH):
            crashes = (number for number in reversed(range(len(lines))) if lines[number].startswith(_CRASH))
            if (number := next(crashes, None)) is not None:
                trace = dropwhile(lambda line: not line.startswith("Current thread "), lines[number:])
                place = next((line.strip() for line in trace if line.startswith("  File ")), "no Python code")
                return f"{lines[number]}, {place}"
        return lines[-1]


def end(processes: Sequence[subprocess.Popen[bytes]], seconds: float) -> list[int]:
    """End processes: SIGTERM, and SIGKILL for those that are left later.

    Args:
        processes: Which; those that have ended already are left out.
        seconds: Time between the two signals [s].

    Returns:
        Process ids of those that still live, since they wait for a disk.
    """
    for process in processes:
        if process.poll() is None:
            process.send_signal(signal.SIGTERM)
    wait(processes, seconds)
    for process in processes:
        if process.poll() is None:
            process.kill()
    # A process in uninterruptible sleep takes no signal, SIGKILL neither: the launcher must not wait for it.
    wait(processes, KILLED_S)
    return [process.pid for process in processes if process.poll() is None]


def wait(processes: Sequence[subprocess.Popen[bytes]], seconds: float) -> None:
    """Wait until all processes have ended, but for ``seconds`` at most [s]."""
    until = time.monotonic() + seconds
    for process in processes:
        try:
            process.wait(max(0.0, until - time.monotonic()))
        except subprocess.TimeoutExpired:
            continue


class Interruption:
    """Turns signals into an order to end the run, for as long as a ``with`` block lasts.

    Python hands signals to the main thread alone: in another one a block leaves them as they are.

    Args:
        stop: Orders an orderly end, for a reason. Called from a signal handler; with ``in_process`` from a
            thread, too.
        in_process: Whether services run in this process. Python handles no signal while one of them computes
            in a library of C: a thread then takes the signals, and ends the process with status 130.

    Example:
        >>> reasons = []
        >>> with Interruption(reasons.append) as interruption:
        ...     os.kill(os.getpid(), signal.SIGTERM)
        >>> interruption.came, reasons
        (True, ['stopped by SIGTERM'])
    """

    def __init__(self, stop: Callable[[str], None], *, in_process: bool = False) -> None:
        self._stop, self._in_process = stop, in_process
        self._before = dict[signal.Signals, Any]()
        self.came = False
        """Whether a signal came."""
        self._is_ordered = False  # by the handler
        self._handled_at = 0.0
        self._thread: threading.Thread | None = None
        self._is_over = threading.Event()

    def __enter__(self) -> Interruption:
        if threading.current_thread() is not threading.main_thread():
            return self
        self._before = {order: signal.signal(order, self._handle) for order in ORDERS}
        if self._in_process:
            self._read, self._write = os.pipe()
            os.set_blocking(self._write, False)  # as `set_wakeup_fd` has to have it
            self._fd_before = signal.set_wakeup_fd(self._write, warn_on_full_buffer=False)
            self._thread = threading.Thread(target=self._take, name="caviar-signals", daemon=True)
            self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._is_over.set()
        if self._thread is not None:
            signal.set_wakeup_fd(self._fd_before)
            os.close(self._write)  # the end of what the thread reads
            self._thread.join()
            os.close(self._read)
        for number, handler in self._before.items():
            signal.signal(number, handler)

    def _handle(self, number: int, _: FrameType | None) -> None:
        self._handled_at = time.monotonic()
        if self._is_ordered:
            raise KeyboardInterrupt  # through the launcher's block, which ends all processes
        self._is_ordered = True
        self._order(number)

    def _order(self, number: int) -> None:
        self.came = True
        name = "Ctrl-C" if number == signal.SIGINT else signal.Signals(number).name
        self._stop(f"stopped by {name}")

    def _take(self) -> None:
        """Take the numbers of the signals as they arrive, and act on those that are not handled."""
        while numbers := os.read(self._read, 64):
            arrived = time.monotonic()
            if not set(numbers) & set(ORDERS) or self._is_over.wait(PYTHON_S):
                continue
            # One that was handled just before it is read here counts, too: Python merges signals that come
            # together.
            if self._handled_at > arrived - PYTHON_S:
                continue
            if self.came:
                _end_at_once()
            self._order(next(number for number in numbers if number in ORDERS))


def _end_at_once() -> None:
    """End this process from a thread, whatever the others do."""
    if sys.stderr.isatty():
        sys.stderr.write("\x1b[?25h")  # the cursor, which the bar hides
    sys.stderr.write("caviar: ended at once, from within a call that does not return: nothing was closed\n")
    sys.stderr.flush()
    os._exit(128 + signal.SIGINT)
