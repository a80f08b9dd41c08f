"""Arguments and options that several commands of `caviar` have."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from caviar_clients.cli.scenarios import complete_scenario


def _newest_run() -> Path:
    """The newest run below ``./runs``; says on standard error which it is."""
    from caviar_protocol.recording import newest_run

    directory = newest_run("runs")
    typer.echo(f"run {directory}, the newest in ./runs", err=True)
    return directory


RunDirectory = Annotated[
    Path,
    typer.Argument(
        help="directory of a run, or one segment of its recording",
        default_factory=_newest_run,
        show_default="the newest in ./runs",
    ),
]
Frames = Annotated[int | None, typer.Option(min=1, help="frames of an episode, instead of the scenario's")]
Seed = Annotated[int | None, typer.Option(min=0, max=2**63 - 1, help="seed, instead of the scenario's")]
Pace = Annotated[
    str | None, typer.Option(help="free, realtime or a number [times real time], instead of the scenario's")
]
Keys = Annotated[
    Path | None, typer.Option(help="keys directory: only authorized keys take part (caviar keys)")
]
Http = Annotated[str, typer.Option(help="HOST:PORT: serve status, orders and WebSocket there")]
Resume = Annotated[Path | None, typer.Option(help="go on with the run in this directory, whose broker died")]
Force = Annotated[
    bool, typer.Option("--force", help="with --resume: though code, libraries or files have changed")
]
ScenarioOrNone = Annotated[
    Path | None,
    typer.Argument(
        help="scenario that ships, by name (caviar scenarios), or a file (TOML)",
        show_default=False,
        autocompletion=complete_scenario,
    ),
]
Restarted = Annotated[
    bool,
    typer.Option("--restarted", help="for a container that is started again whenever this status is not 0"),
]
