"""Schedulers: which of the users of a transmitter are served in a slot.

A scheduler is a priority for each user; of those that may be served the greatest are. Arrays have users as
their last axis and any axes of transmitters, cells or environments before it.
"""

from __future__ import annotations

from typing import Literal

import numpy as np

from caviar_protocol.arrays import BoolArray, Float64Array, Int64Array

Scheduler = Literal["round-robin", "max-rate", "proportional-fair"]


def round_robin(turns: Int64Array) -> Float64Array:
    """Priority of the user that was not served for longest; of equal ones the first.

    Args:
        turns: Turn in which each user was served last, as `note_turns` writes it; −1: never.

    Example:
        >>> chosen(round_robin(np.array([4, 3, 5])), np.array([True, True, True]), 1).tolist()
        [False, True, False]
    """
    return -turns.astype(np.float64)


def note_turns(turns: Int64Array, served: BoolArray, number: int) -> int:
    """Number the turns of the users that a slot served, those first that had waited longest.

    Args:
        turns: Turn in which each user was served last, Shape ``[U]``; changed in place.
        served: Which were served, Shape ``[U]``.
        number: Of the next turn.

    Returns:
        Number of the turn after these.

    Example:
        >>> turns = np.array([7, 4, 5])
        >>> note_turns(turns, np.array([True, False, True]), 8), turns.tolist()
        (10, [9, 4, 8])
    """
    (users,) = served.nonzero()
    # Users of one slot have turns of their own: with equal ones the first of them would always go before.
    if len(users) > 1:
        users = users[turns[users].argsort(kind="stable")]
    turns[users] = np.arange(number, number + len(users))
    return number + len(users)


def max_rate(rate: Float64Array) -> Float64Array:
    """Priority of the user for which the slot carries most, whatever the others get.

    Args:
        rate: Bits that the slot carries for each user if it is served: of a user with less to send, that.

    Example:
        >>> chosen(max_rate(np.array([100.0, 60.0])), np.array([True, True]), 1).tolist()
        [True, False]
    """
    return rate


def proportional_fair(rate: Float64Array, average: Float64Array) -> Float64Array:
    """Priority of the user with the greatest ratio of its rate to what it got on average.

    F. P. Kelly, "Charging and rate control for elastic traffic", 1997; as a scheduler: P. Viswanath,
    D. N. C. Tse and R. Laroia, "Opportunistic beamforming using dumb antennas", 2002, section II.

    Args:
        rate: Bits that the slot carries for each user if it is served: of a user with less to send, that.
        average: What each user was served on average [bit/slot], as `averaged` follows it.

    Example:
        >>> proportional_fair(np.array([100.0, 60.0]), np.array([50.0, 20.0])).tolist()
        [2.0, 3.0]
    """
    # Less than a bit a slot counts as one: a user that was never served has a finite priority.
    priority: Float64Array = rate / np.maximum(average, 1.0)
    return priority


def averaged(average: Float64Array, served: Int64Array, window: float) -> Float64Array:
    """Average of what users are served, exponentially weighted: ā ← (1 − 1/T)·ā + s/T.

    Args:
        average: ā [bit/slot].
        served: s, what each user was served in the slot [bit]; 0 for one that was not.
        window: T, the slots that the average forgets in, 1 or more.

    Example:
        >>> averaged(np.array([10.0]), np.array([30]), 4.0).tolist()
        [15.0]
    """
    following: Float64Array = average + (served - average) / window
    return following


def chosen(priority: Float64Array, eligible: BoolArray, count: int) -> BoolArray:
    """Choose users by priority, of equal ones the first.

    Args:
        priority: Of each user, finite, Shape ``[..., U]``.
        eligible: Users that may be served, of the same shape.
        count: Users that are served at once, at most.

    Returns:
        Which are served, Shape ``[..., U]``.

    Example:
        >>> chosen(np.array([1.0, 5.0, 5.0, 9.0]), np.array([True, True, True, False]), 2).tolist()
        [False, True, True, False]
    """
    found = np.zeros(eligible.shape, np.bool_)
    users = eligible.shape[-1]
    if not users:
        return found
    # On one flat axis: `put_along_axis` takes longer than all of the rest.
    rows = np.arange(0, eligible.size, users)
    if count == 1:
        rows += np.where(eligible, priority, -np.inf).argmax(-1).reshape(-1)
        found.reshape(-1)[rows] = True
    else:
        # Stable: users with equal priorities keep their order, on every machine.
        order = np.argsort(np.where(eligible, -priority, np.inf), axis=-1, kind="stable")[..., :count]
        found.reshape(-1)[order.reshape(len(rows), -1) + rows[:, None]] = True
    found &= eligible
    return found
