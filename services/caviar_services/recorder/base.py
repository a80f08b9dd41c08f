"""Base of all recorders.

A recorder takes every product of a frame, with every decision about it, and creates no demand
(contract, clause 5). Its DONE says that the frame is in the hands of the operating system, so
that a killed process loses no frame that was acknowledged. Of the overrun policies only ``wait``
and ``abort`` are allowed (clause 9).
"""

from __future__ import annotations

import errno
import os
import platform
import shutil
from collections.abc import Mapping
from pathlib import Path, PurePosixPath
from typing import ClassVar, Generic, TypeVar

import msgspec

from caviar_protocol.digest import file_digest
from caviar_protocol.errors import AssetError, RunError
from caviar_protocol.files import replace_file, sync_file
from caviar_protocol.messages import Asset, GrantInput, Input, Role, Status
from caviar_protocol.run_directory import RunDirectory
from caviar_services.service import Service

S = TypeVar("S", bound=msgspec.Struct)


class Recorder(Service[S], Generic[S]):
    """Base of the recorders: takes all topics, requires none, produces nothing.

    A subclass implements `Service.step`, which returns once every product of the frame, and its provenance,
    is with the operating system (``frame.inputs`` are the products, ``frame.reports`` what services reported
    beside them).

    Args:
        settings: The scenario's settings of the recorder.
        run: What the recorder knows about the run; it writes into ``run.directory``.

    Example:
        >>> from caviar_services.service import Frame, NoSettings, RunInfo, StepResult
        >>> class Counting(Recorder[NoSettings]):
        ...     products = 0
        ...
        ...     def step(self, frame: Frame) -> StepResult:
        ...         self.products += sum(item.present for item in frame.inputs)
        ...         return StepResult()
        >>> Counting(NoSettings(), RunInfo(name="recorder")).step(Frame(episode=0, number=0, t_ns=0)).products
        {}
    """

    role: ClassVar[Role] = "recorder"
    inputs: ClassVar[tuple[Input, ...]] = (Input(topic="*", required=False),)

    @property
    def parts(self) -> Mapping[str, frozenset[str]]:
        """Parts that ``run.record`` of the scenario names."""
        run = self.run.scenario.get("run", {})
        found: dict[str, frozenset[str]] = {}
        for entry in run.get("record", ()) if isinstance(run, Mapping) else ():
            topic, _, part = entry.partition(".")
            found[topic] = found.get(topic, frozenset()) | ({part} - {""})
        return found


class RunTime:
    """Run time of frames: a later episode begins one sampling period after the end of the one before.

    Args:
        sampling_period_ns: Sampling period of the run [ns].

    Example:
        >>> time = RunTime(100)
        >>> time.base_of(0, 0), time.base_of(0, 100), time.base_of(1, 0)
        (0, 0, 200)
    """

    def __init__(self, sampling_period_ns: int) -> None:
        self._period = sampling_period_ns
        self._episode = -1
        self._base_ns, self._last_ns = 0, 0

    def continue_from(self, episode: int, base_ns: int, t_ns: int) -> None:
        """Note a frame that is recorded already.

        Args:
            episode: Its episode.
            base_ns: Run time of the episode's zero [ns].
            t_ns: Simulated time of the frame [ns].
        """
        self._episode, self._base_ns, self._last_ns = episode, base_ns, base_ns + t_ns

    def base_of(self, episode: int, t_ns: int) -> int:
        """Run time of an episode's zero [ns], for its next frame.

        Args:
            episode: The episode.
            t_ns: Simulated time of the frame [ns].
        """
        if self._episode >= 0 and episode != self._episode:
            self._base_ns = self._last_ns + self._period - t_ns
        self._episode, self._last_ns = episode, self._base_ns + t_ns
        return self._base_ns


class StoredProducts:
    """Products of the episode that are in the recording already: their bytes are stored once.

    Example:
        >>> stored = StoredProducts()
        >>> stored.begin(0)
        >>> fresh = GrantInput(topic="scene", source="world", status=Status.FRESH, frame=3)
        >>> held = GrantInput(topic="scene", source="world", status=Status.HELD, frame=3, age=1)
        >>> stored.is_new(fresh), stored.is_new(held)
        (True, False)
    """

    def __init__(self) -> None:
        self._newest: dict[tuple[str, str], int] = {}
        self._episode = -1

    def begin(self, episode: int) -> None:
        """Begin an episode, unless it has begun.

        Args:
            episode: Number of the episode.
        """
        if episode != self._episode:
            self._newest.clear()
            self._episode = episode

    def is_new(self, entry: GrantInput) -> bool:
        """Return whether the bytes of a product have to be stored; from then on they count as stored.

        Args:
            entry: Provenance of the product.
        """
        if entry.status is Status.ABSENT:
            return False
        key = (entry.topic, entry.source)
        newest = self._newest.get(key, -1)
        # A product that came too late for its own frame is held by later ones, and stored with the first.
        if entry.status is Status.HELD and newest == entry.frame:
            return False
        self._newest[key] = max(newest, entry.frame)
        return True


# Whatever else the system says, another directory may help.
_REMEDIES = {
    errno.ENOSPC: "free space on its file system{resume}, or choose another directory with --out",
    errno.EDQUOT: "free space within your quota{resume}, or choose another directory with --out",
    errno.EFBIG: "raise the limit of file sizes (ulimit -f), or set segment_mib of the recorder below it",
    errno.EMFILE: "raise the limit of open files (ulimit -n)",
    errno.ENFILE: "the machine has too many open files: end programs, or raise fs.file-max",
    errno.EROFS: "its file system can only be read: choose another directory with --out",
    errno.EACCES: "allow writing there, or choose another directory with --out",
    errno.ENOENT: "the run's directory was removed or renamed while the run wrote to it: leave it there",
}


def failure(path: Path, error: OSError) -> RunError:
    """The error that ends a run whose recording cannot be written.

    Args:
        path: The file or directory.
        error: What the operating system said.

    Returns:
        The error, with path, reason and remedy.

    Example:
        >>> print(failure(Path("/run/x.mcap"), OSError(errno.EROFS, "Read-only file system")))
        the recorder cannot write /run/x.mcap: Read-only file system (errno 30); its file system can only be \
read: choose another directory with --out
    """
    remedy = _REMEDIES.get(error.errno or 0, "choose another directory with --out")
    # A run in one process has no run.json, and cannot be resumed.
    resumable = RunDirectory(path.parent).record.exists()
    resume = f", then resume with caviar run --resume {path.parent}" if resumable else ""
    return RunError(
        f"the recorder cannot write {path}: {error.strerror or error} (errno {error.errno}); "
        f"{remedy.format(folder=path.parent, resume=resume)}"
    )


def machine() -> dict[str, str]:
    """Machine, as a reader of performance figures needs it: system, CPU, memory, GPU.

    Example:
        >>> sorted({"cpu", "cpu_count", "memory_gib", "platform"} - machine().keys())
        []
    """
    found = {
        "platform": platform.platform(),
        # `platform.processor` is empty on most Linux systems.
        "cpu": _after("model name", Path("/proc/cpuinfo")) or platform.processor() or platform.machine(),
        "cpu_count": str(os.cpu_count() or 0),
        "memory_gib": f"{os.sysconf('SC_PAGE_SIZE') * os.sysconf('SC_PHYS_PAGES') / 2**30:.1f}",
    }
    for information in sorted(Path("/proc/driver/nvidia/gpus").glob("*/information")):
        found["gpu"] = _after("Model", information)
    return found


def _after(key: str, file: Path) -> str:
    try:
        lines = file.read_text().splitlines()
    except OSError:
        return ""
    return next((line.partition(":")[2].strip() for line in lines if line.startswith(key)), "")


def copy_meshes(meshes: Mapping[str, Path], folder: Path, *, sync: bool = False) -> None:
    """Copy meshes that came while the run goes on into a recording.

    They are named by their content, so that one which is there already is the same.

    Args:
        meshes: File by asset name.
        folder: Where the copies go.
        sync: Whether they are on disk when this returns.

    Raises:
        OSError: A file cannot be read or written.
    """
    for name, source in sorted(meshes.items()):
        target = folder / PurePosixPath(name)
        if not target.is_file():
            target.parent.mkdir(parents=True, exist_ok=True)
            # In one step: a recorder that is killed leaves no half of a mesh under the name of the whole.
            replace_file(target, source.read_bytes(), durable=sync)


def copy_assets(assets: Mapping[str, Path], folder: Path, *, sync: bool = False) -> tuple[Asset, ...]:
    """Copy files of scenery into a recording.

    Args:
        assets: File by asset name, which is the relative path of the copy.
        folder: Where the copies go.
        sync: Whether they are on disk when this returns.

    Returns:
        Digests and sizes, sorted by name.

    Raises:
        AssetError: A name leads out of ``folder``.
        OSError: A file cannot be read or written.

    Example:
        >>> copy_assets({"../wall.ply": Path("wall.ply")}, Path("assets"))
        Traceback (most recent call last):
            ...
        caviar_protocol.errors.AssetError: asset '../wall.ply' leads out of the recording; use a relative \
path without '..'
    """
    copied = []
    for name, source in sorted(assets.items()):
        relative = PurePosixPath(name)
        if relative.is_absolute() or ".." in relative.parts:
            raise AssetError(f"asset {name!r} leads out of the recording; use a relative path without '..'")
        target = folder / relative
        target.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(source, target)
        copied.append(Asset(name=name, digest=file_digest(target), size=target.stat().st_size))
    if sync and copied:
        files = [folder / asset.name for asset in copied]
        # Directories too: a file whose name is not on disk is lost with the power, whatever else was synced.
        for path in [*files, *{file.parent for file in files}, folder, folder.parent]:
            sync_file(path)
    return tuple(copied)
