"""Agents of a recorded run that had nobody to serve."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable

from caviar_protocol.messages import Report

_WITHOUT_USERS = "frames-without-users"


class Unserved:
    """Counts frames, and those in which an agent had no user."""

    def __init__(self) -> None:
        self._frames = 0
        self._without: Counter[str] = Counter()

    def add(self, reports: Iterable[Report]) -> None:
        """What services reported of a frame."""
        self._frames += 1
        for report in reports:
            if report.counts.get(_WITHOUT_USERS):
                self._without[report.source] += 1

    def warnings(self) -> list[str]:
        """For a user: a line for each agent that served nobody from the first frame to the last."""
        return [
            f"{agent} had nobody to serve in any frame; see its `users`, and `on` of the receivers"
            for agent, frames in sorted(self._without.items())
            if frames == self._frames
        ]
