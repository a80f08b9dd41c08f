"""``caviar doctor RUN``: what of a damaged run can be read, and a copy of that beside it.

Nothing in the run's directory is changed. Where a part is damaged, what can be read of all parts goes to a
new directory, which is a run again: it can be inspected, replayed and, where its journal and its recording
allow, gone on with.
"""

from __future__ import annotations

import shutil
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Literal, TypeAlias

import msgspec
from rich.console import Console
from rich.table import Table
from rich.text import Text

from caviar_broker.journal_format import JournalReader, run_of_journal
from caviar_broker.run_record import RunRecord, read_record
from caviar_clients.cli.recording_summary import resume_hint
from caviar_protocol.errors import RecordingError, RunError
from caviar_protocol.files import RunDirectory
from caviar_protocol.messages import Status
from caviar_protocol.recording import Recording, RecordingWarning, frame_name
from caviar_protocol.recording.segment import Segment
from caviar_protocol.scenario import Scenario
from caviar_services.recorder.base import failure
from caviar_services.recorder.continuation import stored_products
from caviar_services.recorder.segment_writer import Persistence, SegmentWriter

SHOWN = 10
"""Lines about a part that are printed; how many there are more is said."""

State: TypeAlias = Literal["whole", "damaged", "lost", "none", "foreign"]


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
    """Say what of a run can be read, and save it where a part of it is damaged.

    Returns:
        0: all is whole; 1: a part is damaged, and the rest is saved; 2: of a part nothing can be read.

    Raises:
        RunError: It is no directory, or the copy cannot be written.
    """
    if not run.is_dir():
        raise RunError(f"{run} is no directory; give the directory of a run")
    recording, of_recording = _examine_recording(run)
    journal, of_journal = _examine_journal(run)
    record, of_record = _examine_record(run, recording, journal)
    parts = [of_recording, of_record, of_journal]
    _tell_runs_apart(parts)
    console.print(_table(parts))
    states = {part.state for part in parts}
    if not states & {"damaged", "lost", "foreign"}:
        if recording is not None and (hint := resume_hint(recording)):
            console.print(Text(hint), soft_wrap=True)
        return 0
    if "foreign" in states:
        text = "nothing is saved: the parts are of several runs; put the files of one run together"
        console.print(Text(text), soft_wrap=True)
        return 2
    target = _free_name(run)
    try:
        _save(run, target, recording, record, journal)
    except OSError as error:
        raise failure(Path(error.filename or target), error) from error
    if not any(target.iterdir()):
        target.rmdir()
        console.print(Text("nothing is saved, since nothing can be read"), soft_wrap=True)
        return 2
    text = f"{run} is as it was; what can be read of it is in {target}"
    console.print(Text(text), soft_wrap=True)
    return 2 if "lost" in states else 1


def _tell_runs_apart(parts: list[Part]) -> None:
    """Say of each part of which run it is, where they are not all of one."""
    told = [part for part in parts if part.run]
    if len({part.run for part in told}) > 1:
        for part in told:
            part.state = "foreign"
            part.lines.insert(0, f"of run {part.run!r}")


def _examine_recording(run: Path) -> tuple[Recording | None, Part]:
    part = Part(name="recording", state="whole", lines=[])
    if not any(run.glob("recording*")):
        part.state, part.lines = "none", ["there is none"]
        return None, part
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", RecordingWarning)
            recording = Recording(run, past_gaps=True)
        damage = list(recording.run_digest().damage)
    except RecordingError as error:
        part.state, part.lines = "lost", [str(error)]
        return None, part
    readable = sum(1 for _ in _readable_frames(recording)) if damage else len(recording)
    last = recording.entry(len(recording) - 1) if len(recording) else None
    up_to = f", up to {frame_name((last.episode, last.frame))}" if last else ""
    ends = "" if recording.complete or damage else "; it breaks off there, as a killed recorder leaves it"
    part.run = recording.metadata.run
    part.lines = [f"{readable} frames can be read{up_to}{ends}", *damage]
    if damage:
        part.state = "damaged"
    return recording, part


def _examine_journal(run: Path) -> tuple[JournalReader | None, Part]:
    part = Part(name="journal", state="whole", lines=[])
    if not RunDirectory(run).journal.exists():
        part.state, part.lines = "none", ["there is none: an embedded run has no journal"]
        return None, part
    try:
        part.run = run_of_journal(RunDirectory(run).journal)
        reader = JournalReader(RunDirectory(run).journal)
        entries = sum(1 for _ in reader)
    except RecordingError as error:
        part.state, part.lines = "lost", [str(error)]
        return None, part
    part.lines = [f"{entries} entries can be read"]
    if reader.problem:
        part.state = "damaged"
        part.lines.append(f"{reader.problem}: {reader.lost} B are lost")
    return reader, part


def _examine_record(
    run: Path, recording: Recording | None, journal: JournalReader | None
) -> tuple[RunRecord | None, Part]:
    part = Part(name=RunDirectory(run).record.name, state="whole", lines=[])
    if journal is None and not RunDirectory(run).record.exists() and not RunDirectory(run).journal.exists():
        part.state, part.lines = "none", ["there is none: an embedded run has no record"]
        return None, part
    try:
        record = read_record(run)
    except RecordingError as error:
        rebuilt = _rebuilt(recording, journal)
        part.state = "damaged" if rebuilt is not None else "lost"
        part.lines = [str(error).removeprefix(f"cannot go on with {run}: ")]
        if rebuilt is not None:
            part.lines.append("made anew from the recording's metadata and the journal")
        return rebuilt, part
    part.run = record.run
    part.lines = [f"run {record.run}, epoch {record.epoch}"]
    return record, part


def _rebuilt(recording: Recording | None, journal: JournalReader | None) -> RunRecord | None:
    """The record of a run whose recording has its scenario."""
    if recording is None or journal is None:
        return None
    try:
        scenario = msgspec.convert(recording.metadata.scenario, Scenario)
    except msgspec.ValidationError:
        return None
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
        stored = (p for p in products if p.provenance.status in (Status.FRESH, Status.LATE))
        if all(product.digest == product.provenance.digest for product in stored):
            yield index


def _save(
    run: Path,
    target: Path,
    recording: Recording | None,
    record: RunRecord | None,
    journal: JournalReader | None,
) -> None:
    target.mkdir()
    if recording is not None:
        _save_recording(recording, target)
    if record is not None:
        record.save(target)
    if journal is not None:
        with journal.path.open("rb") as source:
            RunDirectory(target).journal.write_bytes(source.read(journal.end))
    for folder in (RunDirectory(run).assets, RunDirectory(run).checkpoints):
        if folder.is_dir():
            shutil.copytree(folder, target / folder.name)


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
    table = Table(box=None, pad_edge=False, show_header=False)
    table.add_column(no_wrap=True)
    table.add_column(no_wrap=True)
    table.add_column(overflow="fold")
    styles = {"whole": "green", "none": "", "damaged": "yellow", "lost": "bold red", "foreign": "bold red"}
    for part in parts:
        more = [f"and {len(part.lines) - SHOWN} more lines"] if len(part.lines) > SHOWN else []
        text = "\n".join([*part.lines[:SHOWN], *more])
        table.add_row(part.name, Text(part.state, style=styles[part.state]), Text(text))
    return table
