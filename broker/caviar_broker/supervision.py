"""Life of the services: the operating system is asked about local ones, connections about remote ones."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

# The launcher looks at processes, too, and loads no clock for it.
if TYPE_CHECKING:
    from caviar_broker.core.clock import FrameClock


class LocalProcess:
    """A process of this kernel and PID namespace, watched through a pidfd.

    The descriptor becomes readable the moment the process dies, whichever its parent is, and never
    means another process that was given the same number later.
    """

    def __init__(self, pid: int) -> None:
        self.pid = pid
        # Not by polling the number: the system may give it to another process at once.
        self.fd = os.pidfd_open(pid)

    def verdict(self) -> str:
        """End of the process in words, as far as the system says."""
        fields = _stat(self.pid)
        if fields is not None and fields[0] == "Z":
            return describe_exit(os.waitstatus_to_exitcode(int(fields[-1])))
        return "its process is gone"

    @property
    def stopped(self) -> bool:
        """Whether it is stopped by a signal (SIGSTOP, SIGTSTP), so that it cannot answer."""
        return is_stopped(self.pid)

    def close(self) -> None:
        """Stop watching."""
        os.close(self.fd)


def watch(pid: int) -> LocalProcess | None:
    """Watch a process; None where the system does not let us.

    Raises:
        ProcessLookupError: There is no such process.
    """
    try:
        return LocalProcess(pid)
    except ProcessLookupError:
        raise
    except OverflowError:
        raise ProcessLookupError(pid) from None
    except OSError:
        return None


def is_stopped(pid: int) -> bool:
    """Whether a process is stopped by a signal (SIGSTOP, SIGTSTP), so that it cannot answer."""
    fields = _stat(pid)
    return fields is not None and fields[0] == "T"


def describe_stop(pid: int) -> str:
    """A stopped process for people."""
    return f"its process {pid} is stopped (SIGSTOP or SIGTSTP)"


def describe_exit(code: int) -> str:
    """An exit status for people: negative for a signal, as `subprocess` has it."""
    if code >= 0:
        return f"it exited with status {code}"
    try:
        name = signal.Signals(-code).name
    except ValueError:
        name = f"signal {-code}"
    return f"it was killed by {name}"


def _stat(pid: int) -> list[str] | None:
    """Fields of /proc/PID/stat after the command name, state first; None where it is gone."""
    try:
        with open(f"/proc/{pid}/stat", "rb", buffering=0) as file:  # noqa: PTH123 - read 100 times a second
            text = file.read()
    except OSError:
        return None
    return text.rpartition(b")")[2].decode().split()


CHECK_NS = 50_000_000
"""[ns] between looks at whether a local process is stopped; its death shows at once."""
SUPERVISOR_NS = 1_000_000_000
"""[ns] that a launcher has to report the death of its child, with exit status and last words."""


@dataclass
class _Watched:
    """One incarnation of a service as the watchdog knows it."""

    since: int
    process: LocalProcess | None = None
    # Routing id of its heartbeat connection.
    pulse: bytes | None = None
    heard_at: int = 0
    # When the process of a supervised service died [ns].
    died_at: int | None = None
    # When a message to a local process first found no connection [ns].
    cut_off_at: int | None = None
    warned: bool = False


@dataclass
class Watchdog:
    """Tells of services that are gone (contract, clause 15).

    Args:
        clock: Who is present in the run.
        heartbeat_ns, liveness_ns: Of the run [ns].
        probe: Sends a harmless message to a heartbeat connection; why that did not go, or an empty text.
        lost: Called with service and verdict.
        warn: Called with service and text.
        gone_words: What is said of a service without a connection.
    """

    clock: FrameClock
    heartbeat_ns: int
    liveness_ns: int
    probe: Callable[[bytes], str]
    lost: Callable[[str, str], None]
    warn: Callable[[str, str], None]
    gone_words: str
    supervised: set[str] = field(default_factory=set)
    """Services whose death a launcher reports, who knows their exit status and last words."""
    _watched: dict[str, _Watched] = field(default_factory=dict)

    def welcome(self, service: str, pid: int | None) -> int | None:
        """Begin to watch a new incarnation of a service.

        Args:
            service: Its name.
            pid: Of its process on this machine; None if it is elsewhere.

        Returns:
            A descriptor that is readable once the process is dead; None where it cannot be watched.
        """
        watched = self._watched[service] = _Watched(since=time.monotonic_ns())
        if pid is None:
            return None
        try:
            watched.process = watch(pid)
        except ProcessLookupError:
            self.lost(service, f"there is no process {pid}, which it says it is")
        return watched.process.fd if watched.process else None

    def forget(self, service: str) -> int | None:
        """Stop to watch an incarnation; the descriptor that `welcome` returned, now closed."""
        watched = self._watched.pop(service, None)
        if watched is None or watched.process is None:
            return None
        watched.process.close()
        return watched.process.fd

    def attach(self, service: str, pulse: bytes) -> bytes | None:
        """Note the heartbeat connection of a service; the one that it had before."""
        watched = self._watched[service]
        before, watched.pulse = watched.pulse, pulse
        self.heard(service)
        return before

    def heard(self, service: str) -> None:
        """Note that a heartbeat came."""
        watched = self._watched.get(service)
        if watched is not None:
            watched.heard_at = time.monotonic_ns()

    def died(self, service: str) -> None:
        """Act on the death of a local process, which its descriptor shows."""
        watched = self._watched[service]
        watched.died_at = time.monotonic_ns()
        # A launcher knows more of its child, exit status and last words: it gets `SUPERVISOR_NS` to say so.
        if service not in self.supervised and watched.process is not None:
            self.lost(service, watched.process.verdict())

    def cut_off(self, service: str) -> bool:
        """Note that a message found no connection.

        Returns:
            Whether the verdict is left to the operating system, which says a moment later how a local process
            ended.
        """
        watched = self._watched.get(service)
        if watched is None or watched.process is None:
            return False
        watched.cut_off_at = watched.cut_off_at or time.monotonic_ns()
        return True

    def check(self, now: int) -> None:
        """Look for local processes that are stopped, and probe remote ones."""
        for service, watched in list(self._watched.items()):
            member = self.clock.member(service)
            if member is None or not member.present:
                continue
            if watched.process is not None:
                if watched.died_at is not None:
                    if now - watched.died_at > SUPERVISOR_NS:
                        self.lost(service, watched.process.verdict())
                elif watched.process.stopped:
                    self.lost(service, describe_stop(watched.process.pid))
                # A process that dies loses its connection first: one that lives on without is reported here.
                elif watched.cut_off_at is not None and now - watched.cut_off_at > SUPERVISOR_NS:
                    self.lost(service, f"its process {watched.process.pid} lives, but {self.gone_words}")
            else:
                if watched.pulse is None:
                    if not watched.warned and now - watched.since > self.liveness_ns:
                        watched.warned = True
                        text = "has no heartbeat connection: its death shows only when it is due to answer"
                        self.warn(service, text)
                elif now - watched.heard_at > 2 * self.heartbeat_ns:
                    self._probe(service, watched.pulse)

    def recheck(self, service: str) -> None:
        """Probe a remote service now, since another process claims its name."""
        watched = self._watched.get(service)
        if watched is not None and watched.process is None and watched.pulse is not None:
            self._probe(service, watched.pulse)

    def close(self) -> None:
        """Stop watching."""
        for service in tuple(self._watched):
            self.forget(service)

    def _probe(self, service: str, pulse: bytes) -> None:
        reason = self.probe(pulse)
        if reason:
            self.lost(service, f"it is unreachable or stopped: {reason}")
