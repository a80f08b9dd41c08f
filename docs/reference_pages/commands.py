"""The commands of `caviar`: a page for each, from the parser of its arguments."""

from __future__ import annotations

import inspect
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Literal, get_args, get_origin

import typer

from caviar_clients.cli.main import app
from caviar_protocol import spec

from . import markdown


def pages() -> Iterator[tuple[str, str]]:
    """File name and text of each page."""
    # The parser itself and not the text of --help: options have their types and ranges there.
    root: Any = typer.main.get_command(app)
    context = root.context_class(root, info_name="caviar")
    groups: dict[str, list[tuple[str, str]]] = {}
    for name in root.list_commands(context):  # without the hidden ones, which are former names
        command = root.get_command(context, name)
        groups.setdefault(command.rich_help_panel, []).append((name, command.get_short_help_str(400)))
        yield f"{name}.md", "\n".join(_command(command, context, f"caviar {name}", 1))
    lines = ["# Commands", "", "What `caviar COMMAND -h` prints of every command.", ""]
    for group, found in groups.items():
        cells = [(f"[{name}]({name}.md)", text) for name, text in found]
        lines += [f"## {group}", "", *markdown.table(("command", "what it does"), cells)]
    names = [name for found in groups.values() for name, _ in found]
    yield "index.md", "\n".join([*lines, *markdown.toctree(names, ":hidden:")])


def _command(command: Any, parent: Any, path: str, level: int) -> Iterator[str]:
    """A command with its arguments and options, and below it its own commands."""
    context = command.context_class(command, info_name=path.rpartition(" ")[2], parent=parent)
    usage = " ".join([path, *command.collect_usage_pieces(context)])
    yield from ("#" * level + f" {path}", "", spec.markdown(inspect.cleandoc(command.help or "")), "")
    yield from ("```text", usage, "```", "")
    shown = [p for p in command.get_params(context) if p.name != "help" and not getattr(p, "hidden", False)]
    for kind in ("argument", "option"):
        found = [_row(parameter) for parameter in shown if parameter.param_type_name == kind]
        if found:
            yield from markdown.table((kind, "default", "meaning"), found)
    for name in command.list_commands(context) if hasattr(command, "list_commands") else ():
        yield from _command(command.get_command(context, name), context, f"{path} {name}", level + 1)


def _row(parameter: Any) -> tuple[str, str, str]:
    if parameter.param_type_name == "argument":
        shown = f"`{parameter.metavar or parameter.name.upper()}`"
    else:
        shown = ", ".join(f"`{flag}`" for flag in (*parameter.opts, *parameter.secondary_opts))
        shown += "" if parameter.is_flag else f" {_kind(parameter)}"
    meaning = getattr(parameter, "help", None) or ""
    if parameter.envvar:
        meaning += f"; environment variable `{parameter.envvar}`"
    return shown, _default(parameter), meaning


_KINDS = {int: "INTEGER", float: "NUMBER", str: "TEXT", Path: "PATH"}


def _kind(parameter: Any) -> str:
    kind = parameter.type_descriptor.annotation
    if get_origin(kind) is Literal:
        return " or ".join(f"`{word}`" for word in get_args(kind))
    kind = next(iter(get_args(kind)), kind)  # of a list, its element
    low, high = parameter.min, parameter.max
    bounds = [f"≥ {low:g}"] if low is not None else []
    # 2^31 is a bound of the parser, and no property of the option.
    bounds += [f"≤ {high:g}"] if high is not None and high < 2**31 else []
    return " ".join([_KINDS[kind], *bounds]) + (" …" if parameter.multiple else "")


def _default(parameter: Any) -> str:
    if isinstance(parameter.show_default, str):
        return parameter.show_default
    if parameter.required:
        return "required"
    if isinstance(parameter.default, bool):
        return "yes" if parameter.default else "no"
    return "" if parameter.default in (None, "") or callable(parameter.default) else f"`{parameter.default}`"
