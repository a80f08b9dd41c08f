"""Record of a run in its directory: the one that another broker resumes from, and the recording.

The recording tells a broker how far it goes, whose it is, and what a replay repeats. Its readers are imported
by the functions that read: a broker that begins a run reads none, and they take an eighth of its start.
"""

from __future__ import annotations

import hashlib
import platform
import re
from collections.abc import Collection, Iterator, Mapping
from contextlib import suppress
from dataclasses import replace
from importlib import metadata
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec

from caviar_broker.core.plan import RunPlan, briefings, plan_run
from caviar_broker.journal_format import run_of_journal
from caviar_protocol.errors import RecordingError, RunError
from caviar_protocol.files import PUT_BACK, read_regular, refuse_other_kinds, replace_file, sync_file
from caviar_protocol.messages import PROTOCOL_VERSION, GrantInput, Status
from caviar_protocol.plugins import plugins
from caviar_protocol.run_directory import RunDirectory
from caviar_protocol.scenario import ReplaySpec, Scenario
from caviar_protocol.scenario.conversion import Source

PACKAGES = ("caviar_protocol", "caviar_space", "caviar_broker", "caviar_services", "caviar_bridges")
"""Code that takes part in a run."""
LIBRARIES = ("numpy", "msgspec", "pyzmq", "mcap")
TRACING = ("sionna-rt", "mitsuba", "drjit")
TRAFFIC = ("libsumo", "eclipse-sumo")
ENTRY_POINTS = "caviar.services"
"""Group through which other distributions add services."""


def versions_of(scenario: Scenario) -> dict[str, str]:
    """Version of each part that the results of a scenario may depend on; of code and files a hash.

    Libraries for ray tracing and traffic count where a service that `caviar run` starts may use them.
    """
    read = msgspec.structs.replace(scenario, source=Source())  # a run is resumed with what was read
    used = {spec.use for spec in scenario.services.values()}
    libraries = [*LIBRARIES]
    libraries += TRAFFIC if used & {"sumo", "sumo-actuated"} else ()
    # Implementations that import the ray tracer.
    libraries += TRACING if used & frozenset({"sionna-rt", "adaptive", "lidar", "camera"}) else ()
    found = {
        "python": platform.python_version(),
        "protocol": ".".join(map(str, PROTOCOL_VERSION)),
        "code": _hash_of(path for package in PACKAGES for path in _sources(package)),
    }
    found |= {name: _version(name) for name in libraries}
    for package in sorted({use.partition(".")[0].partition(":")[0] for use in used if ":" in use}):
        found[f"code of {package}"] = _hash_of(_sources(package))
    # A service of another distribution changes with that distribution's version.
    for point in plugins(ENTRY_POINTS).values():
        if point.name.partition(":")[2] in used and point.dist is not None:
            found[point.dist.name] = point.dist.version
    for path in sorted(set(_files_in(msgspec.to_builtins(read)))):
        found[f"file {path}"] = _hash_of([path])
    return found


def changes(before: Mapping[str, str], now: Mapping[str, str]) -> str:
    """Names of what is of another version than before; empty where nothing is.

    Args:
        before: Versions that began the run.
        now: Versions of this process.
    """
    return "; ".join(
        f"{name} {now.get(name, 'not used')} (was {before.get(name, 'not used')})"
        for name in sorted({*before, *now})
        if before.get(name) != now.get(name)
    )


def _version(name: str) -> str:
    try:
        return metadata.version(name)
    except metadata.PackageNotFoundError:
        return "not installed"


def _sources(package: str) -> Iterator[Path]:
    spec = find_spec(package)
    if spec is None:
        return  # a service that is not installed here does not start here
    for folder in spec.submodule_search_locations or ():
        yield from sorted(Path(folder).rglob("*.py"))
    if not spec.submodule_search_locations and spec.origin:
        yield Path(spec.origin)


def _hash_of(paths: Any) -> str:
    """A short hash of the contents of files."""
    h = hashlib.sha256()
    for path in paths:
        # Name and length go in, too: code that moves from one file to the next is other code.
        data = path.read_bytes()
        h.update(f"{path.name}\0{len(data)}\0".encode())
        h.update(data)
    return h.hexdigest()[:16]


def _files_in(value: Any) -> Iterator[Path]:
    """Files that a scenario names, with their absolute paths."""
    if isinstance(value, Mapping):
        value = list(value.values())
    if isinstance(value, list | tuple):
        for item in value:
            yield from _files_in(item)
    elif isinstance(value, str) and len(value) < 4096:
        path = Path(value.removeprefix("file:"))
        if path.is_absolute() and path.is_file():
            yield path


_UNSET = "0" * 64
# The last line of the file.
_CHECK = re.compile(rb'\n "check": "([0-9a-f]{64})"\n}\n$')


class RunRecord(msgspec.Struct, frozen=True, kw_only=True):
    """``run.json``: who runs what, where, and with which code."""

    run: str
    epoch: int
    """Of the broker that wrote this."""
    endpoint: str
    """Where that broker listened."""
    scenario: Scenario
    """As resolved, with the command line's values and absolute paths."""
    versions: dict[str, str] = {}
    """Of all that the results depend on, as `caviar_broker.versions.versions_of` finds them."""
    check: str = _UNSET
    """SHA-256 of the file with zeros in this place."""

    def save(self, directory: Path) -> None:
        """Write it, in one step and to the disk. `RunError` naming the file where that fails."""
        path = RunDirectory(directory).record
        file = self.scenario.source.file  # whose folder may have modules of services
        source = Source(file=str(Path(file).resolve()) if file else "")
        without_lines = msgspec.structs.replace(self.scenario, source=source)
        plain = msgspec.structs.replace(self, scenario=without_lines, check=_UNSET)
        data = msgspec.json.format(msgspec.json.encode(plain), indent=1) + b"\n"
        check = hashlib.sha256(data).hexdigest()
        try:
            replace_file(path, data.replace(_UNSET.encode(), check.encode()))
        except OSError as error:
            raise RunError(f"cannot write {path}: {error.strerror}") from error


def read_record(directory: Path) -> RunRecord:
    """The record of a run. `RecordingError` naming the file where it is none, or not as it was written."""
    path = RunDirectory(directory).record
    try:
        data = read_regular(path)
    except OSError as error:
        if isinstance(error, FileNotFoundError) and RunDirectory(directory).journal.exists():
            raise RecordingError(
                f"cannot resume {directory}: it has no {path.name}, and an embedded run cannot be "
                "resumed; run its scenario again"
            ) from error
        remedy = "; give the directory of a run" if isinstance(error, FileNotFoundError) else ""
        raise RecordingError(f"cannot resume {directory}: {path}: {error.strerror}{remedy}") from error
    found = _CHECK.search(data)
    if found is None or hashlib.sha256(_blanked(data, found)).hexdigest() != found[1].decode():
        why = "it is empty" if not data.strip(b"\0") else "its content is not that of its SHA-256"
        if found is None and b'"scenario"' in data and b'"check"' not in data:
            why = "it has no check value; a run that another version began is resumed by that version"
        raise RecordingError(f"cannot resume {directory}: {path} is damaged: {why}")
    try:
        return msgspec.json.decode(data, type=RunRecord)
    except msgspec.MsgspecError as error:
        raise RecordingError(f"cannot resume {directory}: {path} is damaged: {error}") from error


def _blanked(data: bytes, found: re.Match[bytes]) -> bytes:
    return data[: found.start(1)] + _UNSET.encode() + data[found.end(1) :]


if TYPE_CHECKING:
    from caviar_protocol.assets import AssetStore
    from caviar_protocol.recording import Recording


def has_recording(directory: Path) -> bool:
    """Whether there is a file of a recording."""
    return bool(RunDirectory(directory).segments())


def recorded_frames(directory: Path, scenario: Scenario) -> tuple[tuple[int, int] | None, tuple[str, ...]]:
    """The last recorded episode and how many frames of it there are, and what is damaged, a line each.

    None where no recorder of this machine takes part: how far another got is known to that one alone.

    Args:
        directory: Of the run.
        scenario: Of the run.
    """
    recorders = [spec for spec in scenario.services.values() if spec.role == "recorder"]
    # A recording on another machine cannot be looked at: its recorder says what it lacks when it is granted.
    if not any(not spec.remote for spec in recorders):
        return None, ()
    from caviar_protocol.recording.integrity import recorded_until

    last, damage = recorded_until(directory)
    return ((0, 0) if last is None else (last[0], last[1] + 1)), damage


def sync_recording(directory: Path) -> None:
    """Put on the disk what a recorder of this machine has handed to the system.

    The recorder closes a segment when it opens the next one, so the last two may have changed since the
    last time. `RunError` naming the directory where that fails.
    """
    try:
        # The directory too, or a segment that is new could be lost with its name.
        for path in [*RunDirectory(directory).segments()[-2:], directory]:
            # A recorder that goes on writes its last segment anew, so that the file may be gone for a moment.
            with suppress(FileNotFoundError):
                sync_file(path)
    except OSError as error:
        raise RunError(f"cannot put the recording in {directory} on the disk: {error.strerror}") from error


def check_run_files(directory: Path, journal: Path, run: str) -> None:
    """Check that journal and recording are files, and those of this run.

    Args:
        directory: Of the run.
        journal: In it.
        run: Id of the run, as ``run.json`` has it.

    Raises:
        RunError: A file is another run's, or no regular file.
        RecordingError: The journal is none. What is damaged is not looked at here.
    """
    from caviar_protocol.recording import read_manifest
    from caviar_protocol.recording.integrity import metadata_of
    from caviar_protocol.recording.segment import Segment

    files = RunDirectory(directory)
    segments = files.segments()
    for path in (journal, files.manifest, *segments):
        try:
            refuse_other_kinds(path, PUT_BACK)
        except OSError as error:
            raise RunError(f"cannot resume {directory}: {path}: {error.strerror}") from error
    # Each file says by itself which run it is of; copies of a directory keep that.
    runs = {journal.name: run_of_journal(journal)}
    # What is damaged is mended or reported by the reader of the recording; here it only must not be
    # another's.
    with suppress(RecordingError):
        manifest = read_manifest(directory)
        runs[files.manifest.name] = manifest.run if manifest else ""
    with suppress(RecordingError):
        runs |= {path.name: metadata_of(Segment(path)).run for path in segments[:1]}
    strange = [f"{name} is of run {other!r}" for name, other in runs.items() if other not in ("", run)]
    if strange:
        raise RunError(
            f"cannot resume {directory}: run.json is of run {run!r}, but {' and '.join(strange)}; "
            "put the files of one run together"
        )


def planned_run(scenario: Scenario, run: str, directory: Path, store: AssetStore, *, keeps: bool) -> RunPlan:
    """Plan a run, for its broker or for one process.

    Args:
        scenario: After `with_ownership`.
        run: Its id.
        directory: Of the run, as services are told.
        store: Gets the files of antennas and of trained policies.
        keeps: Whether the directory keeps the policies.

    Raises:
        RecordingError: There is no recording of the run that is repeated.
        AssetError: A file cannot be read or stored.
        ScenarioError: A policy is not the one that the scenario names.
    """
    # Late: a command that only reads a record needs neither sockets nor asyncio.
    from caviar_broker.assets import pattern_files
    from caviar_broker.policies import given_policies

    return replace(
        _with_replay(plan_run(scenario, run, briefings(scenario, directory)), scenario.replay),
        patterns=pattern_files(scenario, store),
        policies=given_policies(scenario, store, directory if keeps else None),
    )


def _with_replay(plan: RunPlan, spec: ReplaySpec | None) -> RunPlan:
    """The plan with the recorded decisions and misses of a run that is repeated.

    Args:
        plan: Of the run that repeats.
        spec: What it repeats; None: nothing.

    Raises:
        RecordingError: There is no such recording.
    """
    if spec is None:
        return plan
    from caviar_protocol.recording import Recording
    from caviar_protocol.recording.reader import recorded_decisions

    recording = Recording(spec.recording)
    decisions = recorded_decisions(recording)
    return replace(
        plan,
        imposed={key: taken for key, taken in decisions.items() if key[0] in spec.imposed},
        recorded=recorded_misses(recording, spec.served),
    )


def recorded_misses(
    recording: Recording, services: Collection[str]
) -> dict[tuple[str, int, int], tuple[GrantInput, ...]]:
    """Provenance of the products of a frame, by (service, episode, frame), where not all were fresh."""
    found: dict[tuple[str, int, int], list[GrantInput]] = {}
    for index in range(len(recording)):
        entry = recording.entry(index)
        for item in entry.inputs:
            if item.source in services and item.status is not Status.LATE:
                found.setdefault((item.source, entry.episode, entry.frame), []).append(item)
    return {
        key: tuple(items)
        for key, items in found.items()
        if any(item.status is not Status.FRESH for item in items)
    }
