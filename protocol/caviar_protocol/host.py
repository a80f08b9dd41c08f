"""Which kernel and process namespace this process lives in."""

from __future__ import annotations

import ctypes
from pathlib import Path

_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD = -1, -3
_LARGE = 4 << 20
"""[B] Buffers from here on come from the system and return to it; each of their pages costs a fault."""
_SPARE = 64 << 20
"""[B] that a heap may keep at its end."""


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
    """Let glibc keep what products of some megabytes need, and return what is larger to the system.

    By default it raises the size from which it does so up to 32 MiB, as buffers come and go, and keeps and
    splits all below: the memory of a process that handles megabytes in every frame creeps up for hours. With
    a small fixed size it stays flat too, but a product of 1 MB costs 250 page faults each time it passes.
    Without glibc nothing happens.
    """
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
    """Let glibc return what is free in its heap to the system; takes milliseconds. Without glibc nothing
    happens."""
    _glibc("malloc_trim", 0)


def _glibc(function: str, *arguments: int) -> None:
    try:
        getattr(ctypes.CDLL(None), function)(*arguments)
    except (OSError, AttributeError):
        return  # another C library: it has a strategy of its own
