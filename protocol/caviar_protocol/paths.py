"""Paths from frame to frame: which appeared and which vanished."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from caviar_protocol.arrays import BoolArray
from caviar_protocol.topics.channel import Channel


@dataclass(frozen=True, eq=False)
class Changes:
    """What became of the paths between two products."""

    born: BoolArray
    """Which paths of the later product the earlier one does not have, Shape ``[P]`` of the later."""
    died: BoolArray
    """Which paths of the earlier product the later one does not have, Shape ``[P]`` of the earlier."""

    @property
    def births(self) -> int:
        """Number of paths that appeared."""
        return int(np.count_nonzero(self.born))

    @property
    def deaths(self) -> int:
        """Number of paths that vanished."""
        return int(np.count_nonzero(self.died))


def changes(before: Channel, after: Channel) -> Changes:
    """Births and deaths of paths from one product to a later one.

    A path is the same where TX, RX and ``id`` are; all paths of a pair that came or left are born or
    died with it.
    """
    same = before.tx == after.tx and before.rx == after.rx
    if same and np.array_equal(before.offsets, after.offsets) and np.array_equal(before.id, after.id):
        return Changes(np.zeros(len(after.id), np.bool_), np.zeros(len(before.id), np.bool_))
    born, died = np.ones(len(after.id), np.bool_), np.ones(len(before.id), np.bool_)
    earlier = frozenset(before.rx)
    for tx in sorted(frozenset(before.tx) & frozenset(after.tx)):
        for rx in (name for name in after.rx if name in earlier):
            old, new = before.pair(tx, rx), after.pair(tx, rx)
            born[new] = ~np.isin(after.id[new], before.id[old])
            died[old] = ~np.isin(before.id[old], after.id[new])
    return Changes(born, died)
