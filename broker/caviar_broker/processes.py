"""What the operating system knows of services on this machine (clause 15), and grants the broker."""

from __future__ import annotations

import os
import resource
import signal

from caviar_protocol.errors import RunError

OWN_DESCRIPTORS = 40
"""Open files of a broker without services: 27 of its own, and a few strangers that connect."""
SERVICE_DESCRIPTORS = 4
"""Open files for each service: two connections, its process, and an asset or checkpoint that is written."""
WANTED_DESCRIPTORS = 16_384
"""Open files that a broker asks for where the system grants them: connections that it lets wait."""


def reserve_descriptors(services: int) -> None:
    """Ask the system for as many open files as a broker of that many services may need.

    Raises `RunError` naming the limit and the remedy where fewer are granted than a run takes: accepting a
    connection without a free descriptor fails in silence, and the service that made it seems dead.
    """
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    if soft == resource.RLIM_INFINITY:
        return
    granted = WANTED_DESCRIPTORS if hard == resource.RLIM_INFINITY else min(hard, WANTED_DESCRIPTORS)
    if soft < granted:
        resource.setrlimit(resource.RLIMIT_NOFILE, (granted, hard))
        soft = granted
    needed = OWN_DESCRIPTORS + SERVICE_DESCRIPTORS * services
    if soft < needed:
        raise RunError(
            f"this process may have {soft} files open, and a run of {services} services needs {needed}; "
            "raise the limit with  ulimit -n 1024  (LimitNOFILE= of systemd, --ulimit nofile of Docker)"
        )


class LocalProcess:
    """A process of this kernel and PID namespace, watched through a pidfd.

    The descriptor becomes readable the moment the process dies, whoever its parent is, and never
    means another process that was given the same number later.
    """

    def __init__(self, pid: int) -> None:
        self.pid = pid
        self.fd = os.pidfd_open(pid)

    def verdict(self) -> str:
        """How the process ended, as far as can be told."""
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

    Raises `ProcessLookupError` where there is no such process.
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
    """Fields of /proc/PID/stat behind the command name, state first; None where it is gone."""
    try:
        with open(f"/proc/{pid}/stat", "rb", buffering=0) as file:  # noqa: PTH123 - read 100 times a second
            text = file.read()
    except OSError:
        return None
    return text.rpartition(b")")[2].decode().split()
