"""``caviar inspect``: contents of a recording, and the digest of its run."""

from __future__ import annotations

import warnings
from collections.abc import Iterable, Sequence
from pathlib import Path

import msgspec
import typer
from rich.console import Console
from rich.markup import escape
from rich.table import Table
from rich.text import Text

from caviar_clients.cli.recording_summary import (
    SHOWN_DAMAGE,
    RunSummary,
    SourceSummary,
    decided_lines,
    link_quality,
    outage_lines,
    resume_hint,
    summarise,
)
from caviar_protocol.recording import Recording, RecordingWarning


def inspect_command(run: Path, digest: bool = False, as_json: bool = False) -> int:
    """Print a summary of a recording, or only its digest; the exit status, 1 where it is damaged.

    Raises `RecordingError` where it is no recording.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RecordingWarning)  # its lines are printed as damage
        recording = Recording(run)
    if digest:
        return _print_digest(recording)
    return _print_summary(summarise(recording), as_json, resume_hint(recording))


def _print_digest(recording: Recording) -> int:
    report = recording.run_digest()
    typer.echo(report.digest)
    if not recording.complete:
        last = recording.entry(len(recording) - 1) if len(recording) else None
        behind = f" behind frame {last.frame} of episode {last.episode}" if last is not None else ""
        note = f"note: the recording breaks off{behind}; the digest is that of {report.frames} frames"
        typer.echo(note, err=True)
    return _print_damage(report.damage)


def _print_damage(damage: Sequence[str]) -> int:
    for line in damage[:SHOWN_DAMAGE]:
        typer.echo(f"damaged: {line}", err=True)
    if len(damage) > SHOWN_DAMAGE:
        typer.echo(f"damaged: and {len(damage) - SHOWN_DAMAGE} more", err=True)
    return 1 if damage else 0


def _print_summary(summary: RunSummary, as_json: bool, hint: str) -> int:
    if as_json:
        typer.echo(msgspec.json.format(msgspec.json.encode(summary), indent=2))
    else:
        console = Console()
        console.print(_facts(summary))
        console.print(_topics(summary.sources))
        if hint:
            console.print(Text(hint), soft_wrap=True)
    return _print_damage(summary.damage)


def _facts(summary: RunSummary) -> Table:
    table = Table(show_header=False, box=None, pad_edge=False)
    table.add_column(style="bold", no_wrap=True)
    table.add_column(overflow="fold")
    state = "complete" if summary.complete else "[red]breaks off[/red]: the recorder did not close it"
    table.add_row("run", escape(f"{summary.run} (scenario {summary.scenario}, seed {summary.seed})"))
    table.add_row("started", summary.started)
    table.add_row("recording", f"{state}, {_size(summary.bytes)} in {_count(summary.segments, 'segment')}")
    table.add_row(
        "frames",
        f"{summary.frames} of {summary.frames_planned} planned, {_count(summary.episodes, 'episode')}, "
        f"{summary.simulated_s:g} s simulated",
    )
    link = summary.link
    if link is not None and link.mean_abs_y is not None:
        table.add_row(
            "mean |y|",
            f"{link.mean_abs_y:.4g}, best {link.mean_abs_y_best:.4g}, straight line "
            f"{link.mean_abs_y_baseline:.4g} (over users with a path)",
        )
    if link is not None and link.mean_bit_rate is not None:
        table.add_row("mean SNR", link_quality(link.mean_snr_db, link.mean_snr_best_db, link.mean_bit_rate))
    if link is not None:
        table.add_row("no path", f"{link.no_path_share:.2%} of {_count(link.users, 'user')} over all frames")
    for line in [] if summary.outage is None else outage_lines(summary.outage):
        table.add_row("no path", escape(line))
    for line in decided_lines(summary.decided):
        table.add_row("decided", escape(line))
    for line in summary.warnings:
        table.add_row("warning", escape(line), style="yellow")
    machine = summary.machine
    table.add_row("machine", escape(", ".join(f"{key} {value}" for key, value in sorted(machine.items()))))
    table.add_row("versions", escape(", ".join(f"{k} {v}" for k, v in summary.versions.items())))
    for note in summary.notes:
        table.add_row("note", escape(note))
    return table


def _topics(sources: Iterable[SourceSummary]) -> Table:
    table = Table()
    for title in ("topic", "source"):
        table.add_column(title)
    for title in ("fresh", "held", "absent", "late", "size"):
        table.add_column(title, justify="right")
    for source in sources:
        counts = (source.fresh, source.held, source.absent, source.late)
        table.add_row(source.topic, escape(source.source), *map(str, counts), _size(source.bytes))
    return table


def _count(number: int, noun: str) -> str:
    return f"{number} {noun}" if number == 1 else f"{number} {noun}s"


def _size(count: float) -> str:
    for unit in ("B", "KiB", "MiB"):
        if count < 1024:
            return f"{count:.0f} {unit}" if unit == "B" else f"{count:.1f} {unit}"
        count /= 1024
    return f"{count:.1f} GiB"
