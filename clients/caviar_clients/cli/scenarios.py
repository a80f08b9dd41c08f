"""``caviar scenarios`` and ``caviar new``: the scenarios that ship, and the beginning of one's own."""

from __future__ import annotations

import re
from importlib import resources
from pathlib import Path
from pkgutil import resolve_name

import typer
from rich.console import Console
from rich.table import Column, Table
from rich.text import Text

from caviar_clients.cli.shared import description, print_line, require_installed
from caviar_clients.session.prepared import PreparedScenario, PreparedService, implemented
from caviar_protocol.errors import RunError
from caviar_protocol.host import has_extra, install_command
from caviar_protocol.plugins import plugins
from caviar_protocol.scenario import Scenario, load_scenario, shipped_scenarios
from caviar_services.registry import load

TEMPLATE = "new/scenario.toml"
"""The scenario that `caviar new` writes, in the package of scenarios."""
# Of a package above this one, which knows the scenes that are imported.
_TOWN = "caviar_scenes.town:new_town"
_TEMPLATE_NAME = 'name = "my-scenario"'
# A name of a run becomes part of a directory's name and of ids on the wire.
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.-]*")


def extras_of(scenario: Scenario | PreparedScenario) -> tuple[str, ...]:
    """Name the extras of the distribution that the services of a scenario need, in alphabetical order.

    Remote services need theirs where they run.
    """
    return tuple(sorted(set().union(*map(_extras, implemented(scenario).services.values()))))


def _extras(service: PreparedService) -> set[str]:
    spec, found = service.spec, {service.cls.extra}
    # Scenes of Sionna are part of a package that both `world` and `channel` bring.
    scenery = spec.settings.get("scenery", "")
    if isinstance(scenery, str) and scenery.startswith("sionna:"):
        found.add("channel" if has_extra("channel") and not has_extra("world") else "world")
    if spec.settings.get("rate_model") == "nr":  # of the link `cell`
        found.add("system")
    if flown := spec.settings.get("flown", ()):  # perhaps quadrotors
        from caviar_services.world.quadrotor.airframe import PLANTS, plant_named

        engines = {each.get("engine") for each in flown}
        found.update(plant_named(engine).extra for engine in engines & plugins(PLANTS).keys())
    ladder, reference = spec.settings.get("ladder", ()), spec.settings.get("reference")
    for rung in (*ladder, *([reference] if reference else [])):  # models that an adaptive channel has
        found.add(load(spec.role, rung.get("use", "sionna-rt")).extra)
    return found - {""}


def require_extras(scenario: Scenario | PreparedScenario) -> None:
    """Refuse a scenario for which an extra is not installed.

    Raises:
        SetupError: An extra is missing; the text has one command that installs all that are.
    """
    prepared = implemented(scenario)
    require_installed(f"scenario {prepared.scenario.run.name!r}", extras_of(prepared))


def list_scenarios(console: Console) -> None:
    """Print the scenarios that ship, each with a line and the extras that it needs."""
    columns = (Column(name, overflow="fold") for name in ("what it is", "needs"))
    table = Table(Column("name", no_wrap=True), *columns, box=None, pad_edge=False)
    lacking: set[str] = set()
    for name, path in shipped_scenarios().items():
        extras = extras_of(load_scenario(path))
        lacking.update(extra for extra in extras if not has_extra(extra))
        table.add_row(name, Text(description(path.read_text())), _needs(extras))
    console.print(table)
    console.print("\ncaviar run NAME runs one; caviar new NAME writes one of your own to edit.")
    if lacking:
        console.print("[yellow]*[/] is not installed; what installs all of it:")
        print_line(console, f"  {install_command(*sorted(lacking))}")


def _needs(extras: tuple[str, ...]) -> Text:
    if not extras:
        return Text("base install")
    text = Text(", ".join(extra if has_extra(extra) else f"{extra}*" for extra in extras))
    text.highlight_regex(r"\*", "yellow")
    return text


def new_scenario(name: str, scene: Path | None = None) -> Path:
    """Write a commented scenario to edit.

    Args:
        name: Of the scenario, for ``NAME.toml`` in this folder, or the path of a file ``….toml``.
        scene: Folder of an imported scene, on whose streets it is; None: it has boxes alone.

    Returns:
        The file.

    Raises:
        RunError: The file exists or cannot be written, or the name is none of a run or that of another kind
            of file.
        AssetError: The folder is no scene, or its network is damaged.
        SetupError: SUMO is not installed.
    """
    path = Path(name if name.endswith(".toml") else f"{name}.toml")
    suffix = Path(name).suffix
    if suffix != ".toml" and suffix[1:2].isalpha():  # not the ".2" of v1.2
        raise RunError(f"a scenario is a TOML file, not {suffix}: write {Path(name).with_suffix('.toml')}")
    if _NAME.fullmatch(path.stem) is None or len(path.stem) > 100:  # its traffic is named after it
        raise RunError(
            f"{path.stem[:120]!r} is no name of a scenario: use up to 100 letters, digits, '_', '.' and '-'"
        )
    if scene is not None:
        resolve_name(_TOWN)(path, scene, say=typer.echo)
        return path
    text = (resources.files("caviar_scenarios") / TEMPLATE).read_text()
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        # Mode x: a file that another process makes meanwhile is not overwritten either.
        with path.open("x", encoding="utf-8") as file:
            file.write(text.replace(_TEMPLATE_NAME, f'name = "{path.stem}"', 1))
    except OSError as error:
        if path.is_file():
            raise RunError(f"{path} is there already: choose another name, or remove it") from error
        raise RunError(f"cannot write {path}: {error.strerror}; choose another folder") from error
    return path
