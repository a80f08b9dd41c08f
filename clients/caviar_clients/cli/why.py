"""``caviar why``: whom a running broker waits for, in words."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from rich.console import Console

from caviar_broker.control.socket import ask
from caviar_protocol.errors import RunError
from caviar_protocol.run_directory import RunDirectory

RUNS = Path("runs")


def why_command(run: Path | None, console: Console) -> None:
    """Print what the broker of a run says; of the newest one that runs below ``./runs`` where none is named.

    Raises `RunError` where no broker runs there.
    """
    directory = run if run is not None else newest_run(RUNS)
    for line in why_lines(ask(directory, do="why")["why"]):
        console.print(line, highlight=False, soft_wrap=True, markup=False)


def newest_run(root: Path) -> Path:
    """The directory of the run below ``root`` whose broker was started last and is still noted there."""
    notes = [note for run in root.glob("*") if (note := RunDirectory(run).control_note).is_file()]
    if not notes:
        raise RunError(f"no broker runs below {root.resolve()}; name the directory of a run: caviar why RUN")
    return max(notes, key=lambda note: note.stat().st_mtime_ns).parent


def why_lines(why: Mapping[str, Any]) -> Iterator[str]:
    """The answer of a desk, in words."""
    waits, last = why["waits"], why["last_blame"]
    late = [wait for wait in waits if wait["late"]]
    where = f", episode {why['episode']}, frame {why['frame']}" if why["frame"] >= 0 else ""
    paused = ", paused" if why["paused"] else ""
    yield f"run {why['run']}: {why['state']}{where}{paused}"
    if why["error"]:
        yield f"it ends early: {why['error']}"
    if not late:
        yield _nobody_late(why)
    for wait in waits:
        yield f"{'late' if wait['late'] else 'waited for'}: {wait['text']}"
    if last is not None:
        frame = f" in frame {last['frame']}" if last["frame"] >= 0 else ""
        yield f"last blame: {last['kind']}: {last['service']}{frame}: {last['text']}"


def _nobody_late(why: Mapping[str, Any]) -> str:
    if why["paused"] and not why["waits"]:
        return "nobody is late: the run is paused, and every frame that has begun is finished"
    return "nobody is late"
