"""Commands that measure and judge: ``caviar measure`` and ``caviar conform``.

They compare what was measured with what is right or wanted, show it in a table, and write it to files. A file
that cannot be written is refused before the work.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterable, Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn
from rich.table import Column, Table
from rich.text import Text

from caviar_clients.cli.scenarios import extras_of
from caviar_clients.cli.shared import (
    print_line,
    progress_bar,
    require_installed,
    require_known,
    require_parent,
    require_writable,
    write_json,
)
from caviar_clients.files import require_folder, reserved, write_file
from caviar_clients.session.prepared import PreparedScenario, prepare
from caviar_protocol.errors import SetupError
from caviar_protocol.host import has_extra, install_command
from caviar_protocol.scenario.toml import MAX_SIZE, parse_toml
from caviar_services.registry import load

# A command loads its own part of the package and not that of the others.
if TYPE_CHECKING:
    from caviar_labs.budget import Forecast, ServiceForecast
    from caviar_labs.conform import Verdict
    from caviar_labs.conform.client import Rules
    from caviar_labs.stability.case import Case
    from caviar_labs.tradeoff.campaign import Progress as CampaignProgress
    from caviar_labs.tradeoff.report import Options, Report

VERDICT_STYLES = {"pass": "green", "right": "green", "not applicable": "dim"}
"""Styles of verdicts; all others are failures."""
_FAILED = "bold red"


def measure_broker(
    console: Console,
    topology: Literal["hub", "all"],
    services: int,
    payload: int,
    frames: int,
    curve: bool,
    json_file: Path | None,
) -> None:
    """Measure a frame's way through the broker, and print and write the figures.

    Args:
        console: Where the table is printed.
        topology: ``hub``: one service exchanges products with all others; ``all``: each with each.
        services: Number of services, each a process.
        payload: Size of a product [B].
        frames: Frames that are measured.
        curve: Whether connections have keys and are encrypted.
        json_file: Where the figures are written; None: nowhere.
    """
    from caviar_labs.broker_bench import measure

    require_writable(json_file)  # before minutes of measuring
    measured = measure(topology, services, payload, frames, curve=curve)
    table = Table(
        "services", "payload B", "µs a frame: mean", "p50", "p99", "MB/s", "broker CPU µs", "misses"
    )
    time = measured.us_per_frame
    table.add_row(
        str(services),
        str(payload),
        *(f"{value:.0f}" for value in (time.mean, time.p50, time.p99)),
        f"{measured.bytes_per_second / 1e6:.3g}",
        f"{measured.broker_cpu_us_per_frame:.0f}",
        str(measured.misses),
    )
    console.print(table)
    write_json(json_file, measured)


# --- caviar measure budget -------------------------------------------------------------------------------


def budget_run(run: Path, console: Console, json_file: Path | None = None) -> Forecast:
    """Print what frame rates a recorded run would sustain, and write it to a file.

    Args:
        run: The run's directory, or a segment of its recording.
        console: Where it is printed.
        json_file: Where the figures are written; None: nowhere.

    Raises:
        RecordingError: There is no recording, or no latencies beside it.
        RunError: The file cannot be written; nothing was worked out then.
    """
    from caviar_clients.replay.recorded import RecordedRun
    from caviar_labs.budget import forecast
    from caviar_protocol.recording import Recording

    recording = Recording(run)
    require_writable(json_file)
    found = forecast(RecordedRun(recording))
    headings = ("p50 ms", "p99 ms", "budget", "suggested", "alone", "without", "misses")
    table = Table("service", *(Column(heading, justify="right") for heading in headings))
    for service in found.services:
        table.add_row(*map(Text, _forecast_row(service)))
    console.print(table)
    for line in forecast_lines(found):
        print_line(console, line)
    write_json(json_file, found)
    return found


def forecast_lines(found: Forecast) -> list[str]:
    """Put into words what a forecast says beyond its table of services."""
    rates = ", ".join(f"{policy} {rate:.1f}" for policy, rate in found.rates.items())
    substituted = {
        policy: {s.name: s.substituted[policy] for s in found.services if s.substituted[policy]}
        for policy in found.rates
    }
    return [
        f"alone, without: frames/s if only it took time, or all others; misses: {'/'.join(found.rates)}",
        f"frames/s as budgets are: {rates}; measured {found.measured:.1f}, real time {found.realtime:.1f}",
        *(
            f"under {policy}, held or absent in so many of {found.frames} frames: "
            + ", ".join(f"{name} {count}" for name, count in services.items())
            for policy, services in substituted.items()
            if services
        ),
        _bound(found),
        *found.notes,
    ]


def _bound(found: Forecast) -> str:
    bound = found.bound
    text = f"{bound.service} bounds the frame rate under wait"
    if math.isfinite(bound.gain):
        text += f": if it took no time, there were {bound.gain:.2f} times as many frames a second"
    if bound.realtime_factor is None:
        return f"{text}; for real time it is not enough to make it alone faster"
    if bound.realtime_factor > 1.0:
        return f"{text}; for real time it would have to be {bound.realtime_factor:.2f} times as fast"
    return f"{text}; real time is sustained"


def _forecast_row(service: ServiceForecast) -> list[str]:
    return [
        service.name,
        f"{service.p50_ms:.2f}",
        f"{service.p99_ms:.2f}",
        f"{service.budget_ms:g}",
        f"{service.suggested_ms:g}",
        f"{service.alone:.1f}",
        "any" if service.without is None else f"{service.without:.1f}",
        "/".join(map(str, service.misses.values())),
    ]


# --- caviar measure tradeoff -----------------------------------------------------------------------------


def tradeoff_options(
    reference: str | None,
    baseline: str | None,
    receivers: int | None,
    seeds: int,
    minutes: float,
    parts: Sequence[str] | None,
    errors_db: Sequence[float] | None = None,
    times_ms: Sequence[float] | None = None,
) -> Options:
    """Make the options of a comparison from those of the command line.

    Raises:
        RunError: A part does not exist.
    """
    from caviar_labs.tradeoff.report import PARTS, Options

    for part in parts or ():
        require_known("--part", part, PARTS)
    # What is asked replaces the errors and times that are answered by default.
    asked = {} if not (errors_db or times_ms) else {"errors_db": errors_db or (), "times_ms": times_ms or ()}
    return Options(
        **{name: tuple(values) for name, values in asked.items()},
        reference=reference,
        baseline=baseline,
        receivers=receivers,
        seeds=seeds,
        seconds=60 * minutes,
        parts=tuple(part for part in PARTS if not parts or part in parts),
    )


def trade(
    source: Path, frames: int, options: Options, json_file: Path | None, out: Path | None, console: Console
) -> Report:
    """Compare channel settings over the same scenes, show a table, and write what was asked for.

    Args:
        source: A scenario, or the directory of a run that recorded ``scene``.
        frames: Scenes, spread over the episode.
        options: What is compared.
        json_file: Where all figures are written; None: nowhere.
        out: Folder of tables and pictures; None: nowhere.
        console: Where progress and table are shown.

    Raises:
        SetupError: An extra is not installed; the text has the command for all that are missing.
        RunError: A file cannot be written; nothing was measured then, and no empty file is left.
    """
    from caviar_labs.tradeoff.plot import draw_convergence, draw_pareto
    from caviar_labs.tradeoff.tables import answer_sentences, by_reason, markdown, screen_table

    if out is not None:
        require_folder("--out", out, "tables and pictures")
    prepared = _require_extras_of_ladder(source, options, with_pictures=out is not None)
    if json_file is not None:
        require_parent(json_file)
    files = [file for file in (json_file, out and out / "tradeoff.md") if file is not None]
    # Files that are still empty after an error are removed: an empty table looks like a result.
    with reserved(*files):
        report = _compared(source, prepared, frames, options, console)
    if warning := _other_reference(options, report):
        print_line(console, warning, style="yellow")
    console.print(screen_table(report))
    for sentence in answer_sentences(report):
        print_line(console, sentence)
    for reason, labels in by_reason(report.skipped).items():
        console.print(f"not measured: {', '.join(labels)}: {reason}", markup=False, highlight=False)
    write_json(json_file, report)
    if out is not None:
        write_file(out / "tradeoff.md", markdown(report))
        files = [*files, draw_pareto(report, out / "pareto.png")]
        # Without two seeds there is nothing to draw.
        if any(point.seeds > 1 for point in report.convergence):
            files.append(draw_convergence(report, out / "convergence.png"))
    for file in files:
        print_line(console, file)
    return report


def _other_reference(options: Options, report: Report) -> str:
    """A warning where errors are against a coarser setting than the finest; empty where they are not."""
    from caviar_labs.tradeoff import ladder

    finest = options.reference or ladder.REFERENCES[0]
    reasons = [entry.reason for entry in report.skipped if entry.setting == finest]
    if report.reference == finest or not reasons:
        return ""
    return (
        f"warning: errors are against {report.reference!r}, since {finest!r} was not measured: {reasons[0]}, "
        "or name one that fits with --reference"
    )


def _require_extras_of_ladder(source: Path, options: Options, with_pictures: bool) -> PreparedScenario | None:
    """Raise `SetupError` with one command where the comparison cannot be made with what is installed.

    Then the command installs what the rest of the ladder needs, too; alone, that is left out and reported.

    Returns:
        The scenario; None of a recording.
    """
    from caviar_clients.session.scenes import is_recording, worlds_only
    from caviar_labs.tradeoff import ladder
    from caviar_labs.tradeoff.campaign import candidates

    needed = {"plot"} if with_pictures else set[str]()
    prepared = None if is_recording(source) else prepare(source)
    if prepared is not None:
        needed.update(extras_of(worlds_only(prepared)))
    known = (*ladder.LADDER, *ladder.spacing_settings())
    choices = (
        candidates(options.reference, ladder.REFERENCES, known, "--reference"),
        candidates(options.baseline, ladder.BASELINES, known, "--baseline"),
    )
    for settings in choices:
        extras = {load("channel", setting.use).extra for setting in settings}
        # One candidate that the base install can compute is enough.
        needed |= extras if "" not in extras else set()
    if not all(has_extra(extra) for extra in needed):
        needed |= {load("channel", setting.use).extra for setting in known} - {""}
        require_installed("the comparison", sorted(needed))
    return prepared


def _compared(
    source: Path, prepared: PreparedScenario | None, frames: int, options: Options, console: Console
) -> Report:
    from caviar_labs.tradeoff.report import compare
    from caviar_labs.tradeoff.scenes import scenes_of
    from caviar_services.recorder.base import machine

    with progress_bar(console, TimeElapsedColumn(), TextColumn("{task.fields[left]}")) as bar:
        task = bar.add_task("scenes", total=1.0, left="")

        def show(news: CampaignProgress) -> None:
            minutes, seconds = divmod(round(news.left_s), 60)
            left = f"{minutes}:{seconds:02d} left" if news.left_s > 0 else "time is up: ending what began"
            bar.update(task, description=news.text, completed=news.done, left=left)

        return compare(scenes_of(source, frames, prepared), options, machine(), show)


# --- caviar measure stability ----------------------------------------------------------------------------


def stability(
    console: Console,
    groups: Sequence[str] = (),
    json_file: Path | None = None,
    markdown_file: Path | None = None,
    traced: bool = True,
) -> int:
    """Ask the channel models at their extremes, compare with formulas, and print and write the verdicts.

    Args:
        console: Where progress and table are shown.
        groups: Groups of cases; empty: all.
        json_file: Where the results are written; None: nowhere.
        markdown_file: Where they are written as a table; None: nowhere.
        traced: Whether cases that need the ray tracer are played, too.

    Returns:
        The exit status: 1 where a case that ran is wrong, or none ran.

    Raises:
        SetupError: A group does not exist.
        RunError: A file cannot be written; no case was run then.
    """
    from caviar_labs.stability import case as kit

    chosen = _cases_of(kit.cases(), groups, traced)
    require_writable(json_file, markdown_file)
    # The bar stands before the text, whose length differs from case to case.
    columns = (BarColumn(), MofNCompleteColumn(), TextColumn("{task.description}", markup=False))
    with Progress(*columns, console=console, transient=True) as bar:
        task = bar.add_task("", total=len(chosen))
        results = kit.run(
            chosen, lambda number, case: bar.update(task, completed=number, description=case.title)
        )
    ran = [result for result in results if result.verdict != "not run"]
    faulty = kit.wrong(ran)
    rows = ((f"{r.group}: {r.case}", r.expected, r.got, r.verdict) for r in ran)
    console.print(_verdict_table(_folded("case"), ("expected", "got"), rows))
    seconds = sum(result.seconds for result in ran)
    style = "bold green" if ran and not faulty else _FAILED
    print_line(console, f"{len(ran) - len(faulty)} of {len(ran)} right, in {seconds:.0f} s", style)
    if len(ran) < len(results):
        without = f"{len(results) - len(ran)} of {len(results)} cases did not run: they need the ray tracer"
        remedy = f"(extra {kit.EXTRA!r}); run: {install_command(kit.EXTRA)}"
        print_line(console, f"{without} {remedy}", "yellow")
    write_json(json_file, results)
    if markdown_file is not None:
        write_file(markdown_file, kit.markdown(results))
    return 0 if ran and not faulty else 1


def _cases_of(every: Sequence[Case], groups: Sequence[str], traced: bool) -> list[Case]:
    known = list(dict.fromkeys(case.group for case in every))
    for group in groups:
        if group not in known:
            raise SetupError(f"there is no group {group!r} of cases; --group takes one of {', '.join(known)}")
    return [case for case in every if (case.group in groups or not groups) and (traced or not case.traced)]


# --- caviar conform --------------------------------------------------------------------------------------


def conform_client(
    console: Console,
    listen: str,
    rules: Rules,
    *,
    command: str = "",
    names: Sequence[str] = (),
    websocket: bool = False,
    json_file: Path | None = None,
    markdown_file: Path | None = None,
) -> int:
    """Judge a client against the protocol, and print and write the verdicts.

    Args:
        console: Where verdicts are shown as they come.
        listen: Address at which the kit listens; with ``websocket``, at which WebSockets are served. Empty:
            any port of 127.0.0.1 where ``command`` passes it on, else the one that a user has to know.
        rules: What the client has to declare, and in which time it has to answer.
        command: Starts the client for each case; empty: the user does.
        names: Cases that are played; empty: all.
        websocket: Whether the client speaks WebSocket, through a gateway before the kit.
        json_file: Where the verdicts are written; None: nowhere.
        markdown_file: Where they are written as a table; None: nowhere.

    Returns:
        The exit status: 1 where a verdict is «fail».

    Raises:
        SetupError: A case does not exist.
        RunError: The address is taken, the command cannot be started, or a file cannot be written.
    """
    from caviar_labs import conform as kit
    from caviar_labs.conform.case import as_json, as_markdown, repeated, summary

    def tell(text: str) -> None:
        print_line(console, text, "bold")

    def each(verdict: Verdict) -> None:
        line = Text(f"{verdict.outcome:<15}", style=VERDICT_STYLES.get(verdict.outcome, _FAILED))
        console.print(line + Text(f"{verdict.case}: {verdict.title}", style="default"), soft_wrap=True)

    require_writable(json_file, markdown_file)
    # Another kit, say, may have the usual port; a client that is given the address does not need it.
    listen = listen or f"tcp://127.0.0.1:{0 if '{endpoint}' in command else 5590}"
    options: dict[str, Any] = {"command": command, "names": names, "rules": rules, "tell": tell, "each": each}
    if websocket:
        # The gateway has the address that clients know; the kit is behind it, at any.
        options["front"] = _gateway(listen, tell)
        listen = "tcp://127.0.0.1:0"
    verdicts = kit.conform(listen, **options)
    console.print()
    rows = ((v.case, v.clauses, v.expected, v.got, v.outcome) for v in verdicts)
    console.print(_verdict_table(Column("case", no_wrap=True), ("clauses", "expected", "got"), rows))
    for cause in repeated(verdicts):
        print_line(console, cause)
    failed = any(verdict.outcome == "fail" for verdict in verdicts)
    print_line(console, summary(verdicts), _FAILED if failed else "bold green")
    for file, text in ((json_file, as_json(verdicts)), (markdown_file, as_markdown(verdicts))):
        if file is not None:
            write_file(file, text)
    return 1 if failed else 0


def _gateway(listen: str, tell: Callable[[str], None]) -> Callable[[str], AbstractContextManager[str]]:
    """A server of WebSockets at ``listen``, an address of this machine, in front of the kit."""
    from caviar_broker.http.process import gateway_in_front

    address = listen.partition("://")[2].partition("/")[0] or listen
    return lambda endpoint: gateway_in_front(endpoint, address, tell)


def list_cases(console: Console) -> None:
    """Print what can be asked for with ``caviar conform --case``."""
    from caviar_labs.conform import cases

    columns = (
        Column("case", no_wrap=True),
        Column("what it shows", overflow="fold"),
        Column("clauses", overflow="fold"),
    )
    table = Table(*columns, box=None, pad_edge=False)
    for case in cases():
        table.add_row(case.name, Text(case.title), Text(case.clauses))
    console.print(table)


def settings_of(file: Path | None) -> dict[str, Any]:
    """Read the ``settings`` of WELCOME.

    Args:
        file: A TOML file, or ``….json``; None: no settings.

    Raises:
        SetupError: The file cannot be read, or holds no table.
    """
    if file is None:
        return {}
    try:
        with file.open(encoding="utf-8") as stream:
            text = stream.read(MAX_SIZE + 1)  # parse_toml refuses what is longer; a device would never end
        found = json.loads(text) if file.suffix == ".json" else parse_toml(text)
    except (OSError, ValueError, RecursionError) as error:
        raise SetupError(f"cannot read settings from {file}: {error}; give a TOML or JSON file") from error
    if not isinstance(found, dict):
        raise SetupError(f"{file} holds {type(found).__name__}, expected a table of settings")
    return found


def _folded(name: str) -> Column:
    return Column(name, overflow="fold", ratio=1)


def _verdict_table(case: Column, others: Iterable[str], rows: Iterable[Sequence[str]]) -> Table:
    """A table of cases; a row is the case, its other cells, and its verdict."""
    columns = (case, *map(_folded, others), Column("verdict", no_wrap=True))
    table = Table(*columns, box=None, pad_edge=False)
    for *cells, verdict in rows:
        table.add_row(*map(Text, cells), Text(verdict, style=VERDICT_STYLES.get(verdict, _FAILED)))
    return table
