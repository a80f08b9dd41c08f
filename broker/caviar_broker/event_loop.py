"""The threads and waits of a broker: an event loop, and calls that a disk may hold up."""

from __future__ import annotations

import os
import select
import threading
import time
from collections.abc import Callable
from typing import Any

import zmq
from zmq.backend import zmq_poll

PRIORITY = 1
"""The least of the real-time class: ahead of whatever computes, after every other real-time task."""
NICE = -10
"""Niceness that is asked for where the real-time class is not permitted."""


def raise_priority() -> str:
    """Have this thread run before the services where the system permits it; how it is scheduled now.

    A deadline is decided on time only by a process that gets a core then. The real-time class needs
    ``CAP_SYS_NICE`` or ``ulimit -r`` of 1, a better niceness ``CAP_SYS_NICE`` or ``ulimit -e`` of 30. Without
    the right to either the broker keeps its place, and a busy machine shows in the lateness that a run
    reports. It is the thread that calls which gets it: those that it starts later share its niceness, but not
    the real-time class. The kernel leaves a twentieth of each second to others, whatever such a task does.
    """
    try:
        policy = os.SCHED_FIFO | os.SCHED_RESET_ON_FORK
        os.sched_setscheduler(0, policy, os.sched_param(PRIORITY))
    except OSError:
        pass
    else:
        return "real time"
    niceness = os.getpriority(os.PRIO_PROCESS, 0)
    try:
        os.setpriority(os.PRIO_PROCESS, 0, min(NICE, niceness))
    except OSError:
        return f"niceness {niceness}"
    return f"niceness {min(NICE, niceness)}"


def call_with_timeout(action: Callable[[], object], seconds: float) -> bool:
    """Make a call in a thread of its own; whether it came to its end within so long [s].

    A thread that waits for a disk cannot be ended: it goes on, and holds up no caller and no exit.
    Raises the `OSError` that the call raised in that time.

    Args:
        action: What is called.
        seconds: [s] that are waited for its end.
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


Source = int | zmq.Socket[Any]
"""A file descriptor or a ZeroMQ socket."""


COARSE_NS = 1_000_000
"""[ns] The poller counts whole milliseconds, and may take one more than it was given."""
_POLLIN = int(zmq.POLLIN)
SELECTABLE = 1024
"""Descriptors from here on are nothing for ``select``."""


class EventLoop:
    """Calls back when something can be read or written.

    Waits end on time to within some 0.1 ms: the poller, which knows whole milliseconds only, is left two of
    them early, and the rest is waited for on the sockets alone. Other descriptors are late by that at most.
    """

    def __init__(self) -> None:
        self._poller = zmq.Poller()
        self._sockets: dict[int, zmq.Socket[Any]] = {}
        # The same as `zmq_poll` takes them.
        self._polled: list[tuple[zmq.Socket[Any], int]] = []
        self._callbacks: dict[Source, Callable[[], None]] = {}
        self._prompt: set[int] = set()
        self._polls = 0

    def watch(
        self,
        source: Source,
        callback: Callable[[], None],
        events: int = zmq.POLLIN,
        *,
        prompt: bool = False,
    ) -> None:
        """Call back when a source is ready.

        Args:
            source: A file descriptor or a ZeroMQ socket.
            callback: Called in the thread that polls.
            events: ``zmq.POLLIN`` or ``zmq.POLLOUT``.
            prompt: Whether a descriptor is waited for with the sockets, to 0.1 ms.
        """
        if self._callbacks.get(source) != callback:
            self._callbacks[source] = callback
            self._poller.register(source, events)
            if isinstance(source, zmq.Socket) and events == zmq.POLLIN:
                fd = int(source.getsockopt(zmq.FD))
                self._sockets |= {fd: source} if fd < SELECTABLE else {}
                self._polled = [(s, _POLLIN) for s in self._sockets.values()]
            elif prompt and isinstance(source, int) and source < SELECTABLE:
                self._prompt.add(source)

    def unwatch(self, source: Source) -> None:
        """Undo `watch`; nothing where it was not watched."""
        if self._callbacks.pop(source, None) is not None:
            self._poller.unregister(source)
            self._sockets = {fd: socket for fd, socket in self._sockets.items() if socket is not source}
            self._polled = [(s, _POLLIN) for s in self._sockets.values()]
            self._prompt -= {fd for fd in self._prompt if fd == source}

    def poll(self, wait_ns: int = 0) -> list[Source]:
        """Wait for at most ``wait_ns`` [ns]; the sources that are ready."""
        self._polls += 1
        # One millisecond less than there is: the poller rounds up, and the rest is waited for exactly.
        until = time.monotonic_ns() + wait_ns
        ready = [source for source, _ in self._poller.poll(max(0, wait_ns // COARSE_NS - 1))]
        return ready if ready or wait_ns <= 0 else self.poll_sockets(until)

    def poll_sockets(self, until: int) -> list[Source]:
        """Sockets and prompt descriptors that can be read, until that instant [ns] at the latest."""
        while True:
            # Asked before it is waited for: only then does a socket's descriptor tell of what comes. One call
            # for all of them: asking each for its EVENTS takes 4 µs a socket.
            ready: list[Source] = [s for s, _ in zmq_poll(self._polled, 0)]
            rest = until - time.monotonic_ns()
            if ready or rest <= 0:
                return ready
            readable, _, _ = select.select([*self._sockets, *self._prompt], (), (), rest / 1e9)
            if found := self._prompt.intersection(readable):
                return [*found]

    def call(self, ready: list[Source]) -> None:
        """Call back for what `poll` returned, unless it is not watched any more.

        Where another thread polls while one of the callbacks waits, the others are its to call.
        """
        polls = self._polls
        for source in ready:
            if self._polls != polls:
                return
            callback = self._callbacks.get(source)
            if callback is not None:
                callback()


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

    Args:
        turn: One turn of the loop. It returns soon once ``fd`` is readable. After a `call` it takes nothing
            for granted that it looked up before, since other turns may have been run meanwhile.
        over: Whether the loop is over.
    """

    def __init__(self, turn: Callable[[], None], over: Callable[[], bool]) -> None:
        self._turn, self._over = turn, over
        self.fd = os.eventfd(0, os.EFD_NONBLOCK | os.EFD_CLOEXEC)
        """Readable once the leader is back and the standby is to end its turn."""
        self.calling_since: float | None = None
        """When the call that is under way began [s]; None: there is none."""
        self.cpu_s = 0.0
        """CPU time of the leader, once the loop is over [s]."""
        # Whether the standby runs a turn.
        self._relieved = False
        # Held by the thread that runs turns.
        self._role = threading.Lock()
        self._ended = threading.Event()
        self._failures: list[BaseException] = []

    @property
    def calling(self) -> bool:
        """True if nothing may be called: a call is under way, or the standby runs a turn."""
        # A call may end while the standby is in a turn. One that it made itself then would give the loop back
        # to the leader, and never end: the leader calls nothing before it knows what came of that call.
        return self.calling_since is not None or self._relieved

    def run(self, begin: Callable[[], object] = lambda: None) -> None:
        """Run the loop until it is over; raises what a turn raised.

        The leader is a thread of its own, so that this returns, and signals are heard, whatever a disk does.

        Args:
            begin: Called by the leader first.
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
                self._relieved = True
                try:
                    while self.calling_since is not None and not self._over():
                        self._turn()
                finally:
                    self._relieved = False
                if self._over():
                    self._ended.set()
