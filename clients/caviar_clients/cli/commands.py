"""Commands of `caviar` by name: its own, former names, and those that entry points add; added options.

A distribution adds a command with an entry point of the group ``caviar.commands``. Its name is what is typed
after ``caviar``; its value, ``module:object``, is a function for Typer, or a ``typer.Typer``, which becomes a
group of commands. The module is imported when the command is typed, and for the list of ``caviar -h``: slow
imports stand in the function. A name that `caviar` itself has is not replaced.
"""

from __future__ import annotations

import inspect
import pkgutil
from collections.abc import Callable
from functools import cache
from importlib.metadata import EntryPoint
from typing import Any, TypeVar

import typer
from rich.markup import escape
from typer.core import TyperCommand, TyperGroup, TyperOption
from typer.main import get_command_from_info, get_group, solve_typer_info_help
from typer.models import CommandInfo, TyperInfo

from caviar_protocol.errors import DeclarationError, one_line
from caviar_protocol.host import DISTRIBUTION
from caviar_protocol.plugins import claims, plugins

PANELS = RUN, LOOK, DATASETS, POLICIES, OPERATE, LABORATORIES, PLUG_INS = (
    "Run", "Look at a run", "Datasets", "Policies", "Operate", "Laboratories", "Plug-ins"
)  # fmt: skip
"""Panels of commands in the help, in their order."""

ENTRY_POINT_GROUP = "caviar.commands"

GROUPS = {
    "dataset": (
        DATASETS, "caviar_clients.cli.datasets:app", "Datasets: generate, look, verify, tables."
    ),
    "policy": (
        POLICIES, "caviar_clients.cli.learning:app", "Trained policies: train, evaluate, export, swap."
    ),
    "keys": (OPERATE, "caviar_clients.cli.keys:app", "Keys: who may take part in a run, and as what."),
}  # fmt: skip
"""Panel, place and help of groups that are imported when one of their commands is typed."""

F = TypeVar("F", bound=Callable[..., None])
_own: dict[str, CommandInfo] = {}


def command(panel: str, cls: type[TyperCommand] = TyperCommand) -> Callable[[F], F]:
    """Make a function a command of `caviar` itself, by its name; what it takes is looked at when it is typed.

    Args:
        panel: Panel in the help.
        cls: Of the command.
    """

    def keep(function: F) -> F:
        name = function.__name__
        _own[name] = CommandInfo(name, cls=cls, callback=function, rich_help_panel=panel)
        return function

    return keep


_OWN_PANELS = {"caviar_labs": LABORATORIES, "caviar_formats": DATASETS, "caviar_scenes": RUN}

FORMER = {
    "generate": "dataset generate", "look": "dataset look", "verify": "dataset verify",
    "tables": "dataset tables", "train": "policy train", "evaluate": "policy evaluate",
    "export-policy": "policy export", "swap": "policy swap", "budget": "measure budget",
    "tradeoff": "measure tradeoff", "stability": "measure stability", "bench": "measure bench",
    "map": "plot map", "video": "plot video", "why": "status",
}  # fmt: skip
"""Names that commands had before they were in groups: they go on, and no help shows them."""


class LazyGroup(TyperGroup):
    """Group of commands that is known by name, and imported when one of its commands is asked for.

    Args:
        name: What is typed.
        panel: Panel in the help.
        target: ``module:object``, a ``typer.Typer``.
        help: What the help says of it.
    """

    def __init__(self, name: str, panel: str, target: str, help: str) -> None:  # noqa: A002 - Typer's name
        super().__init__(name=name, help=help, rich_help_panel=panel, no_args_is_help=True)
        self._target = target

    def list_commands(self, ctx: Any) -> list[str]:
        if not self.commands:
            self.commands.update(get_group(pkgutil.resolve_name(self._target)).commands)
        return super().list_commands(ctx)

    def get_command(self, ctx: Any, cmd_name: str) -> Any:
        self.list_commands(ctx)
        return super().get_command(ctx, cmd_name)


class Commands(TyperGroup):
    """Group of all commands, listed by their panels. Entry points are read for names that are not its own."""

    def __init__(self, **attributes: Any) -> None:
        super().__init__(**attributes)
        self.commands.update({name: LazyGroup(name, *entry) for name, entry in GROUPS.items()})

    def format_help(self, ctx: Any, formatter: Any) -> None:
        for name, info in _own.items():  # their options, which are not shown, take as long as all the rest
            text = inspect.getdoc(info.callback)
            self.commands[name] = TyperCommand(name, help=text, rich_help_panel=info.rich_help_panel)
        super().format_help(ctx, formatter)

    def list_commands(self, ctx: Any) -> list[str]:
        names = dict.fromkeys([*_own, *self.commands, *sorted(added())])
        shown = {name: self.get_command(ctx, name) for name in names if name not in FORMER}
        return sorted(shown, key=lambda name: PANELS.index(shown[name].rich_help_panel))

    def get_command(self, ctx: Any, cmd_name: str) -> Any:
        first, *rest = FORMER.get(cmd_name, cmd_name).split(" ")
        if first in _own and first not in self.commands:
            self.commands[first] = get_command_from_info(
                _own[first], pretty_exceptions_short=False, rich_markup_mode=self.rich_markup_mode
            )
        found = self.commands.get(first) or added_command(first)
        return found.get_command(ctx, *rest) if rest and isinstance(found, TyperGroup) else found

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        if self.get_command(ctx, args[0]) is None:  # Typer suggests what is in self.commands
            self.commands.update({name: self.get_command(ctx, name) for name in (*_own, *FORMER, *added())})
        return super().resolve_command(ctx, args)


@cache
def added() -> dict[str, list[EntryPoint]]:
    """Entry points by the command that they add: one, or those of all distributions that claim the name."""
    found: dict[str, list[EntryPoint]] = {}
    for point in claims(ENTRY_POINT_GROUP):
        found.setdefault(point.name, []).append(point)
    # A name that one claims needs no look at whose it is, which reads the metadata of that distribution.
    return {
        name: (len(points) > 1 and [p for p in points if _is_own(p)]) or points
        for name, points in found.items()
    }


@cache
def added_command(name: str) -> Any:
    """Load the command that an entry point adds.

    Args:
        name: What is typed.

    Returns:
        The command; None: no distribution adds one of this name. One that cannot be loaded says so in its
        help, and raises `DeclarationError` when it runs.
    """
    points = added().get(name)
    if points is None:
        return None
    panel = _OWN_PANELS.get(points[0].module.partition(".")[0], PLUG_INS)
    if len(points) > 1:
        return _refusing(name, panel, f"{name} is {_sources(points)}; uninstall one of them")
    holder = typer.Typer()
    try:
        loaded = points[0].load()
        if isinstance(loaded, typer.Typer) and panel != PLUG_INS:
            return LazyGroup(name, panel, points[0].value, solve_typer_info_help(TyperInfo(loaded)))
        if isinstance(loaded, typer.Typer):
            holder.add_typer(loaded, name=name, rich_help_panel=panel)
        else:
            holder.command(name, rich_help_panel=panel)(loaded)
        return get_group(holder).commands[name]
    except (Exception, SystemExit) as error:  # whatever a module of others does when it is imported
        reason = f"{type(error).__name__}: {one_line(str(error))}"
        return _refusing(name, panel, f"{name} is {_sources(points)}, which cannot be loaded: {reason}")


def _sources(points: list[EntryPoint]) -> str:
    return " and ".join(f"{p.value} of {p.dist.name} {p.dist.version}" for p in points if p.dist)


def _is_own(point: EntryPoint) -> bool:
    return point.dist is not None and point.dist.name == DISTRIBUTION


def _refusing(name: str, panel: str, text: str) -> TyperCommand:
    """A command that shows ``text`` in the help, and raises it whatever its arguments are."""

    def refuse() -> None:
        raise DeclarationError(text)

    anything = {"ignore_unknown_options": True, "allow_extra_args": True}
    return TyperCommand(
        name, callback=refuse, help=escape(text), rich_help_panel=panel, context_settings=anything
    )


class _Alias(TyperOption):
    """``--NAME VALUE``, for ``--attach NAME=VALUE``.

    Args:
        attach: The option ``--attach``, of which it is a copy.
        attachment: ``NAME``.
    """

    def __init__(self, attach: Any, attachment: str) -> None:
        vars(self).update(vars(attach))  # Typer's own arguments are not the same in all of its versions
        self.attachment, self.name, self.opts = attachment, f"attach_{attachment}", [f"--{attachment}"]
        self.metavar = "VALUE"

    @property
    def help(self) -> str:  # type: ignore[override]
        """First line of the attachment's docstring; its module is imported where that is shown."""
        from caviar_protocol.scenario import summary

        return summary(self.attachment)


class AttachingCommand(TyperCommand):
    """A command with ``--attach``, and an alias of it for each attachment that is installed."""

    def get_params(self, ctx: Any) -> list[Any]:
        """List the parameters, with the aliases after ``--attach``."""
        from caviar_protocol.scenario import ATTACHMENTS

        found = super().get_params(ctx)
        taken = {flag for parameter in found for flag in parameter.opts}
        at = next(i for i, parameter in enumerate(found) if parameter.name == "attach")
        names = [name for name in plugins(ATTACHMENTS) if f"--{name}" not in taken]
        return [*found[: at + 1], *(_Alias(found[at], name) for name in names), *found[at + 1 :]]

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Parse the command line; the values of aliases become those of ``--attach``."""
        rest = super().parse_args(ctx, args)
        for alias in self.get_params(ctx):
            if isinstance(alias, _Alias):
                values = [f"{alias.attachment}={value}" for value in ctx.params.pop(alias.name) or ()]
                ctx.params["attach"] = [*(ctx.params["attach"] or ()), *values]
        return rest
