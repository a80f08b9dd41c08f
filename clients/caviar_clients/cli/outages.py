"""Why users of a recorded run had no path, by count."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable

import msgspec

from caviar_protocol.messages import Report
from caviar_protocol.topics.channel import INSIDE_PREFIX, Cause

_CAUSES = {cause.count_name: cause for cause in Cause}

SHOWN_INSIDE = 8
"""Antennas inside an object that are named; how many there are more is said."""


class OutageSummary(msgspec.Struct, kw_only=True):
    """Users without a path, summed over frames."""

    users: int
    causes: dict[str, int]
    """Of these, how many for which `Cause`, the most frequent first."""
    unexplained: int
    """Of these, those for which the channel reported no cause: it was held, or is of another make."""
    inside: dict[str, int]
    """Frames in which an antenna without a path stood inside an object, by ``ANTENNA in OBJECT``."""


class Outages:
    """Counts causes, frame by frame."""

    def __init__(self) -> None:
        self._causes: Counter[str] = Counter()
        self._inside: Counter[str] = Counter()

    def add(self, reports: Iterable[Report]) -> None:
        """What services reported of a frame."""
        for report in reports:
            for name, count in report.counts.items():
                if name in _CAUSES:
                    self._causes[_CAUSES[name].value] += count
                elif name.startswith(INSIDE_PREFIX):
                    self._inside[name.removeprefix(INSIDE_PREFIX)] += 1

    def summary(self, users: int) -> OutageSummary | None:
        """The causes of ``users`` users without a path; None where there were none."""
        if not users:
            return None
        return OutageSummary(
            users=users,
            causes=dict(self._causes.most_common()),
            unexplained=max(0, users - self._causes.total()),
            inside=dict(self._inside.most_common()),
        )


def outage_lines(outage: OutageSummary) -> list[str]:
    """For a user: the causes in one line, and what stands inside of what."""
    parts = [f"{count} {cause}" for cause, count in outage.causes.items()]
    if outage.unexplained:
        parts.append(f"{outage.unexplained} for a cause that the channel did not report")
    lines = [", ".join(parts)]
    shown = list(outage.inside.items())[:SHOWN_INSIDE]
    lines += [f"inside an object: {name}, in {_frames(frames)}" for name, frames in shown]
    if len(outage.inside) > len(shown):
        lines.append(f"inside an object: {len(outage.inside) - len(shown)} more antennas")
    return lines


def _frames(count: int) -> str:
    return f"{count} frame" if count == 1 else f"{count} frames"
