"""Distributions of the page of a dataset, and what its generation took."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from caviar_clients.datasets.look.data import (
    AZIMUTH_EDGES,
    ZENITH_EDGES,
    Sample,
)
from caviar_clients.datasets.look.pictures import (
    Draw,
    Theme,
    all_handles,
    panel_axes,
    plain,
    share_axis,
)
from caviar_clients.datasets.look.units import time_unit
from caviar_clients.plots.style import BLUE
from caviar_protocol.arrays import BoolArray, Float64Array


def draw_shares(
    names: Sequence[str], sight: Sequence[int], hidden: Sequence[int], none: Sequence[int]
) -> Draw:
    """A bar for each name: shares with a line of sight, with other paths only, without a path."""

    def draw(drawn: Any, theme: Theme) -> None:
        axes = drawn.subplots()
        parts = np.array([sight, hidden, none], dtype=float)
        parts = 100.0 * parts / np.maximum(parts.sum(axis=0), 1.0)
        at, left = np.arange(len(names)), np.zeros(len(names))
        kinds = (("line of sight", theme.first), ("other paths only", theme.second), ("no path", theme.third))
        for part, (label, colour) in zip(parts, kinds, strict=True):
            axes.barh(at, part, left=left, color=colour, height=0.62, label=label)
            for row, (share, start) in enumerate(zip(part, left, strict=True)):
                if share >= 6.0:
                    axes.text(
                        start + share / 2, row, f"{share:.1f} %", ha="center", va="center", fontsize=9,
                        color="white" if colour == BLUE else "#1a1a1a",
                    )  # fmt: skip
            left = left + part
        axes.set(yticks=at, yticklabels=list(map(plain, names)), xlim=(0, 100), xlabel="Share of users [%]")
        axes.invert_yaxis()
        axes.spines["left"].set_visible(False)
        axes.tick_params(axis="y", length=0)
        handles, labels = axes.get_legend_handles_labels()
        drawn.legend(handles, labels, loc="outside upper center", ncols=3, frameon=False)

    return draw


def draw_counts(panels: Sequence[tuple[str, Any]]) -> Draw:
    """A panel for each label, with the shares of small whole numbers.

    Args:
        panels: Label of the axis, and the numbers.
    """

    def draw(drawn: Any, theme: Theme) -> None:
        from matplotlib.ticker import MaxNLocator

        for axes, (label, numbers) in zip(panel_axes(drawn, len(panels)), panels, strict=True):
            low, high = int(numbers.min()), int(numbers.max())
            step = -(-(high - low + 1) // 60)  # many numbers share bars
            edges = np.arange(low, high + step + 1, step) - 0.5
            axes.hist(
                numbers, edges, weights=np.full(len(numbers), 100.0 / len(numbers)), color=theme.first,
                rwidth=0.86 if step == 1 else 1.0,
            )  # fmt: skip
            if high - low < 3:
                axes.set_xlim(low - 1.6, high + 1.6)
            axes.xaxis.set_major_locator(MaxNLocator(9, integer=True, min_n_ticks=1))
            axes.set_xlabel(label)
            share_axis(axes)

    return draw


def draw_histograms(panels: Sequence[tuple[str, Float64Array, BoolArray]], label: str) -> Draw:
    """A histogram for each carrier, those with a line of sight below the others.

    Args:
        panels: Title, numbers, and which have a line of sight.
        label: Of the numbers, with their unit.
    """

    def draw(drawn: Any, theme: Theme) -> None:
        together = np.concatenate([numbers for _, numbers, _ in panels])
        edges = histogram_edges(together)
        for axes, (title, numbers, sight) in zip(panel_axes(drawn, len(panels)), panels, strict=True):
            parts, colours, labels = [], [], []
            kinds = ((sight, theme.first, "line of sight"), (~sight, theme.second, "other paths only"))
            for mask, colour, name in kinds:
                if mask.any():
                    parts.append(numbers[mask])
                    colours.append(colour)
                    labels.append(name)
            weights = [np.full(len(part), 100.0 / len(numbers)) for part in parts]
            axes.hist(parts, edges, weights=weights, stacked=True, color=colours, label=labels)
            axes.set(xlabel=label, title=plain(title))
            share_axis(axes)
        handles, labels = all_handles(drawn)
        drawn.legend(handles, labels, loc="outside upper center", ncols=2, frameon=False)

    return draw


def histogram_edges(numbers: Float64Array) -> Float64Array:
    """Choose the limits of some 40 classes: all numbers but the outermost thousandths.

    Example:
        >>> histogram_edges(np.array([2.0, 2.0]))[[0, -1]].tolist()
        [1.5, 2.5]
    """
    low, high = np.percentile(numbers, [0.1, 99.9]).tolist()
    if high - low < 1e-3 * max(abs(low), abs(high), 1e-3):
        half = 0.5 if max(abs(low), abs(high)) > 1e-3 else 0.5 * max(abs(high), 1.0)
        low, high = low - half, high + half
    edges: Float64Array = np.linspace(low, high, 41)
    return edges


def draw_angles(sample: Sample) -> Draw:
    """Four histograms: azimuth and zenith, at departure and arrival."""

    def draw(drawn: Any, theme: Theme) -> None:
        from matplotlib.ticker import MaxNLocator

        panels = drawn.subplots(2, 2)
        ends = (
            ("departure", sample.departure, sample.strongest_departure),
            ("arrival", sample.arrival, sample.strongest_arrival),
        )
        for row, (end, every, strongest) in zip(panels, ends, strict=True):
            kinds = (
                ("Azimuth", AZIMUTH_EDGES, every.azimuth, strongest.azimuth),
                ("Zenith angle", ZENITH_EDGES, every.zenith, strongest.zenith),
            )
            for axes, (name, edges, all_counts, strong_counts) in zip(row, kinds, strict=True):
                shares = [100.0 * counts / max(counts.sum(), 1) for counts in (all_counts, strong_counts)]
                axes.stairs(shares[0], edges, fill=True, color=theme.first, alpha=0.75, label="all paths")
                axes.stairs(
                    shares[1], edges, color=theme.second, linewidth=1.4, label="strongest path of each user"
                )
                axes.set_xlim(*_occupied(all_counts + strong_counts, edges))
                if name == "Azimuth" and np.ptp(axes.get_xlim()) > 180.0:
                    axes.set(xlim=(-180.0, 180.0), xticks=range(-180, 181, 60))
                else:
                    axes.xaxis.set_major_locator(MaxNLocator(7, integer=True))
                axes.set_xlabel(f"{name} of {end} [°]")
                share_axis(axes, "paths")
        handles, labels = all_handles(drawn)
        drawn.legend(handles, labels, loc="outside upper center", ncols=2, frameon=False)

    return draw


def _occupied(counts: Any, edges: Float64Array) -> tuple[float, float]:
    """Limits of the classes in which there is something, with room beside them."""
    used = np.flatnonzero(counts)
    if not len(used):
        return float(edges[0]), float(edges[-1])
    low, high = float(edges[used[0]]), float(edges[used[-1] + 1])
    room = max(0.04 * (high - low), (20.0 - (high - low)) / 2, 0.0)
    return max(low - room, float(edges[0])), min(high + room, float(edges[-1]))


def draw_beams(panels: Sequence[tuple[str, Any, Any]], codebooks: tuple[int, int]) -> Draw:
    """How often each pair of beams is the best: a panel for each carrier and transmitter.

    Args:
        panels: Title, and beams of transmitter and receiver, each of the same users.
        codebooks: Beams that a transmitter and a receiver have at least.
    """

    def draw(drawn: Any, theme: Theme) -> None:
        from matplotlib.colors import LogNorm
        from matplotlib.ticker import MaxNLocator

        columns = max(codebooks[0], *(int(tx.max()) + 1 for _, tx, _ in panels))
        rows = max(codebooks[1], *(int(rx.max()) + 1 for _, _, rx in panels))
        grids = [np.bincount(rx * columns + tx, minlength=rows * columns) for _, tx, rx in panels]
        most = max(int(grid.max()) for grid in grids)
        found = panel_axes(drawn, len(panels))
        for axes, (title, _, _), grid in zip(found, panels, grids, strict=True):
            shown = axes.imshow(
                np.ma.masked_equal(grid.reshape(rows, columns), 0), origin="lower", aspect="auto",
                interpolation="none", cmap=theme.colours, norm=LogNorm(0.9, max(most, 2)),
            )  # fmt: skip
            for axis in (axes.xaxis, axes.yaxis):
                axis.set_major_locator(MaxNLocator(9, integer=True, min_n_ticks=1))
            axes.set(xlabel="Beam of the transmitter", ylabel="Beam of the receiver", title=plain(title))
        bar = drawn.colorbar(shown, ax=list(found), label="Users", pad=0.01)
        ticks = [tick for power in range(8) for tick in (10**power, 3 * 10**power) if tick <= most]
        bar.set_ticks(ticks if len(ticks) < 9 else ticks[::2])
        bar.minorticks_off()
        bar.ax.yaxis.set_major_formatter("{x:g}")

    return draw


def beams_height(panels: Sequence[tuple[str, Any, Any]]) -> float:
    """Height of the figure of the beams [inches]."""
    return 3.2 * (-(-len(panels) // 2)) + 0.4


@dataclass(frozen=True, eq=False)
class Lag:
    """Correlation of scenes that are a time apart."""

    apart_s: float
    low: float
    """Tenth percentile."""
    median: float
    high: float
    """Ninetieth percentile."""


def lags(sample: Sample) -> list[Lag]:
    """Group the correlations by the time between the scenes, in 24 groups at most.

    Args:
        sample: Has them.
    """
    apart, values = np.array(sample.apart_s), np.array(sample.correlation)
    times = np.round(apart, 6)
    known = np.unique(times)
    if len(known) > 24:
        edges = np.quantile(times, np.linspace(0.0, 1.0, 25)[1:-1])
        times = np.searchsorted(edges, times).astype(float)
        known = np.unique(times)
    found = []
    for time in known:
        mask = times == time
        low, median, high = np.percentile(values[mask], [10.0, 50.0, 90.0]).tolist()
        found.append(Lag(float(np.mean(apart[mask])), low, median, high))
    return found


def draw_correlation(sample: Sample) -> Draw:
    """A histogram for scenes that follow one another, and quantiles against the time between scenes."""

    def draw(drawn: Any, theme: Theme) -> None:
        values = np.array(sample.correlation)[np.array(sample.consecutive)]
        found = lags(sample)
        panels = panel_axes(drawn, 2 if len(found) > 1 else 1)
        axes = panels[0]
        axes.hist(
            values, np.linspace(0.0, 1.0, 41), weights=np.full(len(values), 100.0 / len(values)),
            color=theme.first,
        )  # fmt: skip
        axes.set(xlim=(0.0, 1.0), xlabel="Correlation of consecutive scenes")
        share_axis(axes, "users")
        if len(found) > 1:
            axes = panels[1]
            unit, name = time_unit(found[0].apart_s)
            apart = [lag.apart_s / unit for lag in found]
            axes.fill_between(
                apart, [lag.low for lag in found], [lag.high for lag in found], color=theme.first, alpha=0.25,
                linewidth=0, label="10 % to 90 %",
            )  # fmt: skip
            axes.plot(
                apart, [lag.median for lag in found], "o-", color=theme.first, markersize=4, label="median"
            )
            axes.set(
                xlim=(0.0, None),
                ylim=(0.0, 1.03),
                xlabel=f"Time between the scenes [{name}]",
                ylabel="Correlation",
            )
            axes.grid(axis="y")
            axes.legend(loc="lower left", frameon=False)

    return draw
