"""Shares of valid users, and of those with a line of sight, beside the counts of the paper's Table 2."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from caviar_clients.datasets.plan import PRESETS

if TYPE_CHECKING:
    from caviar_clients.datasets.reader import Dataset


@dataclass(frozen=True)
class UserCounts:
    """Numbers of users: receivers in all scenes, on each carrier and for each transmitter.

    Example:
        >>> str(UserCounts(users=20_860, valid=11_194, los=6_482))
        '20,860 users: 11,194 valid (53.7 %), of these 6,482 LOS (57.9 %) and 4,712 NLOS (42.1 %)'
    """

    users: int
    valid: int
    """Those that a path reaches."""
    los: int
    """Of these, those with a line of sight."""

    def __str__(self) -> str:
        if not self.valid:
            return f"{self.users:,} users: 0 valid"
        nlos = self.valid - self.los
        return (
            f"{self.users:,} users: {self.valid:,} valid ({100 * self.valid / self.users:.1f} %), of these "
            f"{self.los:,} LOS ({100 * self.los / self.valid:.1f} %) "
            f"and {nlos:,} NLOS ({100 * nlos / self.valid:.1f} %)"
        )


def count_users(dataset: Dataset) -> UserCounts:
    """Count the users of a dataset.

    Args:
        dataset: All its episodes count.
    """
    row = dataset.query(
        "SELECT count(*) AS users, coalesce(sum(valid), 0) AS valid, coalesce(sum(valid AND los), 0) AS los "
        "FROM users"
    )
    return UserCounts(**{name: int(column[0]) for name, column in row.items()})


def paper_counts(name: str) -> str:
    """What Table 2 of the paper says of the set of a preset; empty where there is no such preset.

    Args:
        name: Of the run.

    Example:
        >>> paper_counts("s008"), paper_counts("smoke")
        ('s008 of the paper: 20,860 users, 11,000 valid (53 %)', '')
    """
    preset = PRESETS.get(name)
    if preset is None:
        return ""
    users = preset.episodes * preset.scenes * preset.count
    share = 100 * preset.valid_channels / users
    return f"{name} of the paper: {users:,} users, {preset.valid_channels:,} valid ({share:.0f} %)"
