"""What an agent is rewarded with, from the link of the frame it decided."""

from __future__ import annotations

from collections.abc import Collection
from typing import Literal, TypeAlias, get_args

import numpy as np

from caviar_protocol.arrays import BoolArray, Float64Array
from caviar_protocol.topics import Link

RewardKind: TypeAlias = Literal["abs_y", "normalised", "snr", "spectral_efficiency"]
KINDS: tuple[RewardKind, ...] = get_args(RewardKind)


class Reward:
    """Mean over the users served of one of their figures; users without a path are left out.

    ``abs_y``: |y| of the chosen pair (the paper, section 4); ``normalised``: |y| over that of the best
    pair; ``snr``: linear; ``spectral_efficiency`` [bit/s/Hz]. 0 where no user has a path.
    """

    def __init__(self, kind: RewardKind) -> None:
        self.kind = kind
        self._known: tuple[tuple[str, ...], tuple[str, ...], Collection[tuple[str, str]]] | None = None
        self._served: BoolArray | None = None

    def served(self, link: Link, pairs: Collection[tuple[str, str]]) -> BoolArray | None:
        """Which users of the link are among these (TX, RX); None: all of them."""
        known = (link.tx, link.rx, pairs)
        if known != self._known:
            inside = np.array([pair in pairs for pair in zip(link.tx, link.rx, strict=True)], np.bool_)
            self._known, self._served = known, None if inside.all() else inside
        return self._served

    def of(self, link: Link, pairs: Collection[tuple[str, str]]) -> float:
        """The reward for a frame."""
        values = self._values(link)
        counted, served = link.has_path, self.served(link, pairs)
        if served is not None:
            counted = counted & served
        if len(values) == 1:
            return float(values[0]) if counted[0] else 0.0
        chosen = values[counted]
        return float(chosen.mean()) if len(chosen) else 0.0

    def _values(self, link: Link) -> Float64Array:
        match self.kind:
            case "abs_y":
                return link.abs_y
            case "snr":
                return link.snr
            case "spectral_efficiency":
                return link.spectral_efficiency
            case "normalised":
                best = link.top_abs_y.max(axis=1, initial=0.0)
                share: Float64Array = np.divide(link.abs_y, best, out=np.zeros(len(best)), where=best > 0)
                return share
