"""No service that could go on is overlooked: in random runs every one is looked at again after every step.

`Dispatcher.advance` looks only at services for which something may have changed. Whatever a look at all of
them, without anything remembered, would grant or skip in addition is a service that would have waited for
ever.
"""

from __future__ import annotations

from typing import Any

import pytest
from test_core_stateful import play

from caviar_broker.core.dispatch import Dispatcher

pytestmark = pytest.mark.slow

advance = Dispatcher.advance


def done_so_far(dispatcher: Dispatcher) -> tuple[Any, ...]:
    """What a look at a service could change."""
    table = dispatcher.table
    eligible = {(task.service, task.frame): task.eligible_at for task in table.tasks() if task.eligible_at}
    actions, entries = len(dispatcher._run.actions), dispatcher._ledger.last
    reached = [participant.next_frame for participant in table.participants.values()]
    return actions, entries, reached, eligible


def advance_twice(dispatcher: Dispatcher, now: int) -> None:
    """Advance, look at every service, and put back what each waits for."""
    advance(dispatcher, now)
    before = done_so_far(dispatcher)
    remembered = [dispatcher.table.ready, *dispatcher.waiting()]
    kept = [set(waiting) for waiting in remembered]
    gathered = {task: task.inputs for task in dispatcher.table.tasks()}
    for task in gathered:
        task.inputs = None
    # A frame whose time has come meanwhile is begun by the timer, not by a look.
    for_the_timer = kept[2].difference(*kept[:2], *kept[3:])
    dispatcher.wake_all()
    dispatcher.table.ready -= for_the_timer
    advance(dispatcher, now)
    assert done_so_far(dispatcher) == before
    for task, inputs in gathered.items():
        assert inputs is None or task.inputs == inputs, f"{task} would be granted what is not so any more"
        task.inputs = inputs
    for waiting, known in zip(remembered, kept, strict=True):
        waiting.clear()
        waiting |= known


def test_a_look_at_everybody_changes_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Dispatcher, "advance", advance_twice)
    play(150)
