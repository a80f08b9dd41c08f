"""Figures of a run in words: the table that ``caviar run`` prints, and the lines of ``caviar inspect``."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import msgspec
from rich.markup import escape
from rich.table import Column, Table
from rich.text import Text

from caviar_clients.cli.shared import counted, scaled
from caviar_clients.cli.summary import Decided, OutageSummary, PacketSummary

SHOWN_INSIDE = 8
"""Antennas inside an object that are named; of the others, the number."""
SHOWN_DAMAGE = 20
"""Lines about damage that are printed; of the others, the number."""


def summary_table(summary: Mapping[str, Any]) -> Table:
    """Make the table of a finished run: latencies and misses by service; below, what else there is to say.

    Args:
        summary: As `summary_of` returns it.
    """
    figures_of = (Column(name, justify="right") for name in ("p50 ms", "p99 ms", "budget ms", "misses"))
    title = Text(f"{summary['scenario']}: {summary['run']}")  # as Text: brackets in a name are no markup
    table = Table("service", *figures_of, title=title, title_justify="left")
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
    misses = sum(s["misses"] for s in summary["services"].values())
    if misses or late["decisions"]:
        parts.append(_missed(misses, late))
    if pace["slips"]:
        parts.append(
            f"{counted(pace['slips'], 'frame')} slipped behind real time, "
            f"by {pace['worst_slip_ms']:.1f} ms at worst, {pace['lag_ms']:.1f} ms in all; none was skipped"
        )
    # A mean over carriers says nothing of any of them: each has lines of its own.
    for figures in summary.get("stations") or [summary]:
        of = f"{figures['tx']} on {figures['carrier']}: " if "tx" in figures else ""
        if figures["mean_abs_y"] is not None:
            share = figures["mean_abs_y"] / figures["mean_abs_y_best"] if figures["mean_abs_y_best"] else 0.0
            parts.append(
                f"{of}mean |y| {figures['mean_abs_y']:.3g} of {figures['mean_abs_y_best']:.3g} at best "
                f"({share:.1%}), LOS beam {figures['mean_abs_y_baseline']:.3g}"
            )
            parts.append(of + gain_line(figures["loss_to_best_db"], figures["gain_over_random_db"]))
        if figures["mean_bit_rate"] is not None:
            numbers = figures["mean_snr_db"], figures["mean_snr_best_db"], figures["mean_bit_rate"]
            parts.append(f"{of}mean SNR {link_quality(*numbers)}")
        if of:
            parts.append(f"{of}{figures['no_path_share']:.1%} of {figures['users']:,} links without a path")
    if summary.get("packets") is not None:
        parts.append(packet_line(msgspec.convert(summary["packets"], PacketSummary)))
    if summary["outage"] is not None:
        causes, *inside = outage_lines(msgspec.convert(summary["outage"], OutageSummary))
        parts += [f"{summary['no_path_share']:.1%} of links without a path: {causes}", *inside]
    parts += decided_lines(msgspec.convert(summary["decided"], list[Decided]))
    parts += [f"warning: {warning}" for warning in summary["warnings"]]
    return "\n".join(parts)


def _missed(misses: int, late: Mapping[str, Any]) -> str:
    """Count missed deadlines, and say how promptly the broker decided those without an answer by then."""
    seen = late["decisions"]
    when = f"{late['p99_ms']:.2f} ms late (p99), {late['worst_ms']:.2f} ms at worst"
    # A late answer that arrives before the broker looks at the clock is a miss without a decision.
    if not seen:
        return counted(misses, "missed deadline")
    if misses <= seen:
        return f"{counted(seen, 'missed deadline')}, decided {when}"
    return (
        f"{counted(misses, 'missed deadline')}: {seen} decided {when}; "
        f"{misses - seen} answered before the broker looked at the clock"
    )


def decided_lines(found: Sequence[Decided]) -> list[str]:
    """Put decisions into words, one line each."""
    lines = []
    for entry in found:
        total = sum(entry.frames.values())
        shares = ", ".join(f"{value} {count / total:.0%}" for value, count in entry.frames.items())
        line = f"{entry.service}: {entry.decision} {shares}; {counted(entry.changes, 'change')}"
        if entry.error_checks:
            line += f"; stated error held in {entry.error_covered} of {counted(entry.error_checks, 'check')}"
        lines.append(line)
    return lines


def outage_lines(outage: OutageSummary) -> list[str]:
    """Put the causes into one line, and into one each which antenna stands inside of which object."""
    parts = [f"{count} {cause}" for cause, count in outage.causes.items()]
    if outage.unexplained:
        parts.append(f"{outage.unexplained} for a cause that the channel did not report")
    lines = [", ".join(parts)]
    shown = list(outage.inside.items())[:SHOWN_INSIDE]
    lines += [f"inside an object: {name}, in {counted(frames, 'frame')}" for name, frames in shown]
    if len(outage.inside) > len(shown):
        lines.append(f"inside an object: {len(outage.inside) - len(shown)} more antennas")
    return lines


def gain_line(loss_db: float | None, gain_db: float | None) -> str:
    """Put the loss to the best pair and the gain over a random one [dB] into words.

    Example:
        >>> gain_line(0.04, 17.25), gain_line(3.0, None)
        ('beams 0.0 dB below the best pair, 17.2 dB above a random one', 'beams 3.0 dB below the best pair')
    """
    loss = "served no link" if loss_db is None else f"{loss_db:.1f} dB below the best pair"
    return f"beams {loss}" + ("" if gain_db is None else f", {gain_db:.1f} dB above a random one")


def link_quality(snr_db: float | None, snr_best_db: float | None, bit_rate: float) -> str:
    """Put the SNR [dB] of the chosen and of the best beams, and a link's bit rate [bit/s], into words.

    Example:
        >>> link_quality(12.34, 15.0, 2.5e8)
        '12.3 dB of 15.0 dB at best, mean rate 250 Mbit/s a link'
    """
    snr, best = ("none" if value is None else f"{value:.1f} dB" for value in (snr_db, snr_best_db))
    rate, unit = scaled(bit_rate, ("bit/s", "kbit/s", "Mbit/s", "Gbit/s"))
    return f"{snr} of {best} at best, mean rate {rate:.3g} {unit} a link"


def packet_line(found: PacketSummary) -> str:
    """Put the figures into words.

    Example:
        >>> figures = PacketSummary(
        ...     arrived=100, sent=90, dropped=5, delivered=9, mean_delay=0.0021, mean_throughput=2e6,
        ...     blocks=20, block_errors=0,
        ... )
        >>> packet_line(figures)
        'packets: 90.0% sent, 5.0% dropped, mean delay 2.1 ms, mean throughput 2 Mbit/s a user'
    """
    whole = max(found.arrived, 1)
    delay = "none delivered" if found.mean_delay is None else f"mean delay {1e3 * found.mean_delay:.3g} ms"
    rate, unit = scaled(found.mean_throughput, ("bit/s", "kbit/s", "Mbit/s", "Gbit/s"))
    errors = f", {found.block_errors / found.blocks:.1%} of blocks failed" if found.block_errors else ""
    return (
        f"packets: {found.sent / whole:.1%} sent, {found.dropped / whole:.1%} dropped, {delay}, "
        f"mean throughput {rate:.3g} {unit} a user{errors}"
    )
