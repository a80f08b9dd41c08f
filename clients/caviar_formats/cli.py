"""``caviar export`` and ``caviar import``: datasets in the formats of other programs, and from them."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from caviar_clients.cli.shared import print_line, progress_bar
from caviar_protocol.errors import RunError


def export_command(
    source: Annotated[
        str, typer.Argument(metavar="DATASET|RUN", help="folder or address of a dataset, or a run")
    ],
    to: Annotated[
        str,
        typer.Option(
            metavar="NAME",
            help="npz, parquet, huggingface, sionna, itu, deepmimo, deepsense, minari, ns3-qd, pcd, "
            "viwi, foxglove, ros2, rerun, or an installed package's",
        ),
    ],
    out: Annotated[Path, typer.Option(help="folder that is made")],
    flavour: Annotated[str, typer.Option(help="variant of the format")] = "",
    origin: Annotated[
        str | None,
        typer.Option(metavar="LAT,LON", help="of the world's origin [°], for deepsense, where it has none"),
    ] = None,
    carrier: Annotated[str | None, typer.Option(help="users of this carrier alone")] = None,
    tx: Annotated[str | None, typer.Option(help="users of this transmitter alone")] = None,
    object_class: Annotated[str | None, typer.Option(help="users on objects of this class alone")] = None,
) -> None:
    """Export a dataset or a run to the format of another program; a command that was ended goes on."""
    from rich.progress import MofNCompleteColumn, TimeRemainingColumn

    from caviar_clients.datasets.remote import is_address
    from caviar_formats.base import export_users, find_format
    from caviar_formats.runs import open_source

    console, form = Console(), find_format(to, flavour)
    if origin is not None and not form.takes_origin:
        raise RunError(f"--origin: {to} has no places on the Earth; leave it out")
    form.origin = None if origin is None else _origin(origin)
    if not is_address(source) and Path(source).resolve() in (out.resolve(), *out.resolve().parents):
        raise RunError(f"--out {out} is in {source}, which is read; choose a folder outside")
    columns = (MofNCompleteColumn(), TimeRemainingColumn())
    with open_source(source) as dataset, progress_bar(console, *columns, transient=True) as bar:
        users = dataset.users(carrier=carrier, tx=tx, object_class=object_class)
        task = bar.add_task(f"{to}: scenes", total=None)
        export_users(users, form, out, lambda done, of: bar.update(task, completed=done, total=of))
    print_line(console, out)


def _origin(text: str) -> tuple[float, float]:
    try:
        latitude, longitude = map(float, text.split(","))
    except ValueError:
        latitude = longitude = math.nan
    if not (abs(latitude) <= 90 and abs(longitude) <= 180):
        raise RunError(f"--origin {text!r}: write latitude and longitude in degrees, as 38.8907,-77.0787")
    return latitude, longitude


def import_command(
    source: Annotated[Path, typer.Argument(metavar="FILE|DIR", help="files of another program")],
    form: Annotated[
        str,
        typer.Option("--from", metavar="NAME", help="deepmimo, itu, p2m, or an installed package's"),
    ],
    out: Annotated[Path, typer.Option(help="folder of the dataset, which is made")],
    flavour: Annotated[str, typer.Option(help="variant of the format")] = "",
    frequency_hz: Annotated[
        float | None, typer.Option(help="of the carrier, where the files lack it")
    ] = None,
) -> None:
    """Make a dataset of the files of another program."""
    from caviar_formats.base import find_format
    from caviar_formats.imports import import_dataset

    console = Console()
    with progress_bar(console, "{task.completed}", transient=True) as bar:
        task = bar.add_task(f"{form}: episodes", total=None)
        reader = find_format(form, flavour, "--from")
        reader.frequency_hz = frequency_hz
        if not source.exists():
            raise RunError(f"{source}: there is no such file or folder")
        found = reader.read(source)
        import_dataset(found, out, lambda done: bar.update(task, completed=done))
    for text in filter(None, (found.lacks, found.assumed)):
        print_line(console, text)
    print_line(console, out)
