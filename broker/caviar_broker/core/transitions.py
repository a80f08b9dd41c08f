"""Every state and every transition of the core, in one place.

Three machines: the *run*, each *service* in it, and each *task* (one service's part of one
frame). What is not in a table is not allowed; `step` raises `IllegalTransitionError`, which is a fault
of the core itself, never of a member: what members send out of turn is sorted out before.
"""

from __future__ import annotations

import enum
from enum import auto
from typing import TypeVar


class Enum(enum.Enum):
    """Members are singletons; hashed as such, which is many times faster than by name, in C."""

    # `Enum.__hash__` is a Python function that hashes the name, and tables are asked several times a frame.
    __hash__ = object.__hash__


class RunState(Enum):
    """State of the run as a whole."""

    JOINING = auto()
    """Waiting for HELLO of every service."""
    PREPARING = auto()
    """Services load and warm up: worlds first, then, with their scenery, all others."""
    RESETTING = auto()
    """Waiting for RESET_DONE of every service."""
    RUNNING = auto()
    """Frames of an episode are granted."""
    STOPPING = auto()
    """SHUTDOWN was sent; waiting for BYE."""
    FINISHED = auto()


class RunEvent(Enum):
    """Events that move a run on."""

    ALL_JOINED = auto()
    ALL_READY = auto()
    ALL_RESET = auto()
    NEXT_EPISODE = auto()
    STOP = auto()
    ALL_GONE = auto()


class ServiceState(Enum):
    """State of one service as the broker sees it."""

    EXPECTED = auto()
    JOINED = auto()
    PREPARING = auto()
    READY = auto()
    RESETTING = auto()
    RESTORING = auto()
    """Gets its state back, and the grants since, before it takes part again."""
    ACTIVE = auto()
    """In an episode: may be granted frames."""
    LOST = auto()
    """Died or became unreachable; may rejoin under its name where the run allows it."""
    LEFT = auto()
    """Said BYE, or the run ended without it."""


class ServiceEvent(Enum):
    """Events that move a service on."""

    HELLO = auto()
    PREPARE = auto()
    READY = auto()
    RESET = auto()
    RESET_DONE = auto()
    RESTORE = auto()
    RESTORED = auto()
    EPISODE_END = auto()
    LOST = auto()
    BYE = auto()


class TaskState(Enum):
    """State of one service's part of one frame."""

    PENDING = auto()
    """Not granted yet: an input is undecided, or the service is busy."""
    GRANTED = auto()
    DONE = auto()
    OVERDUE = auto()
    """The deadline passed and the frame went on; the answer is still due (clause 11)."""
    LATE = auto()
    """Answered after the frame went on."""
    FAILED = auto()
    """Answered with FAULT."""
    SKIPPED = auto()
    """Never granted: a required input is absent (clause 10), or the service was busy for too long."""
    ABANDONED = auto()
    """Granted, but the episode ended before this frame; the answer is still due and not used."""
    DISCARDED = auto()
    """Answered after the end of the episode."""


class TaskEvent(Enum):
    """Events that move a task on."""

    GRANT = auto()
    ANSWER = auto()
    DEADLINE = auto()
    FAULT = auto()
    SKIP = auto()
    CUT = auto()


RUN: dict[tuple[RunState, RunEvent], RunState] = {
    (RunState.JOINING, RunEvent.ALL_JOINED): RunState.PREPARING,
    (RunState.PREPARING, RunEvent.ALL_READY): RunState.RESETTING,
    (RunState.RESETTING, RunEvent.ALL_RESET): RunState.RUNNING,
    (RunState.RUNNING, RunEvent.NEXT_EPISODE): RunState.RESETTING,
    **{
        (state, RunEvent.STOP): RunState.STOPPING
        for state in (RunState.JOINING, RunState.PREPARING, RunState.RESETTING, RunState.RUNNING)
    },
    (RunState.STOPPING, RunEvent.ALL_GONE): RunState.FINISHED,
}

_PRESENT = (
    ServiceState.JOINED,
    ServiceState.PREPARING,
    ServiceState.READY,
    ServiceState.RESETTING,
    ServiceState.RESTORING,
    ServiceState.ACTIVE,
)

SERVICE: dict[tuple[ServiceState, ServiceEvent], ServiceState] = {
    (ServiceState.EXPECTED, ServiceEvent.HELLO): ServiceState.JOINED,
    (ServiceState.LOST, ServiceEvent.HELLO): ServiceState.JOINED,
    (ServiceState.JOINED, ServiceEvent.PREPARE): ServiceState.PREPARING,
    (ServiceState.PREPARING, ServiceEvent.READY): ServiceState.READY,
    (ServiceState.READY, ServiceEvent.RESET): ServiceState.RESETTING,
    # Without state, or after a first reset; else RESTORE comes in between.
    (ServiceState.RESETTING, ServiceEvent.RESET_DONE): ServiceState.ACTIVE,
    (ServiceState.RESETTING, ServiceEvent.RESTORE): ServiceState.RESTORING,
    (ServiceState.RESTORING, ServiceEvent.RESTORED): ServiceState.ACTIVE,
    # The others may be through with the episode before a service has its state back.
    (ServiceState.RESTORING, ServiceEvent.EPISODE_END): ServiceState.READY,
    (ServiceState.ACTIVE, ServiceEvent.EPISODE_END): ServiceState.READY,
    (ServiceState.RESETTING, ServiceEvent.EPISODE_END): ServiceState.READY,
    # A launcher reports the end of a process that never said HELLO.
    (ServiceState.EXPECTED, ServiceEvent.LOST): ServiceState.LOST,
    **{(state, ServiceEvent.LOST): ServiceState.LOST for state in _PRESENT},
    **{(state, ServiceEvent.BYE): ServiceState.LEFT for state in _PRESENT},
}

TASK: dict[tuple[TaskState, TaskEvent], TaskState] = {
    (TaskState.PENDING, TaskEvent.GRANT): TaskState.GRANTED,
    (TaskState.PENDING, TaskEvent.SKIP): TaskState.SKIPPED,
    # It could not be granted in time: its service was still busy, or not there.
    (TaskState.PENDING, TaskEvent.DEADLINE): TaskState.SKIPPED,
    (TaskState.GRANTED, TaskEvent.ANSWER): TaskState.DONE,
    (TaskState.GRANTED, TaskEvent.DEADLINE): TaskState.OVERDUE,
    (TaskState.GRANTED, TaskEvent.FAULT): TaskState.FAILED,
    # An agent ended the episode before this frame (clause 16); the service is not interrupted.
    (TaskState.GRANTED, TaskEvent.CUT): TaskState.ABANDONED,
    # Its frame has gone on; what comes may be held by later frames, and is recorded (clause 11).
    (TaskState.OVERDUE, TaskEvent.ANSWER): TaskState.LATE,
    (TaskState.OVERDUE, TaskEvent.FAULT): TaskState.FAILED,
    (TaskState.OVERDUE, TaskEvent.CUT): TaskState.ABANDONED,
    (TaskState.ABANDONED, TaskEvent.ANSWER): TaskState.DISCARDED,
    (TaskState.ABANDONED, TaskEvent.FAULT): TaskState.DISCARDED,
}

PRESENT = frozenset(_PRESENT)
"""Service states in which messages can reach the service."""

OUTSTANDING = frozenset({TaskState.GRANTED, TaskState.OVERDUE, TaskState.ABANDONED})
"""Task states in which DONE or FAULT is due."""

DECIDED = frozenset({TaskState.DONE, TaskState.OVERDUE, TaskState.LATE, TaskState.FAILED, TaskState.SKIPPED})
"""Task states in which consumers know what they get."""


class IllegalTransitionError(AssertionError):
    """The core tried a transition that is not in its tables."""


_S = TypeVar("_S", RunState, ServiceState, TaskState)
_E = TypeVar("_E", RunEvent, ServiceEvent, TaskEvent)


def step(table: dict[tuple[_S, _E], _S], state: _S, event: _E) -> _S:
    """The state after ``event``; `IllegalTransitionError` where the table has none.

    Args:
        table: `RUN`, `SERVICE` or `TASK`.
        state: The state before.
        event: What happens.
    """
    try:
        return table[state, event]
    except KeyError:
        raise IllegalTransitionError(f"{event} in {state}") from None
