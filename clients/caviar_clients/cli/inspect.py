"""``caviar inspect``: what a recording holds, and the digest of its run."""

from __future__ import annotations

import math
import shlex
import warnings
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Annotated, Any, cast

import msgspec
import numpy as np
import typer
from rich.console import Console
from rich.markup import escape
from rich.table import Table
from rich.text import Text

from caviar_clients.cli.decided import Decided, Decisions, decided_lines
from caviar_clients.cli.outages import Outages, OutageSummary, outage_lines
from caviar_clients.cli.unserved import Unserved
from caviar_protocol.arrays import quantity
from caviar_protocol.errors import RecordingError
from caviar_protocol.messages import Status
from caviar_protocol.recording import RecordedFrame, Recording, RecordingWarning
from caviar_protocol.run_directory import RunDirectory
from caviar_protocol.topics import Link

SHOWN_DAMAGE = 20
"""Lines about damage that are printed; how many there are more is said."""


class SourceSummary(msgspec.Struct, kw_only=True):
    """What became of one source's products of one topic."""

    topic: str
    source: str
    fresh: int = 0
    held: int = 0
    absent: int = 0
    late: int = 0
    bytes: Annotated[int, quantity("B", "stored")] = 0


class LinkSummary(msgspec.Struct, kw_only=True):
    """Means over frames and users that have a path; |y| of beams of unit norm."""

    mean_abs_y: float | None
    """None where no user ever had a path."""
    mean_abs_y_best: float | None
    mean_abs_y_baseline: float | None
    mean_snr_db: Annotated[float | None, quantity("dB", "mean of the linear SNR of the chosen pairs")]
    """None where no user had a path, or none was served."""
    mean_snr_best_db: Annotated[float | None, quantity("dB", "the same of the best pairs")]
    mean_bit_rate: Annotated[float | None, quantity("bit/s", "of a user with the chosen pair")]
    no_path_share: float | None
    """Share of users without a path; None where there was no user."""
    users: int
    """Users summed over frames."""


class RunSummary(msgspec.Struct, kw_only=True):
    """A recording at a glance."""

    run: str
    scenario: str
    seed: int
    started: str
    complete: bool
    """Whether the recorder closed the recording."""
    segments: int
    episodes: int
    frames: int
    frames_planned: int
    simulated_s: Annotated[float, quantity("s", "up to a sampling period behind the last frames")]
    bytes: Annotated[int, quantity("B", "size of the segments")]
    sources: list[SourceSummary]
    link: LinkSummary | None
    outage: OutageSummary | None
    """Why users had no path; None where all had one."""
    decided: list[Decided]
    warnings: list[str]
    """What the user probably did not mean."""
    versions: dict[str, str]
    machine: dict[str, str]
    notes: tuple[str, ...]
    damage: list[str]


def resume_hint(recording: Recording) -> str:
    """How to go on with a run that was killed; empty for one that ended, or is embedded and cannot go on.

    A recorder closes its recording where `caviar run` alone was killed: such a run has no summary.
    """
    directory, metadata = recording.directory, recording.metadata
    planned = metadata.frames * _episodes_planned(metadata.scenario)
    files = RunDirectory(directory)
    ended = files.summary.is_file() or len(recording) >= planned
    if not files.record.is_file() or (recording.complete and ended):
        return ""
    return (
        f"unless the run still goes on, continue it with: caviar run --resume {shlex.quote(str(directory))}"
    )


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


def summarise(recording: Recording) -> RunSummary:
    """The summary of a recording. Damaged frames are listed and count as if they had no products."""
    metadata, damage = recording.metadata, list(recording.damage)
    sources: dict[tuple[str, str], SourceSummary] = {}
    totals, decisions, unserved, outages = _LinkTotals(), Decisions(), Unserved(), Outages()
    episodes: dict[int, int] = {}  # to the last instant [ns]
    for frame in recording.frames():
        episodes[frame.episode] = max(frame.t_ns, episodes.get(frame.episode, 0))
        decisions.add(frame.episode, frame.reports)
        unserved.add(frame.reports)
        outages.add(frame.reports)
        for entry in frame.inputs:
            key = (entry.topic, entry.source)
            source = sources.setdefault(key, SourceSummary(topic=entry.topic, source=entry.source))
            setattr(source, entry.status.value, getattr(source, entry.status.value) + 1)
        try:
            _measure(frame, sources, totals)
        except RecordingError as error:
            damage.append(str(error))
    return RunSummary(
        run=metadata.run,
        scenario=metadata.name,
        seed=metadata.seed,
        started=metadata.started,
        complete=recording.complete,
        segments=len(recording.files),
        episodes=len(episodes),
        frames=len(recording),
        frames_planned=metadata.frames * _episodes_planned(metadata.scenario),
        simulated_s=sum(last + metadata.sampling_period_ns for last in episodes.values()) / 1e9,
        bytes=sum(file.stat().st_size for file in recording.files),
        sources=[sources[key] for key in sorted(sources)],
        link=totals.summary(),
        outage=outages.summary(totals.users - totals.served),
        decided=decisions.summary(),
        warnings=unserved.warnings(),
        versions=metadata.versions,
        machine=metadata.machine,
        notes=metadata.notes,
        damage=damage,
    )


class _LinkTotals:
    """Sums over users that have a path, and how many users had none."""

    def __init__(self) -> None:
        self.users = self.served = 0
        self._sums = np.zeros(6)
        """Of |y|, best and baseline |y|, SNR, best SNR, bit rate."""

    def add(self, link: Link) -> None:
        with_path = link.has_path
        self.users += len(link.rx)
        self.served += int(with_path.sum())
        best = link.top_abs_y[:, :1].sum(axis=1)  # no column where there is no user
        figures = (link.abs_y, best, link.baseline_abs_y, link.snr, link.snr_best, link.bit_rate)
        self._sums += [values[with_path].sum() for values in figures]

    def summary(self) -> LinkSummary | None:
        if not self.users:
            return None
        means: list[float | None] = [None] * len(self._sums)
        if self.served:
            means = (self._sums / self.served).tolist()
        abs_y, best, baseline, snr, snr_best, bit_rate = means
        return LinkSummary(
            mean_abs_y=abs_y,
            mean_abs_y_best=best,
            mean_abs_y_baseline=baseline,
            mean_snr_db=_db(snr),
            mean_snr_best_db=_db(snr_best),
            mean_bit_rate=bit_rate,
            no_path_share=1 - self.served / self.users,
            users=self.users,
        )


def _db(ratio: float | None) -> float | None:
    return 10 * math.log10(ratio) if ratio else None


def _measure(
    frame: RecordedFrame, sources: dict[tuple[str, str], SourceSummary], totals: _LinkTotals
) -> None:
    for product in frame.products:
        entry = product.provenance
        if entry.status in (Status.FRESH, Status.LATE):
            sources[entry.topic, entry.source].bytes += product.size
        if entry.topic == "link" and entry.status is Status.FRESH:
            totals.add(cast(Link, product.payload))


def _episodes_planned(scenario: dict[str, Any]) -> int:
    run = scenario.get("run")
    episodes = run.get("episodes", 1) if isinstance(run, dict) else 1
    return episodes if isinstance(episodes, int) else 1


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


def link_quality(snr_db: float | None, snr_best_db: float | None, bit_rate: float) -> str:
    """SNR [dB] against the best beams', and the rate [bit/s] of a user, in words."""
    snr, best = ("none" if value is None else f"{value:.1f} dB" for value in (snr_db, snr_best_db))
    return f"{snr} of {best} at best, mean rate {_rate(bit_rate)} a user"


def _rate(bit_rate: float) -> str:
    for unit in ("bit/s", "kbit/s", "Mbit/s"):
        if bit_rate < 1000:
            return f"{bit_rate:.3g} {unit}"
        bit_rate /= 1000
    return f"{bit_rate:.3g} Gbit/s"


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
