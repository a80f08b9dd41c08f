"""Progress where there is no terminal, as in a log or a pipe: a line now and then instead of a bar."""

from __future__ import annotations

import threading
from datetime import timedelta

from rich.progress import Progress, Task

from caviar_clients.cli.shared import print_line

EVERY_S = 30.0
"""[s] between two lines."""


class PlainProgress(Progress):
    """Prints how far the tasks are that have not ended, every `EVERY_S`, also while nothing is reported.

    Example:
        >>> bar = PlainProgress()
        >>> task = bar.add_task("frames", total=None)
        >>> line_of(bar.tasks[0])  # with an end: frames: 35 %, 0:12:10 left
        'frames: 0'
    """

    _thread: threading.Thread | None = None

    def start(self) -> None:
        """Begin to print."""
        super().start()
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._print, name="progress", daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """Print no more."""
        if self._thread is not None:
            self._ended.set()
            self._thread.join()
            self._thread = None
        super().stop()

    def _print(self) -> None:
        while not self._ended.wait(EVERY_S):
            tasks = self.tasks
            # Where all have ended, the work goes on with what has no task yet.
            for task in [task for task in tasks if not task.finished] or tasks[-1:]:
                print_line(self.console, line_of(task))


def line_of(task: Task) -> str:
    """Say how far a task is, with the time left as soon as it can be told."""
    start = f"{task.description}: " if task.description else ""
    if task.total is None:
        return f"{start}{task.completed:g}"
    if (said := task.fields.get("left")) is not None:  # the command knows better
        return f"{start}{task.percentage:.0f} %{f', {said}' if said else ''}"
    left = task.time_remaining
    if left is None and task.elapsed and 0 < task.completed < task.total:
        left = task.elapsed * (task.total / task.completed - 1)
    end = "" if left is None or task.finished else f", {timedelta(seconds=round(left))} left"
    return f"{start}{task.percentage:.0f} %{end}"
