"""What of a run survives a loss of power, and the calls that put a file on the disk.

A process that dies loses nothing that it handed to the operating system. A machine that dies loses what
was not synchronised yet, so ``run.durability`` says when that happens:

* ``none``: whenever the operating system likes.
* ``periodic``: at most `SYNC_PERIOD_S` after a frame.
* ``frame``: before the next frame relies on it.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import Literal

Durability = Literal["none", "periodic", "frame"]

SYNC_PERIOD_S = 1.0
"""[s] of a run that a loss of power costs at most under ``periodic``, beside one frame."""


def sync_file(path: Path) -> None:
    """Have the disk hold what the operating system holds of a file or a directory.

    Raises `OSError` with the path as its filename.
    """
    fd = os.open(path, os.O_RDONLY | os.O_CLOEXEC)
    try:
        os.fsync(fd)
    except OSError as error:
        error.filename = str(path)
        raise
    finally:
        os.close(fd)


def replace_file(path: Path, data: bytes | memoryview, *, durable: bool = True) -> None:
    """Write a file in one step: readers, and a machine that died, have the whole of it or what was before.

    ``durable`` says whether it is on the disk when this returns. Raises `OSError`.
    """
    partial = path.with_name(path.name + ".partial")
    with partial.open("wb") as file:
        file.write(data)
        if durable:
            file.flush()
            os.fsync(file.fileno())
    partial.replace(path)
    if durable:
        sync_file(path.parent)


def file_system_of(path: Path) -> str:
    """The file system that holds a path, for people: ``ext4 on /dev/sda1, mounted at /data``.

    It reads what the kernel lists and asks no disk, so it answers for one that does not.
    """
    found, best = "its file system is unknown", ""
    try:
        lines = Path("/proc/self/mountinfo").read_text().splitlines()
    except OSError:
        return found
    place = f"{os.path.abspath(path)}/"  # noqa: PTH100  # Path.resolve would ask the disk
    for line in lines:
        fields, _, rest = line.partition(" - ")
        mount, kind = fields.split()[4], rest.split()
        if place.startswith(mount.rstrip("/") + "/") and len(mount) >= len(best):
            found, best = f"{kind[0]} on {kind[1]}, mounted at {mount}", mount
    return found
