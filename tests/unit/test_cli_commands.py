"""Commands that installed distributions add to `caviar` by entry points."""

from __future__ import annotations

import re
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import typer
from rich.text import Text
from typer.testing import CliRunner

from caviar_clients.cli import commands
from caviar_clients.cli.main import app
from caviar_protocol import plugins
from caviar_protocol.errors import DeclarationError

runner = CliRunner()
ENVIRONMENT = {"COLUMNS": "200", "TERM": "dumb"}
MODULE = """\
from typing import Annotated
import typer

def beams(count: Annotated[int, typer.Option(min=1)] = 1) -> None:
    "Count beams."
    typer.echo(f"beams: {count}")

group = typer.Typer(help="Two commands of others.")
group.command("one")(beams)
group.command("two")(beams)
number = 5
"""
Install = Callable[..., None]


@pytest.fixture
def install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Install]:
    """Installs a distribution that adds commands, which are values by name."""
    monkeypatch.syspath_prepend(str(tmp_path))
    (tmp_path / "others_commands.py").write_text(MODULE)
    (tmp_path / "others_exit.py").write_text("raise SystemExit(3)\n")

    def forget() -> None:
        plugins._all.cache_clear()
        commands.added.cache_clear()
        commands.added_command.cache_clear()

    def add(distribution: str, **values: str) -> None:
        folder = tmp_path / f"{distribution}-1.5.dist-info"
        folder.mkdir()
        (folder / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {distribution}\nVersion: 1.5\n")
        lines = (f"{name} = {value}\n" for name, value in values.items())
        (folder / "entry_points.txt").write_text("[caviar.commands]\n" + "".join(lines))
        forget()

    yield add
    forget()


def help_lines() -> list[str]:
    done = runner.invoke(app, ["-h"], env=ENVIRONMENT)
    assert done.exit_code == 0
    return done.output.splitlines()


def test_a_function_and_a_group_of_another_distribution_are_commands(install: Install) -> None:
    install("others", beams="others_commands:beams", several="others_commands:group")
    done = runner.invoke(app, ["beams", "--count", "3"])
    assert (done.exit_code, done.output) == (0, "beams: 3\n")
    assert runner.invoke(app, ["beams", "--count", "0"]).exit_code == 2
    assert runner.invoke(app, ["several", "two"]).output == "beams: 1\n"
    assert "Did you mean 'several'" in runner.invoke(app, ["severl"]).output
    lines = help_lines()
    (panel,) = (number for number, line in enumerate(lines) if "Plug-ins" in line)
    assert "Count beams." in lines[panel + 1]
    assert "Two commands of others." in lines[panel + 2]
    assert sum("Laboratories" in line for line in lines) == 1


@pytest.mark.parametrize(
    ("value", "reason"),
    [
        ("no_such_module:app", "ModuleNotFoundError: No module named 'no_such_module'"),
        ("others_commands:absent", "AttributeError: module 'others_commands' has no attribute 'absent'"),
        ("others_commands:number", "TypeError: 5 is not a callable object"),
        ("others_exit:app", "SystemExit: 3"),
    ],
)
def test_a_command_that_cannot_be_loaded_is_named_and_breaks_no_other(
    install: Install, value: str, reason: str
) -> None:
    install("others", beams="others_commands:beams", wrong=value)
    named = f"{value} of others 1.5"
    (line,) = (line for line in help_lines() if " wrong " in line)
    assert named in line
    failed = runner.invoke(app, ["wrong", "--count", "3", "x"])
    assert isinstance(failed.exception, DeclarationError)
    assert named in str(failed.exception)
    assert reason in str(failed.exception)
    assert "\n" not in str(failed.exception)
    assert runner.invoke(app, ["beams"]).exit_code == 0


def test_a_name_of_two_distributions_is_refused_and_one_of_caviar_stays(install: Install) -> None:
    counting = "others_commands:beams"
    install("others", beams=counting, paper=counting, run=counting)
    install("rivals", beams="others_commands:group")
    failed = runner.invoke(app, ["beams"])
    assert isinstance(failed.exception, DeclarationError)
    assert "of others 1.5" in str(failed.exception)
    assert "of rivals 1.5" in str(failed.exception)
    assert "fig8" in runner.invoke(app, ["paper", "-h"], env=ENVIRONMENT).output
    assert "--frames" in runner.invoke(app, ["run", "-h"], env=ENVIRONMENT).output
    assert not [line for line in help_lines() if "Count beams" in line]


def test_a_command_loads_no_other_and_the_help_nothing_heavy() -> None:
    program = (
        "import sys\n"
        "from typer.testing import CliRunner\n"
        "from caviar_clients.cli.main import app\n"
        "assert CliRunner().invoke(app, ['new', '-h']).exit_code == 0\n"
        "print([name for name in sys.modules if name.startswith('caviar_labs')])\n"
        "assert CliRunner().invoke(app, ['-h']).exit_code == 0\n"
        "heavy = ('numpy', 'zmq', 'caviar_broker', 'caviar_services', 'caviar_labs.cli.measure')\n"
        "print([name for name in heavy if name in sys.modules])\n"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stdout == "[]\n[]\n"


def test_the_list_of_commands_is_made_without_their_options(monkeypatch: pytest.MonkeyPatch) -> None:
    root: Any = typer.main.get_command(app)
    context = root.context_class(root)
    whole = {name: root.get_command(context, name) for name in commands._own}
    assert len(whole) > 8
    assert all(len(command.get_params(context)) > (name != "scenarios") for name, command in whole.items())
    monkeypatch.setattr(commands, "get_command_from_info", None)
    lines = "\n".join(help_lines())
    for name, command in whole.items():
        first = command.get_short_help_str(400)
        assert re.search(rf" {name} +{re.escape(first)}", lines), name


def test_help_is_shown_as_it_is_written() -> None:
    """Rich takes what is in brackets, as a unit, for a style, and leaves it out."""
    root: Any = typer.main.get_command(app)
    context = root.context_class(root)
    waiting, helps = [root], list[str]()
    while waiting:
        command = waiting.pop()
        if hasattr(command, "commands"):
            waiting += [command.get_command(context, name) for name in command.list_commands(context)]
        helps += [part.help for part in (command, *command.params) if getattr(part, "help", None)]
    assert len(helps) > 200
    assert not [text for text in helps if Text.from_markup(text).plain != text]
