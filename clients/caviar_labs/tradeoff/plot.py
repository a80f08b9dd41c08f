"""Plots of a comparison: time against error, error against samples."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from caviar_clients.plots.style import BLACK, BLUE, GREY, ORANGE, SKY, VERMILION, figure
from caviar_labs.tradeoff.errors import Row
from caviar_labs.tradeoff.labels import place_labels
from caviar_labs.tradeoff.report import Point, Report

RUNG_COLOURS = {
    "free-space": SKY,
    "geometric": ORANGE,
    "siso-rt": BLUE,
    "spherical": VERMILION,
    "mimo-rt": BLACK,
}
EQUAL_DB = -150.0
"""[dB] An NMSE below this is rounding, and not drawn."""
# Room beside the outermost points, of the axis.
_MARGIN = 0.12
# Ratio of greatest to least below which each tick of a logarithmic axis has a number.
_FEW_TICKS = 8.0


def draw_pareto(report: Report, file: Path) -> Path:
    """Draw time of a scene against NMSE and against the error of path gain, a point for each setting.

    Args:
        report: The comparison.
        file: PNG that is written.

    Returns:
        The file.
    """
    # The ladder alone: the lines of the paper's tables are the same settings in finer steps.
    rows = [row for row in report.rows if row.block == "ladder" and row.nmse_db is not None]
    with figure(file, 10.0, 11.0) as drawn:
        upper, lower = drawn.subplots(2, 1, sharex=True)
        _panel(upper, rows, report.reference, _nmse)
        upper.set_ylabel("NMSE of H [dB], mean over users")
        upper.set_title(f"{report.scenario}: what accuracy costs", loc="left")
        _panel(lower, rows, report.reference, _gain)
        lower.set_ylabel("error of path gain [dB], mean of absolute values")
        lower.set_xlabel("time of a scene [ms], median")
        handles, names = upper.get_legend_handles_labels()
        drawn.legend(handles, names, loc="outside lower center", ncols=4)
        # At the end, when limits and layout are known: places are found in pixels.
        for axes, value in ((upper, _nmse), (lower, _gain)):
            shown = _points(rows, report.reference, value)
            points = [(row.time_ms_median, error) for row, error in shown]
            place_labels(axes, points, [row.setting for row, _ in shown], pareto_front(points))
    return file


def _gain(row: Row) -> float | None:
    return row.path_gain_error_db


def _nmse(row: Row) -> float | None:
    return None if row.nmse_db is None or row.nmse_db < EQUAL_DB else row.nmse_db


def _points(
    rows: Sequence[Row], reference: str, value: Callable[[Row], float | None]
) -> list[tuple[Row, float]]:
    """Select rows with the value that is drawn; the reference has no error."""
    return [(row, error) for row in rows if row.setting != reference and (error := value(row)) is not None]


def _panel(axes: Any, rows: Sequence[Row], reference: str, value: Callable[[Row], float | None]) -> None:
    from matplotlib.ticker import LogLocator

    points = _points(rows, reference, value)
    for row, error in points:
        colour = RUNG_COLOURS.get(row.rung, GREY)
        axes.plot(row.time_ms_median, error, "o", color=colour, markersize=8, zorder=3)
    # Empty curves for the legend, in the order of the ladder and each rung once.
    for rung, colour in RUNG_COLOURS.items():
        if any(row.rung == rung for row, _ in points):
            axes.plot([], [], "o", color=colour, markersize=8, label=rung)
    # What saw fewer receivers had less to do: it is drawn, and is not on the front.
    whole = max((row.receivers for row in rows), default=0.0)
    front = pareto_front([(row.time_ms_median, error) for row, error in points if row.receivers == whole])
    on_front = [(row.time_ms_median, error) for row, error in points if (row.time_ms_median, error) in front]
    axes.plot(*_columns(on_front), "o", color=BLACK, fillstyle="none", markersize=14, label="on the front")
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
    axes.grid()


def _widen(axes: Any) -> None:
    """Make room for labels beside the outermost points."""
    # More to the right, where labels stand by preference.
    left, right = axes.get_xlim()
    axes.set_xlim(left / (right / left) ** (_MARGIN / 3), right * (right / left) ** _MARGIN)
    bottom, top = axes.get_ylim()
    if axes.get_yscale() == "log":
        axes.set_ylim(bottom / (top / bottom) ** _MARGIN, top * (top / bottom) ** _MARGIN)
    else:
        axes.set_ylim(bottom - _MARGIN * (top - bottom), top + _MARGIN * (top - bottom))


def pareto_front(points: Sequence[tuple[float, float]]) -> list[tuple[float, float]]:
    """Find the staircase below which no point lies.

    Args:
        points: Time and error of each setting.

    Returns:
        Its corners, from the fastest on.

    Example:
        >>> pareto_front([(2.0, 5.0), (1.0, 9.0), (3.0, 8.0)])
        [(1.0, 9.0), (2.0, 9.0), (2.0, 5.0)]
    """
    front = list[tuple[float, float]]()
    for time, error in sorted(points):
        if not front:
            front.append((time, error))
        elif error < front[-1][1]:
            front += [(time, front[-1][1]), (time, error)]
    return front


def draw_convergence(report: Report, file: Path) -> Path:
    """Draw over the samples: NMSE, and how far seeds are apart in path gain and best pair of beams.

    Args:
        report: The comparison.
        file: PNG that is written.

    Returns:
        The file.
    """
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
            axes.grid()
        handles, names = error.get_legend_handles_labels()
        more, more_names = gain.get_legend_handles_labels()
        drawn.legend(handles + more[-1:], names + more_names[-1:], loc="outside lower center", ncols=5)
    return file


def _curves(error: Any, gain: Any, beams: Any, kind: str, points: Sequence[Point], colour: str) -> None:
    pairs = [point for point in points if point.seeds > 1]
    samples = [point.samples for point in pairs]
    between = [(p.samples, db) for p in pairs if (db := p.pair_nmse_db) is not None and db > EQUAL_DB]
    # Rays leave along a lattice, so seeds may give the very same paths: the legend states what has no line.
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
