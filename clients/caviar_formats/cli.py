"""``caviar export``: a dataset in the format of another program."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from caviar_clients.cli.shared import print_line, progress_bar


def export(
    dataset: Annotated[str, typer.Argument(help="folder or address of a dataset")],
    to: Annotated[str, typer.Option(help="npz, sionna, or the format of an installed package")],
    out: Annotated[Path, typer.Option(help="folder that is made")],
    flavour: Annotated[str, typer.Option(help="variant of the format")] = "",
    carrier: Annotated[str | None, typer.Option(help="users of this carrier alone")] = None,
    tx: Annotated[str | None, typer.Option(help="users of this transmitter alone")] = None,
    object_class: Annotated[str | None, typer.Option(help="users on objects of this class alone")] = None,
) -> None:
    """Export a dataset to the format of another program; a command that was ended goes on."""
    from caviar_clients.datasets.reader import Dataset
    from caviar_formats.base import export_users, find_format

    console = Console()
    form = find_format(to, flavour)
    users = Dataset(dataset).users(carrier=carrier, tx=tx, object_class=object_class)
    with progress_bar(console, transient=True) as bar:
        task = bar.add_task(f"{to}: episodes")
        export_users(users, form, out, lambda done, of: bar.update(task, completed=done, total=of))
    print_line(console, out)
