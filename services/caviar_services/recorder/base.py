"""What all recorders share.

A recorder takes every product of a frame, with every decision about it, and creates no demand
(contract, clause 5). Its DONE says that the frame is in the hands of the operating system, so
that a killed process loses no frame that was acknowledged. Of the overrun policies only ``wait``
and ``abort`` are allowed (clause 9).
"""

from __future__ import annotations

import errno
import hashlib
import os
import platform
import re
import shutil
from collections.abc import Mapping
from importlib import metadata
from pathlib import Path, PurePosixPath
from typing import ClassVar, Generic, TypeVar

import msgspec

from caviar_protocol.errors import AssetError, RunError
from caviar_protocol.files import sync_file
from caviar_protocol.messages import Asset, Input, Role
from caviar_services.service import Service

S = TypeVar("S", bound=msgspec.Struct)

DISTRIBUTION = "caviar-sim"


class Recorder(Service[S], Generic[S]):
    """Base of the recorders: takes all topics, requires none, produces nothing.

    A subclass implements `Service.step`, which returns once every product of the frame, and its provenance,
    is with the operating system (``frame.inputs`` are the products, ``frame.reports`` what services reported
    beside them).

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
        """Those that ``run.record`` of the scenario names."""
        run = self.run.scenario.get("run", {})
        found: dict[str, frozenset[str]] = {}
        for entry in run.get("record", ()) if isinstance(run, Mapping) else ():
            topic, _, part = entry.partition(".")
            found[topic] = found.get(topic, frozenset()) | ({part} - {""})
        return found


_REMEDIES = {
    errno.ENOSPC: "free space on its file system, then go on with caviar run --resume {folder}, "
    "or choose another directory with --out",
    errno.EDQUOT: "free space within your quota, then go on with caviar run --resume {folder}, "
    "or choose another directory with --out",
    errno.EFBIG: "raise the limit of file sizes (ulimit -f), or set segment_mib of the recorder below it",
    errno.EMFILE: "raise the limit of open files (ulimit -n)",
    errno.ENFILE: "the machine has too many open files: end programs, or raise fs.file-max",
    errno.EROFS: "its file system can only be read: choose another directory with --out",
    errno.EACCES: "allow writing there, or choose another directory with --out",
    errno.ENOENT: "the run's directory was removed or renamed while the run wrote to it: leave it there",
}


def failure(path: Path, error: OSError) -> RunError:
    """The error that ends a run whose recording cannot be written: path, reason and remedy."""
    remedy = _REMEDIES.get(error.errno or 0, "choose another directory with --out")
    return RunError(
        f"the recorder cannot write {path}: {error.strerror or error} (errno {error.errno}); "
        f"{remedy.format(folder=path.parent)}"
    )


def versions() -> dict[str, str]:
    """Versions of Python, of this distribution, and of its dependencies that are installed."""
    found = {"python": platform.python_version()}
    try:
        requirements = [DISTRIBUTION, *(metadata.requires(DISTRIBUTION) or ())]
    except metadata.PackageNotFoundError:
        return found
    for requirement in requirements:
        if requirement.endswith(('extra == "dev"', "extra == 'dev'")):
            continue  # tools of developers take no part in a run
        name = re.split(r"[^A-Za-z0-9._-]", requirement, maxsplit=1)[0]
        try:
            found[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            continue
    return dict(sorted(found.items()))


def machine() -> dict[str, str]:
    """What a reader of performance figures asks first: system, CPU, memory, GPU."""
    found = {
        "platform": platform.platform(),
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


def copy_assets(assets: Mapping[str, Path], folder: Path, *, sync: bool = False) -> tuple[Asset, ...]:
    """Copy files of scenery to ``folder`` at their names; their digests and sizes, sorted by name.

    With ``sync`` they are on disk when this returns.
    Raises `AssetError` for a name that leads out of ``folder``.
    """
    copied = []
    for name, source in sorted(assets.items()):
        relative = PurePosixPath(name)
        if relative.is_absolute() or ".." in relative.parts:
            raise AssetError(f"asset {name!r} leads out of the recording; use a relative path without '..'")
        target = folder / relative
        target.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(source, target)
        with target.open("rb") as stream:
            digest = hashlib.file_digest(stream, "sha256").hexdigest()
        copied.append(Asset(name=name, digest=digest, size=target.stat().st_size))
    if sync and copied:
        files = [folder / asset.name for asset in copied]
        for path in [*files, *{file.parent for file in files}, folder, folder.parent]:
            sync_file(path)
    return tuple(copied)
