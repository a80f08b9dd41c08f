"""The broker as a process: ``python -m caviar_broker SCENARIO --bind URL --directory DIR``.

``python -m caviar_broker --resume DIR`` resumes a run that another broker left, at the address
where that one listened unless ``--bind`` says another.

With ``--control`` a launcher talks to it in JSON lines. On standard output come ``listening``,
``notice``, ``frame`` and ``finished`` events; on standard input it takes
``{"lost": SERVICE, "verdict": TEXT}``, ``{"restarted": SERVICE, "text": TEXT}`` and
``{"stop": REASON}``. When the input ends, the run does.
"""

from __future__ import annotations

import argparse
import gc
import resource
import signal
import sys
from collections.abc import Mapping, Sequence
from contextlib import closing, nullcontext
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import msgspec

from caviar_broker.control.launcher import LauncherPipe, Reporter, stop_on_signals
from caviar_broker.control.server import ControlServer
from caviar_broker.control.socket import locked, refuse_second_broker
from caviar_broker.core.plan import with_ownership
from caviar_broker.event_loop import call_with_timeout, raise_priority
from caviar_broker.journal import CheckpointFiles, JournalFile
from caviar_broker.resume import ResumeState, read_resumption
from caviar_broker.run_record import (
    RunRecord,
    changes,
    check_run_files,
    has_recording,
    planned_run,
    read_record,
    recorded_frames,
    sync_recording,
    versions_of,
)
from caviar_broker.security.access import Access, check_bind
from caviar_broker.security.limits import PeerLimits
from caviar_broker.server import BrokerServer
from caviar_protocol.assets import AssetStore
from caviar_protocol.errors import CaviarError, RunError
from caviar_protocol.files import file_system_of
from caviar_protocol.host import steady_memory
from caviar_protocol.run_directory import RunDirectory
from caviar_protocol.scenario import attached, load_scenario
from caviar_protocol.scenario.rules import with_overrides

if TYPE_CHECKING:
    from caviar_broker.http.process import HttpProcess

SAVE_S = 5.0
"""[s] that is waited for the disk to take the latencies."""
OWN_DESCRIPTORS = 40
"""Open files of a broker without services: 27 of its own, and a few strangers that connect."""
SERVICE_DESCRIPTORS = 4
"""Open files for each service: two connections, its process, and an asset or checkpoint that is written."""
WANTED_DESCRIPTORS = 16_384
"""Open files that a broker asks for where the system grants them: connections that it lets wait."""
DEFAULT_BIND = "tcp://127.0.0.1:5570"


def tune_garbage_collector() -> None:
    """Let the garbage collector look less often: what a frame leaves behind has no cycles, and
    is freed by counting references."""
    gc.collect()
    gc.freeze()
    gc.set_threshold(50_000, 20, 20)


def reserve_descriptors(services: int) -> None:
    """Ask the system for as many open files as a broker of that many services may need.

    Raises:
        RunError: Fewer are granted than a run takes; it names limit and remedy. Accepting a
            connection without a free descriptor fails in silence, and the service that made it seems dead.
    """
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    if soft == resource.RLIM_INFINITY:
        return
    granted = WANTED_DESCRIPTORS if hard == resource.RLIM_INFINITY else min(hard, WANTED_DESCRIPTORS)
    if soft < granted:
        resource.setrlimit(resource.RLIMIT_NOFILE, (granted, hard))
        soft = granted
    needed = OWN_DESCRIPTORS + SERVICE_DESCRIPTORS * services
    if soft < needed:
        raise RunError(
            f"this process may have {soft} files open, and a run of {services} services needs {needed}; "
            "raise the limit with  ulimit -n 1024  (LimitNOFILE= of systemd, --ulimit nofile of Docker)"
        )


def serve(arguments: argparse.Namespace) -> int:
    """Run the broker; the exit status: 0 exactly if the run came to its end."""
    steady_memory()
    record, directory, forced = _resumed(arguments) if arguments.resume else _begun(arguments)
    with locked(directory):  # before its journal is read, which is cut where it is damaged
        return _serve(arguments, record, directory, forced)


def _serve(arguments: argparse.Namespace, record: RunRecord, directory: Path, forced: Sequence[str]) -> int:
    scenario = with_ownership(record.scenario)
    reserve_descriptors(len(scenario.services))
    local = {name: spec.role for name, spec in scenario.services.items() if not spec.remote}
    access = _access(arguments, local)
    check_bind(record.endpoint, keys=access is not None)
    beside = _http_process(arguments, directory)
    store = AssetStore()
    plan = replace(planned_run(scenario, record.run, directory, store, keeps=True), epoch=record.epoch)
    durability = record.scenario.run.durability
    # Under every durability but `none` a state is on the disk before an older one is removed.
    checkpoints = CheckpointFiles(directory, durable=durability != "none")
    # A launcher that starts its broker again has not summed the run up yet.
    files = RunDirectory(directory)
    last = files.summary if arguments.control else files.latencies
    left = _left(directory, record, checkpoints, last) if arguments.resume else _NOTHING
    if left.is_cut and not has_recording(directory) and not arguments.force:
        raise RunError(
            f"cannot resume {directory}: its recording is gone; put it back, or begin again with --force"
        )
    resumption = left.resumption
    scheduling = raise_priority()  # before the threads of the port are started, which inherit it
    reporter = Reporter(sys.stdout.fileno(), files.events, arguments.control)
    journal_file = JournalFile(
        files.journal, plan.epoch, checkpoints, left.end, run=plan.run, durable=durability != "none"
    )
    with closing(journal_file) as journal:
        supervised = arguments.supervised if arguments.control else ()
        control = ControlServer(directory, reporter)
        with closing(beside) if beside is not None else nullcontext(), closing(control):
            server = BrokerServer(
                plan,
                record.endpoint,
                journal,
                control,
                store=store,
                supervised=supervised,
                access=access,
                peer_limits=PeerLimits.from_scenario(record.scenario.limits),
                resumption=resumption,
                durability=durability,
                sync_recording=lambda: sync_recording(directory),
            )
            msgspec.structs.replace(record, endpoint=server.endpoint).save(directory)
            reporter.attach(server)
            control.attach(server)
            if resumption is not None:
                server.statistics.earlier = resumption.finished_before + resumption.finished
            if arguments.control:
                LauncherPipe(server)
            stopped = stop_on_signals(server)
            reporter.listening(server.endpoint)
            for line in forced:
                server.note("", line)
            if left.losses:
                server.note("", "; ".join(left.losses), "damage")
            if beside is not None:
                beside.start(server)
            # Last: what is there by now lives as long as the run, and is never looked at again.
            tune_garbage_collector()
            outcome = server.run(raise_priority)
    statistics = server.statistics
    takes_files = server.disk_answers and call_with_timeout(lambda: statistics.save(files.latencies), SAVE_S)
    figures = statistics.figures()
    reporter.finished(
        disk="" if takes_files else f"the disk does not answer: {file_system_of(directory)}",
        error=outcome.error,
        culprit=outcome.culprit,
        digest=outcome.digest,
        **figures | {"deadlines": {"scheduling": scheduling} | figures["deadlines"]},
    )
    if outcome.error and not arguments.control:
        sys.stderr.write(f"caviar broker: {outcome.error}\n")
    # The interpreter puts handlers back to the default while it ends: a late SIGTERM would be the status.
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    if arguments.restarted and stopped():
        return 0
    return 1 if outcome.error else 0


def _http_process(arguments: argparse.Namespace, directory: Path) -> HttpProcess | None:
    """The process that serves HTTP, where there is to be one."""
    if not arguments.http:
        return None
    # Its module loads asyncio and urllib: a broker that serves no HTTP starts 30 ms sooner without.
    from caviar_broker.http.process import HttpProcess

    return HttpProcess(directory, arguments.http, arguments.keys, again=bool(arguments.resume))


def _access(arguments: argparse.Namespace, local: Mapping[str, str]) -> Access | None:
    if arguments.keys is None:
        return None
    return Access(arguments.keys, arguments.local_key, local)


def _begun(arguments: argparse.Namespace) -> tuple[RunRecord, Path, tuple[str, ...]]:
    """A new run, and its directory."""
    if arguments.scenario is None or arguments.directory is None:
        raise RunError("give a scenario and a --directory, or --resume with the directory of a run")
    scenario = with_overrides(
        load_scenario(arguments.scenario, arguments.set), arguments.frames, arguments.seed, arguments.pace
    )
    scenario = attached(scenario, arguments.attach)
    try:
        arguments.directory.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise RunError(
            f"cannot write the run to {arguments.directory}: {error.strerror}; choose another --directory"
        ) from error
    directory = arguments.directory.resolve()
    run, endpoint = arguments.run or directory.name, arguments.bind or DEFAULT_BIND
    versions = versions_of(scenario)
    return (
        RunRecord(run=run, epoch=1, endpoint=endpoint, scenario=scenario, versions=versions),
        directory,
        (),
    )


def _resumed(arguments: argparse.Namespace) -> tuple[RunRecord, Path, tuple[str, ...]]:
    """A run that another broker left, in the next epoch; and what of it is different by ``--force``."""
    directory: Path = arguments.resume.resolve()
    before = read_record(directory)
    refuse_second_broker(directory)
    versions = versions_of(before.scenario)
    different = changes(before.versions, versions)
    if different and not arguments.force:
        raise RunError(
            f"cannot resume {directory}: it was begun with other versions, and its results may differ: "
            f"{different}. Resume it with the versions that began it, or with these by --force"
        )
    # The directory of a private socket goes with the launcher that made it.
    listened = DEFAULT_BIND if before.endpoint.startswith("ipc://") else before.endpoint
    endpoint = arguments.bind or listened
    record = msgspec.structs.replace(before, epoch=before.epoch + 1, endpoint=endpoint, versions=versions)
    return record, directory, (f"the run continues with other versions: {different}",) if different else ()


_NOTHING = ResumeState(None, None, ())


def _left(directory: Path, record: RunRecord, checkpoints: CheckpointFiles, last: Path) -> ResumeState:
    """State of a run by its journal and its recording.

    Raises:
        RunError: They are no files, or those of another run, or every frame is finished and there
            is ``last``, the file that is written last.
    """
    journal = RunDirectory(directory).journal
    if not journal.exists():
        return _NOTHING
    scenario = record.scenario
    check_run_files(directory, journal, record.run)
    recorded, damage = recorded_frames(directory, scenario)
    left = read_resumption(journal, checkpoints, recorded)
    found = left.resumption
    over = found is not None and found.finished >= found.frames and found.episode + 1 >= scenario.run.episodes
    if over and last.exists() and last.stat().st_size:
        raise RunError(
            f"cannot resume {directory}: all its frames are finished, and so is it; "
            "to run its scenario again leave out --resume"
        )
    return replace(left, losses=(*damage, *left.losses)) if left.is_cut else left


def parser() -> argparse.ArgumentParser:
    """Command line of the broker."""
    found = argparse.ArgumentParser(prog="python -m caviar_broker", description=__doc__)
    found.add_argument("scenario", type=Path, nargs="?")
    found.add_argument("--bind", default="", help=f"address to listen on; by default {DEFAULT_BIND}")
    found.add_argument("--keys", type=Path, help="keys directory: who may take part (caviar keys)")
    found.add_argument("--local-key", default="", help="public key of the services that a launcher starts")
    found.add_argument("--http", default="", help="HOST:PORT: serve HTTP and WebSocket there")
    found.add_argument("--directory", type=Path, help="where the run is written")
    found.add_argument("--resume", type=Path, help="resume the run in this directory, and nothing else")
    found.add_argument("--force", action="store_true", help="with --resume: though versions have changed")
    found.add_argument("--run", default="", help="id of the run; by default the directory's name")
    found.add_argument("--frames", type=int, default=None, help="instead of the scenario's")
    found.add_argument("--seed", type=int, default=None, help="instead of the scenario's")
    found.add_argument("--pace", default=None, help="instead of the scenario's: free, realtime or a factor")
    found.add_argument("--set", action="append", default=[], help="KEY=VALUE, instead of the scenario's")
    found.add_argument("--attach", action="append", default=[], help="NAME=VALUE of an attachment")
    found.add_argument(
        "--restarted", action="store_true", help="started again whenever its status is not 0: 0 after SIGTERM"
    )
    found.add_argument("--control", action="store_true", help="talk JSON lines with a launcher")
    found.add_argument("--supervised", nargs="*", default=[], help="services the launcher watches itself")
    return found


def main() -> int:
    """Parse the command line and serve; the exit status."""
    try:
        return serve(parser().parse_args())
    except CaviarError as error:
        sys.stderr.write(f"caviar broker: {error}\n")
        return 1
