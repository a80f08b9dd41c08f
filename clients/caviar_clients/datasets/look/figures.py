"""Figures of the page of a dataset, light and dark, as data within the page: histograms, bars and curves.

`maps` has those of what is seen from above.
"""

from __future__ import annotations

import base64
import io
import struct
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from caviar_clients.datasets.look.data import AZIMUTH_EDGES, ZENITH_EDGES, Sample, Throughput
from caviar_clients.datasets.texts import rate_unit, small_time_unit, time_unit
from caviar_clients.plots.style import BLUE, ORANGE, SKY, styled
from caviar_protocol.arrays import BoolArray, Float64Array, UInt8Array

WIDTH_IN = 9.0
"""Width of a figure [inches]."""
DPI = 144
"""Of the pictures; a page shows them at 96, so that screens with small pixels have more to show."""
PANELS = 4
"""Carriers and transmitters with a panel of their own at most."""


@dataclass(frozen=True)
class Theme:
    """Colours of a figure."""

    ink: str
    muted: str
    paper: str
    grid: str
    area: str
    """Of buildings."""
    outline: str
    first: str
    """Of what stands first: a free line of sight."""
    second: str
    """Of what stands second: no line of sight."""
    third: str
    """Of what is missing: no path."""
    ramp: tuple[float, float]
    """Part of viridis that stands out from the paper."""

    @property
    def colours(self) -> Any:
        """Colour map of numbers."""
        from matplotlib import colormaps
        from matplotlib.colors import ListedColormap

        return ListedColormap(colormaps["viridis"](np.linspace(*self.ramp, 256)))

    def settings(self) -> dict[str, Any]:
        """Settings of Matplotlib."""
        ink = ("text.color", "axes.labelcolor", "axes.titlecolor", "xtick.color", "ytick.color")
        paper = ("figure.facecolor", "axes.facecolor", "savefig.facecolor", "legend.facecolor")
        return {
            **dict.fromkeys(ink, self.ink),
            **dict.fromkeys(paper, self.paper),
            "axes.edgecolor": self.muted,
            "legend.edgecolor": self.grid,
            "grid.color": self.grid,
            "hatch.color": self.muted,
        }


LIGHT = Theme(
    "#222222", "#767676", "#ffffff", "#dcdcdc", "#e6e6e6", "#a6a6a6", BLUE, ORANGE, "#b8b8b8", (0.0, 0.95)
)
DARK = Theme(
    "#e4e6e8", "#8d949b", "#17191c", "#33383d", "#2a2f34", "#646c74", SKY, ORANGE, "#6a7178", (0.22, 1.0)
)


@dataclass(frozen=True)
class Picture:
    """A picture within a page."""

    light: str
    """URI with the data of the picture."""
    dark: str
    """The same for dark pages; empty: it is the same."""
    width: int
    """As the page shows it [pixels]."""
    height: int


Draw = Callable[[Any, Theme], None]
"""``draw(figure, theme)``"""


def picture(draw: Draw, height: float, *, map_like: bool = False) -> Picture:
    """Draw a figure in both themes.

    Args:
        draw: Draws it.
        height: Its height [inches].
        map_like: Whether its axes have an aspect of their own.

    Raises:
        SetupError: Matplotlib is not installed.
    """
    light, dark = (_png(draw, theme, height, map_like) for theme in (LIGHT, DARK))
    width_px, height_px = struct.unpack(">II", light[16:24])  # of the PNG's header
    shown = round(width_px * 96 / DPI), round(height_px * 96 / DPI)
    return Picture(_uri(light, "png"), _uri(dark, "png"), *shown)


def pixels(image: UInt8Array) -> Picture:
    """Take pixels as they are.

    Args:
        image: Shape ``[height, width, 3]``.
    """
    from matplotlib.image import imsave

    data = io.BytesIO()
    imsave(data, np.ascontiguousarray(image), format="jpg", pil_kwargs={"quality": 88})
    return Picture(_uri(data.getvalue(), "jpeg"), "", image.shape[1], image.shape[0])


def _png(draw: Draw, theme: Theme, height: float, map_like: bool) -> bytes:
    with styled():
        from matplotlib import rc_context
        from matplotlib.figure import Figure
        from matplotlib.layout_engine import ConstrainedLayoutEngine

        with rc_context(theme.settings()):
            layout: Any = ConstrainedLayoutEngine(w_pad=0.1, h_pad=0.06, compress=map_like)
            drawn = Figure(figsize=(WIDTH_IN, height), layout=layout)
            draw(drawn, theme)
            data = io.BytesIO()
            # Axes with an aspect of their own leave margins; to cut them off takes time.
            cut: dict[str, Any] = {"bbox_inches": "tight", "pad_inches": 0.08} if map_like else {}
            drawn.savefig(data, format="png", dpi=DPI, **cut)
    return data.getvalue()


def _uri(data: bytes, kind: str) -> str:
    return f"data:image/{kind};base64,{base64.b64encode(data).decode()}"


def plain(name: str) -> str:
    """A name of the user's, in which a dollar sign begins no formula.

    Example:
        >>> print(plain("$a"))
        \\$a
    """
    return name.replace("$", r"\$")


def panel_axes(drawn: Any, count: int) -> list[Any]:
    """Axes of so many panels, two a row."""
    columns = min(count, 2)
    cells = drawn.subplots(-(-count // columns), columns, squeeze=False).ravel()
    for axes in cells[count:]:
        axes.set_axis_off()
    return list(cells[:count])


def _share_axis(axes: Any, what: str = "") -> None:
    """Label the axis of shares, of users or of what is named."""
    from matplotlib.ticker import MaxNLocator

    axes.yaxis.set_major_locator(MaxNLocator(5))
    axes.set_ylabel(f"Share of {what} [%]" if what else "Share [%]")
    axes.grid(axis="y")


def legend_of_all(drawn: Any, where: str = "upper", columns: int = 2) -> None:
    """Write a legend with the entries of all panels, each once, above or below them.

    Args:
        drawn: The figure.
        where: ``upper`` or ``lower``.
        columns: Entries of a row.
    """
    found: dict[str, Any] = {}
    for axes in drawn.axes:
        for handle, label in zip(*axes.get_legend_handles_labels(), strict=True):
            found.setdefault(label, handle)
    if found:
        drawn.legend(
            list(found.values()), list(found), loc=f"outside {where} center", ncols=columns, frameon=False
        )


def _share(values: Any) -> Float64Array:
    """Weights by which a histogram of these values has shares [%]."""
    return np.full(len(values), 100.0 / len(values))


def _bars_axis(axes: Any) -> None:
    """Order horizontal bars from above, without ticks beside their names."""
    axes.invert_yaxis()
    axes.spines["left"].set_visible(False)
    axes.tick_params(axis="y", length=0)


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
        _bars_axis(axes)
        legend_of_all(drawn, columns=3)

    return draw


def draw_counts(panels: Mapping[str, Any]) -> Draw:
    """A panel for each label, with the shares of small whole numbers.

    Args:
        panels: Numbers by the label of their axis.
    """

    def draw(drawn: Any, theme: Theme) -> None:
        from matplotlib.ticker import MaxNLocator

        for axes, (label, numbers) in zip(panel_axes(drawn, len(panels)), panels.items(), strict=True):
            low, high = int(numbers.min()), int(numbers.max())
            step = -(-(high - low + 1) // 60)  # many numbers share bars
            edges = np.arange(low, high + step + 1, step) - 0.5
            axes.hist(
                numbers, edges, weights=_share(numbers), color=theme.first, rwidth=0.86 if step == 1 else 1.0
            )
            if high - low < 3:
                axes.set_xlim(low - 1.6, high + 1.6)
            axes.xaxis.set_major_locator(MaxNLocator(9, integer=True, min_n_ticks=1))
            axes.set_xlabel(label)
            _share_axis(axes)

    return draw


def draw_histograms(panels: Sequence[tuple[str, Float64Array, BoolArray]], label: str) -> Draw:
    """A histogram for each carrier, those with a line of sight below the others.

    Args:
        panels: Title, numbers, and which have a line of sight.
        label: Of the numbers, with their unit.
    """

    def draw(drawn: Any, theme: Theme) -> None:
        together = np.concatenate([numbers for _, numbers, _ in panels])
        edges = _histogram_edges(together)
        for axes, (title, numbers, sight) in zip(panel_axes(drawn, len(panels)), panels, strict=True):
            kinds = ((sight, theme.first, "line of sight"), (~sight, theme.second, "other paths only"))
            masks, colours, labels = zip(*(kind for kind in kinds if kind[0].any()), strict=True)
            parts, weights = zip(*((numbers[mask], _share(numbers)[mask]) for mask in masks), strict=True)
            axes.hist(parts, edges, weights=weights, stacked=True, color=colours, label=labels)
            axes.set(xlabel=label, title=plain(title))
            _share_axis(axes)
        legend_of_all(drawn)

    return draw


def _histogram_edges(numbers: Float64Array) -> Float64Array:
    """Choose the limits of some 40 classes: all numbers but the outermost thousandths."""
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

        for row, end in enumerate(("departure", "arrival")):
            every, strongest = sample.angles[row], sample.angles[row + 2]
            kinds = ("Zenith angle", ZENITH_EDGES), ("Azimuth", AZIMUTH_EDGES)
            for kind, (name, edges) in enumerate(kinds):
                axes = drawn.add_subplot(2, 2, 2 * row + 2 - kind)
                shares = [100.0 * counts / max(counts.sum(), 1) for counts in (every[kind], strongest[kind])]
                axes.stairs(shares[0], edges, fill=True, color=theme.first, alpha=0.75, label="all paths")
                axes.stairs(
                    shares[1], edges, color=theme.second, linewidth=1.4, label="strongest path of each user"
                )
                axes.set_xlim(*_occupied(every[kind] + strongest[kind], edges))
                if name == "Azimuth" and np.ptp(axes.get_xlim()) > 180.0:
                    axes.set(xlim=(-180.0, 180.0), xticks=range(-180, 181, 60))
                else:
                    axes.xaxis.set_major_locator(MaxNLocator(7, integer=True))
                axes.set_xlabel(f"{name} of {end} [°]")
                _share_axis(axes, "paths")
        legend_of_all(drawn)

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
    """A heat map of how often each pair of beams is the best, for each carrier and transmitter.

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


def lags(sample: Sample) -> Float64Array:
    """Group the correlations by the time between the scenes, in 24 groups at most.

    Args:
        sample: Has them.

    Returns:
        Time between the scenes [s], tenth percentile, median and ninetieth percentile, Shape ``[4, L]``.
    """
    apart, values = np.array(sample.apart_s), np.array(sample.correlation)
    times = np.round(apart, 6)
    if len(np.unique(times)) > 24:
        edges = np.quantile(times, np.linspace(0.0, 1.0, 25)[1:-1])
        times = np.searchsorted(edges, times).astype(float)
    masks = [times == time for time in np.unique(times)]
    return np.array([(apart[m].mean(), *np.percentile(values[m], [10.0, 50.0, 90.0])) for m in masks]).T


def draw_correlation(sample: Sample) -> Draw:
    """A histogram for scenes that follow one another, and quantiles against the time between scenes."""

    def draw(drawn: Any, theme: Theme) -> None:
        values = np.array(sample.correlation)[np.array(sample.consecutive)]
        apart, low, median, high = lags(sample)
        axes, *others = panel_axes(drawn, 2 if len(apart) > 1 else 1)
        axes.hist(values, np.linspace(0.0, 1.0, 41), weights=_share(values), color=theme.first)
        axes.set(xlim=(0.0, 1.0), xlabel="Correlation of consecutive scenes")
        _share_axis(axes)
        for axes in others:
            unit, name = time_unit(apart[0])
            axes.fill_between(
                apart / unit, low, high, color=theme.first, alpha=0.25, linewidth=0, label="10 % to 90 %"
            )
            axes.plot(apart / unit, median, "o-", color=theme.first, markersize=4, label="median")
            label = f"Time between the scenes [{name}]"
            axes.set(xlim=(0.0, None), ylim=(0.0, 1.03), xlabel=label, ylabel="Correlation")
            axes.grid(axis="y")
            axes.legend(loc="lower left", frameon=False)

    return draw


_NAMES = {"s": "second", "min": "minute", "h": "hour"}


def draw_throughput(found: Throughput) -> Draw:
    """Scenes per second over the time of the generation."""

    def draw(drawn: Any, theme: Theme) -> None:
        unit, name = time_unit(found.elapsed_s)
        mean = found.scenes / found.elapsed_s
        per, per_name = rate_unit(mean)
        axes = drawn.subplots()
        axes.stairs(per * found.rate, found.edges_s / unit, fill=True, color=theme.first, alpha=0.8)
        label = f"mean, {per * mean:.3g} scenes/{per_name}"
        axes.axhline(per * mean, color=theme.second, linewidth=1.4, label=label)
        for at, place in enumerate(found.interruptions_s):
            axes.axvline(
                place / unit, color=theme.muted, linewidth=1.0, linestyle=":",
                label=None if at else "interrupted; the time without work is left out",
            )  # fmt: skip
        axes.set(
            xlim=(0.0, found.elapsed_s / unit),
            xlabel=f"Time at work [{name}]",
            ylabel=f"Scenes per {_NAMES[per_name]}",
        )
        axes.set_ylim(0.0, per * max(float(found.rate.max()), mean) * 1.12)
        axes.grid(axis="y")
        legend_of_all(drawn)

    return draw


def draw_services(shares: Mapping[str, float], scenes: int) -> Draw:
    """A bar for each service: its wall time for a scene.

    Args:
        shares: Seconds of each service.
        scenes: Of which they are the time.
    """

    def draw(drawn: Any, theme: Theme) -> None:
        axes = drawn.subplots()
        names = list(map(plain, shares))
        each = [seconds / max(scenes, 1) for seconds in shares.values()]
        unit, unit_name = small_time_unit(max(each) / 10)  # as numbers that need no zeros after the point
        each = [seconds / unit for seconds in each]
        total = sum(each)
        axes.barh(names, each, color=theme.first, height=0.62)
        for row, value in enumerate(each):
            text = f" {value:.3g} {unit_name}, {value / total:.1%}".replace("%", " %")
            axes.text(value, row, text, va="center", fontsize=9)
        axes.set(xlabel=f"Wall time for a scene [{unit_name}]", xlim=(0.0, 1.28 * max(each)))
        _bars_axis(axes)

    return draw
