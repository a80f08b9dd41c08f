"""Figures of the page of a dataset that are seen from above: users, their gain, LIDAR scans."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from caviar_clients.datasets.look.data import Scan, UserColumns
from caviar_clients.datasets.look.figures import Draw, Theme, legend_of_all, plain
from caviar_clients.plots.map import View, colour_limits, draw_scenery
from caviar_clients.plots.rays import Footprints
from caviar_clients.plots.style import VERMILION, legend_square
from caviar_protocol.arrays import BoolArray, Float64Array

DOTS = 3000
"""Places up to this number are dots in a map of gains; more are cells."""
CELLS = 80
"""Cells of a map, along its longer side."""


@dataclass(frozen=True, eq=False)
class MapOf:
    """The parts of all maps that stand still."""

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


def _within(
    footprints: Footprints | None, left: float, right: float, bottom: float, top: float
) -> Footprints | None:
    """The part of a town's scenery that lies in the view."""
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
        some = users.placed & np.isfinite(users.gain_db)
        gains = users.gain_db[some] if place.dots is None else place.dots[:, 2]
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
    legend_of_all(drawn, "lower", 3)


def cell_m(place: MapOf) -> float:
    """Edge of the cells of a map [m]."""
    (left, right), (bottom, top) = place.view
    edge = max(right - left, top - bottom) / CELLS
    steps = [step * 10.0**power for power in range(-1, 9) for step in (1.0, 2.0, 5.0)]
    return float(next((step for step in steps if step >= edge), steps[-1]))


def _cells(
    axes: Any, place: MapOf, x: Float64Array, y: Float64Array, values: Float64Array, mean: Any, **colours: Any
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
        grid[cell] = mean(part)
    shown = axes.imshow(
        np.ma.masked_invalid(grid.reshape(rows, columns)), origin="lower", interpolation="none",
        extent=(west, west + columns * edge, south, south + rows * edge), **{"zorder": 2, **colours},
    )  # fmt: skip
    axes.set(xlim=place.view[0], ylim=place.view[1])
    return shown


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
            title = plain(scan.title)
            axes.set_title(title.replace("\n", ", ") if columns == 1 else title, fontsize=9.5)
        for axes in panels[-1]:
            axes.set_xlabel("x, east [m]")
        for axes in panels[:, 0]:
            axes.set_ylabel("y, north [m]")
        if rows > 1 and len({_scan_view(scan) for scan in scans}) == 1:
            for axes in panels[:-1, 0]:
                axes.tick_params(labelbottom=False)  # as those below
        legend_of_all(drawn, "lower", 4)

    return draw


def scans_height(scans: Sequence[Scan]) -> float:
    """Height of the figure of these scans [inches]."""
    if not _is_wide(scans):
        return 4.7 if len(scans) > 1 else 6.2
    heights = [(top - bottom) / (right - left) for (left, right), (bottom, top) in map(_scan_view, scans)]
    return 0.9 + sum(max(7.8 * height, 0.7) + 0.45 for height in heights)


def _is_wide(scans: Sequence[Scan]) -> bool:
    """Check whether scans stand one below the other: those along a street."""
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
