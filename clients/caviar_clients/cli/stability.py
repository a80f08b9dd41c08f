"""``caviar stability``: what the channel models answer at the extremes, beside what is right."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import msgspec
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn
from rich.table import Table
from rich.text import Text

from caviar_clients.files import write_file
from caviar_protocol.errors import SetupError
from caviar_protocol.host import install_command
from caviar_services.channel.stability.case import EXTRA, Case, Result, cases, markdown, run, wrong


def stability(
    console: Console,
    groups: Sequence[str] = (),
    json_file: Path | None = None,
    markdown_file: Path | None = None,
    traced: bool = True,
) -> int:
    """Run the cases, print them, write them; status 1 where one that ran is wrong, or none ran.

    Raises `SetupError` for a group that does not exist, `RunError` where a file cannot be written:
    both before the first case.
    """
    chosen = _chosen(groups, traced)
    for file in (json_file, markdown_file):
        if file is not None:
            write_file(file)
    results = _results(console, chosen)
    ran = [result for result in results if result.verdict != "not run"]
    faulty = wrong(ran)
    console.print(_table(ran))
    seconds = sum(result.seconds for result in ran)
    summary = f"{len(ran) - len(faulty)} of {len(ran)} right, in {seconds:.0f} s"
    console.print(summary, style="bold green" if ran and not faulty else "bold red", highlight=False)
    if len(ran) < len(results):
        console.print(
            f"{len(results) - len(ran)} of {len(results)} cases did not run: they need the ray tracer "
            f"(extra {EXTRA!r}); run: {install_command(EXTRA)}",
            style="yellow", markup=False, highlight=False, soft_wrap=True,
        )  # fmt: skip
    if json_file is not None:
        write_file(json_file, msgspec.json.format(msgspec.json.encode(results), indent=2).decode() + "\n")
    if markdown_file is not None:
        write_file(markdown_file, markdown(results))
    return 0 if ran and not faulty else 1


def _chosen(groups: Sequence[str], traced: bool) -> list[Case]:
    every = cases()
    known = list(dict.fromkeys(case.group for case in every))
    for group in groups:
        if group not in known:
            raise SetupError(f"there is no group {group!r} of cases; --group takes one of {', '.join(known)}")
    return [case for case in every if (case.group in groups or not groups) and (traced or not case.traced)]


def _results(console: Console, chosen: Sequence[Case]) -> list[Result]:
    columns = (BarColumn(), MofNCompleteColumn(), TextColumn("{task.description}", markup=False))
    with Progress(*columns, console=console, transient=True) as progress:
        bar = progress.add_task("", total=len(chosen))
        return run(
            chosen, lambda number, case: progress.update(bar, completed=number, description=case.title)
        )


def _table(results: Sequence[Result]) -> Table:
    table = Table(box=None, pad_edge=False)
    for column in ("case", "expected", "got"):
        table.add_column(column, overflow="fold", ratio=1)
    table.add_column("verdict", no_wrap=True)
    for result in results:
        verdict = Text(result.verdict, style="green" if result.verdict == "right" else "bold red")
        name = Text(f"{result.group}: {result.case}")
        table.add_row(name, Text(result.expected), Text(result.got), verdict)
    return table
