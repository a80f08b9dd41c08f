"""What services decided in a recorded run, and whether the errors they stated held."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from typing import Annotated

import msgspec

from caviar_protocol.arrays import quantity
from caviar_protocol.messages import Report

STATE = "state:"
"""Begins the name of a decision that is no choice, but what a service knew when the episode began."""


def counted(number: int, what: str) -> str:
    """``1 frame``, ``2 frames``."""
    return f"{number} {what}" if number == 1 else f"{number} {what}s"


class Decided(msgspec.Struct, kw_only=True):
    """One decision of one service over all frames: the rung of an adaptive channel, say."""

    service: str
    decision: str
    frames: dict[str, int]
    """How many had each value, the most frequent first."""
    changes: int
    """Frames whose value is not that of the frame before, in the same episode."""
    error_checks: Annotated[int, quantity("1", "stated errors that were measured, of all pairs and frames")]
    error_covered: Annotated[int, quantity("1", "of these, those that held")]


class Decisions:
    """Counts decisions, frame by frame."""

    def __init__(self) -> None:
        self._values: dict[tuple[str, str], Counter[str]] = {}
        self._last: dict[tuple[str, str], tuple[int, str]] = {}
        self._changes: Counter[tuple[str, str]] = Counter()
        self._counts: dict[str, Counter[str]] = {}

    def add(self, episode: int, reports: Iterable[Report]) -> None:
        """What services reported of a frame; frames come in their order."""
        for report in reports:
            if not report.decisions:
                continue
            self._counts.setdefault(report.source, Counter()).update(report.counts)
            for name, value in report.decisions.items():
                if name.startswith(STATE):
                    continue
                key = report.source, name
                self._values.setdefault(key, Counter())[value] += 1
                before, last = self._last.get(key, (episode, value))
                self._changes[key] += before == episode and last != value
                self._last[key] = episode, value

    def summary(self) -> list[Decided]:
        """By service and decision."""
        return [
            Decided(
                service=service,
                decision=name,
                frames=dict(values.most_common()),
                changes=self._changes[service, name],
                error_checks=self._counts[service]["error-checks"],
                error_covered=self._counts[service]["error-covered"],
            )
            for (service, name), values in sorted(self._values.items())
        ]


def decided_lines(found: Sequence[Decided]) -> list[str]:
    """For a user: one line a decision."""
    lines = []
    for entry in found:
        total = sum(entry.frames.values())
        shares = ", ".join(f"{value} {count / total:.0%}" for value, count in entry.frames.items())
        line = f"{entry.service}: {entry.decision} {shares}; {counted(entry.changes, 'change')}"
        if entry.error_checks:
            line += f"; stated error held in {entry.error_covered} of {counted(entry.error_checks, 'check')}"
        lines.append(line)
    return lines
