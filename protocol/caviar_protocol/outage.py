"""Why users have no path: the causes that channels count in their reports, and their names there.

A user is a (TX, RX, carrier), as in `Link`. Counts stand beside a product, not in it: the same paths have
the same digest, whatever is known about the paths that are not there.
"""

from __future__ import annotations

from enum import Enum


class Cause(Enum):
    """Why no path reaches a user; of several causes the one that stands first."""

    INSIDE = "inside an object"
    """An end is inside a building or a body, its own or another."""
    TOO_CLOSE = "too close"
    """The ends are nearer to each other than one wavelength, where no path loss holds."""
    OUT_OF_RANGE = "out of range"
    """An end is beside the scenery or below its lowest point, and its line of sight is not free."""
    BLOCKED = "blocked"
    """Something stands between the ends, and no way around it was found."""
    NOT_FOUND = "no path found"
    """The line of sight is free, but not modelled, or of amplitude 0."""

    @property
    def count_name(self) -> str:
        """Name in the counts of a report, as ``no-path/out-of-range``."""
        return f"no-path/{self.value.replace(' ', '-')}"


INSIDE_PREFIX = "inside/"
"""Before ``ANTENNA in OBJECT`` in the counts of a report: an antenna that no path reaches, and the object
that it stands inside."""
