"""Progress without a terminal: lines in a log."""

from __future__ import annotations

import io
import re
import threading
import time

import pytest
from rich.console import Console

from caviar_clients.cli import plain_progress
from caviar_clients.cli.shared import progress_bar
from caviar_labs.cli.paper import _time_left


def test_lines_are_printed_where_there_is_no_terminal(monkeypatch: pytest.MonkeyPatch) -> None:
    """Also by ``caviar paper``, whose bar vanishes, and while nothing is reported."""
    monkeypatch.setattr(plain_progress, "EVERY_S", 0.05)
    output = io.StringIO()
    with _time_left(Console(file=output)) as show:
        for share in (0.0, 0.1, 0.2):
            show("training [1]", share)
            time.sleep(0.01)
        until = time.monotonic() + 10
        while output.getvalue().count("\n") < 3 and time.monotonic() < until:
            time.sleep(0.01)
    lines = output.getvalue().splitlines()
    assert len(lines) >= 3
    assert re.fullmatch(r"training \[1\]: 20 %, 0:00:0\d left", lines[0])
    assert not any(thread.name == "progress" for thread in threading.enumerate())


def test_nothing_is_printed_beside_a_bar(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(plain_progress, "EVERY_S", 0.01)
    console = Console(file=io.StringIO(), force_terminal=True)
    assert not isinstance(progress_bar(console), plain_progress.PlainProgress)


def test_what_has_no_end_is_counted() -> None:
    bar = plain_progress.PlainProgress(console=Console(file=io.StringIO()))
    task = bar.add_task("frames", total=None)
    bar.update(task, completed=12)
    assert plain_progress.line_of(bar.tasks[0]) == "frames: 12"


def test_the_time_left_is_that_of_the_command_where_it_knows() -> None:
    bar = plain_progress.PlainProgress(console=Console(file=io.StringIO()))
    task = bar.add_task("episodes", total=4, left="")
    bar.update(task, completed=1)
    assert plain_progress.line_of(bar.tasks[0]) == "episodes: 25 %"
    bar.update(task, left="0:00:09 left")
    assert plain_progress.line_of(bar.tasks[0]) == "episodes: 25 %, 0:00:09 left"


def test_every_task_that_has_not_ended_has_a_line(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of a page with several parts, or a traffic before the episodes, not the first one for ever."""
    output, ended = io.StringIO(), iter((False, True))
    bar = plain_progress.PlainProgress(console=Console(file=output))
    for name, done in (("traffic", 9), ("episodes", 2), ("scans", 0)):
        bar.update(bar.add_task(name, total=9), completed=done)
    bar._ended = threading.Event()
    monkeypatch.setattr(bar._ended, "wait", lambda timeout: next(ended))
    bar._print()
    assert [line.partition(":")[0] for line in output.getvalue().splitlines()] == ["episodes", "scans"]
    for task in bar.tasks:
        bar.update(task.id, completed=9)
    ended = iter((False, True))
    bar._print()
    assert output.getvalue().splitlines()[2:] == ["scans: 100 %"]
