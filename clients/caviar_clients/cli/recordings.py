"""Commands on a recorded run: ``caviar inspect``, ``caviar replay``, and ``caviar doctor RUN``.

The last says what of a damaged run can be read. Nothing in the run's directory is changed: what can be read
goes to a new directory, which is a run again. It can be inspected, replayed and, where its journal and its
recording allow, resumed.
"""

from __future__ import annotations

import json
import shutil
import warnings
from collections.abc import Iterable, Iterator, Sequence
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Literal, TypeAlias

import msgspec
import typer
from rich.console import Console
from rich.markup import escape
from rich.table import Column, Table
from rich.text import Text

from caviar_broker.journal_format import NO_BROKER, JournalReader, run_of_journal
from caviar_broker.run_record import RunRecord, read_record
from caviar_clients.cli.shared import counted, print_line, scaled
from caviar_clients.cli.summary import (
    LinkFigures,
    RunSummary,
    SourceSummary,
    StationSummary,
    resume_hint,
    summarise,
)
from caviar_clients.cli.summary_table import (
    SHOWN_DAMAGE,
    decided_lines,
    gain_line,
    link_quality,
    outage_lines,
    packet_line,
)
from caviar_protocol.errors import RecordingError, RunError
from caviar_protocol.files import PrivateFolder
from caviar_protocol.messages import Status
from caviar_protocol.recording import Recording, RecordingWarning, frame_name
from caviar_protocol.recording.segment import Segment
from caviar_protocol.run_directory import RunDirectory, runs_below
from caviar_protocol.scenario import Scenario
from caviar_services.recorder.base import failure
from caviar_services.recorder.segment_writer import Persistence, SegmentWriter, stored_products

# A replay loads what runs a scenario, 0.2 s of imports that the other commands do without.
if TYPE_CHECKING:
    from caviar_clients.replay.plan import ReplayPlan
    from caviar_clients.replay.recorded import RecordedRun

PARTS = {
    "recorded": "as recorded",
    "replaced": "replaced",
    "again": "runs again",
    "left out": "left out",
}
"""What becomes of a service in a replay, in words."""
SHOWN = 10
"""Lines about a part of a damaged run that are printed; of the others, the number."""

State: TypeAlias = Literal["whole", "damaged", "lost", "none", "foreign"]


# --- caviar inspect --------------------------------------------------------------------------------------


def inspect_command(run: Path, digest: bool = False, as_json: bool = False) -> int:
    """Print a summary of a recording, or its digest.

    Args:
        run: The run's directory, or a segment of its recording.
        digest: Whether only the digest is printed, recomputed from the payloads.
        as_json: Whether the summary is printed as JSON.

    Returns:
        The exit status: 1 where the recording is damaged.

    Raises:
        RecordingError: There is no recording.
    """
    # The lines of its warnings are printed as damage.
    with warnings.catch_warnings(action="ignore", category=RecordingWarning):
        recording = Recording(run)
    if digest:
        return _print_digest(recording)
    return _print_summary(summarise(recording), as_json, resume_hint(recording))


def _print_digest(recording: Recording) -> int:
    report = recording.run_digest()
    typer.echo(report.digest)
    if not recording.complete:
        last = recording.entry(len(recording) - 1) if len(recording) else None
        behind = f" after frame {last.frame} of episode {last.episode}" if last is not None else ""
        note = f"note: the recording breaks off{behind}; the digest is that of {report.frames} frames"
        typer.echo(note, err=True)
    return _print_damage(report.damage)


def _print_damage(damage: Sequence[str]) -> int:
    for line in damage[:SHOWN_DAMAGE]:
        typer.echo(f"damaged: {line}", err=True)
    if len(damage) > SHOWN_DAMAGE:
        typer.echo(f"damaged: and {len(damage) - SHOWN_DAMAGE} more", err=True)
    return 1 if damage else 0


def _print_summary(summary: RunSummary, as_json: bool, hint: str) -> int:
    if as_json:
        typer.echo(msgspec.json.format(msgspec.json.encode(summary), indent=2))
    else:
        console = Console()
        console.print(_facts(summary))
        console.print(_topics(summary.sources))
        if hint:
            print_line(console, hint)
    return _print_damage(summary.damage)


def _facts(summary: RunSummary) -> Table:
    columns = (Column(style="bold", no_wrap=True), Column(overflow="fold"))
    table = Table(*columns, show_header=False, box=None, pad_edge=False)
    state = "complete" if summary.complete else "[red]breaks off[/red]: the recorder did not close it"
    table.add_row("run", escape(f"{summary.run} (scenario {summary.scenario}, seed {summary.seed})"))
    table.add_row("started", summary.started)
    table.add_row("recording", f"{state}, {_size(summary.bytes)} in {counted(summary.segments, 'segment')}")
    table.add_row(
        "frames",
        f"{summary.frames} of {summary.frames_planned} planned, {counted(summary.episodes, 'episode')}, "
        f"{summary.simulated_s:g} s simulated",
    )
    link = summary.link
    parts: Sequence[LinkFigures] = [] if link is None else link.stations or [link]
    for of in parts:
        place = f"{of.tx} on {of.carrier}: " if isinstance(of, StationSummary) else ""
        if of.mean_abs_y is not None:
            table.add_row(
                "mean |y|",
                f"{escape(place)}{of.mean_abs_y:.4g}, best {of.mean_abs_y_best:.4g}, LOS beam "
                f"{of.mean_abs_y_baseline:.4g} (over links with a path)",
            )
            gains = gain_line(of.loss_to_best_db, of.gain_over_random_db)
            table.add_row("", f"{escape(place)}{gains}")
        if of.mean_bit_rate is not None:
            quality = link_quality(of.mean_snr_db, of.mean_snr_best_db, of.mean_bit_rate)
            table.add_row("mean SNR", f"{escape(place)}{quality}")
    if link is not None and link.packets is not None:
        table.add_row("packets", packet_line(link.packets).removeprefix("packets: "))
    if link is not None:
        table.add_row("no path", f"{link.no_path_share:.2%} of {counted(link.users, 'link')} over all frames")
    for line in [] if summary.outage is None else outage_lines(summary.outage):
        table.add_row("no path", escape(line))
    for line in decided_lines(summary.decided):
        table.add_row("decided", escape(line))
    for line in summary.warnings:
        table.add_row("warning", escape(line), style="yellow")
    machine = summary.machine
    table.add_row("machine", escape(", ".join(f"{key} {value}" for key, value in sorted(machine.items()))))
    table.add_row("versions", escape(", ".join(f"{k} {v}" for k, v in summary.versions.items())))
    for note in summary.notes:
        table.add_row("note", escape(note))
    return table


def _topics(sources: Iterable[SourceSummary]) -> Table:
    counts_of = (Column(title, justify="right") for title in ("fresh", "held", "absent", "late", "size"))
    table = Table("topic", "source", *counts_of)
    for source in sources:
        counts = (source.fresh, source.held, source.absent, source.late)
        table.add_row(source.topic, escape(source.source), *map(str, counts), _size(source.bytes))
    return table


def _size(number: float) -> str:
    value, unit = scaled(number, ("B", "KiB", "MiB", "GiB"), 1024.0)
    return f"{value:.0f} B" if unit == "B" else f"{value:.1f} {unit}"


# --- caviar replay ---------------------------------------------------------------------------------------


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
    """Run a recorded run again, with some of its services replaced.

    Args:
        run: The recorded run's directory, or a segment of its recording.
        out: Folder in which the new run's directory is made.
        console: Where plan, progress and summary are shown.
        replace: Implementations in place of the recorded ones, as ``SERVICE=IMPLEMENTATION``.
        settings: Settings in place of the recorded ones, as ``SERVICE.SETTING=VALUE``.
        keep: Services that run again as recorded.
        recorded: Services that are served as recorded, though what they take has changed.
        again: Whether everything runs again, with the recorded decisions.
        frames: Of each episode, at most; None: as many as were recorded.
        json_file: Where the summary is written beside the run's own.
        embedded: Whether all services run in this process.

    Returns:
        The exit status: 0 exactly if the run came to its end and, where nothing was replaced, has the digest
        of the recorded one.

    Raises:
        RecordingError: There is no recording, or none that can be replayed.
        RunError: An option names nothing, or a service needs what was not recorded.
    """
    from caviar_clients.cli.run import run_scenario
    from caviar_clients.replay.plan import plan_replay, request_of, scenario_text
    from caviar_clients.replay.recorded import RecordedRun
    from caviar_clients.session.prepared import names_class, prepare
    from caviar_services.registry import find_modules_in

    found = RecordedRun(Recording(run))
    if any(map(names_class, found.scenario.services.values())) or any(":" in text for text in replace):
        find_modules_in(Path.cwd())
    request = request_of(found.scenario.services, replace, settings, keep, recorded, again)
    plan = plan_replay(found, request, frames)
    prepare(plan.scenario)
    _print_plan(plan, found, console)
    with PrivateFolder("replay") as folder:
        scenario, figures = folder.path / f"{plan.scenario.run.name}.toml", folder.path / "summary.json"
        scenario.write_text(scenario_text(plan.scenario))
        written = json_file or figures
        ended = run_scenario(scenario, out, console, plan.frames, json_file=written, embedded=embedded)
        return ended.status or _compare_digests(plan, written, console)


def _print_plan(plan: ReplayPlan, run: RecordedRun, console: Console) -> None:
    recording = run.recording
    print_line(console, f"replay of {recording.path}, {len(run.lengths)} × {plan.frames} frames")
    table = Table("service", "", "implementation", "")
    for role in plan.roles:
        use = "" if role.part == "recorded" else role.use
        table.add_row(*map(Text, (role.name, PARTS[role.part], use, role.why)))
    console.print(table)
    for note in plan.notes:
        print_line(console, note, style="yellow")


def _compare_digests(plan: ReplayPlan, figures: Path, console: Console) -> int:
    """Compare the digest with that of the recorded run; status 1 where it has to be that, and is not."""
    expected = plan.scenario.replay.digest if plan.scenario.replay else ""
    equal = json.loads(figures.read_text())["digest"] == expected
    if equal:
        print_line(console, "every product is that of the recorded run, byte for byte")
    elif plan.identical:
        print_line(console, f"the recorded run has the digest {expected}: something differs", style="red")
    return 1 if plan.identical and not equal else 0


# --- caviar doctor RUN ------------------------------------------------------------------------------------


class Part(msgspec.Struct, kw_only=True):
    """One part of a run's directory."""

    name: str
    state: State
    """Of a damaged part something can be read, of a lost one nothing; none: the run has no such part;
    foreign: the parts are of several runs."""
    lines: list[str]
    run: str = ""
    """Id of the run that it says it is of; empty where it does not."""


def rescue_run(run: Path, console: Console) -> int:
    """Say what of a run can be read, and save it beside the run where a part is damaged.

    Args:
        run: The run's directory, in which nothing is changed.
        console: Where it is said.

    Returns:
        0: all is whole; 1: a part is damaged, and the rest is saved; 2: of a part nothing can be read.

    Raises:
        RunError: It is no directory, or none of a run, or the copy cannot be written.
    """
    if not run.is_dir():
        raise RunError(f"{run} is no directory; give the directory of a run")
    files = RunDirectory(run)
    if not (any(run.glob("recording*")) or files.journal.exists() or files.record.exists()):
        raise RunError(
            f"{run} is no directory of a run: it has neither recording, {files.record.name} nor "
            f"{files.journal.name}{runs_below(run)}"
        )
    recording, of_recording = _examine_recording(run)
    journal, of_journal = _examine_journal(run)
    record, of_record = _examine_record(run, recording, journal)
    parts = [of_recording, of_record, of_journal]
    named = [part for part in parts if part.run]
    if len({part.run for part in named}) > 1:  # each part says of which run it is
        for part in named:
            part.state = "foreign"
            part.lines.insert(0, f"of run {part.run!r}")
    console.print(_table(parts))
    states = {part.state for part in parts}
    if not states & {"damaged", "lost", "foreign"}:
        if recording is not None and (hint := resume_hint(recording)):
            print_line(console, hint)
        return 0
    if "foreign" in states:
        print_line(
            console, "nothing is saved: the parts are of several runs; put the files of one run together"
        )
        return 2
    target = _free_name(run)
    try:
        target.mkdir()
        if recording is not None:
            _save_recording(recording, target)
        if record is not None:
            record.save(target)
        if journal is not None:
            # Up to the last whole entry; what a broker began to write when it died is no entry.
            with journal.path.open("rb") as source:
                RunDirectory(target).journal.write_bytes(source.read(journal.end))
        for folder in (files.assets, files.checkpoints):
            if folder.is_dir():
                shutil.copytree(folder, target / folder.name)
    except OSError as error:
        raise failure(Path(error.filename or target), error) from error
    if not any(target.iterdir()):
        target.rmdir()
        print_line(console, "nothing is saved, since nothing can be read")
        return 2
    print_line(console, f"{run} is as it was; what can be read of it is in {target}")
    return 2 if "lost" in states else 1


def _examine_recording(run: Path) -> tuple[Recording | None, Part]:
    if not any(run.glob("recording*")):
        return None, Part(name="recording", state="none", lines=["there is none"])
    try:
        with warnings.catch_warnings(action="ignore", category=RecordingWarning):
            # Segments after one that is missing, too: other readers stop there.
            recording = Recording(run, past_gaps=True)
        damage = list(recording.run_digest().damage)
    except RecordingError as error:
        return None, Part(name="recording", state="lost", lines=[str(error)])
    readable = sum(1 for _ in _readable_frames(recording)) if damage else len(recording)
    last = recording.entry(len(recording) - 1) if len(recording) else None
    up_to = f", up to {frame_name((last.episode, last.frame))}" if last else ""
    ends = "" if recording.complete or damage else "; it breaks off there, as a killed recorder leaves it"
    lines = [f"{readable} frames can be read{up_to}{ends}", *damage]
    state: State = "damaged" if damage else "whole"
    return recording, Part(name="recording", state=state, lines=lines, run=recording.metadata.run)


def _examine_journal(run: Path) -> tuple[JournalReader | None, Part]:
    file, of = RunDirectory(run).journal, ""
    if not file.exists():
        return None, Part(name="journal", state="none", lines=["there is none"])
    try:
        of = run_of_journal(file)
        reader = JournalReader(file)
        lines = [f"{sum(1 for _ in reader)} entries can be read"]
    except RecordingError as error:
        return None, Part(name="journal", state="lost", lines=[str(error)], run=of)
    if reader.problem:
        lines.append(f"{reader.problem}: {reader.lost} B are lost")
    return reader, Part(name="journal", state="damaged" if reader.problem else "whole", lines=lines, run=of)


def _examine_record(
    run: Path, recording: Recording | None, journal: JournalReader | None
) -> tuple[RunRecord | None, Part]:
    files = RunDirectory(run)
    name = files.record.name
    # Read anew: a reader goes through its journal once.
    entries = JournalReader(journal.path) if journal is not None else ()
    embedded = any(entry.epoch == NO_BROKER for entry in islice(entries, 1))
    if not files.record.exists() and (embedded or not files.journal.exists()):
        text = "there is none, as of every run in one process" if embedded else "there is none"
        return None, Part(name=name, state="none", lines=[text])
    try:
        record = read_record(run)
    except RecordingError as error:
        lines = [str(error).removeprefix(f"cannot resume {run}: ")]
        rebuilt = _rebuilt(recording, journal)
        if rebuilt is None:
            return None, Part(name=name, state="lost", lines=lines)
        lines.append("made anew from the recording's metadata and the journal")
        return rebuilt, Part(name=name, state="damaged", lines=lines)
    lines = [f"run {record.run}, epoch {record.epoch}"]
    return record, Part(name=name, state="whole", lines=lines, run=record.run)


def _rebuilt(recording: Recording | None, journal: JournalReader | None) -> RunRecord | None:
    """The record of a run, made from the scenario of its recording and the epochs of its journal."""
    if recording is None or journal is None:
        return None
    try:
        scenario = msgspec.convert(recording.metadata.scenario, Scenario)
    except msgspec.ValidationError:
        return None
    # A broker that resumes the run takes the next epoch; one that was used would let late answers pass.
    epoch = max((entry.epoch for entry in JournalReader(journal.path)), default=1)
    run = recording.metadata.run
    return RunRecord(run=run, epoch=epoch, endpoint="tcp://127.0.0.1:0", scenario=scenario)


def _readable_frames(recording: Recording) -> Iterator[int]:
    """Frames all of whose products have the bytes that were recorded."""
    for index in range(len(recording)):
        try:
            products = recording.products_of(index)
        except RecordingError:
            continue
        # Of a product that was held or absent no bytes are stored.
        stored = (p for p in products if p.provenance.status in (Status.FRESH, Status.LATE))
        if all(product.digest == product.provenance.digest for product in stored):
            yield index


def _save_recording(recording: Recording, target: Path) -> None:
    """Write the frames that can be read, segment by segment."""
    metadata = recording.metadata
    kept = Persistence(target, "none", metadata.run, metadata.seed, [])
    writer: SegmentWriter | None = None
    source: Segment | None = None
    number = 0
    for index in _readable_frames(recording):
        segment, place = recording.segment_of(index)
        if segment is not source:
            if writer is not None:
                kept.finished(writer)
            file, source = RunDirectory(target).segment(number), segment
            writer = SegmentWriter(file, segment.metadata, "none")
            number += 1
        if writer is not None:
            entry = segment.entries[place]
            writer.write(entry, list(stored_products(segment, place)), segment.base_of(place))
            kept.written(writer)
    if writer is not None:
        kept.finished(writer)
        kept.close()


def _free_name(run: Path) -> Path:
    run = run.resolve()
    names = (run.with_name(f"{run.name}-rescued{n}") for n in ("", *(f"-{k}" for k in range(2, 1000))))
    for name in names:
        if not name.exists():
            return name
    raise RunError(f"{run.parent} has a thousand copies of {run.name}; remove some")


def _table(parts: list[Part]) -> Table:
    columns = (Column(no_wrap=True), Column(no_wrap=True), Column(overflow="fold"))
    table = Table(*columns, box=None, pad_edge=False, show_header=False)
    styles = {"whole": "green", "none": "", "damaged": "yellow", "lost": "bold red", "foreign": "bold red"}
    for part in parts:
        more = [f"and {len(part.lines) - SHOWN} more lines"] if len(part.lines) > SHOWN else []
        text = "\n".join([*part.lines[:SHOWN], *more])
        table.add_row(part.name, Text(part.state, style=styles[part.state]), Text(text))
    return table
