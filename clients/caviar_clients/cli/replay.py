"""`caviar replay`: a recorded run again, with some of its services replaced."""

from __future__ import annotations

import json
import tempfile
from collections.abc import Sequence
from pathlib import Path

from rich.console import Console
from rich.table import Table
from rich.text import Text

from caviar_clients.cli.run import run_scenario
from caviar_clients.replay.plan import ReplayPlan, plan_replay
from caviar_clients.replay.recorded import RecordedRun
from caviar_clients.replay.request import request_of
from caviar_clients.replay.toml import scenario_text
from caviar_clients.session.checks import check_implementations
from caviar_protocol.recording import Recording
from caviar_services.registry import find_modules_in

PARTS = {
    "recorded": "as recorded",
    "replaced": "replaced",
    "again": "runs again",
    "left out": "left out",
}


def replay_run(
    run: Path,
    out: Path,
    console: Console,
    *,
    replace: Sequence[str] = (),
    settings: Sequence[str] = (),
    keep: Sequence[str] = (),
    recorded: Sequence[str] = (),
    again: bool = False,
    frames: int | None = None,
    json_file: Path | None = None,
    embedded: bool = False,
) -> int:
    """Replay a run; the exit status: 0 exactly if it came to its end, and where nothing was replaced with
    the digest that it had."""
    find_modules_in(Path.cwd())  # of classes that --replace names as module:Class
    found = RecordedRun(Recording(run))
    request = request_of(found.scenario.services, replace, settings, keep, recorded, again)
    plan = plan_replay(found, request, frames)
    check_implementations(plan.scenario)
    _tell(plan, found, console)
    with tempfile.TemporaryDirectory(prefix="caviar-replay-") as folder:
        scenario, figures = Path(folder) / f"{plan.scenario.run.name}.toml", Path(folder) / "summary.json"
        scenario.write_text(scenario_text(plan.scenario))
        ended = run_scenario(
            scenario, out, console, plan.frames, json_file=json_file or figures, embedded=embedded
        )
        return ended.status or _compared(plan, json_file or figures, console)


def _tell(plan: ReplayPlan, run: RecordedRun, console: Console) -> None:
    """Which is which, before it begins."""
    recording = run.recording
    what = f"replay of {recording.path}, {len(run.lengths)} × {plan.frames} frames"
    console.print(Text(what), soft_wrap=True)
    table = Table()
    for heading in ("service", "", "implementation", ""):
        table.add_column(heading)
    for role in plan.roles:
        use = "" if role.part == "recorded" else role.use
        table.add_row(*map(Text, (role.name, PARTS[role.part], use, role.why)))
    console.print(table)
    for note in plan.notes:
        console.print(Text(note, style="yellow"), soft_wrap=True)


def _compared(plan: ReplayPlan, figures: Path, console: Console) -> int:
    """Whether the digest is that of the recorded run, where it has to be."""
    expected = plan.scenario.replay.digest if plan.scenario.replay else ""
    equal = json.loads(figures.read_text())["digest"] == expected
    if equal:
        console.print("every product is that of the recorded run, byte for byte", highlight=False)
    elif plan.identical:
        console.print(
            Text(f"the recorded run has the digest {expected}: something differs", style="red"),
            soft_wrap=True,
        )
    return 1 if plan.identical and not equal else 0
