"""A loop that goes on while the thread that runs it waits for a disk: a standby thread takes it over."""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Callable

PATIENCE_S = 0.1
"""[s] that a call may wait until the standby takes over. Peers hear nothing for that long."""
LOOK_S = 0.05
"""[s] between looks of the standby at the call that is under way."""


class _RelievedError(Exception):
    """The loop ended under the standby; the thread that comes back has nothing to do any more."""


class Standby:
    """Runs the turns of a loop, one at a time, in one of two threads.

    The leader runs them. What may wait for a disk it does through `call`: while that takes long, the standby
    runs the turns. To hand each write to another thread and wait for it would cost two switches of threads,
    several times what the write takes; here a write that is quick costs a lock.

    Parameters
    ----------
    turn
        One turn of the loop. It returns soon once ``fd`` is readable. Behind a `call` it takes nothing for
        granted that it looked up before, since other turns may have been run meanwhile.
    over
        Whether the loop is over.
    """

    def __init__(self, turn: Callable[[], None], over: Callable[[], bool]) -> None:
        self._turn, self._over = turn, over
        self.fd = os.eventfd(0, os.EFD_NONBLOCK | os.EFD_CLOEXEC)
        """Readable once the leader is back and the standby is to end its turn."""
        self.calling_since: float | None = None
        """When the call that is under way began [s]; None: there is none."""
        self.cpu_s = 0.0
        """CPU time of the leader, once the loop is over [s]."""
        self._role = threading.Lock()
        """Held by the thread that runs turns."""
        self._ended = threading.Event()
        self._failures: list[BaseException] = []

    @property
    def calling(self) -> bool:
        """Whether a call is under way: then nothing may be called."""
        return self.calling_since is not None

    def run(self, begin: Callable[[], object] = lambda: None) -> None:
        """Run the loop until it is over; raises what a turn raised.

        The leader is a thread of its own, so that this returns, and signals are heard, whatever a disk does.

        Parameters
        ----------
        begin
            Called by the leader first.
        """
        self._role.acquire()
        for body, name in ((self._lead, "leader"), (self._stand_by, "standby")):
            threading.Thread(target=self._guarded, args=(body, begin), name=name, daemon=True).start()
        self._ended.wait()
        with self._role:  # the thread that ended it is through
            pass
        if self._failures:
            raise self._failures[0]

    def call(self, action: Callable[[], None]) -> None:
        """Do what may wait for a disk. The leader alone calls this, while no call is under way."""
        self.calling_since = time.monotonic()
        self._role.release()
        try:
            action()
        finally:
            self.calling_since = None
            if not self._role.acquire(blocking=False):
                os.eventfd_write(self.fd, 1)
                self._role.acquire()
        if self._ended.is_set():
            raise _RelievedError

    def close(self) -> None:
        """Close the descriptor; a call that is still under way needs it later, and keeps it."""
        if not self.calling:
            os.close(self.fd)

    def _guarded(self, body: Callable[[Callable[[], object]], None], begin: Callable[[], object]) -> None:
        try:
            body(begin)
        except _RelievedError:
            pass
        except BaseException as error:  # raised by `run`
            self._failures.append(error)
            self._ended.set()

    def _lead(self, begin: Callable[[], object]) -> None:
        try:
            begin()
            while not self._over():
                self._turn()
        finally:
            self.cpu_s = time.thread_time()
            self._ended.set()
            self._role.release()

    def _stand_by(self, begin: Callable[[], object]) -> None:
        begin()
        while not self._ended.wait(LOOK_S):
            since = self.calling_since
            if since is None or time.monotonic() - since < PATIENCE_S:
                continue
            with self._role:
                while self.calling and not self._over():
                    self._turn()
                if self._over():
                    self._ended.set()
