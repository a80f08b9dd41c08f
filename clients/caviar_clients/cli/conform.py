"""``caviar conform``: judge a client of the user's, case by case."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table
from rich.text import Text

from caviar_clients.conform import Verdict, cases, conform
from caviar_clients.conform.case import as_json, as_markdown, repeated, summary
from caviar_clients.conform.client import Rules
from caviar_clients.files import write_file
from caviar_protocol.errors import SetupError
from caviar_protocol.scenario.toml import MAX_SIZE, parse_toml

STYLES = {"pass": "green", "fail": "bold red", "not applicable": "dim"}


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
    """Play the cases, print and write the verdicts; status 1 where one is «fail».

    With ``websocket`` the kit plays behind a gateway that serves WebSockets at the address of ``listen``.

    Raises `SetupError` for an unknown case, `RunError` where nothing can be listened at, the command
    cannot be started or a file cannot be written.
    """

    def tell(text: str) -> None:
        console.print(Text(text, style="bold"), soft_wrap=True)

    def each(verdict: Verdict) -> None:
        line = Text(f"{verdict.outcome:<15}", style=STYLES[verdict.outcome])
        console.print(line + Text(f"{verdict.case}: {verdict.title}", style="default"), soft_wrap=True)

    for file in (json_file, markdown_file):
        if file is not None:
            write_file(file)
    options: dict[str, Any] = {"command": command, "names": names, "rules": rules, "tell": tell, "each": each}
    if websocket:
        options["front"] = _gateway(listen, tell)
        listen = "tcp://127.0.0.1:0"
    verdicts = conform(listen, **options)
    console.print()
    console.print(_table(verdicts))
    for cause in repeated(verdicts):
        console.print(Text(cause), soft_wrap=True)
    failed = any(verdict.outcome == "fail" for verdict in verdicts)
    console.print(summary(verdicts), style="bold red" if failed else "bold green", highlight=False)
    for file, text in ((json_file, as_json(verdicts)), (markdown_file, as_markdown(verdicts))):
        if file is not None:
            write_file(file, text)
    return 1 if failed else 0


def _gateway(listen: str, tell: Callable[[str], None]) -> Callable[[str], AbstractContextManager[str]]:
    """What serves WebSockets at ``listen``, an address of this machine, for the kit."""
    from caviar_broker.http.process import gateway_in_front

    address = listen.partition("://")[2].partition("/")[0] or listen
    return lambda endpoint: gateway_in_front(endpoint, address, tell)


def list_cases(console: Console) -> None:
    """Print what can be asked for with ``--case``."""
    table = Table(box=None, pad_edge=False)
    for column in ("case", "what it shows", "clauses"):
        table.add_column(column, overflow="fold", no_wrap=column == "case")
    for case in cases():
        table.add_row(case.name, Text(case.title), Text(case.clauses))
    console.print(table)


def settings_of(file: Path | None) -> dict[str, Any]:
    """``settings`` of WELCOME from a TOML or JSON file.

    Raises `SetupError` where it cannot be read.
    """
    if file is None:
        return {}
    try:
        with file.open(encoding="utf-8") as stream:
            text = stream.read(MAX_SIZE + 1)
        found = json.loads(text) if file.suffix == ".json" else parse_toml(text)
    except (OSError, ValueError, RecursionError) as error:
        raise SetupError(f"cannot read settings from {file}: {error}; give a TOML or JSON file") from error
    if not isinstance(found, dict):
        raise SetupError(f"{file} holds {type(found).__name__}, expected a table of settings")
    return found


def _table(verdicts: Sequence[Verdict]) -> Table:
    table = Table(box=None, pad_edge=False)
    table.add_column("case", no_wrap=True)
    for column in ("clauses", "expected", "got"):
        table.add_column(column, overflow="fold", ratio=1)
    table.add_column("verdict", no_wrap=True)
    for verdict in verdicts:
        table.add_row(
            Text(verdict.case),
            Text(verdict.clauses),
            Text(verdict.expected),
            Text(verdict.got),
            Text(verdict.outcome, style=STYLES[verdict.outcome]),
        )
    return table
