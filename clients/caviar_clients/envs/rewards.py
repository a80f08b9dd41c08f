"""Rewards of the environments from what a link achieved, and what ``info`` says of it."""

from __future__ import annotations

from collections.abc import Collection
from functools import reduce
from operator import add
from typing import Any, Literal, Protocol, TypeAlias, get_args

import numpy as np
from numpy.typing import NDArray

from caviar_protocol.arrays import BoolArray, Float64Array
from caviar_protocol.errors import ScenarioError
from caviar_protocol.observations import LinkFigures
from caviar_protocol.topics import Link


class LinkResult(LinkFigures, Protocol):
    """What environments say about a link: a `Link`, or one of many episodes."""

    @property
    def has_path(self) -> BoolArray:
        """Whether each user has a path, Shape ``[..., U]`` as all below."""

    @property
    def los(self) -> BoolArray:
        """Whether the line of sight is free."""

    @property
    def top_abs_y(self) -> Float64Array:
        """|y| of the best pairs, best first, Shape ``[..., U, K]``."""

    @property
    def baseline_abs_y(self) -> Float64Array:
        """|y| of the pair along the straight line."""

    @property
    def snr(self) -> Float64Array:
        """Linear."""


def link_info(link: LinkResult) -> dict[str, NDArray[Any]]:
    """What ``info`` has of a link, by name."""
    known = {
        "abs_y": link.abs_y,
        "best_abs_y": link.top_abs_y[..., 0],
        "baseline_abs_y": link.baseline_abs_y,
        "los": link.los,
    }
    if isinstance(link, Link) and link.throughput is not None:
        known |= {name: getattr(link, name) for name in PACKETS}
    return known


PACKETS = ("throughput", "delay", "waiting", "buffered", "dropped")
"""What ``info`` has of a link with packets, in the units of `Link`."""

RewardKind: TypeAlias = Literal["abs_y", "normalised", "snr", "spectral_efficiency", "throughput", "delay"]
KINDS: tuple[RewardKind, ...] = get_args(RewardKind)
OF_PACKETS = ("throughput", "delay")
"""Rewards for which the link has to have packets."""


class Reward:
    """Mean over the users served of one of their figures; users without a path are left out.

    Args:
        kind: ``abs_y``: |y| of the chosen pair (the paper, section 4); ``normalised``: |y| over that of the
            best pair; ``snr``: linear; ``spectral_efficiency`` [bit/s/Hz]. Of a link with packets, mean over
            the users whose receiver the transmitter serves, with a path or without: ``throughput`` [Mbit/s];
            ``delay`` [ms]: minus the mean delay of the packets that came through in the frame, or minus the
            age of the oldest one that still waits, whichever is longer: to send nothing is no way out.
    """

    def __init__(self, kind: RewardKind) -> None:
        self.kind = kind
        self._known: tuple[tuple[str, ...], tuple[str, ...], Collection[tuple[str, str]]] | None = None
        self._served: BoolArray | None = None

    def served(self, link: LinkResult, pairs: Collection[tuple[str, str]]) -> BoolArray | None:
        """Find the users of a link that are among some pairs.

        Args:
            link: Has the users.
            pairs: Names of transmitter and receiver.

        Returns:
            Whether each user is, Shape ``[U]``; None where all are.
        """
        # Users hardly ever change: comparing three tuples costs less than looking up each pair.
        known = (link.tx, link.rx, pairs)
        if known != self._known:
            inside = np.array([pair in pairs for pair in zip(link.tx, link.rx, strict=True)], np.bool_)
            self._known, self._served = known, None if inside.all() else inside
        return self._served

    def mean(self, link: Link, pairs: Collection[tuple[str, str]]) -> float:
        """Work out the reward for a frame.

        Args:
            link: What the decision led to.
            pairs: Names of transmitter and receiver of the users that count.

        Returns:
            The mean over these users; 0 where none of them has a path.
        """
        values = self._values(link)
        counted, served = self._counted(link), self.served(link, pairs)
        if served is not None:
            counted = counted & served
        if len(values) == 1:  # without a mask and a mean of NumPy, which take 5 µs more
            return float(values[0]) if counted[0] else 0.0
        chosen: list[float] = values[counted].tolist()
        # One after the other, as `means` adds them: `sum` has an order of its own.
        return reduce(add, chosen) / len(chosen) if chosen else 0.0

    def means(self, link: LinkResult, pairs: Collection[tuple[str, str]]) -> Float64Array:
        """Work out the rewards for a frame of many episodes.

        Args:
            link: What the decisions led to, with M rows of users.
            pairs: Names of transmitter and receiver of the users that count.

        Returns:
            What `mean` returns for the link of each episode, Shape ``[M]``.
        """
        values = self._values(link)
        counted, served = link.has_path, self.served(link, pairs)
        if served is not None:
            counted = counted & served
        total, number = np.zeros(len(values)), counted.sum(axis=1)
        for user in range(values.shape[1]):
            total += np.where(counted[:, user], values[:, user], 0.0)
        means: Float64Array = np.divide(total, number, out=np.zeros(len(values)), where=number > 0)
        return means

    def _counted(self, link: Link) -> BoolArray:
        if self.kind not in OF_PACKETS:
            return link.has_path
        if link.serving is None:
            raise ScenarioError(
                f"the reward {self.kind!r} is of packets, and the link of the run sends none; write "
                'use = "cell" and its traffic, or another reward'
            )
        return link.serving

    def _values(self, link: LinkResult) -> Float64Array:
        match self.kind:
            case "throughput" | "delay":
                return self._of_packets(link)
            case "abs_y":
                return link.abs_y
            case "snr":
                return link.snr
            case "spectral_efficiency":
                return link.spectral_efficiency
            case "normalised":
                best = link.top_abs_y.max(axis=-1, initial=0.0)
                share: Float64Array = np.divide(link.abs_y, best, out=np.zeros(best.shape), where=best > 0)
                return share

    def _of_packets(self, link: LinkResult) -> Float64Array:
        if not isinstance(link, Link) or link.throughput is None:
            return np.zeros(link.abs_y.shape)  # it is refused where users are counted
        if self.kind == "throughput":
            return link.throughput / 1e6
        ages = [values for values in (link.delay, link.waiting) if values is not None]
        longest: Float64Array = np.max(ages, axis=0)
        return 0.0 - 1e3 * longest
