"""Process and machine: identity, memory of glibc, a sign of life, installed extras."""

from __future__ import annotations

import contextlib
import ctypes
import gc
import importlib.util
import os
import re
import signal
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from multiprocessing.process import BaseProcess

_STATUS, _CLEAR = Path("/proc/self/status"), Path("/proc/self/clear_refs")
_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD = -1, -3
# [B] Buffers from here on come from the system and return to it; each of their pages costs a fault.
_LARGE = 4 << 20
# [B] that a heap may keep at its end.
_SPARE = 64 << 20


def host_identity() -> str:
    """Identify the kernel and the process namespace that this process lives in.

    A process id means something only within one boot of one kernel and one PID namespace, so a
    container on the same machine is another host.

    Returns:
        A text that is equal in two processes exactly if one can watch the other by process id; empty if
        unknown.
    """
    try:
        boot = Path("/proc/sys/kernel/random/boot_id").read_text().strip()
        namespace = Path("/proc/self/ns/pid").readlink()
    except OSError:
        return ""
    return f"{boot}:{namespace}"


def resident_mib() -> float | None:
    """Return the resident memory of this process [MiB]; None where the system does not state it."""
    return _status("VmRSS")


def peak_mib() -> float | None:
    """Return its highest value since `reset_peak` [MiB]."""
    return _status("VmHWM")


def reset_peak() -> float | None:
    """Forget the highest value and return the present one [MiB]; None where that cannot be done."""
    try:
        # 5 resets the peak of the resident set, VmHWM (proc(5), since Linux 4.0).
        _CLEAR.write_text("5")
    except OSError:
        return None
    return resident_mib()


def _status(name: str) -> float | None:
    try:
        text = _STATUS.read_text()
    except OSError:
        return None
    found = re.search(rf"^{name}:\s+(\d+) kB$", text, re.MULTILINE)
    return int(found[1]) * 1024 / 2**20 if found else None


def steady_memory() -> None:
    """Let glibc keep what products of some megabytes need, and return what is larger to the system.

    By default it raises the size from which it does so up to 32 MiB, as buffers come and go, and keeps and
    splits all below: the memory of a process that handles megabytes in every frame creeps up for hours. With
    a small fixed size it stays flat too, but a product of 1 MB costs 250 page faults each time it passes.
    Without glibc nothing happens.
    """
    # Setting either of the two stops glibc from adapting both.
    _glibc("mallopt", _M_MMAP_THRESHOLD, _LARGE)
    _glibc("mallopt", _M_TRIM_THRESHOLD, _SPARE)


def keep_large_buffers() -> None:
    """Let glibc keep buffers of up to 32 MiB, the most that it can, for the next frame.

    For a process that makes a product of tens of megabytes in every frame, of about the same size: to get the
    pages of 10 MB from the system takes as long as to fill them. Without glibc nothing happens.
    """
    _glibc("mallopt", _M_MMAP_THRESHOLD, 32 << 20)
    _glibc("mallopt", _M_TRIM_THRESHOLD, 256 << 20)


def trim_memory() -> None:
    """Let glibc return what is free in its heap to the system: 0.1 ms for a small heap, milliseconds for a
    large one, and page faults when the memory is used again. Without glibc nothing happens."""
    _glibc("malloc_trim", 0)


def _glibc(function: str, *arguments: int) -> None:
    try:
        getattr(ctypes.CDLL(None), function)(*arguments)
    except (OSError, AttributeError):
        # musl and others have no mallopt; ctypes raises AttributeError for it.
        return  # another C library: it has a strategy of its own


VARIABLE = "CAVIAR_ALIVE"
"""Environment variable with the path of the file; without it no sign is given."""
INTERVAL_S = 1.0
"""[s] between signs at least."""


class SignOfLife:
    """A file that is as old as the last sign of life of this process, for the health check of a container.

    The environment variable ``CAVIAR_ALIVE`` names the file; without it no sign is given.

    Example:
        >>> SignOfLife().touch()  # as often as the process likes: once a second the file is touched
    """

    def __init__(self) -> None:
        name = os.environ.get(VARIABLE, "")
        self._path = Path(name) if name else None
        self._due = 0.0

    def touch(self) -> None:
        """Touch the file, unless that has just been done."""
        # The event loop gives a sign in every turn, thousands of times a second: a touch a second is enough.
        now = time.monotonic()
        if self._path is None or now < self._due:
            return
        self._due = now + INTERVAL_S
        # A file that cannot be written is no reason to end a run: the health check says so.
        with contextlib.suppress(OSError):
            self._path.touch()


PYTHON = (sys.executable, "-P")
"""This interpreter, for ``-m`` and ``-c``: without ``-P`` both find the current folder before the standard
library, and a file ``signal.py`` there in its place."""


@contextlib.contextmanager
def loading() -> Iterator[None]:
    """A block that loads libraries: looking for garbage, which that leaves none of, takes a tenth of it."""
    was_enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was_enabled:
            gc.enable()


@contextlib.contextmanager
def safe_path() -> Iterator[None]:
    """A block in which `multiprocessing` starts processes as with ``-P``, for which it has no option."""
    before = os.environ.get("PYTHONSAFEPATH", "")
    os.environ["PYTHONSAFEPATH"] = "1"
    try:
        yield
    finally:
        os.environ["PYTHONSAFEPATH"] = before  # empty is not set


def start_process(process: BaseProcess) -> None:
    """Start a process of `multiprocessing` that leaves Ctrl-C to this one, also while it imports, and that
    searches no module in the current folder (`safe_path`).

    Args:
        process: Made by the context ``spawn``.
    """
    from multiprocessing import resource_tracker

    # Python 3.11 starts its tracker with the first process, and unblocks SIGINT after that.
    resource_tracker.ensure_running()
    # A process inherits what the thread that starts it blocks; a handler of its own would come too late.
    blocked = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        with safe_path():
            process.start()
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, blocked)


DISTRIBUTION = "caviar-sim"
"""Name under which pip knows this project."""

# A module that each extra brings and the base install does not.
_MODULES = {
    "channel": "sionna",
    "sensors": "mitsuba",
    "world": "libsumo",
    "datasets": "distributed",
    "learning": "stable_baselines3",
    "plot": "matplotlib",
    "mavlink": "pymavlink",
    "mujoco": "mujoco",
    "panda3d": "panda3d",
    "system": "sionna.sys",
}


def has_extra(extra: str) -> bool:
    """Whether the libraries of an extra can be imported; they are not imported for that.

    Args:
        extra: Name of an extra: ``channel``, ``sensors``, ``world``, ``datasets``, ``learning``, ``plot``,
            ``mavlink``, ``mujoco``, ``panda3d`` or ``system``.
    """
    package, _, inner = _MODULES[extra].partition(".")
    spec = importlib.util.find_spec(package)
    # Looking for a module inside would import its package, a ray tracer.
    places = [] if spec is None else spec.submodule_search_locations or []
    return spec is not None and (not inner or any(Path(place, inner).is_dir() for place in places))


def install_command(*extras: str) -> str:
    """Shell command that adds extras to this installation.

    It names the interpreter that runs, so that it works without an activated environment; pip takes the
    requirements of the extras from the metadata of what is installed, be that a wheel or a checkout.

    Args:
        extras: Names of extras, as in pyproject.toml.

    Returns:
        ``/…/python -m pip install 'caviar-sim[plot]'``

    Example:
        >>> install_command("plot", "world").partition(" -m ")[2]
        "pip install 'caviar-sim[plot,world]'"
    """
    return f"{sys.executable} -m pip install '{DISTRIBUTION}[{','.join(extras)}]'"
