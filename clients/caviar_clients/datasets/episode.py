"""One episode of a dataset: one embedded run in this process, and its recording renamed into place.

It imports services, and runs in the processes of a cluster.
"""

from __future__ import annotations

import gc
import logging
import os
import socket
import tempfile
import time
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from datetime import UTC, datetime
from functools import cache
from pathlib import Path
from typing import Any

import msgspec

from caviar_clients.datasets.cluster_watch import LOOK_S, StepWatch
from caviar_clients.datasets.directory import DatasetDirectory, rename_unless_there, unwritable
from caviar_clients.datasets.remote import RemoteDataset, is_address
from caviar_clients.datasets.rows import EpisodeRows, rows_of
from caviar_clients.files import printable
from caviar_clients.session.embedded import EmbeddedRun
from caviar_protocol.assets import default_folder
from caviar_protocol.errors import CaviarError
from caviar_protocol.files import PrivateFolder, replace_file, sync_file
from caviar_protocol.host import resident_mib
from caviar_protocol.recording import Recording
from caviar_protocol.run_directory import RunDirectory
from caviar_protocol.scenario import Scenario
from caviar_services.channel.sionna.scene import MadeScene, shared_scenes
from caviar_services.recorder.provenance import installed_versions

MEASURED = "measured.json"
"""Beside the recording of an episode: times, host and start, which differ from run to run."""
SETTINGS = "settings"
"""Key in that file of the digest of the settings of the dataset."""
# Of the episode before in this process: the next one of its dataset has the same scenery.
_scenes: list[MadeScene] = []


@cache
def _settle() -> None:
    """Spare collections what stays in this process: libraries, and the scene of its first episode."""
    gc.collect()
    gc.freeze()


@dataclass(frozen=True)
class EpisodeTask:
    """Task of a process that plays an episode."""

    scenario: Scenario
    """With the settings of a dataset (`plan.dataset_scenario`)."""
    episode: int
    out: str
    """Folder of the dataset, as the process sees it, or its address (`remote`)."""
    trial: bool = False
    """Whether the recording is removed once its time and size are known."""
    kept: str = ""
    """Where the recording of a trial is moved to; empty: it is removed."""
    cached: Mapping[str, bytes] = field(default_factory=dict)
    """Files that the cache of the process's user needs, by their names in it (`generate.SharedTraffic`)."""
    settings: str = ""
    """Digest of the settings of the dataset (`settings.fingerprint`): kept beside the recording, so that a
    catalogue can be made from recordings; empty: not known."""


@dataclass(frozen=True)
class EpisodeResult:
    """Result of an episode."""

    episode: int
    error: str = ""
    """Why it failed; empty: it is there."""
    rows: EpisodeRows | None = None
    """Of the catalogue; None where it failed."""
    measured: dict[str, Any] = field(default_factory=dict)
    """Times, host and start."""


@contextmanager
def _quiet_services() -> Iterator[None]:
    """Silence the services' logger: the result has what fails, with episode and cause."""
    logger = logging.getLogger("caviar.service")
    before = logger.level
    logger.setLevel(logging.CRITICAL)
    try:
        yield
    finally:
        logger.setLevel(before)


@_quiet_services()
def play_episode(task: EpisodeTask) -> EpisodeResult:
    """Play an episode, and put its recording into place.

    The result has whatever fails: an episode that fails is no reason to lose others.

    Args:
        task: The episode.

    Returns:
        Rows of the catalogue and times, or the error.
    """
    began, cpu = time.monotonic(), time.process_time()
    measured: dict[str, Any] = {
        "host": socket.gethostname(),
        "pid": os.getpid(),
        "started": datetime.now(UTC).isoformat(timespec="milliseconds"),
    }
    remote = RemoteDataset(task.out) if is_address(task.out) else None
    directory = DatasetDirectory(Path(task.out))
    target = directory.episode(task.episode)
    stack = ExitStack()
    try:
        if remote is None and target.exists() and not task.trial:
            # By a twin of this task, on a worker that was given up.
            return EpisodeResult(task.episode, rows=rows_of(Recording(target)), measured=measured)
        work = stack.enter_context(work_folder(task.out, str(task.episode)))
    except OSError as error:
        return EpisodeResult(task.episode, str(unwritable(error.filename or task.out, error)))
    except CaviarError as error:
        return EpisodeResult(task.episode, str(error))
    try:
        # The last part is the id of the run, which the recording has in it.
        folder = work / target.name
        folder.mkdir()
        times = _play(task, folder)
        rows = rows_of(Recording(folder))
        used = {"wall_s": time.monotonic() - began, "cpu_s": time.process_time() - cpu}
        measured |= {**used, "memory_mib": resident_mib(), **times}
        if not task.trial:
            _put_into_place(folder, remote or target, task, measured)
        else:
            measured["disk_b"] = _on_disk(folder)
            if task.kept:
                folder.rename(task.kept)
        return EpisodeResult(task.episode, rows=rows, measured=measured)
    except CaviarError as error:
        return EpisodeResult(task.episode, printable(str(error)), measured=measured)
    except OSError as error:
        return EpisodeResult(task.episode, str(unwritable(error.filename or work, error)), measured=measured)
    finally:
        stack.close()


def _play(task: EpisodeTask, folder: Path) -> dict[str, Any]:
    """Play; the wall time of each service, summed over the scenes [s]."""
    for name, content in task.cached.items():
        file = default_folder() / name
        if not file.exists():
            file.parent.mkdir(parents=True, exist_ok=True)
            replace_file(file, content, durable=False, concurrent=True)
    watch = StepWatch(task.episode)
    run = EmbeddedRun(
        task.scenario,  # which is checked where the dataset is planned
        folder,
        on_frame=watch.frame_finished,
        on_wait=watch.waits,
        wait_again_s=LOOK_S,
        episode=task.episode,
        with_journal=False,
    )
    earlier = _scenes[-1:]
    _scenes.clear()  # an episode that fails may leave a scene that is half changed
    with shared_scenes(earlier):
        outcome = run.run()
    if outcome.error:
        raise CaviarError(outcome.error)
    _scenes.extend(earlier)
    _settle()
    services = run.statistics.recent_services()
    return {"services_s": {name: service.total_ms / 1e3 for name, service in services.items()}}


def _on_disk(folder: Path) -> int:
    """Space that a recording takes of the disk, with its folder and a block for what is measured [B]."""
    about = [path.stat() for path in (folder, *folder.iterdir())]
    return sum(stat.st_blocks * 512 for stat in about) + about[0].st_blksize


@contextmanager
def work_folder(out: str, prefix: str) -> Iterator[Path]:
    """Make a folder for what is half-written: on the disk of what is complete, so that it can be renamed.

    Of a dataset with an address it is one of the temporary folders of this machine. It is removed at the end.

    Args:
        out: Folder or address of the dataset.
        prefix: Of its name.
    """
    if is_address(out):
        with PrivateFolder(prefix) as folder:
            yield folder.path
        return
    work = DatasetDirectory(Path(out)).work
    work.mkdir(exist_ok=True)
    with tempfile.TemporaryDirectory(prefix=f"{prefix}-", dir=work, ignore_cleanup_errors=True) as made:
        yield Path(made)


def _put_into_place(
    folder: Path, target: Path | RemoteDataset, task: EpisodeTask, measured: dict[str, Any]
) -> None:
    """Have the disk hold a recording, and rename it in one step; upload it where the dataset is elsewhere."""
    # The recording names what it was computed with; this is everything that was installed.
    beside = {**measured, "versions": installed_versions()}
    if task.settings:
        beside[SETTINGS] = task.settings
    replace_file(folder / MEASURED, msgspec.json.encode(beside) + b"\n", durable=False)
    if isinstance(target, RemoteDataset):
        target.put_episode(task.episode, folder)
        return
    for file in (*RunDirectory(folder).segments(), RunDirectory(folder).manifest, folder):
        sync_file(file)
    # Where a twin was quicker, its recording is as good: it depends on the episode alone.
    rename_unless_there(folder, target)
    sync_file(target.parent)
