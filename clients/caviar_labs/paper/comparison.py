"""Report of an experiment of the paper: tables of its figures beside published ones, and what differs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from rich.console import Console
from rich.table import Column, Table
from rich.text import Text

NOTHING = "–"
"""Cell of a figure that does not exist."""


@dataclass(frozen=True)
class Comparison:
    """A table, and in words what has to be known to read it.

    Example:
        >>> print(Comparison("Rates", ("user", "here", "published"), [("UAV", "0.52", "0.5")]).markdown())
        ## Rates
        <BLANKLINE>
        | user | here | published |
        | --- | --- | --- |
        | UAV | 0.52 | 0.5 |
        <BLANKLINE>
    """

    title: str
    columns: tuple[str, ...]
    rows: Sequence[tuple[str, ...]] = ()
    notes: Sequence[str] = field(default=())
    """What differs from what was published, and why: a sentence or two each."""

    def markdown(self) -> str:
        """Write the table as Markdown, below a heading of its own."""
        lines = [self.columns, ("---",) * len(self.columns), *self.rows]
        # A bar within a cell would end it.
        cells = [[cell.replace("|", "\\|") for cell in line] for line in lines]
        table = "".join(f"| {' | '.join(line)} |\n" for line in cells) if self.rows else ""
        notes = "".join(f"* {note}\n" for note in self.notes)
        parts = (f"## {self.title}\n", table, notes)
        return "\n".join(part for part in parts if part)

    def show(self, console: Console) -> None:
        """Print table and notes.

        Args:
            console: Where.
        """
        if self.rows:
            first, *others = self.columns
            justified = (Column(name, justify="right") for name in others)
            table = Table(first, *justified, title=self.title, title_justify="left")
            for cells in self.rows:
                table.add_row(*map(Text, cells))
            console.print(table)
        for note in self.notes:
            console.print(Text(f"* {note}"))


def with_interval(values: Sequence[float], digits: int = 3) -> str:
    """A mean over episodes and its 95 % interval, by Student's t.

    Args:
        values: One of each episode.
        digits: After the point.

    Example:
        >>> with_interval([0.1, 0.2, 0.3], 2)
        '0.20 ± 0.25'
    """
    from caviar_clients.learning.evaluate import mean_of

    found = mean_of(values)
    if found.episodes == 0:
        return NOTHING
    if found.episodes == 1:
        return number(found.mean, digits)
    return f"{number(found.mean, digits)} ± {found.half_width:.{digits}f}"


def with_range(values: Sequence[float], digits: int = 3) -> str:
    """A mean over runs and what 95 % of single runs are within, by Student's t.

    To compare with a single run, which is not the mean of many: its own spread counts.

    Args:
        values: One of each run, two at least.
        digits: After the point.

    Example:
        >>> with_range([0.1, 0.2, 0.3], 2)
        '0.20 ± 0.50'
    """
    from caviar_clients.learning.evaluate import student_95

    count = len(values)
    spread = float(np.std(values, ddof=1)) * student_95(count - 1) * (1 + 1 / count) ** 0.5
    return f"{number(float(np.mean(values)), digits)} ± {spread:.{digits}f}"


def number(value: float, digits: int = 3) -> str:
    """A number with a minus sign where it is negative.

    Example:
        >>> number(-0.1268)
        '−0.127'
    """
    return f"{value:.{digits}f}".replace("-", "−")
