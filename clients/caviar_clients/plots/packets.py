"""Picture of the packets of a run: throughput, delay and drops of each receiver over time."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from caviar_clients.plots.style import (
    BLACK,
    BLUE,
    GREY,
    ORANGE,
    SKY,
    VERMILION,
    figure,
    legend_below,
)
from caviar_clients.plots.user_curves import link_source, running_time
from caviar_protocol.arrays import Float64Array, Int64Array
from caviar_protocol.recording import Recording

_COLORS = (BLUE, VERMILION, ORANGE, SKY, BLACK, "#009e73", "#cc79a7", "#f0e442")
"""Of the receivers with most traffic (Okabe and Ito); the others are grey."""

POINTS = 100
"""Points of a curve at most; frames beyond that are averaged, since packets of single frames are noise."""


@dataclass(frozen=True, eq=False)
class PacketSeries:
    """Packets of R receivers in F frames; summed over transmitters and carriers."""

    rx: tuple[str, ...]
    time: Float64Array
    """[s], simulated; an episode begins where the one before ended. Shape ``[F]``."""
    frame_s: float
    """Length of a frame [s]."""
    arrived: Float64Array
    """[bit], Shape ``[F, R]``; likewise the others."""
    sent: Float64Array
    dropped: Float64Array
    delivered: Float64Array
    """Packets."""
    delay: Float64Array
    """Sum over the delivered packets [s]."""

    def binned(self) -> PacketSeries:
        """The series with at most `POINTS` instants: sums of as many frames each, and their mean time."""
        width = -(-len(self.time) // POINTS)
        begins = np.arange(0, len(self.time), width)
        counts = np.diff(np.append(begins, len(self.time)))
        # What a last, shorter bin lacks: it stands for as many frames as the others.
        full = (width / counts)[:, None]
        fields = ("arrived", "sent", "dropped", "delivered", "delay")
        sums = {name: np.add.reduceat(getattr(self, name), begins) * full for name in fields}
        time = np.add.reduceat(self.time, begins) / counts
        return PacketSeries(rx=self.rx, time=time, frame_s=width * self.frame_s, **sums)


def packet_series(recording: Recording) -> PacketSeries | None:
    """Read what became of the packets of each receiver.

    Args:
        recording: With topic ``link``.

    Returns:
        None where the link has no packets.
    """
    link = recording["link", link_source(recording)]
    if not link.users or np.isnan(link.arrived).all():
        return None
    names = tuple(dict.fromkeys(sorted(user.rx for user in link.users)))
    of_rx = np.array([[user.rx == name for name in names] for user in link.users], np.float64)

    def summed(values: Float64Array) -> Float64Array:
        # A receiver that was not there had nothing.
        total: Float64Array = np.nan_to_num(values) @ of_rx
        return total

    period_ns = recording.metadata.sampling_period_ns
    return PacketSeries(
        rx=names,
        time=running_time(link, period_ns),
        frame_s=period_ns * 1e-9,
        arrived=summed(link.arrived),
        sent=summed(link.sent),
        dropped=summed(link.dropped),
        delivered=summed(link.delivered),
        delay=summed(link.delay * link.delivered),
    )


def draw_traffic(data: PacketSeries, file: Path) -> None:
    """Draw throughput, mean delay and dropped bits of each receiver over time.

    Args:
        data: As `packet_series` reads it.
        file: PNG that is written.
    """
    whole, drawn_data = data, data.binned()
    order = _by_traffic(whole)
    with figure(file, 9.0, 8.0) as drawn:
        throughput, delay, dropped = drawn.subplots(3, 1, sharex=True)
        for rank, r in enumerate(order):
            color = _COLORS[rank] if rank < len(_COLORS) else GREY
            style: dict[str, Any] = {"color": color, "linewidth": 1.6 if rank < len(_COLORS) else 0.8}
            of_all = whole.dropped[:, r].sum() / max(whole.arrived[:, r].sum(), 1.0)
            label = f"{whole.rx[r]}, {of_all:.2%} dropped" if rank < len(_COLORS) else None
            throughput.plot(
                drawn_data.time, drawn_data.sent[:, r] / drawn_data.frame_s * 1e-6, label=label, **style
            )
            with np.errstate(invalid="ignore", divide="ignore"):
                mean = drawn_data.delay[:, r] / drawn_data.delivered[:, r]
            delay.plot(drawn_data.time, 1e3 * mean, **style)
            dropped.plot(drawn_data.time, drawn_data.dropped[:, r] / drawn_data.frame_s * 1e-6, **style)
        for axes, text in (
            (throughput, "Throughput\n[Mbit/s]"),
            (delay, "Mean delay of what\nwas delivered [ms]"),
            (dropped, "Dropped\n[Mbit/s]"),
        ):
            axes.set_ylabel(text)
            axes.set_ylim(bottom=0)
            axes.grid()
        dropped.margins(x=0)
        dropped.set_xlabel("Time [s]")
        throughput.set_title(f"Packets of {_receivers(whole)}, means over {drawn_data.frame_s:.3g} s")
        legend_below(drawn, throughput)


def _by_traffic(data: PacketSeries) -> Int64Array:
    """Receivers by name; where there are more than colours, those with most traffic first."""
    if len(data.rx) <= len(_COLORS):
        return np.arange(len(data.rx))
    order: Int64Array = np.argsort(-data.arrived.sum(0), kind="stable")
    return order


def _receivers(data: PacketSeries) -> str:
    more = len(data.rx) - len(_COLORS)
    return f"{len(data.rx)} receivers" + (f", {more} of them grey" if more > 0 else "")
