"""Paths from frame to frame: which appeared and which vanished."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from caviar_protocol.arrays import BoolArray, Int64Array
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
    earlier, later = _keys(before, after)
    return Changes(~np.isin(later, earlier), ~np.isin(earlier, later))


def _keys(before: Channel, after: Channel) -> tuple[Int64Array, Int64Array]:
    """Numbers that two paths of the products, Shape ``[P]`` each, have in common where they are the same."""
    channels = (before, after)
    tx, rx = (
        {name: number for number, name in enumerate(dict.fromkeys(names))}
        for names in (before.tx + after.tx, before.rx + after.rx)
    )
    numbers, places = np.unique(np.concatenate([c.id for c in channels]), return_inverse=True)
    pairs = [
        np.repeat([tx[t] * len(rx) + rx[r] for t in c.tx for r in c.rx], np.diff(c.offsets)).astype(np.int64)
        for c in channels
    ]
    keys = np.concatenate(pairs) * len(numbers) + places.reshape(-1)
    return keys[: len(before.id)], keys[len(before.id) :]
