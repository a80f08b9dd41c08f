"""`caviar budget`: what frame rate a recorded run would sustain, and who bounds it."""

from __future__ import annotations

import math
from pathlib import Path

import msgspec
from rich.console import Console
from rich.table import Table
from rich.text import Text

from caviar_clients.budget.forecast import POLICIES, Forecast, ServiceForecast, forecast
from caviar_clients.files import write_file
from caviar_clients.replay.recorded import RecordedRun
from caviar_protocol.recording import Recording


def budget_run(run: Path, console: Console, json_file: Path | None = None) -> Forecast:
    """Print what a recorded run tells about budgets, and write it to a file.

    Raises `RunError` before anything is worked out where the file cannot be written.
    """
    recording = Recording(run)
    if json_file is not None:
        write_file(json_file)
    found = forecast(RecordedRun(recording))
    console.print(_services(found))
    for line in lines(found):
        console.print(Text(line), soft_wrap=True)
    if json_file is not None:
        write_file(json_file, msgspec.json.format(msgspec.json.encode(found)).decode() + "\n")
    return found


def lines(found: Forecast) -> list[str]:
    """What there is to say beyond the table."""
    rates = ", ".join(f"{policy} {found.rates[policy]:.1f}" for policy in POLICIES)
    substituted = {
        policy: {s.name: s.substituted[policy] for s in found.services if s.substituted[policy]}
        for policy in POLICIES
    }
    return [
        f"alone, without: frames/s if only it took time, or all others; misses: {'/'.join(POLICIES)}",
        f"frames/s as budgets are: {rates}; measured {found.measured:.1f}, real time {found.realtime:.1f}",
        *(
            f"under {policy}, held or absent in so many of {found.frames} frames: "
            + ", ".join(f"{name} {count}" for name, count in services.items())
            for policy, services in substituted.items()
            if services
        ),
        _bound(found),
        *found.notes,
    ]


def _bound(found: Forecast) -> str:
    bound = found.bound
    text = f"{bound.service} bounds the frame rate under wait"
    if math.isfinite(bound.gain):
        text += f": if it took no time, there were {bound.gain:.2f} times as many frames a second"
    if bound.realtime_factor is None:
        return f"{text}; for real time it is not enough to make it alone faster"
    if bound.realtime_factor > 1.0:
        return f"{text}; for real time it would have to be {bound.realtime_factor:.2f} times as fast"
    return f"{text}; real time is sustained"


def _services(found: Forecast) -> Table:
    table = Table()
    table.add_column("service")
    headings = ("p50 ms", "p99 ms", "budget", "suggested", "alone", "without", "misses")
    for heading in headings:
        table.add_column(heading, justify="right")
    for service in found.services:
        table.add_row(*map(Text, _row(service)))
    return table


def _row(service: ServiceForecast) -> list[str]:
    return [
        service.name,
        f"{service.p50_ms:.2f}",
        f"{service.p99_ms:.2f}",
        f"{service.budget_ms:g}",
        f"{service.suggested_ms:g}",
        f"{service.alone:.1f}",
        "any" if service.without is None else f"{service.without:.1f}",
        "/".join(str(service.misses[policy]) for policy in POLICIES),
    ]
