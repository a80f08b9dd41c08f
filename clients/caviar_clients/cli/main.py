"""The `caviar` command."""

from __future__ import annotations

import _thread
import signal
import sys
import threading
import warnings
from contextlib import nullcontext
from importlib import metadata
from pathlib import Path
from typing import Annotated, Any, Literal

import typer
from rich.console import Console
from rich.text import Text
from typer.core import TyperGroup

from caviar_clients.cli.commands import LOOK, OPERATE, RUN, AttachingCommand, Commands, command
from caviar_clients.cli.shared import (
    Attach,
    Embedded,
    Episodes,
    Force,
    Frames,
    Http,
    Keys,
    Pace,
    Record,
    Restarted,
    Resume,
    RunDirectory,
    RunsFolder,
    ScenarioOrNone,
    ScenarioOrRun,
    Seed,
    Set,
    Shown,
    SummaryFile,
    keys_set,
)
from caviar_protocol.errors import CaviarError, RunError
from caviar_protocol.host import DISTRIBUTION, loading


class _PlotGroup(TyperGroup):
    """Group of ``caviar plot``, whose command `run` is meant where none is named: ``caviar plot RUN``."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        named = args[:1] and args[0] in (*self.commands, *ctx.help_option_names)
        if not named and not ctx.resilient_parsing:  # a shell that completes is offered all commands
            args = ["run", *args]
        return super().parse_args(ctx, args)


# Commands import what they need when they run: `caviar --help` and completion in a shell load none of it.
app = typer.Typer(
    cls=Commands,
    no_args_is_help=True,
    context_settings={"help_option_names": ["-h", "--help"]},
    pretty_exceptions_enable=False,  # a bug shows the traceback of Python, which reports can quote
)
pictures = typer.Typer(
    cls=_PlotGroup, help="Draw a run, map its coverage, or make a video: plot RUN, map, video."
)
_console = Console()
# Warnings, errors and progress: what a command prints on standard output can be piped.
_errors = Console(stderr=True)


def _show_version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"caviar {metadata.version(DISTRIBUTION)}")
        raise typer.Exit


@app.callback()
def caviar(
    version: Annotated[
        bool,
        typer.Option("--version", help="Show the version and exit.", callback=_show_version, is_eager=True),
    ] = False,
) -> None:
    """Co-simulation of machine-learning-based 6G in virtual worlds."""


def _started_anew(resume: Path | None, scenario: Path | None, *others: object) -> Path:
    """The scenario of a run that is started anew; refuses what does not go together with ``--resume``."""
    if resume is not None and any(value is not None for value in (scenario, *others)):
        raise RunError(
            "a run goes on as it began: --resume takes no scenario, frames, seed, --embedded or --attach"
        )
    if resume is None and scenario is None:
        raise RunError(
            "give a scenario, by name (caviar scenarios) or file, or --resume with the directory of a run"
        )
    return scenario or Path()


@command(RUN, AttachingCommand)
def run(
    scenario: ScenarioOrNone = None,
    frames: Frames = None,
    episodes: Episodes = None,
    seed: Seed = None,
    set_: Set = None,
    record: Record = None,
    json: SummaryFile = None,
    out: RunsFolder = Path("runs"),
    bind: Annotated[
        str,
        typer.Option(help="address of the broker; port 0: any; default: a private socket, or any port"),
    ] = "",
    embedded: Embedded = False,
    pace: Pace = None,
    keys: Keys = None,
    http: Http = "",
    view: Annotated[
        bool, typer.Option("--view", help="show the run in 3D: print the page's address, open a browser")
    ] = False,
    attach: Attach = None,
    resume: Resume = None,
    force: Force = False,
) -> None:
    """Run a scenario: the broker and every service as processes of their own, or all in this one."""
    with loading():
        from caviar_clients.cli.run import resume_run, run_scenario

    keys_given = keys_set(set_, record, episodes)
    source = _started_anew(
        resume, scenario, frames, seed, embedded or None, pace, attach or None, keys_given or None
    )
    if resume is not None:
        ended = resume_run(resume, _console, json, bind, keys, http, force=force)
    else:
        ended = run_scenario(
            source, out, _console, frames, seed, json, bind, embedded, keys, http, pace,
            attach or (), keys_given, view,
        )  # fmt: skip
    raise typer.Exit(ended.status)


@command(LOOK)
def view(
    source: Shown,
    beside: Annotated[
        Path | None, typer.Option(help="a second run, at the same time and from the same place")
    ] = None,
    save: Annotated[
        Path | None, typer.Option(help="write one HTML file that opens without a server, and serve nothing")
    ] = None,
    limit: Annotated[
        float,
        typer.Option(min=0.5, help="MB of that file: fewer frames, points and pixels where it needs them"),
    ] = 25.0,
    picture: Annotated[
        Path | None, typer.Option(help="write one PNG of the page, by a Chromium without a window")
    ] = None,
    link: Annotated[
        str, typer.Option(help="link to the page, or its part from # on, that says what is seen")
    ] = "",
    size: Annotated[str, typer.Option(metavar="WIDTHxHEIGHT", help="of the picture, in px")] = "1280x720",
    episode: Annotated[int | None, typer.Option(min=0, help="of a dataset; default: its first")] = None,
    http: Annotated[str, typer.Option(help="HOST:PORT to serve at; port 0: any free one")] = "127.0.0.1:0",
    keys: Keys = None,
    browser: Annotated[bool, typer.Option(help="open a browser, where there is one")] = True,
    foxglove: Annotated[
        int | None,
        typer.Option(min=0, max=65535, help="port at which Foxglove gets a run that goes on; 0: any"),
    ] = None,
) -> None:
    """Show a run, an episode or a scenario in 3D in a browser: rays, beams, sensors, clock and curves."""
    from caviar_clients.cli import view as viewer

    if foxglove is not None:
        viewer.view_in_foxglove(source, foxglove)
    elif picture is not None:
        viewer.take_picture(source, picture, link, size, episode)
        typer.echo(picture)
    else:
        viewer.view(source, beside, http, keys, save, limit, episode, browser)


@command(RUN)
def scenarios() -> None:
    """List the scenarios that ship: what each is, and which extras it needs."""
    from caviar_clients.cli.scenarios import list_scenarios

    list_scenarios(_console)


@command(RUN)
def new(
    name: Annotated[str, typer.Argument(help="name of the scenario, or path of its file")],
    scene: Annotated[
        Path | None,
        typer.Option(help="folder of an imported scene: traffic, people, base stations and a UAV in it"),
    ] = None,
) -> None:
    """Write a scenario of your own to edit, with comments; it runs as it is, on the base install."""
    from caviar_clients.cli.scenarios import new_scenario

    path = new_scenario(name, scene)
    typer.echo(f"{path} is a scenario to edit; run it with: caviar run {path}")


@command(RUN)
def schema(
    out: Annotated[Path | None, typer.Option(help="write the schema to this file")] = None,
) -> None:
    """Print the JSON Schema of scenario files, with which an editor completes and checks them."""
    import json

    from caviar_clients.files import write_file
    from caviar_services.registry import scenario_schema

    text = json.dumps(scenario_schema(), indent=1, ensure_ascii=False)
    if out is None:
        typer.echo(text)
    else:
        write_file(out, text + "\n")


@command(OPERATE)
def broker(
    scenario: ScenarioOrNone = None,
    bind: Annotated[
        str,
        typer.Option(help="address to listen on; by default port 5570 of this machine, or as before"),
    ] = "",
    frames: Frames = None,
    seed: Seed = None,
    out: RunsFolder = Path("runs"),
    pace: Pace = None,
    keys: Keys = None,
    http: Http = "",
    resume: Resume = None,
    force: Force = False,
    restarted: Restarted = False,
) -> None:
    """Run only the broker; start the services with `caviar service`, here or on other machines."""
    from caviar_clients.cli.remote import resume_broker, serve_broker

    source = _started_anew(resume, scenario, frames, seed, pace)
    # The options that a new and a resumed run share, as the broker's own command line has them.
    options = ["--bind", bind] + (["--keys", str(keys)] if keys else []) + ["--restarted"] * restarted
    options += (["--http", http] if http else []) + ["--force"] * force
    if resume is not None:
        raise typer.Exit(resume_broker(resume, options))
    raise typer.Exit(serve_broker(source, out, frames, seed, pace, bind, keys, options))


@command(OPERATE)
def service(
    name: Annotated[str, typer.Argument(help="name of the service in the scenario")],
    use: Annotated[str, typer.Option(help="implementation, as ROLE:NAME, for example channel:sionna-rt")],
    broker: Annotated[str, typer.Option(help="address of the broker")] = "tcp://127.0.0.1:5570",
    connect_timeout: Annotated[
        float, typer.Option(min=0.0, help="seconds to wait for the broker, which may start later")
    ] = 30.0,
    key: Annotated[
        Path | None, typer.Option(help="secret key of this service, NAME.key", envvar="CAVIAR_KEY")
    ] = None,
    broker_key: Annotated[
        Path | None, typer.Option(help="public key of the broker, broker.pub", envvar="CAVIAR_BROKER_KEY")
    ] = None,
    restarted: Restarted = False,
) -> None:
    """Run one service and connect it to a broker."""
    from caviar_services.runner import serve

    # At once: a service that waits says nothing else until the broker is there.
    limit = f"for at most {connect_timeout:g} s (--connect-timeout)"
    typer.echo(f"service {name}: waiting for the broker at {broker}, {limit}", err=True)
    raise typer.Exit(serve(name, use, broker, connect_timeout, key, broker_key, restarted=restarted))


@command(LOOK)
def status(
    run: Annotated[
        Path | None, typer.Argument(help="directory of a run; by default the newest in ./runs")
    ] = None,
) -> None:
    """Ask a running broker which services it waits for now, and why."""
    from caviar_clients.cli.remote import why_command

    why_command(run, _console)


@command(OPERATE)
def doctor(
    run: Annotated[Path | None, typer.Argument(help="directory of a damaged run", show_default=False)] = None,
    warm: Annotated[
        bool,
        typer.Option("--warm", help="compile the channel's loops, for which a first run else waits"),
    ] = False,
) -> None:
    """Check what this machine has, or say what of a damaged RUN can be read, and save that beside it."""
    if run is not None:
        from caviar_clients.cli.recordings import rescue_run

        raise typer.Exit(rescue_run(run, _console))
    from caviar_clients.cli import doctor as checks

    if warm:
        checks.warm(_console)
    found = checks.doctor()
    checks.render(found, _console)
    raise typer.Exit(checks.exit_status(found))


@command(LOOK)
def inspect(
    run: RunDirectory,
    digest: Annotated[bool, typer.Option("--digest", help="only the digest, from the payloads")] = False,
    json: Annotated[bool, typer.Option("--json", help="as JSON")] = False,
) -> None:
    """Say what a recording holds, or recompute its digest."""
    from caviar_clients.cli.recordings import inspect_command

    raise typer.Exit(inspect_command(run, digest, json))


@pictures.command("run")
def plot(
    run: RunDirectory,
    out: Annotated[
        Path | None, typer.Option(help="folder that the PNGs go into; by default the run's")
    ] = None,
    frame: Annotated[int | None, typer.Option(help="frame of map, scan and images")] = None,
    user: Annotated[str | None, typer.Option(help="receiver whose |y| and paths are drawn")] = None,
    camera: Annotated[
        str | None, typer.Option(help="camera whose images are drawn, in files with its name")
    ] = None,
    style: Annotated[
        Literal["screen", "paper"],
        typer.Option(help="screen: PNG; paper: PDF and SVG of one and of two columns, and CSV"),
    ] = "screen",
) -> None:
    """Draw a run: its map with rays and beam, |y|, delay spread, frequency response, LIDAR and cameras."""
    from caviar_clients.cli.plot import plot_run
    from caviar_clients.plots.style import paper_style

    with paper_style() if style == "paper" else nullcontext():
        for picture in plot_run(run, out, frame, user, camera):
            typer.echo(picture)


@pictures.command("map")
def radio_map(
    source: ScenarioOrRun,
    metric: Annotated[
        list[str] | None,
        typer.Option(help="gain, rss, sinr or best-server; by default gain; may be repeated"),
    ] = None,
    height: Annotated[float, typer.Option(help="of the cells above the ground, in m")] = 1.5,
    cell: Annotated[float, typer.Option(help="side of a cell, in m")] = 5.0,
    surface: Annotated[
        str,
        typer.Option(help="plane, ground, or a piece of scenery by its name, over which the cells follow"),
    ] = "plane",
    area: Annotated[
        tuple[float, float, float, float] | None,
        typer.Option(help="lowest x and y, highest x and y, in m; by default all of the scenery"),
    ] = None,
    frame: Annotated[int, typer.Option(min=0, help="instant of the first episode that is mapped")] = 0,
    carrier: Annotated[str | None, typer.Option(help="by its name; by default the first")] = None,
    beam: Annotated[
        str, typer.Option(help="best of the codebook for each cell, wide (one element), or a beam's number")
    ] = "best",
    samples: Annotated[
        int, typer.Option(min=1000, max=1_000_000_000, help="rays of each transmitter")
    ] = 10_000_000,
    memory_gib: Annotated[float, typer.Option(min=0.05, help="memory that it may take, in GiB")] = 2.0,
    out: Annotated[
        Path | None,
        typer.Option(
            help="PNG; the arrays go beside it as .npz; by default radio-map.png, here or in the run"
        ),
    ] = None,
) -> None:
    """Map best server, path gain, received power and SINR over a plane or the ground."""
    from caviar_clients.cli.radio_map import MapOptions, beam_choice, draw_radio_map

    metrics = tuple(dict.fromkeys(metric or ("gain",)))
    options = MapOptions(
        metrics=metrics, height=height, cell=cell, surface=surface, area=area, frame=frame, carrier=carrier,
        beam=beam_choice(beam), samples=samples, memory_gib=memory_gib,
    )  # fmt: skip
    for file in draw_radio_map(source, out, options, _errors):
        typer.echo(file)


@pictures.command()
def video(
    run: RunDirectory,
    out: Annotated[
        Path | None,
        typer.Option(help=".mp4 (needs ffmpeg) or .gif; by default into the run, .mp4 if there is ffmpeg"),
    ] = None,
    fps: Annotated[
        float | None, typer.Option(help="frames shown a second; by default real time, from 5 to 30")
    ] = None,
    frames: Annotated[str | None, typer.Option(help="A:B, frames A to B - 1 of the first episode")] = None,
    camera: Annotated[str | None, typer.Option(help="camera whose pictures are shown")] = None,
    width: Annotated[int | None, typer.Option(help="pixels, even; by default 1280, of a GIF 960")] = None,
    user: Annotated[str | None, typer.Option(help="receiver whose |y| and beam are shown")] = None,
    link: Annotated[
        str | None,
        typer.Option(help="film the page of caviar view as this link to it shows it, such as '#panel=0'"),
    ] = None,
) -> None:
    """Make a video of a run: map with rays and beam, |y| over time, a camera; or the page of caviar view."""
    from caviar_clients.cli.plot import film_run

    film = film_run(run, out, fps, frames, camera, width, user, _errors, link)
    pace = f"{film.fps:g} frames/s, {film.speed:.3g} times real time"
    typer.echo(f"{film.file}: {film.frames} frames of {film.size[0]}×{film.size[1]}, {pace}")


@command(RUN)
def replay(
    run: RunDirectory,
    replace: Annotated[
        list[str] | None, typer.Option(help="SERVICE=IMPLEMENTATION, by name or role; may be repeated")
    ] = None,
    set_: Annotated[
        list[str] | None, typer.Option("--set", help="SERVICE.SETTING=VALUE; may be repeated")
    ] = None,
    keep: Annotated[list[str] | None, typer.Option(help="service that runs again as recorded")] = None,
    recorded: Annotated[
        list[str] | None, typer.Option(help="service served as recorded, though what it takes has changed")
    ] = None,
    again: Annotated[bool, typer.Option("--again", help="run everything again, decisions imposed")] = False,
    frames: Annotated[int | None, typer.Option(min=1, help="only the first frames of each episode")] = None,
    json: SummaryFile = None,
    out: RunsFolder = Path("runs"),
    embedded: Embedded = False,
) -> None:
    """Run a recorded world again: products served as recorded, but of what is replaced and what follows."""
    from caviar_clients.cli.recordings import replay_run

    status = replay_run(
        run, out, _console, replace=replace or (), settings=set_ or (), keep=keep or (),
        recorded=recorded or (), again=again, frames=frames, json_file=json, embedded=embedded,
    )  # fmt: skip
    raise typer.Exit(status)


app.add_typer(pictures, name="plot", rich_help_panel=LOOK)


def _show_warning(message: Warning | str, *_: object, **__: object) -> None:
    _errors.print(Text.assemble(("caviar: warning:", "yellow"), f" {message}"), soft_wrap=True)


def _give_again(lost: Any) -> None:
    """Give an order to end again that came while an object was finalised: Python ignores it there."""
    if lost.exc_type is KeyboardInterrupt:
        again = threading.Timer(0.1, _thread.interrupt_main)
        again.daemon = True
        again.start()
    else:
        sys.__unraisablehook__(lost)


def main() -> None:
    """Entry point: errors meant for the user become one line and status 1, warnings a line."""
    warnings.showwarning = _show_warning
    sys.unraisablehook = _give_again
    # As Ctrl-C, so that temporary folders and child processes are not left; one that is ignored stays so.
    for order in (signal.SIGTERM, signal.SIGHUP):
        if signal.getsignal(order) is signal.SIG_DFL:
            signal.signal(order, signal.default_int_handler)
    try:
        app()
    except CaviarError as error:
        # A message may hold what a user wrote, with brackets: assembled, it is no markup.
        _errors.print(Text.assemble(("caviar:", "red"), f" {error}"), soft_wrap=True)
        sys.exit(1)
    except KeyboardInterrupt:
        sys.exit(130)  # 128 + SIGINT, as a shell has it
