"""Figures of a finished run: `caviar run --json`, and the table on the screen."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import msgspec
from rich.markup import escape
from rich.table import Table
from rich.text import Text

from caviar_clients.cli.recording_summary import (
    Decided,
    OutageSummary,
    RunSummary,
    counted,
    decided_lines,
    link_quality,
    outage_lines,
    summarise,
)
from caviar_protocol.errors import RecordingError
from caviar_protocol.recording import Recording


def recorded_figures(directory: Path) -> RunSummary | None:
    """What a run's recording comes to; None where it has none."""
    try:
        return summarise(Recording(directory))
    except RecordingError:
        return None


def summary_of(
    outcome: Mapping[str, Any],
    recorded: RunSummary | None,
    scenario: str,
    directory: Path,
    seed: int,
    warnings: Sequence[str] = (),
) -> dict[str, Any]:
    """Everything `--json` writes; ``warnings`` are those of the scenario, beside what the recording warns of.

    Of a run that ended early ``frames_recorded`` may be one more than ``frames``: a frame that the recorder
    had answered and that was not over for everybody. The digest is that of ``frames``.
    """
    figures = recorded.link if recorded else None
    return {
        "run": directory.name,
        "scenario": scenario,
        "seed": seed,
        "complete": not outcome["error"],
        "error": outcome["error"],
        "frames": outcome["frames"],
        "frames_recorded": recorded.frames if recorded else None,
        "frames_per_second": outcome["frames_per_second"],
        "warm_up_frames": outcome["warm_up_frames"],
        "services": outcome["services"],
        "deadlines": outcome["deadlines"],
        "pace": outcome["pace"],
        "digest": outcome["digest"],
        "mean_abs_y": figures.mean_abs_y if figures else None,
        "mean_abs_y_best": figures.mean_abs_y_best if figures else None,
        "mean_abs_y_baseline": figures.mean_abs_y_baseline if figures else None,
        "mean_snr_db": figures.mean_snr_db if figures else None,
        "mean_snr_best_db": figures.mean_snr_best_db if figures else None,
        "mean_bit_rate": figures.mean_bit_rate if figures else None,
        "no_path_share": figures.no_path_share if figures else None,
        "outage": msgspec.to_builtins(recorded.outage) if recorded else None,
        "decided": msgspec.to_builtins(recorded.decided) if recorded else [],
        "warnings": [*warnings, *(recorded.warnings if recorded else ())],
    }


def summary_table(summary: Mapping[str, Any]) -> Table:
    """p50 and p99 by service, misses, and |y| against the best."""
    table = Table(title=Text(f"{summary['scenario']}: {summary['run']}"), title_justify="left")
    for column in ("service", "p50 ms", "p99 ms", "budget ms", "misses"):
        table.add_column(column, justify="left" if column == "service" else "right")
    for name, figures in summary["services"].items():
        table.add_row(
            escape(name),
            f"{figures['p50_ms']:.2f}",
            f"{figures['p99_ms']:.2f}",
            f"{figures['budget_ms']:g}",
            f"[red]{figures['misses']}[/red]" if figures["misses"] else "0",
        )
    table.caption_justify = "left"
    table.caption = _caption(summary)
    return table


def _caption(summary: Mapping[str, Any]) -> str:
    parts = [f"{counted(summary['frames'], 'frame')}, {summary['frames_per_second']:.1f} frames/s"]
    if summary["frames_recorded"] not in (None, summary["frames"]):
        parts.append(
            f"{counted(summary['frames_recorded'], 'frame')} recorded, of which the run finished "
            f"{summary['frames']}; its digest is that of these"
        )
    late, pace = summary["deadlines"], summary["pace"]
    if late["decisions"]:
        parts.append(_missed(sum(s["misses"] for s in summary["services"].values()), late))
    if pace["slips"]:
        parts.append(
            f"{counted(pace['slips'], 'frame')} slipped behind real time, "
            f"by {pace['worst_slip_ms']:.1f} ms at worst, {pace['lag_ms']:.1f} ms in all; none was skipped"
        )
    if summary["mean_abs_y"] is not None:
        share = summary["mean_abs_y"] / summary["mean_abs_y_best"] if summary["mean_abs_y_best"] else 0.0
        parts.append(
            f"mean |y| {summary['mean_abs_y']:.3g} of {summary['mean_abs_y_best']:.3g} at best "
            f"({share:.1%}), straight line {summary['mean_abs_y_baseline']:.3g}"
        )
    if summary["mean_bit_rate"] is not None:
        quality = link_quality(summary["mean_snr_db"], summary["mean_snr_best_db"], summary["mean_bit_rate"])
        parts.append(f"mean SNR {quality}")
    if summary["outage"] is not None:
        causes, *inside = outage_lines(msgspec.convert(summary["outage"], OutageSummary))
        parts += [f"{summary['no_path_share']:.1%} of users without a path: {causes}", *inside]
    parts += decided_lines(msgspec.convert(summary["decided"], list[Decided]))
    parts += [f"warning: {warning}" for warning in summary["warnings"]]
    return "\n".join(parts)


def _missed(misses: int, late: Mapping[str, Any]) -> str:
    """Missed deadlines, and how promptly the broker saw those that passed before the answer came."""
    seen, when = (
        late["decisions"],
        f"{late['p99_ms']:.2f} ms (p99) behind, {late['worst_ms']:.2f} ms at worst",
    )
    if misses <= seen:
        return f"{counted(seen, 'missed deadline')}, decided {when}"
    return (
        f"{counted(misses, 'missed deadline')}: {seen} decided {when}; "
        f"{misses - seen} answered before the broker looked at the clock"
    )
