"""``caviar tradeoff``: what accuracy costs, over the scenes of a scenario or a recording."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import msgspec
from msgspec.structs import replace
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

from caviar_clients.cli.scenarios import extras_of
from caviar_clients.files import reserved, write_file
from caviar_clients.session.checks import checked_scenario
from caviar_clients.tradeoff import ladder
from caviar_clients.tradeoff.campaign import Progress as CampaignProgress
from caviar_clients.tradeoff.campaign import candidates
from caviar_clients.tradeoff.plot import draw_convergence, draw_pareto
from caviar_clients.tradeoff.report import PARTS, Options, Report, compare
from caviar_clients.tradeoff.scenes import is_recording, scenes_of, services_kept
from caviar_clients.tradeoff.tables import by_reason, markdown, screen_table
from caviar_protocol.errors import RunError, SetupError, suggestion
from caviar_protocol.host import has_extra, install_command
from caviar_services.recorder.base import machine
from caviar_services.registry import load


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

    Raises `SetupError` naming all extras that lack, and `RunError` where a file cannot be written, both
    before anything is measured. An error leaves no empty files.
    """
    _require_extras(source, options, with_pictures=out is not None)
    files = [file for file in (json, out and out / "tradeoff.md") if file is not None]
    with reserved(*files):
        report = _compared(source, frames, options, console)
    warning = _other_reference(options, report)
    if warning:
        console.print(warning, markup=False, highlight=False, soft_wrap=True, style="yellow")
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


def _other_reference(options: Options, report: Report) -> str:
    """A warning where errors are against a coarser setting than the finest; empty where they are not."""
    finest = options.reference or ladder.REFERENCES[0]
    reasons = [entry.reason for entry in report.skipped if entry.setting == finest]
    if report.reference == finest or not reasons:
        return ""
    return (
        f"warning: errors are against {report.reference!r}, since {finest!r} was not measured: {reasons[0]}"
    )


def _require_extras(source: Path, options: Options, with_pictures: bool) -> None:
    """Raise `SetupError` with one command where the comparison cannot be made with what is installed.

    Then the command installs what the rest of the ladder needs, too; alone, that is left out and reported.
    """
    needed = {"plot"} if with_pictures else set[str]()
    if not is_recording(source):
        scenario = checked_scenario(source)
        needed.update(extras_of(replace(scenario, services=services_kept(scenario))))
    known = (*ladder.LADDER, *ladder.spacing_settings())
    choices = (
        candidates(options.reference, ladder.REFERENCES, known, "--reference"),
        candidates(options.baseline, ladder.BASELINES, known, "--baseline"),
    )
    for settings in choices:
        extras = {load("channel", setting.use).extra for setting in settings}
        needed |= extras if "" not in extras else set()
    if all(has_extra(extra) for extra in needed):
        return
    needed |= {load("channel", setting.use).extra for setting in known} - {""}
    missing = sorted(extra for extra in needed if not has_extra(extra))
    raise SetupError(
        f"the comparison needs what is not installed ({', '.join(missing)}); run: {install_command(*missing)}"
    )


def _compared(source: Path, frames: int, options: Options, console: Console) -> Report:
    with _progress(console) as bar:
        task = bar.add_task("scenes", total=1.0, left="")

        def show(news: CampaignProgress) -> None:
            minutes, seconds = divmod(round(news.left_s), 60)
            left = f"{minutes}:{seconds:02d} left" if news.left_s > 0 else "time is up: ending what began"
            bar.update(task, description=news.text, completed=news.done, left=left)

        scenes = scenes_of(source, frames)
        return compare(scenes, options, machine(), show)


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
