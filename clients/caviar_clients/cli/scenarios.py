"""``caviar scenarios`` and ``caviar new``; arguments that several commands share."""

from __future__ import annotations

import re
from importlib import resources
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.table import Table
from rich.text import Text

from caviar_protocol.errors import RunError, SetupError
from caviar_protocol.host import has_extra, install_command
from caviar_protocol.scenario import Scenario, ServiceSpec, load_scenario, shipped_scenarios
from caviar_services.registry import load

TEMPLATE = "new/scenario.toml"
"""The scenario that `caviar new` writes, in the package of scenarios."""
_TEMPLATE_NAME = 'name = "my-scenario"'
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.-]*")


def description(text: str) -> str:
    """What a scenario is: the first sentence of the comment at the head of its file."""
    lines = []
    for line in text.splitlines():
        comment = line.removeprefix("#").strip()
        if not line.startswith("#") or not comment:
            break
        lines.append(comment)
    return re.split(r"(?<=\.) (?=[A-Z])", " ".join(lines), maxsplit=1)[0].rstrip(".")


def extras_of(scenario: Scenario) -> tuple[str, ...]:
    """Extras of the distribution that the services of a scenario need, in order of name.

    Remote services need theirs where they run.
    """
    return tuple(sorted(set().union(*(_extras(spec) for spec in scenario.services.values()))))


def _extras(spec: ServiceSpec) -> set[str]:
    if spec.remote:
        return set()
    found = {load(spec.role, spec.use).extra}
    scenery = spec.settings.get("scenery", "")
    if isinstance(scenery, str) and scenery.startswith("sionna:"):
        found.add("world")
    ladder, reference = spec.settings.get("ladder", ()), spec.settings.get("reference")
    for rung in (*ladder, *([reference] if reference else [])):  # models that an adaptive channel has
        found.add(load(spec.role, rung.get("use", "sionna-rt")).extra)
    return found - {""}


def require_extras(scenario: Scenario) -> None:
    """Raise `SetupError` with one command that installs every extra which a scenario needs and that lacks."""
    missing = [extra for extra in extras_of(scenario) if not has_extra(extra)]
    if missing:
        raise SetupError(
            f"scenario {scenario.run.name!r} needs what is not installed ({', '.join(missing)}); "
            f"run: {install_command(*missing)}"
        )


def list_scenarios(console: Console) -> None:
    """Print the scenarios that ship, each with a line and the extras that it needs."""
    table = Table(box=None, pad_edge=False)
    table.add_column("name", no_wrap=True)
    table.add_column("what it is", overflow="fold")
    table.add_column("needs", overflow="fold")
    lacking: set[str] = set()
    for name, path in shipped_scenarios().items():
        extras = extras_of(load_scenario(path))
        lacking.update(extra for extra in extras if not has_extra(extra))
        table.add_row(name, Text(description(path.read_text())), _needs(extras))
    console.print(table)
    console.print("\ncaviar run NAME runs one; caviar new NAME writes one of your own to edit.")
    if lacking:
        console.print("[yellow]*[/] is not installed; what installs all of it:")
        console.print(f"  {install_command(*sorted(lacking))}", soft_wrap=True, markup=False, highlight=False)


def _needs(extras: tuple[str, ...]) -> Text:
    if not extras:
        return Text("base install")
    marks = [(extra if has_extra(extra) else f"{extra}*") for extra in extras]
    text = Text(", ".join(marks))
    text.highlight_regex(r"\*", "yellow")
    return text


def complete_scenario(incomplete: str) -> list[tuple[str, str]]:
    """Names of shipped scenarios that begin so, for completion in a shell, which adds files by itself."""
    return [
        (name, description(path.read_text()))
        for name, path in shipped_scenarios().items()
        if name.startswith(incomplete)
    ]


def new_scenario(name: str) -> Path:
    """Write a commented scenario to edit: ``NAME.toml`` in this folder, or the path that ``name`` is.

    Raises `RunError` where the file exists or cannot be written, or the name is none of a run or that of
    another kind of file.
    """
    path = Path(name if name.endswith(".toml") else f"{name}.toml")
    suffix = Path(name).suffix
    if suffix != ".toml" and suffix[1:2].isalpha():  # not the ".2" of v1.2
        raise RunError(f"a scenario is a TOML file, not {suffix}: write {Path(name).with_suffix('.toml')}")
    if _NAME.fullmatch(path.stem) is None:
        raise RunError(f"{path.stem!r} is no name of a scenario: use letters, digits, '_', '.' and '-'")
    text = (resources.files("caviar_scenarios") / TEMPLATE).read_text()
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with path.open("x", encoding="utf-8") as file:
            file.write(text.replace(_TEMPLATE_NAME, f'name = "{path.stem}"', 1))
    except OSError as error:
        if path.is_file():
            raise RunError(f"{path} is there already: choose another name, or remove it") from error
        raise RunError(f"cannot write {path}: {error.strerror}; choose another folder") from error
    return path


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
