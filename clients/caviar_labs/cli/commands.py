"""Commands of the laboratories but ``caviar paper``: ``caviar measure`` and ``caviar conform``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer
from rich.console import Console

from caviar_clients.cli.shared import FiguresFile, RunDirectory, ScenarioOrRun

measure = typer.Typer(no_args_is_help=True, help="Time and error: budget, bench, tradeoff, stability.")
bench = typer.Typer(no_args_is_help=True, help="Measure what the parts of a run cost on this machine.")
measure.add_typer(bench, name="bench")


@measure.command()
def budget(
    run: RunDirectory,
    json: FiguresFile = None,
) -> None:
    """Tell from a recorded run the frame rate that each policy sustains, and which service bounds it."""
    from caviar_labs.cli.measure import budget_run

    budget_run(run, Console(), json)


@measure.command()
def tradeoff(
    source: ScenarioOrRun,
    json: FiguresFile = None,
    out: Annotated[Path | None, typer.Option(help="directory for tables and pictures")] = None,
    frames: Annotated[int, typer.Option(min=1, max=10_000, help="scenes, spread over the episode")] = 12,
    receivers: Annotated[
        int | None, typer.Option(min=1, help="receivers of a scene at most; by default all")
    ] = None,
    reference: Annotated[
        str | None, typer.Option(help="setting that errors are against; by default the finest")
    ] = None,
    baseline: Annotated[str | None, typer.Option(help="setting that factors of time are against")] = None,
    seeds: Annotated[int, typer.Option(min=2, max=20, help="seeds of the convergence")] = 2,
    minutes: Annotated[float, typer.Option(min=0.1, help="time for measuring")] = 12.0,
    part: Annotated[
        list[str] | None,
        typer.Option(help="ladder, keyframes, spacing, arrays or convergence; by default all"),
    ] = None,
    error_db: Annotated[
        list[float] | None, typer.Option(help="name the fastest setting with this NMSE of H, in dB, as -20")
    ] = None,
    time_ms: Annotated[
        list[float] | None,
        typer.Option(help="name the most accurate setting with this time of a scene, in ms"),
    ] = None,
) -> None:
    """Compare channel settings: time and error of each over the same scenes."""
    from caviar_labs.cli.measure import trade, tradeoff_options

    options = tradeoff_options(reference, baseline, receivers, seeds, minutes, part, error_db, time_ms)
    trade(source, frames, options, json, out, Console())


@measure.command()
def stability(
    group: Annotated[list[str] | None, typer.Option(help="only this group of cases; may be repeated")] = None,
    json: Annotated[Path | None, typer.Option(help="write the results to this file")] = None,
    markdown: Annotated[Path | None, typer.Option(help="write the table of the docs to this file")] = None,
    traced: Annotated[bool, typer.Option(help="also the cases that need the ray tracer")] = True,
) -> None:
    """Ask the channel models at their extremes, and compare with formulas; status 1 where one is wrong."""
    from caviar_labs.cli.measure import stability as ask

    raise typer.Exit(ask(Console(), group or (), json, markdown, traced))


@bench.command("broker")
def bench_broker(
    services: Annotated[int, typer.Option(min=2, max=256, help="services, each a process")] = 8,
    payload: Annotated[int, typer.Option(min=1, max=1 << 28, help="bytes of a product")] = 100,
    frames: Annotated[int, typer.Option(min=10, max=10_000_000, help="frames that are measured")] = 2000,
    topology: Annotated[
        Literal["hub", "all"], typer.Option(help="hub: one with all others; all: everyone with everyone")
    ] = "hub",
    curve: Annotated[bool, typer.Option("--curve", help="with keys, encrypted")] = False,
    json: Annotated[Path | None, typer.Option(help="write the figures to this file")] = None,
) -> None:
    """A frame's way through the broker, with clients that do nothing but exchange products."""
    from caviar_labs.cli.measure import measure_broker

    measure_broker(Console(), topology, services, payload, frames, curve, json)


def conform(
    listen: Annotated[
        str,
        typer.Option(
            help="address to listen on; port 0: any; default: any port of 127.0.0.1 where {endpoint} in "
            "--command passes it on, else tcp://127.0.0.1:5590"
        ),
    ] = "",
    role: Annotated[
        str, typer.Option(help="role that the client has to declare: agent, world, …; by default any")
    ] = "",
    name: Annotated[str, typer.Option(help="name that it has to declare; by default any")] = "",
    case: Annotated[list[str] | None, typer.Option(help="only this case; may be repeated")] = None,
    command: Annotated[
        str,
        typer.Option(help="starts the client for each life, with {endpoint} and {name} filled in"),
    ] = "",
    ws: Annotated[
        bool,
        typer.Option("--ws", help="clients speak WebSocket: {endpoint} is ws://HOST:PORT/ws of --listen"),
    ] = False,
    timeout: Annotated[float, typer.Option(min=0.1, help="seconds in which the client has to answer")] = 5.0,
    settings: Annotated[Path | None, typer.Option(help="TOML or JSON file: its settings in WELCOME")] = None,
    json: Annotated[Path | None, typer.Option(help="write the verdicts to this file")] = None,
    markdown: Annotated[Path | None, typer.Option(help="write them as a Markdown table")] = None,
    list_cases: Annotated[bool, typer.Option("--list", help="only list the cases")] = False,
) -> None:
    """Judge a client in any language against the protocol, clause by clause; status 1 where one fails."""
    from caviar_labs.cli import measure as kit
    from caviar_labs.conform.client import Rules

    if list_cases:
        kit.list_cases(Console())
        return
    rules = Rules(timeout_s=timeout, name=name, role=role, settings=kit.settings_of(settings))
    status = kit.conform_client(
        Console(),
        listen,
        rules,
        command=command,
        names=case or (),
        websocket=ws,
        json_file=json,
        markdown_file=markdown,
    )
    raise typer.Exit(status)
