"""Which kernel and process namespace this process lives in."""

from __future__ import annotations

import ctypes
from pathlib import Path

_M_MMAP_THRESHOLD = -3
_LARGE = 128 * 1024


def host_identity() -> str:
    """Equal in two processes exactly if one can watch the other by process id; empty if unknown.

    A process id means something only within one boot of one kernel and one PID namespace, so a
    container on the same machine is another host.
    """
    try:
        boot = Path("/proc/sys/kernel/random/boot_id").read_text().strip()
        namespace = Path("/proc/self/ns/pid").readlink()
    except OSError:
        return ""
    return f"{boot}:{namespace}"


def steady_memory() -> None:
    """Let glibc return every large buffer to the system when it is freed.

    By default it raises the size from which it does so, as large buffers come and go, and then keeps and
    splits them: the memory of a process that handles megabytes in every frame creeps up for hours.
    Without glibc nothing happens.
    """
    _glibc("mallopt", _M_MMAP_THRESHOLD, _LARGE)


def trim_memory() -> None:
    """Let glibc return what is free in its heap to the system; takes milliseconds. Without glibc nothing
    happens."""
    _glibc("malloc_trim", 0)


def _glibc(function: str, *arguments: int) -> None:
    try:
        getattr(ctypes.CDLL(None), function)(*arguments)
    except (OSError, AttributeError):
        return  # another C library: it has a strategy of its own
