"""Figures of the page of a dataset (`look`): each as a light and a dark picture within the page."""

from __future__ import annotations

import base64
import io
import struct
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from caviar_clients.datasets.look_data import (
    AZIMUTH_EDGES,
    ZENITH_EDGES,
    Sample,
    Scan,
    Throughput,
    UserColumns,
)
from caviar_clients.plots.map import View, colour_limits, draw_scenery
from caviar_clients.plots.rays import Footprints
from caviar_clients.plots.style import BLUE, ORANGE, SKY, VERMILION, legend_square, styled
from caviar_protocol.arrays import BoolArray, Float64Array, UInt8Array

WIDTH_IN = 9.0
"""Width of a figure [inches]."""
DPI = 144
"""Of the pictures; a page shows them at 96, so that screens with small pixels have more to show."""
DOTS = 3000
"""Places up to this number are dots in a map of gains; more are cells."""
CELLS = 80
"""Cells of a map, along its longer side."""
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
    alt: str
    """What it shows, for those who do not see it."""


Draw = Callable[[Any, Theme], None]
"""``draw(figure, theme)``"""


def picture(
    draw: Draw, alt: str, height: float, width: float = WIDTH_IN, *, map_like: bool = False
) -> Picture:
    """Draw a figure in both themes.

    Args:
        draw: Draws it.
        alt: What it shows, for those who do not see it.
        height: Its height [inches].
        width: Its width [inches].
        map_like: Whether its axes have an aspect of their own.

    Raises:
        SetupError: Matplotlib is not installed.
    """
    files = [_png(draw, theme, width, height, map_like) for theme in (LIGHT, DARK)]
    pixels = struct.unpack(">II", files[0][16:24])  # of the PNG's header
    size = [round(side * 96 / DPI) for side in pixels]
    return Picture(_uri(files[0], "png"), _uri(files[1], "png"), size[0], size[1], alt)


def pixels(image: UInt8Array, alt: str) -> Picture:
    """Take pixels as they are.

    Args:
        image: Shape ``[height, width, 3]``.
        alt: What it shows, for those who do not see it.
    """
    from matplotlib.image import imsave

    data = io.BytesIO()
    imsave(data, np.ascontiguousarray(image), format="jpg", pil_kwargs={"quality": 88})
    return Picture(_uri(data.getvalue(), "jpeg"), "", image.shape[1], image.shape[0], alt)


def _png(draw: Draw, theme: Theme, width: float, height: float, map_like: bool) -> bytes:
    with styled():
        from matplotlib import rc_context
        from matplotlib.figure import Figure
        from matplotlib.layout_engine import ConstrainedLayoutEngine

        with rc_context(theme.settings()):
            layout: Any = ConstrainedLayoutEngine(w_pad=0.1, h_pad=0.06, compress=map_like)
            drawn = Figure(figsize=(width, height), layout=layout)
            draw(drawn, theme)
            data = io.BytesIO()
            # Axes with an aspect of their own leave margins; to cut them off takes time.
            cut: dict[str, Any] = {"bbox_inches": "tight", "pad_inches": 0.08} if map_like else {}
            drawn.savefig(data, format="png", dpi=DPI, **cut)
    return data.getvalue()


def _uri(data: bytes, kind: str) -> str:
    return f"data:image/{kind};base64,{base64.b64encode(data).decode()}"


# --- maps ------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class MapOf:
    """What stands still in the maps."""

    footprints: Footprints | None
    transmitters: Float64Array
    """x and y [m], Shape ``[T, 2]``."""
    view: View
    dots: Float64Array | None
    """Where users were: x and y [m], and the median of their gains [dB], NaN where nobody has a path, Shape
    ``[N, 3]``; None where these places are too many for dots."""


def map_of(
    users: UserColumns, footprints: Footprints | None, transmitters: set[tuple[float, float]]
) -> MapOf:
    """Choose the limits of the maps: all users, and transmitters unless far off; at least 40 m.

    Args:
        users: At least one has a position.
        footprints: Scenery; None: there is none.
        transmitters: Their x and y [m].
    """
    placed = users.placed
    places = np.stack([users.x[placed], users.y[placed]], axis=1)
    low, high = places.min(axis=0), places.max(axis=0)
    fixed = np.array(sorted(transmitters)).reshape(-1, 2)
    reach = max(40.0, float((high - low).max()))
    near = np.clip(fixed, low - reach, high + reach)
    low, high = np.min([low, *near], axis=0), np.max([high, *near], axis=0)
    centre, half = (low + high) / 2, np.maximum((high - low) / 2 * 1.06 + 4.0, 20.0)
    half = np.maximum(half, half.max() * np.array([0.9, 0.35]))  # neither a tower nor a strip
    (left, bottom), (right, top) = (centre - half).tolist(), (centre + half).tolist()
    return MapOf(
        _within(footprints, left, right, bottom, top), fixed, ((left, right), (bottom, top)), _dots(users)
    )


def _dots(users: UserColumns) -> Float64Array | None:
    """Places to 0.1 m: receivers that stand still are there in every scene, on every carrier."""
    placed = users.placed
    x, y, gain = (column[placed] for column in (users.x, users.y, users.gain_db))
    key = np.round(10.0 * x).astype(np.int64) * 2**32 + np.round(10.0 * y).astype(np.int64)
    order = np.argsort(key, kind="stable")
    _, starts = np.unique(key[order], return_index=True)
    if len(starts) > DOTS:
        return None
    median = [
        float(np.median(known)) if len(known := part[np.isfinite(part)]) else np.nan
        for part in np.split(gain[order], starts[1:])
    ]
    return np.column_stack([x[order][starts], y[order][starts], median])


def _gains(users: UserColumns, place: MapOf) -> Float64Array:
    """What is coloured: of the dots, or of all users that have a place and a path."""
    if place.dots is not None:
        return place.dots[:, 2]
    return users.gain_db[users.placed & np.isfinite(users.gain_db)]


def _within(
    footprints: Footprints | None, left: float, right: float, bottom: float, top: float
) -> Footprints | None:
    """What of a town's scenery lies in the view."""
    if footprints is None:
        return None

    def seen(shapes: Float64Array) -> BoolArray:
        low, high = shapes.min(axis=1), shapes.max(axis=1)
        inside: BoolArray = (high >= (left, bottom)).all(axis=1) & (low <= (right, top)).all(axis=1)
        return inside

    faces, edges = footprints.faces, footprints.edges
    return Footprints(
        faces[seen(faces)] if len(faces) else faces, edges[seen(edges)] if len(edges) else edges
    )


def map_height(place: MapOf) -> float:
    """Height of a figure with such a map [inches]."""
    (left, right), (bottom, top) = place.view
    return float(np.clip((top - bottom) / (right - left) * 7.6 + 1.4, 3.6, 9.0))


def draw_gain(users: UserColumns, place: MapOf) -> Draw:
    """A map of the users, coloured by their gain."""

    def draw(drawn: Any, theme: Theme) -> None:
        from matplotlib.colors import ListedColormap

        axes = _map_axes(drawn, theme, place)
        gains = _gains(users, place)
        low, high, extend = colour_limits(gains[np.isfinite(gains)])
        colours: dict[str, Any] = {"cmap": theme.colours, "vmin": low, "vmax": high}
        shown = None
        if place.dots is not None:
            none = ~np.isfinite(gains)
            if none.any():
                axes.scatter(
                    *place.dots[none, :2].T, s=16, marker="x", color=theme.ink, linewidths=0.9, zorder=4,
                    label="no path",
                )  # fmt: skip
            if not none.all():
                order = np.argsort(gains[~none], kind="stable")  # the strongest on top
                size = float(np.clip(18000.0 / len(gains), 10.0, 40.0))
                shown = axes.scatter(
                    *place.dots[~none, :2][order].T, c=gains[~none][order], s=size, linewidths=0.3,
                    edgecolors=theme.paper, zorder=3, **colours,
                )  # fmt: skip
        else:
            some = users.placed & np.isfinite(users.gain_db)
            without = users.placed & ~some
            if without.any():
                # Below the others: what shows are cells in which nobody has a path.
                plain = ListedColormap([theme.third])
                ones = np.ones(int(without.sum()))
                _cells(axes, place, users.x[without], users.y[without], ones, np.mean, cmap=plain, zorder=1.9)
                legend_square(axes, "no path for any user", theme.third, theme.muted)
            if some.any():
                shown = _cells(axes, place, users.x[some], users.y[some], gains, np.median, **colours)
        if shown is not None:
            what = "Gain [dB]" if place.dots is not None else "Median gain of a cell [dB]"
            drawn.colorbar(shown, ax=axes, label=what, shrink=0.85, pad=0.01, extend=extend)
        _finish_map(drawn, axes, theme, place)

    return draw


def draw_sight_map(users: UserColumns, place: MapOf) -> Draw:
    """A map of cells, coloured by the share of users with a free line of sight."""

    def draw(drawn: Any, theme: Theme) -> None:
        axes = _map_axes(drawn, theme, place)
        some = users.placed
        shown = _cells(
            axes, place, users.x[some], users.y[some], 100.0 * users.los[some].astype(np.float64), np.mean,
            cmap=theme.colours, vmin=0.0, vmax=100.0,
        )  # fmt: skip
        drawn.colorbar(shown, ax=axes, label="With line of sight [%]", shrink=0.85, pad=0.01)
        _finish_map(drawn, axes, theme, place)

    return draw


def _map_axes(drawn: Any, theme: Theme, place: MapOf) -> Any:
    axes = drawn.subplots()
    axes.set(xlim=place.view[0], ylim=place.view[1], aspect="equal")
    draw_scenery(axes, place.footprints, area=theme.area, outline=theme.outline)
    return axes


def _finish_map(drawn: Any, axes: Any, theme: Theme, place: MapOf) -> None:
    few = len(place.transmitters) <= 10
    label = "transmitter" if few else "transmitter, in the sample"
    if len(place.transmitters):
        axes.scatter(
            *place.transmitters.T, marker="^", s=110 if few else 20, color=VERMILION, edgecolors=theme.paper,
            linewidths=0.8 if few else 0.3, zorder=5, label=label,
        )  # fmt: skip
    axes.set(xlabel="x, east [m]", ylabel="y, north [m]")
    handles, labels = axes.get_legend_handles_labels()
    if handles:
        drawn.legend(handles, labels, loc="outside lower center", ncols=3, frameon=False)


def cell_m(place: MapOf) -> float:
    """Edge of the cells of a map [m]."""
    (left, right), (bottom, top) = place.view
    edge = max(right - left, top - bottom) / CELLS
    steps = [step * 10.0**power for power in range(-1, 5) for step in (1.0, 2.0, 5.0)]
    return float(next((step for step in steps if step >= edge), steps[-1]))


def _cells(
    axes: Any, place: MapOf, x: Float64Array, y: Float64Array, values: Float64Array, of: Any, **colours: Any
) -> Any:
    """Colour each cell by a number of the values within it."""
    (left, right), (bottom, top) = place.view
    edge = cell_m(place)
    # On round numbers, so that cells lie the same way in every map.
    west, south = np.floor(left / edge) * edge, np.floor(bottom / edge) * edge
    columns, rows = int(np.ceil((right - west) / edge)), int(np.ceil((top - south) / edge))
    at = (np.floor((y - south) / edge) * columns + np.floor((x - west) / edge)).astype(int)
    order = np.argsort(at, kind="stable")
    cells, starts = np.unique(at[order], return_index=True)
    grid = np.full(rows * columns, np.nan)
    for cell, part in zip(cells, np.split(values[order], starts[1:]), strict=True):
        grid[cell] = of(part)
    shown = axes.imshow(
        np.ma.masked_invalid(grid.reshape(rows, columns)), origin="lower", interpolation="none",
        extent=(west, west + columns * edge, south, south + rows * edge), **{"zorder": 2, **colours},
    )  # fmt: skip
    axes.set(xlim=place.view[0], ylim=place.view[1])
    return shown


# --- shares and histograms -------------------------------------------------------------------------------


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
        axes.set(yticks=at, yticklabels=names, xlim=(0, 100), xlabel="Share of users [%]")
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

        for axes, (label, numbers) in zip(_panels(drawn, len(panels)), panels, strict=True):
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
        edges = histogram_edges(together)
        for axes, (title, numbers, sight) in zip(_panels(drawn, len(panels)), panels, strict=True):
            parts, colours, labels = [], [], []
            kinds = ((sight, theme.first, "line of sight"), (~sight, theme.second, "other paths only"))
            for mask, colour, name in kinds:
                if mask.any():
                    parts.append(numbers[mask])
                    colours.append(colour)
                    labels.append(name)
            weights = [np.full(len(part), 100.0 / len(numbers)) for part in parts]
            axes.hist(parts, edges, weights=weights, stacked=True, color=colours, label=labels)
            axes.set(xlabel=label, title=title)
            _share_axis(axes)
        handles, labels = _all_handles(drawn)
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
                _share_axis(axes, "paths")
        handles, labels = _all_handles(drawn)
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
        found = _panels(drawn, len(panels))
        for axes, (title, _, _), grid in zip(found, panels, grids, strict=True):
            shown = axes.imshow(
                np.ma.masked_equal(grid.reshape(rows, columns), 0), origin="lower", aspect="auto",
                interpolation="none", cmap=theme.colours, norm=LogNorm(0.9, max(most, 2)),
            )  # fmt: skip
            for axis in (axes.xaxis, axes.yaxis):
                axis.set_major_locator(MaxNLocator(9, integer=True, min_n_ticks=1))
            axes.set(xlabel="Beam of the transmitter", ylabel="Beam of the receiver", title=title)
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
        panels = _panels(drawn, 2 if len(found) > 1 else 1)
        axes = panels[0]
        axes.hist(
            values, np.linspace(0.0, 1.0, 41), weights=np.full(len(values), 100.0 / len(values)),
            color=theme.first,
        )  # fmt: skip
        axes.set(xlim=(0.0, 1.0), xlabel="Correlation of consecutive scenes")
        _share_axis(axes, "users")
        if len(found) > 1:
            axes = panels[1]
            apart = [lag.apart_s for lag in found]
            axes.fill_between(
                apart, [lag.low for lag in found], [lag.high for lag in found], color=theme.first, alpha=0.25,
                linewidth=0, label="10 % to 90 %",
            )  # fmt: skip
            axes.plot(
                apart, [lag.median for lag in found], "o-", color=theme.first, markersize=4, label="median"
            )
            axes.set(
                xlim=(0.0, None), ylim=(0.0, 1.03), xlabel="Time between the scenes [s]", ylabel="Correlation"
            )
            axes.grid(axis="y")
            axes.legend(loc="lower left", frameon=False)

    return draw


# --- sensors ---------------------------------------------------------------------------------------------


def draw_scans(scans: Sequence[Scan]) -> Draw:
    """A panel for each LIDAR scan, from above."""

    def draw(drawn: Any, theme: Theme) -> None:
        rows, columns = (len(scans), 1) if _is_wide(scans) else (1, len(scans))
        panels = drawn.subplots(rows, columns, squeeze=False)
        for axes, scan in zip(panels.ravel(), scans, strict=True):
            if scan.grid is not None:
                _draw_grid(axes, scan.grid, theme)
            else:
                _draw_points(drawn, axes, scan, theme)
            axes.scatter(
                *scan.position, marker="*", s=130, color=VERMILION, edgecolors=theme.paper, linewidths=0.8,
                zorder=5, label="the sensor",
            )  # fmt: skip
            (left, right), (bottom, top) = _scan_view(scan)
            axes.set(xlim=(left, right), ylim=(bottom, top), aspect="equal")
            axes.set_title(scan.title.replace("\n", ", ") if columns == 1 else scan.title, fontsize=9.5)
        for axes in panels[-1]:
            axes.set_xlabel("x, east [m]")
        for axes in panels[:, 0]:
            axes.set_ylabel("y, north [m]")
        if rows > 1 and len({_scan_view(scan) for scan in scans}) == 1:
            for axes in panels[:-1, 0]:
                axes.tick_params(labelbottom=False)  # as those below
        handles, labels = _all_handles(drawn)
        drawn.legend(handles, labels, loc="outside lower center", ncols=4, frameon=False)

    return draw


def scans_height(scans: Sequence[Scan]) -> float:
    """Height of the figure of these scans [inches]."""
    if not _is_wide(scans):
        return 4.7 if len(scans) > 1 else 6.2
    heights = [(top - bottom) / (right - left) for (left, right), (bottom, top) in map(_scan_view, scans)]
    return 0.9 + sum(max(7.8 * height, 0.7) + 0.45 for height in heights)


def _is_wide(scans: Sequence[Scan]) -> bool:
    """Whether scans stand one below the other: those along a street."""
    views = [_scan_view(scan) for scan in scans]
    return all((right - left) > 2.0 * (top - bottom) for (left, right), (bottom, top) in views)


def _draw_grid(axes: Any, grid: tuple[Float64Array, tuple[float, float, float, float]], theme: Theme) -> None:
    from matplotlib.colors import ListedColormap

    cells, extent = grid
    colours = [theme.second, VERMILION, theme.area, theme.first]
    axes.imshow(
        cells, origin="lower", extent=extent, interpolation="none", vmin=-2.5, vmax=1.5,
        cmap=ListedColormap(colours),
    )  # fmt: skip
    for value, label in ((1, "obstacle"), (-1, "transmitter"), (-2, "receiver")):
        if (cells == value).any():
            legend_square(axes, label, colours[value + 2], theme.muted)


def _draw_points(drawn: Any, axes: Any, scan: Scan, theme: Theme) -> None:
    from matplotlib.collections import PolyCollection

    height = scan.points[:, 2]
    low, high = np.percentile(height, [1, 99]) if len(height) else (0.0, 1.0)
    shown = axes.scatter(
        *scan.points[:, :2].T, c=height, s=1.2, linewidths=0, cmap=theme.colours, vmin=low,
        vmax=max(high, low + 0.1),
    )  # fmt: skip
    drawn.colorbar(shown, ax=axes, label="Height z [m]", orientation="horizontal", shrink=0.8, pad=0.02)
    boxes: Any = scan.boxes
    style: dict[str, Any] = {"facecolors": "none", "edgecolors": theme.ink, "linewidths": 0.7}
    axes.add_collection(PolyCollection(boxes, **style))


def _scan_view(scan: Scan) -> View:
    """Limits of what is shown [m]: a square around nearly all points, or the grid."""
    if scan.grid is not None:
        left, right, bottom, top = scan.grid[1]
        return (left, right), (bottom, top)
    around = np.array([scan.position])
    if len(scan.points):
        # Nearly: one hit on a distant tower would make the rest a dot.
        around = np.vstack([around, np.percentile(scan.points[:, :2], [0.5, 99.5], axis=0)])
    low, high = around.min(axis=0), around.max(axis=0)
    half = max(float((high - low).max()) / 2 * 1.05, 10.0)
    (x, y) = ((low + high) / 2).tolist()
    return (x - half, x + half), (y - half, y + half)


# --- generation ------------------------------------------------------------------------------------------


def draw_throughput(found: Throughput) -> Draw:
    """Scenes per second over the time of the generation."""

    def draw(drawn: Any, theme: Theme) -> None:
        unit, name = _time_unit(found.elapsed_s)
        axes = drawn.subplots()
        axes.stairs(found.rate, found.edges_s / unit, fill=True, color=theme.first, alpha=0.8)
        mean = found.scenes / found.elapsed_s
        axes.axhline(mean, color=theme.second, linewidth=1.4, label=f"mean, {mean:.3g} scenes/s")
        for at, place in enumerate(found.interruptions_s):
            axes.axvline(
                place / unit, color=theme.muted, linewidth=1.0, linestyle=":",
                label=None if at else "interrupted; the time without work is left out",
            )  # fmt: skip
        axes.set(
            xlim=(0.0, found.elapsed_s / unit), xlabel=f"Time at work [{name}]", ylabel="Scenes per second"
        )
        axes.set_ylim(0.0, max(float(found.rate.max()), mean) * 1.12)
        axes.grid(axis="y")
        handles, labels = axes.get_legend_handles_labels()
        drawn.legend(handles, labels, loc="outside upper center", ncols=2, frameon=False)

    return draw


def draw_services(shares: Mapping[str, float], scenes: int) -> Draw:
    """A bar for each service: its wall time for a scene.

    Args:
        shares: Seconds of each service.
        scenes: Of which they are the time.
    """

    def draw(drawn: Any, theme: Theme) -> None:
        axes = drawn.subplots()
        names = list(shares)
        each = [1e3 * seconds / scenes for seconds in shares.values()]
        total = sum(each)
        axes.barh(names, each, color=theme.first, height=0.62)
        for row, value in enumerate(each):
            text = f" {value:.3g} ms, {value / total:.1%}".replace("%", " %")
            axes.text(value, row, text, va="center", fontsize=9)
        axes.set(xlabel="Wall time for a scene [ms]", xlim=(0.0, 1.28 * max(each)))
        axes.invert_yaxis()
        axes.spines["left"].set_visible(False)
        axes.tick_params(axis="y", length=0)

    return draw


def _time_unit(seconds: float) -> tuple[float, str]:
    if seconds < 180.0:
        return 1.0, "s"
    return (60.0, "min") if seconds < 3 * 3600.0 else (3600.0, "h")


def _panels(drawn: Any, count: int) -> list[Any]:
    """Axes of so many panels, two a row."""
    columns = min(count, 2)
    cells = drawn.subplots(-(-count // columns), columns, squeeze=False).ravel()
    for axes in cells[count:]:
        axes.set_axis_off()
    return list(cells[:count])


def _share_axis(axes: Any, of: str = "users") -> None:
    from matplotlib.ticker import MaxNLocator

    axes.yaxis.set_major_locator(MaxNLocator(5))
    axes.set_ylabel("Share [%]" if of == "users" else f"Share of {of} [%]")
    axes.grid(axis="y")


def _all_handles(drawn: Any) -> tuple[list[Any], list[str]]:
    """Entries of the legends of all panels, each once."""
    found: dict[str, Any] = {}
    for axes in drawn.axes:
        for handle, label in zip(*axes.get_legend_handles_labels(), strict=True):
            found.setdefault(label, handle)
    return list(found.values()), list(found)
