"""``caviar bench``: what the parts of a run cost on this machine."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import msgspec
import typer
from rich.console import Console
from rich.table import Table

from caviar_broker.bench.client import Topology
from caviar_clients.files import write_file

app = typer.Typer(no_args_is_help=True, help="Measure what the parts of a run cost on this machine.")


@app.callback()
def bench() -> None:
    """Measure what the parts of a run cost on this machine."""


@app.command()
def broker(
    services: Annotated[int, typer.Option(min=2, max=256, help="services, each a process")] = 8,
    payload: Annotated[int, typer.Option(min=1, max=1 << 28, help="bytes of a product")] = 100,
    frames: Annotated[int, typer.Option(min=10, max=10_000_000, help="frames that are measured")] = 2000,
    topology: Annotated[
        Topology, typer.Option(help="hub: one with all others; all: everyone with everyone")
    ] = "hub",
    curve: Annotated[bool, typer.Option("--curve", help="with keys, encrypted")] = False,
    json: Annotated[Path | None, typer.Option(help="write the figures to this file")] = None,
) -> None:
    """A frame's way through the broker, with clients that do nothing but exchange products."""
    from caviar_broker.bench.run import measure

    if json is not None:
        write_file(json)
    measured = measure(topology, services, payload, frames, curve=curve)
    table = Table(
        "services", "payload B", "µs a frame: mean", "p50", "p99", "MB/s", "broker CPU µs", "misses"
    )
    time = measured.us_per_frame
    table.add_row(
        str(services),
        str(payload),
        *(f"{value:.0f}" for value in (time.mean, time.p50, time.p99)),
        f"{measured.bytes_per_second / 1e6:.3g}",
        f"{measured.broker_cpu_us_per_frame:.0f}",
        str(measured.misses),
    )
    Console().print(table)
    if json is not None:
        write_file(json, msgspec.json.format(msgspec.json.encode(measured), indent=2).decode() + "\n")
