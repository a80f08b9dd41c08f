"""Links of many episodes of one run at once; see `caviar_services.channel.batch`."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import NamedTuple

from caviar_protocol.arrays import BoolArray, Float64Array, Int64Array
from caviar_services.channel.batch import MemberSeed


class BatchLink(NamedTuple):
    """Result of a frame per member and user: fields of `caviar_protocol.topics.Link`, of M members and in the
    order of its users."""

    tx: tuple[str, ...]
    rx: tuple[str, ...]
    carrier: tuple[str, ...]
    has_path: BoolArray
    """Shape ``[M, U]``, as all below."""
    los: BoolArray
    tx_beam: Int64Array
    rx_beam: Int64Array
    abs_y: Float64Array
    top_abs_y: Float64Array
    """|y| of the best pair alone, Shape ``[M, U, 1]``."""
    baseline_abs_y: Float64Array
    snr: Float64Array
    spectral_efficiency: Float64Array
    """[bit/s/Hz]."""


class LinkBatch(ABC):
    """The links of many episodes; a link makes one with `LinkModel.batch`."""

    @abstractmethod
    def begin(self, members: Sequence[MemberSeed]) -> None:
        """Begin an episode of each member."""

    @abstractmethod
    def step(self, number: int, beams: Int64Array) -> BatchLink:
        """Score the beams of a frame.

        Args:
            number: Of the frame, which follows on the one before.
            beams: Index ``tx_beam·Nr + rx_beam`` of the pair of each member and user, −1 where it is not
                served; Shape ``[M, U]`` with the users of `caviar_services.link.base.users_of`.
        """
