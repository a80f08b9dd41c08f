"""The broker before others: it works for a fraction of a frame, and everybody waits for it."""

from __future__ import annotations

import os

PRIORITY = 1
"""The least of the real-time class: before whatever computes, behind every other real-time task."""
NICE = -10
"""Niceness that is asked for where the real-time class is not permitted."""


def prefer() -> str:
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
