"""What a run comes to: the figures of `caviar run --json` and the table on the screen."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from rich.table import Table

from caviar_protocol.errors import RecordingError
from caviar_protocol.recording import Recording
from caviar_protocol.topics import Link


class LinkFigures(msgspec.Struct, frozen=True, kw_only=True):
    """Means over users and frames of the link products of a recording.

    Users without a path are left out of the means; `no_path_share` states how many they were.
    """

    mean_abs_y: float | None = None
    """|y| of the pairs that the agents chose [1]."""
    mean_abs_y_best: float | None = None
    """|y| of the best pairs (eq. 2) [1]."""
    mean_abs_y_baseline: float | None = None
    """|y| of the pairs that point along the straight line [1]."""
    no_path_share: float | None = None
    """Users without a path, of all users in all frames [1]."""


def link_figures(directory: Path) -> LinkFigures:
    """Figures of the link products in a run's recording; empty where it has none."""
    chosen, best, baseline, users, without = 0.0, 0.0, 0.0, 0, 0
    try:
        recording = Recording(directory)
    except RecordingError:
        return LinkFigures()
    for _, product in recording.of("link"):
        link = product.payload
        if not isinstance(link, Link) or not link.rx:
            continue
        reached = link.has_path
        users += len(link.rx)
        without += int(np.count_nonzero(~reached))
        chosen += float(link.abs_y[reached].sum())
        best += float(link.top_abs_y[reached, 0].sum())
        baseline += float(link.baseline_abs_y[reached].sum())
    if not users:
        return LinkFigures()
    served = users - without
    return LinkFigures(
        mean_abs_y=chosen / served if served else None,
        mean_abs_y_best=best / served if served else None,
        mean_abs_y_baseline=baseline / served if served else None,
        no_path_share=without / users,
    )


def summary_of(
    outcome: Mapping[str, Any], figures: LinkFigures, scenario: str, directory: Path, seed: int
) -> dict[str, Any]:
    """Everything `--json` writes."""
    return {
        "run": directory.name,
        "scenario": scenario,
        "seed": seed,
        "complete": not outcome["error"],
        "error": outcome["error"],
        "frames": outcome["frames"],
        "frames_per_second": outcome["frames_per_second"],
        "warm_up_frames": outcome["warm_up_frames"],
        "services": outcome["services"],
        "digest": outcome["digest"],
        **msgspec.structs.asdict(figures),
    }


def summary_table(summary: Mapping[str, Any]) -> Table:
    """p50 and p99 by service, misses, and |y| against the best."""
    table = Table(title=f"{summary['scenario']}: {summary['run']}", title_justify="left")
    for column in ("service", "p50 ms", "p99 ms", "budget ms", "misses"):
        table.add_column(column, justify="left" if column == "service" else "right")
    for name, figures in summary["services"].items():
        table.add_row(
            name,
            f"{figures['p50_ms']:.2f}",
            f"{figures['p99_ms']:.2f}",
            f"{figures['budget_ms']:g}",
            f"[red]{figures['misses']}[/red]" if figures["misses"] else "0",
        )
    table.caption_justify = "left"
    table.caption = _caption(summary)
    return table


def _caption(summary: Mapping[str, Any]) -> str:
    parts = [f"{summary['frames']} frames, {summary['frames_per_second']:.1f} frames/s"]
    if summary["mean_abs_y"] is not None:
        share = summary["mean_abs_y"] / summary["mean_abs_y_best"] if summary["mean_abs_y_best"] else 0.0
        parts.append(
            f"mean |y| {summary['mean_abs_y']:.3g} of {summary['mean_abs_y_best']:.3g} at best ({share:.1%}), "
            f"straight line {summary['mean_abs_y_baseline']:.3g}"
        )
    if summary["no_path_share"]:
        parts.append(f"{summary['no_path_share']:.1%} of users without a path")
    return "\n".join(parts)
