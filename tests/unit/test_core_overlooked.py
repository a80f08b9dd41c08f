"""Nobody who could go on is overlooked: in random runs everybody is looked at again after every step.

`Turns` looks only at services for which something may have changed. Whatever a look at all of them, without
anything remembered, would grant or skip in addition is a service that would have waited for ever.
"""

from __future__ import annotations

from typing import Any

import pytest
from test_core_stateful import play

from caviar_broker.core.dispatch import Dispatcher

advance = Dispatcher.advance


def done_so_far(schedule: Dispatcher) -> tuple[Any, ...]:
    """What a look at somebody could change."""
    eligible = {
        (task.service, task.frame): task.eligible_at for task in schedule._book.tasks() if task.eligible_at
    }
    told, entries = len(schedule._actions), schedule._ledger.last
    return told, entries, len(schedule.grants), dict(schedule._book.next), eligible


def advance_twice(schedule: Dispatcher, now: int) -> None:
    """Advance, look at everybody, and put back who waits for what."""
    advance(schedule, now)
    turns, before = schedule._turns, done_so_far(schedule)
    remembered = (
        turns.concerned,
        turns.waiting_for_journal,
        turns.waiting_for_pace,
        turns._waiting_for_frames,
        *turns._awaiting.values(),
    )
    kept = [set(names) for names in remembered]
    gathered = {task: task.inputs for task in schedule._book.tasks()}
    for task in gathered:
        task.inputs = None
    # A frame whose time has come meanwhile is begun by the timer, not by a look.
    for_the_timer = kept[2].difference(*kept[:2], *kept[3:])
    turns.wake_all()
    turns.concerned -= for_the_timer
    advance(schedule, now)
    assert done_so_far(schedule) == before
    for task, inputs in gathered.items():
        assert inputs is None or task.inputs == inputs, f"{task} would be granted what is not so any more"
        task.inputs = inputs
    for names, known in zip(remembered, kept, strict=True):
        names.clear()
        names |= known


def test_a_look_at_everybody_changes_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Dispatcher, "advance", advance_twice)
    play(150)
