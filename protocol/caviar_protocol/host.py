"""Which kernel and process namespace this process lives in."""

from __future__ import annotations

from pathlib import Path


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
