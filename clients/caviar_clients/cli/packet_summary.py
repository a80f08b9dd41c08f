"""Figures of the packets of a run: sums over users and frames, and in words."""

from __future__ import annotations

from typing import Annotated

import msgspec
import numpy as np

from caviar_clients.cli.shared import scaled
from caviar_protocol.arrays import quantity
from caviar_protocol.topics import Link


class PacketSummary(msgspec.Struct, kw_only=True):
    """What became of packets, over all frames and users."""

    arrived: Annotated[int, quantity("bit", "came for users")]
    sent: Annotated[int, quantity("bit", "came through")]
    dropped: Annotated[int, quantity("bit", "too old, or the buffer was full")]
    delivered: int
    """Packets of which the last bit came through."""
    mean_delay: Annotated[float | None, quantity("s", "of these")]
    """None where there was none."""
    mean_throughput: Annotated[float, quantity("bit/s", "of a user")]
    blocks: int
    """Transport blocks that were sent."""
    block_errors: int
    """Of these, how many were not decoded."""


class PacketTotals:
    """Sums over links, of which those without packets count as nothing."""

    def __init__(self) -> None:
        self._counts = np.zeros(6, np.int64)
        self._delay, self._throughput, self._receivers, self._any = 0.0, 0.0, 0, False

    def add(self, link: Link) -> None:
        """Add a frame's link."""
        if link.arrived is None or link.delay is None or link.delivered is None or link.throughput is None:
            return
        self._any = True
        counts = (link.arrived, link.sent, link.dropped, link.delivered, link.blocks, link.block_errors)
        self._counts += [0 if values is None else int(values.sum()) for values in counts]
        self._delay += float(link.delay @ link.delivered)
        self._throughput += float(link.throughput.sum())
        # A receiver on a carrier is one user here, however many transmitters reach it.
        self._receivers += len(set(zip(link.rx, link.carrier, strict=True)))

    def summary(self) -> PacketSummary | None:
        """Figures of all links; None where none had packets."""
        if not self._any:
            return None
        arrived, sent, dropped, delivered, blocks, errors = self._counts.tolist()
        return PacketSummary(
            arrived=arrived,
            sent=sent,
            dropped=dropped,
            delivered=delivered,
            mean_delay=self._delay / delivered if delivered else None,
            mean_throughput=self._throughput / max(self._receivers, 1),
            blocks=blocks,
            block_errors=errors,
        )


def packet_line(found: PacketSummary) -> str:
    """Put the figures into words.

    Example:
        >>> figures = PacketSummary(
        ...     arrived=100, sent=90, dropped=5, delivered=9, mean_delay=0.0021, mean_throughput=2e6,
        ...     blocks=20, block_errors=0,
        ... )
        >>> packet_line(figures)
        'packets: 90.0% sent, 5.0% dropped, mean delay 2.1 ms, mean throughput 2 Mbit/s a user'
    """
    whole = max(found.arrived, 1)
    delay = "none delivered" if found.mean_delay is None else f"mean delay {1e3 * found.mean_delay:.3g} ms"
    rate, unit = scaled(found.mean_throughput, ("bit/s", "kbit/s", "Mbit/s", "Gbit/s"))
    errors = f", {found.block_errors / found.blocks:.1%} of blocks failed" if found.block_errors else ""
    return (
        f"packets: {found.sent / whole:.1%} sent, {found.dropped / whole:.1%} dropped, {delay}, "
        f"mean throughput {rate:.3g} {unit} a user{errors}"
    )
