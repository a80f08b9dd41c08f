"""Shared parts of commands: arguments and options, refusals, lines and bars on the screen, result files."""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Sequence
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import msgspec
import typer
from rich.console import Console
from rich.text import Text

from caviar_clients.files import reason, write_file
from caviar_protocol.errors import RunError, SetupError, suggestion
from caviar_protocol.host import has_extra, install_command

# `caviar --help` loads this module, and bars cost 20 ms more: what few commands need is imported there.
if TYPE_CHECKING:
    from rich.progress import Progress, ProgressColumn


def description(text: str) -> str:
    """Say what a scenario is.

    Args:
        text: The scenario's file.

    Returns:
        The first sentence of the comment at the head of the file, without its full stop.

    Example:
        >>> description("# Cars drive. They turn.\\n[run]")
        'Cars drive'
    """
    lines = []
    for line in text.splitlines():
        comment = line.removeprefix("#").strip()
        if not line.startswith("#") or not comment:
            break
        lines.append(comment)
    return re.split(r"(?<=\.) (?=[A-Z])", " ".join(lines), maxsplit=1)[0].rstrip(".")


def complete_scenario(incomplete: str) -> list[tuple[str, str]]:
    """List shipped scenarios whose names begin so, for completion in a shell, which adds files by itself."""
    from caviar_protocol.scenario import shipped_scenarios

    return [
        (name, description(path.read_text()))
        for name, path in shipped_scenarios().items()
        if name.startswith(incomplete)
    ]


def _newest_run() -> Path:
    """The newest run below ``./runs``; a line on standard error says which it is."""
    from caviar_protocol.recording import newest_run

    directory = newest_run("runs")
    typer.echo(f"run {directory}, the newest in ./runs", err=True)
    return directory


# --- arguments and options -------------------------------------------------------------------------------

ScenarioOrNone = Annotated[
    Path | None,
    typer.Argument(
        help="scenario that ships, by name (caviar scenarios), or a file (TOML)",
        show_default=False,
        autocompletion=complete_scenario,
    ),
]
ScenarioOrRun = Annotated[
    Path,
    typer.Argument(
        help="scenario, by name or file, or directory of a run that recorded `scene`",
        show_default=False,
        autocompletion=complete_scenario,
    ),
]
RunDirectory = Annotated[
    Path,
    typer.Argument(
        help="directory of a run, or one segment of its recording",
        show_default="the newest in ./runs",
        default_factory=_newest_run,
    ),
]
Shown = Annotated[
    Path,
    typer.Argument(
        help="directory of a run, dataset, or scenario by name or file",
        show_default="the newest run in ./runs",
        default_factory=_newest_run,
        autocompletion=complete_scenario,
    ),
]
Frames = Annotated[int | None, typer.Option(min=1, help="frames of an episode, instead of the scenario's")]
Seed = Annotated[int | None, typer.Option(min=0, max=2**63 - 1, help="seed, instead of the scenario's")]
Pace = Annotated[
    str | None,
    typer.Option(
        help="instead of the scenario's: free (or fast, its older name), as fast as the services are; "
        "realtime, as simulated time passes; or a number, 2 for twice as fast as real time"
    ),
]
Episodes = Annotated[int | None, typer.Option(min=1, help="episodes, instead of the scenario's")]
Set = Annotated[
    list[str] | None,
    typer.Option(
        "--set",
        help="KEY=VALUE instead of the scenario's: services.channel.settings.samples=1000, or as in replay "
        "channel.samples=1000; may be repeated",
    ),
]
Record = Annotated[
    str | None, typer.Option(help="topics to record, as scene,channel.h, instead of the scenario's")
]
RunsFolder = Annotated[Path, typer.Option(help="directory in which the run's own is made")]
Embedded = Annotated[bool, typer.Option("--embedded", help="all in this process, without sockets")]
SummaryFile = Annotated[Path | None, typer.Option(help="write the summary to this file too")]
FiguresFile = Annotated[Path | None, typer.Option(help="write all figures to this file")]
Keys = Annotated[
    Path | None, typer.Option(help="keys directory: only authorized keys take part (caviar keys)")
]
Http = Annotated[str, typer.Option(help="HOST:PORT: serve status, orders and WebSocket there")]
Attach = Annotated[
    list[str] | None, typer.Option(metavar="NAME=VALUE", help="attach a service; may be repeated")
]
Resume = Annotated[Path | None, typer.Option(help="resume the run in this directory, whose broker died")]
Force = Annotated[
    bool, typer.Option("--force", help="with --resume: though code, libraries or files have changed")
]
Restarted = Annotated[
    bool,
    typer.Option("--restarted", help="for a container that is started again whenever this status is not 0"),
]


# --- refusals --------------------------------------------------------------------------------------------


def require_installed(what: str, extras: Iterable[str]) -> None:
    """Refuse work for which an extra of the distribution is not installed.

    Args:
        what: What needs the extras, as the error's subject.
        extras: Names of extras.

    Raises:
        SetupError: An extra is missing; the text has one command that installs all that are.
    """
    missing = [extra for extra in extras if not has_extra(extra)]
    if missing:
        lacking = f"{what} needs what is not installed ({', '.join(missing)})"
        raise SetupError(f"{lacking}; run: {install_command(*missing)}")


def require_known(option: str, name: str, known: Iterable[str]) -> None:
    """Refuse the value of an option that names nothing.

    Args:
        option: As the user writes it, ``--part``.
        name: Its value.
        known: What there is.

    Raises:
        RunError: ``name`` is not among ``known``; the text has the near name, or the known ones.
    """
    known = tuple(known)
    if name not in known:
        raise RunError(f"{option} {name!r} does not exist; {suggestion(name, known)}")


def keys_set(
    set_: Sequence[str] | None, record: str | None = None, episodes: int | None = None
) -> tuple[str, ...]:
    """List what options say in place of a scenario's keys, as `caviar_protocol.scenario.set_keys` reads it.

    Args:
        set_: ``KEY=VALUE`` each.
        record: Topics with commas between.
        episodes: Of the run.

    Example:
        >>> keys_set(["run.seed=3"], "scene,link", 2)
        ('run.seed=3', 'run.record=["scene", "link"]', 'run.episodes=2')
    """
    topics = [] if record is None else [json.dumps([topic.strip() for topic in record.split(",")])]
    numbers = [] if episodes is None else [f"run.episodes={episodes}"]
    return *(set_ or ()), *(f"run.record={text}" for text in topics), *numbers


def require_writable(*files: Path | None) -> None:
    """Try files of which an option has the name, before the work whose results they get.

    Raises:
        RunError: One cannot be written, or its folder does not exist; the text has file, cause and remedy.
    """
    for file in files:
        if file is not None:
            require_parent(file)
            write_file(file)


def require_parent(file: Path) -> None:
    """Refuse a file in a folder that does not exist: of a mistyped name, folders would be made silently.

    Raises:
        RunError: There is no such folder.
    """
    if not file.parent.exists():
        raise RunError(f"cannot write {file}: there is no folder {file.parent}; make it, or correct the name")


def new_run_directory(root: Path, name: str) -> Path:
    """Make the directory of a run, ``NAME-DATE-TIME``, with a number after it where that is taken.

    Args:
        root: Folder in which it is made, and which is made where it lacks.
        name: The scenario's name.

    Raises:
        RunError: The directory cannot be made; the text has place, cause and remedy.
    """
    stem = f"{name}-{datetime.now().astimezone():%Y%m%d-%H%M%S}"
    for number in range(1, 1000):
        directory = root / (stem if number == 1 else f"{stem}-{number}")
        try:
            directory.mkdir(parents=True)  # fails where another run took the name in the same second
        except FileExistsError:
            continue
        except OSError as error:
            why = reason(directory, error, "folder")
            raise RunError(f"cannot make the run's directory {directory}: {why}") from error
        return directory
    raise RunError(f"{root} has a thousand runs named {stem}; choose another directory with --out")


# --- output ----------------------------------------------------------------------------------------------


def print_line(console: Console, text: object, style: str = "") -> None:
    """Print a line as it is: Rich neither folds it, so that it can be copied, nor reads ``[…]`` as markup.

    Args:
        console: Where it is printed.
        text: The line, or what has it as text, as a path.
        style: Of Rich, as ``bold red``; empty: none.
    """
    console.print(Text(str(text), style=style), soft_wrap=True)


def progress_bar(console: Console, *columns: str | ProgressColumn, transient: bool = False) -> Progress:
    """Make a bar after the description of its task; where there is no terminal, a line every half minute.

    Args:
        console: Where it is drawn.
        columns: What stands after the bar; texts are formats of a task, as ``{task.fields[left]}``.
        transient: Whether it vanishes when it is done.
    """
    from rich.progress import BarColumn, Progress, TextColumn

    # A task may be named after what a user wrote, in which brackets are no markup.
    first = (TextColumn("{task.description}", markup=False), BarColumn())
    if console.is_interactive or console.is_jupyter:
        return Progress(*first, *columns, console=console, transient=transient)
    from caviar_clients.cli.plain_progress import PlainProgress

    return PlainProgress(*first, *columns, console=console, transient=transient)


def write_json(file: Path | None, found: Any) -> None:
    """Write a structure as indented JSON.

    Args:
        file: Where it is written; None: nowhere.
        found: What msgspec encodes: structs, lists, dictionaries, numbers.

    Raises:
        RunError: The file cannot be written; it stays as it was.
    """
    if file is not None:
        write_file(file, msgspec.json.format(msgspec.json.encode(found), indent=2).decode() + "\n")


def counted(number: int, what: str) -> str:
    """Name a number of things.

    Example:
        >>> counted(1, "frame"), counted(2, "frame")
        ('1 frame', '2 frames')
    """
    return f"{number} {what}" if number == 1 else f"{number} {what}s"


def scaled(value: float, units: Sequence[str], step: float = 1000.0) -> tuple[float, str]:
    """Express a value in a unit of a suitable size.

    Args:
        value: In the first of the units.
        units: From the smallest, each ``step`` times the one before.
        step: Ratio of neighbouring units.

    Returns:
        The value in the unit in which it is below ``step``, or in the last, and the unit.

    Example:
        >>> scaled(1536.0, ("B", "KiB", "MiB"), 1024.0)
        (1.5, 'KiB')
    """
    for unit in units[:-1]:
        if value < step:
            return value, unit
        value /= step
    return value, units[-1]
