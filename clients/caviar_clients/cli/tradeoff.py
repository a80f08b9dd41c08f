"""``caviar tradeoff``: what accuracy costs, over the scenes of a scenario or a recording."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import msgspec
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

from caviar_clients.files import write_file
from caviar_clients.tradeoff.campaign import Told
from caviar_clients.tradeoff.plot import draw_convergence, draw_pareto
from caviar_clients.tradeoff.report import PARTS, Options, Report, compare
from caviar_clients.tradeoff.scenes import scenes_of
from caviar_clients.tradeoff.tables import by_reason, markdown, screen_table
from caviar_protocol.errors import RunError
from caviar_protocol.tables import suggestion
from caviar_services.recorder.base import machine


def options_of(
    reference: str | None,
    baseline: str | None,
    receivers: int | None,
    seeds: int,
    minutes: float,
    parts: Sequence[str] | None,
) -> Options:
    """Options from the command line. Raises `RunError` for a part that does not exist."""
    for part in parts or ():
        if part not in PARTS:
            raise RunError(f"--part {part!r} does not exist; {suggestion(part, PARTS)}")
    return Options(
        reference=reference,
        baseline=baseline,
        receivers=receivers,
        seeds=seeds,
        seconds=60 * minutes,
        parts=tuple(part for part in PARTS if not parts or part in parts),
    )


def trade(
    source: Path, frames: int, options: Options, json: Path | None, out: Path | None, console: Console
) -> Report:
    """Compare, show a table, and write what was asked for.

    Raises `RunError` before anything is measured where a file cannot be written.
    """
    if json is not None:
        write_file(json)
    if out is not None:
        write_file(out / "tradeoff.md")
    with _progress(console) as bar:
        task = bar.add_task("scenes", total=1.0, left="")

        def told(news: Told) -> None:
            minutes, seconds = divmod(round(news.left_s), 60)
            bar.update(
                task, description=news.text, completed=news.done, left=f"at most {minutes}:{seconds:02d} left"
            )

        scenes = scenes_of(source, frames)
        report = compare(scenes, options, machine(), told)
    console.print(screen_table(report))
    for reason, labels in by_reason(report.skipped).items():
        console.print(f"not measured: {', '.join(labels)}: {reason}", markup=False, highlight=False)
    if json is not None:
        write_file(json, msgspec.json.format(msgspec.json.encode(report), indent=2).decode() + "\n")
        console.print(str(json), markup=False, highlight=False, soft_wrap=True)
    if out is not None:
        write_file(out / "tradeoff.md", markdown(report))
        files = [out / "tradeoff.md", draw_pareto(report, out / "pareto.png")]
        if report.convergence:
            files.append(draw_convergence(report, out / "convergence.png"))
        for file in files:
            console.print(str(file), markup=False, highlight=False, soft_wrap=True)
    return report


@contextmanager
def _progress(console: Console) -> Iterator[Progress]:
    columns = (
        TextColumn("{task.description}", markup=False),
        BarColumn(),
        TimeElapsedColumn(),
        TextColumn("{task.fields[left]}"),
    )
    with Progress(*columns, console=console) as bar:
        yield bar
