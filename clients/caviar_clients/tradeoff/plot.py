"""Plots of a comparison: time against error, error against samples; labels that do not overlap."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

from msgspec.structs import replace

from caviar_clients.plots.style import BLACK, BLUE, GREY, LIGHT_GREY, ORANGE, SKY, VERMILION, figure
from caviar_clients.tradeoff.errors import Row
from caviar_clients.tradeoff.report import Point, Report

DISTANCES_PT = (9.0, 16.0, 26.0, 38.0, 52.0, 68.0)
DIRECTIONS = 16
GAP_PX = 3.0
LEADER_PT = 12.0
"""A label farther away than this is tied to its point by a line."""


CROSSING = 100.0
"""Area [pixels²] of overlap that is as bad as a step of such a line within something else."""
STEPS = 12
HIDING = 10.0
"""How much worse it is to cover a point than a label or a line."""


class Box(NamedTuple):
    """A rectangle [pixels]."""

    left: float
    bottom: float
    right: float
    top: float

    def overlap(self, other: Box) -> float:
        """Area that both cover [pixels²]."""
        width = min(self.right, other.right) - max(self.left, other.left)
        height = min(self.top, other.top) - max(self.bottom, other.bottom)
        return max(0.0, width) * max(0.0, height)

    def outside(self, other: Box) -> float:
        """Area of this one that the other does not cover [pixels²]."""
        return (self.right - self.left) * (self.top - self.bottom) - self.overlap(other)


class Spot(NamedTuple):
    """Where a label may stand: its centre relative to its point [points], and the rectangle."""

    dx: float
    dy: float
    distance: float
    box: Box


def spots(x: float, y: float, width: float, height: float, pixels_per_point: float) -> Iterator[Spot]:
    """Places around a point at (x, y) for a label of a size [pixels], the nearest first."""
    for distance in DISTANCES_PT:
        for step in range(DIRECTIONS):
            angle = 2 * math.pi * step / DIRECTIONS
            along, up = math.cos(angle), math.sin(angle)
            # The distance is that of the label's edge from the point.
            dx = along * (distance * pixels_per_point + width / 2)
            dy = up * (distance * pixels_per_point + height / 2)
            centre_x, centre_y = x + dx, y + dy
            box = Box(
                centre_x - width / 2 - GAP_PX,
                centre_y - height / 2 - GAP_PX,
                centre_x + width / 2 + GAP_PX,
                centre_y + height / 2 + GAP_PX,
            )
            yield Spot(dx / pixels_per_point, dy / pixels_per_point, distance, box)


def place(
    axes: Any,
    points: Sequence[tuple[float, float]],
    texts: Sequence[str],
    line: Sequence[tuple[float, float]] = (),
    size: float = 9.0,
) -> None:
    """Label points of ``axes``, off a staircase too, all in data coordinates. The limits must be final."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    drawn = axes.figure
    canvas = FigureCanvasAgg(drawn)
    canvas.draw()  # the layout is known only then
    pixels_per_point = drawn.dpi / 72
    frame = Box(*axes.get_window_extent().extents)
    pixels = [tuple(axes.transData.transform(point)) for point in points]
    radius = 5 * pixels_per_point
    taken = [Box(x - radius, y - radius, x + radius, y + radius) for x, y in pixels]
    corners = [tuple(axes.transData.transform(point)) for point in line]
    lines = [
        Box(min(x0, x1) - 1, min(y0, y1) - 1, max(x0, x1) + 1, max(y0, y1) + 1)
        for (x0, y0), (x1, y1) in pairwise(corners)
    ]
    for text, (x, y), point in sorted(zip(texts, pixels, points, strict=True), key=lambda e: -e[1][1]):
        label = axes.annotate(
            text,
            point,
            xytext=(0, 0),
            textcoords="offset points",
            ha="center",
            va="center",
            fontsize=size,
            zorder=5,
            bbox={"boxstyle": "round,pad=0.1", "facecolor": "white", "edgecolor": "none", "alpha": 0.8},
        )
        extent = label.get_window_extent(canvas.get_renderer())
        found = min(
            spots(x, y, extent.width, extent.height, pixels_per_point),
            key=lambda spot: (
                sum(spot.box.overlap(other) for other in (*taken, *lines))
                + HIDING * sum(spot.box.overlap(other) for other in taken[: len(pixels)])
                + 10 * spot.box.outside(frame)
                + CROSSING * _crossed(x, y, spot, taken),
                spot.distance,
            ),
        )
        label.set_position((found.dx, found.dy))
        taken.append(found.box)
        if found.distance >= LEADER_PT:
            _tie(axes, point, found)


def _crossed(x: float, y: float, spot: Spot, taken: Sequence[Box]) -> int:
    """How many labels and points the line between a point and its label would cross."""
    if spot.distance < LEADER_PT:
        return 0
    centre_x, centre_y = (spot.box.left + spot.box.right) / 2, (spot.box.bottom + spot.box.top) / 2
    beside = [box for box in taken if not (box.left <= x <= box.right and box.bottom <= y <= box.top)]
    found = 0
    for step in range(1, STEPS):
        along = step / STEPS
        here_x, here_y = x + along * (centre_x - x), y + along * (centre_y - y)
        here = Box(here_x - 1, here_y - 1, here_x + 1, here_y + 1)
        found += any(box.overlap(here) > 0 for box in beside)
    return found


def _tie(axes: Any, point: tuple[float, float], spot: Spot) -> None:
    """A line from a point to its label, which is far."""
    reach = spot.distance / math.hypot(spot.dx, spot.dy)
    axes.annotate(
        "",
        point,
        xytext=(spot.dx * reach, spot.dy * reach),
        textcoords="offset points",
        arrowprops={"arrowstyle": "-", "color": GREY, "linewidth": 0.7, "shrinkA": 0, "shrinkB": 4},
    )


RUNG_COLOURS = {
    "free-space": SKY,
    "geometric": ORANGE,
    "siso-rt": BLUE,
    "spherical": VERMILION,
    "mimo-rt": BLACK,
}
EQUAL_DB = -150.0
"""[dB] An NMSE below this is rounding, and not drawn."""
_MARGIN = 0.12
_FEW_TICKS = 8.0
"""Ratio of greatest to least below which each tick of a logarithmic axis has a number."""


def draw_pareto(report: Report, file: Path) -> Path:
    """Time of a scene against NMSE and against the error of path gain, a point for each setting."""
    rows = [row for row in comparable_times(report) if row.block == "ladder" and row.nmse_db is not None]
    with figure(file, 10.0, 11.0) as drawn:
        upper, lower = drawn.subplots(2, 1, sharex=True)
        _panel(upper, rows, report.reference, _nmse)
        upper.set_ylabel("NMSE of H [dB], mean over users")
        upper.set_title(f"{report.scenario}: what accuracy costs", loc="left")
        _panel(lower, rows, report.reference, _gain)
        lower.set_ylabel("error of path gain [dB], mean of absolute values")
        lower.set_xlabel(f"time of a scene [ms]: factor to {report.baseline}, times its median")
        handles, names = upper.get_legend_handles_labels()
        drawn.legend(handles, names, loc="outside lower center", ncols=4)
        for axes, value in ((upper, _nmse), (lower, _gain)):
            shown = _points(rows, report.reference, value)
            points = [(row.time_ms_median, error) for row, error in shown]
            place(axes, points, [row.setting for row, _ in shown], pareto_front(points))
    return file


def comparable_times(report: Report) -> list[Row]:
    """Rows whose times follow from their factors: settings that were measured at different times, on a
    machine that was not as busy at all of them, have the order of their factors."""
    base = next((row.time_ms_median for row in report.rows if row.setting == report.baseline), None)
    if base is None:
        return list(report.rows)
    return [replace(row, time_ms_median=row.factor * base) for row in report.rows]


def _gain(row: Row) -> float | None:
    return row.path_gain_error_db


def _nmse(row: Row) -> float | None:
    return None if row.nmse_db is None or row.nmse_db < EQUAL_DB else row.nmse_db


def _points(
    rows: Sequence[Row], reference: str, value: Callable[[Row], float | None]
) -> list[tuple[Row, float]]:
    """Rows with what is drawn of them; the reference has no error."""
    return [(row, error) for row in rows if row.setting != reference and (error := value(row)) is not None]


def _panel(axes: Any, rows: Sequence[Row], reference: str, value: Callable[[Row], float | None]) -> None:
    from matplotlib.ticker import LogLocator

    points = _points(rows, reference, value)
    for row, error in points:
        colour = RUNG_COLOURS.get(row.rung, GREY)
        axes.plot(row.time_ms_median, error, "o", color=colour, markersize=8, zorder=3)
    for rung, colour in RUNG_COLOURS.items():
        if any(row.rung == rung for row, _ in points):
            axes.plot([], [], "o", color=colour, markersize=8, label=rung)
    front = pareto_front([(row.time_ms_median, error) for row, error in points])
    axes.plot(
        *_columns(front),
        color=GREY,
        linewidth=1.2,
        zorder=1,
        label="Pareto front",
    )
    axes.set_xscale("log")
    found = next((row for row in rows if row.setting == reference), None)
    if found is not None:
        axes.axvline(found.time_ms_median, color=GREY, linestyle=":", label=f"reference: {reference}")
    errors = [error for _, error in points]
    if errors and min(errors) > 0:
        axes.set_yscale("log")
        few = max(errors) < _FEW_TICKS * min(errors)
        axes.yaxis.set_minor_locator(LogLocator(subs=range(2, 10) if few else (2, 5)))
        axes.yaxis.set_major_formatter("{x:g}")
        axes.yaxis.set_minor_formatter("{x:g}")
    _widen(axes)
    axes.grid(color=LIGHT_GREY, linewidth=0.6)


def _widen(axes: Any) -> None:
    """Room for labels beside the outermost points."""
    left, right = axes.get_xlim()
    axes.set_xlim(left / (right / left) ** (_MARGIN / 3), right * (right / left) ** _MARGIN)
    bottom, top = axes.get_ylim()
    if axes.get_yscale() == "log":
        axes.set_ylim(bottom / (top / bottom) ** _MARGIN, top * (top / bottom) ** _MARGIN)
    else:
        axes.set_ylim(bottom - _MARGIN * (top - bottom), top + _MARGIN * (top - bottom))


def pareto_front(points: Sequence[tuple[float, float]]) -> list[tuple[float, float]]:
    """Corners of the staircase below which no point of (time, error) lies, from the fastest on."""
    front = list[tuple[float, float]]()
    for time, error in sorted(points):
        if not front:
            front.append((time, error))
        elif error < front[-1][1]:
            front += [(time, front[-1][1]), (time, error)]
    return front


def draw_convergence(report: Report, file: Path) -> Path:
    """Over the samples: NMSE, and how far seeds are apart in path gain and in their best pair of beams."""
    kinds = {kind: [p for p in report.convergence if p.paths == kind] for kind in ("specular", "diffuse")}
    with figure(file, 14.0, 4.8) as drawn:
        error, gain, beams = drawn.subplots(1, 3)
        for (kind, points), colour in zip(kinds.items(), (BLUE, VERMILION), strict=True):
            if points:
                _curves(error, gain, beams, kind, points, colour)
        error.set_title("NMSE of H", loc="left")
        error.set_ylabel("[dB], mean over users")
        gain.set_title("path gain, between seeds", loc="left")
        gain.set_ylabel("[dB], 95 % of users differ by less")
        gain.axhline(0.5, color=GREY, linestyle=":", label="0.5 dB, 95 %")
        gain.set_ylim(bottom=0)
        beams.set_title("same best pair of beams, between seeds", loc="left")
        beams.set_ylabel("[%] of users")
        beams.axhline(95, color=GREY, linestyle=":")
        beams.set_ylim(top=100.5)
        for axes in (error, gain, beams):
            axes.set_xscale("log")
            axes.set_xlabel("samples of the launch")
            axes.grid(color=LIGHT_GREY, linewidth=0.6)
        handles, names = error.get_legend_handles_labels()
        more, more_names = gain.get_legend_handles_labels()
        drawn.legend(handles + more[-1:], names + more_names[-1:], loc="outside lower center", ncols=5)
    return file


def _curves(error: Any, gain: Any, beams: Any, kind: str, points: Sequence[Point], colour: str) -> None:
    pairs = [point for point in points if point.seeds > 1]
    samples = [point.samples for point in pairs]
    between = [(p.samples, db) for p in pairs if (db := p.pair_nmse_db) is not None and db > EQUAL_DB]
    equal = "" if between else " (equal)"
    error.plot(*_columns(between), "s--", color=colour, label=f"{kind}, between seeds{equal}")
    if all(point.nmse_db for point in points):
        middle = [(point.samples, sorted(point.nmse_db)[len(point.nmse_db) // 2]) for point in points]
        error.plot(*_columns(middle), "-", color=colour, label=f"{kind}, against 3e6 samples")
        for point in points:
            error.plot([point.samples] * len(point.nmse_db), point.nmse_db, "o", color=colour)
    gain.plot(samples, [point.pair_gain_db_p95 for point in pairs], "s--", color=colour)
    shares = [None if p.pair_beam_top1 is None else 100 * p.pair_beam_top1 for p in pairs]
    beams.plot(samples, shares, "s--", color=colour)


def _columns(points: Sequence[tuple[float, float]]) -> tuple[list[float], list[float]]:
    return [x for x, _ in points], [y for _, y in points]
