"""Tables of a comparison, on the screen and as Markdown beside the paper's."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

from rich.table import Table
from rich.text import Text

from caviar_labs.tradeoff.campaign import Skipped
from caviar_labs.tradeoff.errors import FLOOR_DB, Row
from caviar_labs.tradeoff.ladder import (
    CHOSEN_PATHS,
    CHOSEN_SAMPLES,
    DIFFUSE,
    DIFFUSE_CHOSEN,
    DIFFUSE_DEG,
    ELEMENTS,
    SPACINGS_DEG,
    SPECULAR_BESIDE,
    TABLE_RUNGS,
    Block,
    samples_of,
)
from caviar_labs.tradeoff.report import Report, pareto_rows

# Factors are compared and not seconds, which are those of another machine and another ray tracer.
PAPER_SPACING = {
    "1": (1.0, 0.7),
    "0.5": (1.0, 1.0),
    "0.25": (2.4, 1.5),
    "0.1": (11.0, 4.0),
    DIFFUSE: (84.7, 412.9),
}
"""Table 3 of the paper: factors of SISO-RT and MIMO-RT (64×8), each to its own 0.5°."""
PAPER_ARRAYS = {"64×2": 1.0, "64×8": 2.2, "64×64": 12.0}
"""Table 4 of the paper: factors of MIMO-RT to its 64×2."""
_PAPER = (
    "Oliveira et al., “Simulation of Machine Learning-Based 6G Systems in Virtual Worlds”, 2021: Wireless "
    "InSite on an NVIDIA RTX 2070, one scene of dataset s012 (Rosslyn, 60 GHz), 1 transmitter, 10 receivers"
)
_BETWEEN = (
    "Traced at keyframes alone, interpolated path by path in between: the time of a scene is that of a "
    "keyframe and of the interpolation up to it, shared out over its scenes. Errors are over all scenes, "
    "keyframes included. With a bound: channels between keyframes whose bound on ‖H − Ĥ‖²/‖H‖² promises "
    "anything; within it: those of them whose error is no greater."
)


NOTHING = "–"
"""Cell of a figure that does not exist."""


def significant(value: float | None) -> str:
    """Write a figure with three significant digits (two below 1), without exponents.

    Example:
        >>> significant(0.01234), significant(3.456), significant(None)
        ('0.012', '3.46', '–')
    """
    if value is None:
        return NOTHING
    if value == 0:
        return "0"
    if abs(value) >= 100:
        return f"{value:.0f}"
    return f"{value:.2g}" if abs(value) < 1 else f"{value:.3g}"


def level(value: float | None) -> str:
    """Write a ratio in dB to a tenth, with a minus sign where it is negative.

    Example:
        >>> level(-3.14), level(None)
        ('−3.1', '–')
    """
    return NOTHING if value is None else f"{value:.1f}".replace("-", "−")


def percent(share: float | None) -> str:
    """Write a share to a tenth of a percent.

    Example:
        >>> percent(0.857)
        '85.7 %'
    """
    return NOTHING if share is None else f"{100 * share:.1f} %"


Columns = Mapping[str, Callable[[Row], str]]
"""Title of each column, and what a row has there."""


def _figure(name: str, written: Callable[[float | None], str] = significant) -> Callable[[Row], str]:
    """Cell of a column that shows one field of a row."""
    return lambda row: written(getattr(row, name))


_COST: Columns = {
    "setting": lambda row: row.setting,
    "time ms": _figure("time_ms_median"),
    "p99 ms": _figure("time_ms_p99"),
    "factor": _figure("factor"),
}
_QUALITY: Columns = {
    "NMSE dB": _figure("nmse_db", level),
    "median": _figure("nmse_db_median", level),
    "capacity bit/s/Hz": _figure("capacity_error_bps_hz"),
    "top-1": _figure("beam_top1", percent),
    "top-5": _figure("beam_top5", percent),
}
_LADDER: Columns = {
    **_COST,
    "memory MiB": _figure("memory_mib"),
    "paths": _figure("paths"),
    "gain dB": _figure("path_gain_error_db"),
    "delay spread ns": _figure("delay_spread_error_ns"),
    "az. spread ° dep. / arr.": lambda row: (
        f"{significant(row.aod_azimuth_spread_error_deg)} / {significant(row.aoa_azimuth_spread_error_deg)}"
    ),
    **_QUALITY,
    "LOS": _figure("los_agreement", percent),
}
_KEYFRAMES: Columns = {
    **_COST,
    **_QUALITY,
    "with a bound": _figure("with_bound", percent),
    "within it": _figure("within_bound", percent),
}
# Fewer, with shorter titles: a terminal is narrower than a page.
_SCREEN: Columns = {
    "setting": _LADDER["setting"],
    "time ms": _LADDER["time ms"],
    "factor": _LADDER["factor"],
    "gain dB": _LADDER["gain dB"],
    "NMSE dB": _LADDER["NMSE dB"],
    "top-1": _LADDER["top-1"],
    "top-5": _LADDER["top-5"],
    "bit/s/Hz": _LADDER["capacity bit/s/Hz"],
}


def screen_table(report: Report) -> Table:
    """Make the table of all rows for a terminal."""
    table = Table(title=Text(f"{report.scenario}: {report.origin}"), title_justify="left")
    front = pareto_rows(report.rows, report.reference)
    for name in _SCREEN:
        # Folded, not cut: a name that lost its end is another setting.
        table.add_column(name, justify="left" if name == "setting" else "right", overflow="fold")
    for row in report.rows:
        style = "bold" if row in front else ""
        table.add_row(*(Text(cell(row), style) for cell in _marked(_SCREEN, front).values()))
    table.caption_justify = "left"
    table.caption = Text(_against(report))
    return table


def _marked(columns: Columns, front: Sequence[Row]) -> Columns:
    """Columns with a star at settings of the front."""
    return {**columns, "setting": lambda row: f"{row.setting} *" if row in front else row.setting}


def answer_sentences(report: Report) -> list[str]:
    """Name the setting to take for each error and each time that was asked for, a sentence each."""
    ladder = [row for row in report.rows if row.block == "ladder"]
    by_setting = {row.setting: row for row in ladder}
    sentences = []
    for answer in report.answers:
        asked = (
            f"for {level(answer.error_db)} dB"
            if answer.time_ms is None
            else f"for {significant(answer.time_ms)} ms"
        )
        if answer.setting is None:
            fastest = min((row.time_ms_median for row in ladder), default=None)
            sentences.append(f"{asked}: none; the fastest takes {significant(fastest)} ms")
            continue
        row = by_setting[answer.setting]
        error = "the reference itself" if row.setting == report.reference else f"{level(row.nmse_db)} dB"
        sentences.append(f"{asked}: {row.setting} ({error}, {significant(row.time_ms_median)} ms)")
    return sentences


def markdown(report: Report) -> str:
    """Write all tables as Markdown, beside the paper's figures and with what differs from them."""
    ladder = [row for row in report.rows if row.block == "ladder"]
    parts = [
        f"# Time and error of channel settings: {report.scenario}",
        _setting_of(report),
        "\n".join(f"- {sentence}" for sentence in answer_sentences(report)),
        "## The ladder",
        _meaning(),
        _table_of(_marked(_LADDER, pareto_rows(report.rows, report.reference)), ladder),
        _notes(ladder),
    ]
    parts += _keyframes(report) + _spacing(report) + _arrays(report) + _convergence(report) + _skipped(report)
    return "\n\n".join(part for part in parts if part) + "\n"


def _setting_of(report: Report) -> str:
    machine = ", ".join(f"{key} {value}" for key, value in sorted(report.machine.items()))
    carriers = ", ".join(f"{hertz / 1e9:g} GHz" for hertz in report.carriers_hz)
    return (
        f"{report.scenes} scenes of {report.origin}; {report.receivers:.3g} receivers a scene; {carriers}. "
        f"Machine: {machine}. Took {report.elapsed_s / 60:.1f} min.\n\n{_against(report)}"
    )


def _against(report: Report) -> str:
    return (
        f"Errors against {report.reference!r}; factors of time to {report.baseline!r}, measured by turns. "
        "*: on the Pareto front of time and NMSE."
    )


def _meaning() -> str:
    return (
        "Time: wall time of a scene, H included; median, and 99th percentile of the measurements there are. "
        "Memory: growth of the resident memory at the peak of a scene. Errors are means of absolute errors "
        "over all users; NMSE is the mean of ‖H − H_ref‖²/‖H_ref‖², phases included, and its median beside "
        f"it ({level(FLOOR_DB)}: equal). Top-1, top-5: users whose best pair of DFT beams in the reference "
        "is the best, or among the best five, here."
    )


def _notes(rows: Sequence[Row]) -> str:
    return "\n".join(f"- {row.setting}: {row.note}." for row in rows if row.note)


def _keyframes(report: Report) -> list[str]:
    rows = [row for row in report.rows if row.block == "keyframes"]
    if not rows:
        return []
    return [
        "## Between keyframes",
        _BETWEEN,
        _table_of(_KEYFRAMES, rows),
        f"- {rows[0].note[0].upper()}{rows[0].note[1:]}.",
    ]


def _spacing(report: Report) -> list[str]:
    rows = _by_cell(report, "ray spacing")
    if not rows:
        return []
    columns = _rungs(rows)
    header = ["ray spacing °", "rays", *(f"{c} (NMSE)" for c in columns), "paper: SISO-RT", "paper: MIMO-RT"]
    body = []
    for spacing, label in [
        *((s, f"{s:g}") for s in SPACINGS_DEG),
        (DIFFUSE_DEG, DIFFUSE),
        (DIFFUSE_DEG, DIFFUSE_CHOSEN),
    ]:
        cells = [_relative(rows.get((c, label)), rows.get((c, f"{DIFFUSE_DEG:g}"))) for c in columns]
        paper = (f"{value:g}" for value in PAPER_SPACING[label]) if label in PAPER_SPACING else [NOTHING] * 2
        body.append([label, f"{samples_of(spacing):,}", *cells, *paper])
    times = [
        f"{c} {significant(rows[c, f'{DIFFUSE_DEG:g}'].time_ms_median)} ms"
        for c in columns
        if (c, f"{DIFFUSE_DEG:g}") in rows
    ]
    return [
        "## Ray spacing, single antennas and arrays, diffuse scattering (the paper's Table 3)",
        (
            f"Factor of time to {DIFFUSE_DEG:g}° of the same column, both taken as multiples of the baseline "
            "that was measured by turns with them, and NMSE against the reference. "
            f"{DIFFUSE_DEG:g}° takes {', '.join(times)} here, and in the paper 11.749 s and 39.654 s (64×8)."
        ),
        _table(header, body),
        (
            f"The paper: {_PAPER}. Here: {report.scenario} as above, Sionna RT, with the arrays of the "
            "scenario in every column; N = 4π/Δ² rays for a spacing of Δ rad. Diffuse: every point that a "
            f"ray meets is a path, or about {CHOSEN_PATHS} paths a receiver are chosen among those of "
            f"{CHOSEN_SAMPLES:,} rays and stand for all. They are no part of the reference, so that the NMSE "
            "of these lines says what they add."
        ),
        _notes(list(rows.values())),
    ]


def _by_cell(report: Report, block: Block) -> dict[tuple[str, str], Row]:
    """Rows of one of the paper's tables by column and row."""
    return {(row.column, row.row): row for row in report.rows if row.block == block}


def _rungs(rows: Mapping[tuple[str, str], Row]) -> list[str]:
    """Columns that were measured, in the order of the paper's tables."""
    return [rung for rung in TABLE_RUNGS if any(column == rung for column, _ in rows)]


# Of factors to the baseline, each measured by turns with it: times of two rows may be of different hours.
def _relative(row: Row | None, base: Row | None) -> str:
    if row is None or base is None:
        return NOTHING
    return f"{significant(row.factor / base.factor)} ({level(row.nmse_db)} dB)"


def _arrays(report: Report) -> list[str]:
    rows = _by_cell(report, "arrays")
    if not rows:
        return []
    columns = _rungs(rows)
    sizes = [f"{n}×{m}" for n, m in ELEMENTS]
    body = []
    for (nt, nr), size in zip(ELEMENTS, sizes, strict=True):
        cells = []
        for column in columns:
            row, base = rows.get((column, size)), rows.get((column, sizes[0]))
            if row is None or base is None:
                cells.append(NOTHING)
                continue
            factor = significant(row.factor / base.factor)
            cells.append(f"{factor} ({significant(row.time_ms_median)} ms)")
        body.append([str(nt), str(nr), *cells, f"{PAPER_ARRAYS[size]:g}"])
    return [
        "## Elements of the arrays (the paper's Table 4)",
        f"Factor of time to {sizes[0]} of the same column, likewise; depth 3. The paper: 18.437 s.",
        _table(["Nt", "Nr", *columns, "paper: MIMO-RT"], body),
        "Horizontal linear arrays in place of the scenario's; all else as in the table above.",
        _notes(list(rows.values())),
    ]


def _convergence(report: Report) -> list[str]:
    if not report.convergence:
        return []
    between = ["between seeds: users", "NMSE dB", "gain dB", "top-1"]
    header = ["paths", "samples", "seeds", "time ms", "NMSE dB", *between]
    body = []
    for point in report.convergence:
        # The range and not a mean: it shows whether one seed could mislead.
        values = sorted(point.nmse_db)
        span = f"{level(values[0])} … {level(values[-1])}" if values else NOTHING
        body.append(
            [
                point.paths,
                f"{point.samples:,}",
                str(point.seeds),
                significant(point.time_ms_median),
                span,
                str(point.users),
                level(point.pair_nmse_db),
                significant(point.pair_gain_db_p95),
                percent(point.pair_beam_top1),
            ]
        )
    return [
        "## Convergence over samples and seeds",
        (
            "NMSE: of each seed against 3e6 samples with a seed of its own (best … worst seed), for specular "
            f"paths. Diffuse: about {CHOSEN_PATHS} paths of a receiver, chosen among those of so many rays "
            f"of their own, beside {SPECULAR_BESIDE:,} for the others: the more rays, the less two choices "
            "have in common. Between seeds: 95 % of users differ by less in path gain; top-1 is the share "
            "whose best pair of beams is the same; "
            f"{level(FLOOR_DB)} dB: equal, since rays leave along a lattice of directions, and the seed "
            "draws only what happens where they meet something."
        ),
        _table(header, body),
    ]


def _skipped(report: Report) -> list[str]:
    if not report.skipped:
        return []
    lines = [f"- {', '.join(labels)}: {reason}" for reason, labels in by_reason(report.skipped).items()]
    return ["## Not measured", "\n".join(lines)]


def by_reason(skipped: Sequence[Skipped]) -> dict[str, list[str]]:
    """Group the labels of settings that were not measured by the reason.

    Example:
        >>> by_reason([Skipped(setting=name, block="arrays", reason="no time") for name in ("a", "b")])
        {'no time': ['a', 'b']}
    """
    found: dict[str, list[str]] = {}
    for entry in skipped:
        found.setdefault(entry.reason, []).append(entry.setting)
    return found


def _table_of(columns: Columns, rows: Sequence[Row]) -> str:
    return _table(tuple(columns), [[cell(row) for cell in columns.values()] for row in rows])


def _table(header: Sequence[str], body: Sequence[Sequence[str]]) -> str:
    lines = [header, ["---"] + ["---:"] * (len(header) - 1), *body]
    return "\n".join("| " + " | ".join(cells) + " |" for cells in lines)
