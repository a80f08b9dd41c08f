"""Files of a run: written in one step, put on the disk, and opened only where they are files.

A process that dies loses nothing that it handed to the operating system. A machine that dies loses what
was not synchronised yet, so ``run.durability`` says when that happens:

* ``none``: whenever the operating system likes.
* ``periodic``: at most `SYNC_PERIOD_S` after a frame.
* ``frame``: before the next frame relies on it.
"""

from __future__ import annotations

import errno
import os
import stat
from io import BufferedReader, FileIO
from pathlib import Path
from typing import Literal

from caviar_protocol.errors import RunError

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


PUT_BACK = "move it away, and put the file of the run back"
_KINDS = {
    stat.S_IFDIR: "directory",
    stat.S_IFIFO: "named pipe",
    stat.S_IFSOCK: "socket",
    stat.S_IFCHR: "device",
    stat.S_IFBLK: "device",
}


def open_regular(path: Path) -> BufferedReader:
    """Open a regular file, or a link to one, to be read.

    Raises
    ------
    OSError
        Its ``strerror`` says what the path is, where that is no file, and what mends it.
    """
    fd = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)  # else a pipe is waited for here
    try:
        kind = stat.S_IFMT(os.fstat(fd).st_mode)
        _refuse_other_kinds(kind, path, PUT_BACK)
        return os.fdopen(fd, "rb")
    except BaseException:
        os.close(fd)
        raise


def read_regular(path: Path) -> bytes:
    """The content of a regular file. Raises `OSError` as `open_regular` does."""
    with open_regular(path) as file:
        return file.read()


def open_to_append(path: Path) -> FileIO:
    """Open a file of a run behind its end, to be written and read; it and its folder are made where missing.

    Raises `RunError` naming the file, why it cannot be written, and what mends that.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        if not path.is_char_device():  # /dev/null takes a log
            refuse_other_kinds(path)
        return path.open("a+b", buffering=0)
    except OSError as error:
        if path.parent.exists() and not path.parent.is_dir():
            words = f"{path.parent} is a file, not a folder; move it away"
        elif path.exists() and not path.is_file():
            words = str(error.strerror)
        else:
            words = f"{error.strerror}; copy the run to a folder that can be written, or choose another"
        raise RunError(f"cannot write {path}: {words}") from error


def refuse_other_kinds(path: Path, remedy: str = "move it away") -> None:
    """Check that a path is a regular file, or free. Raises `OSError` as `open_regular` does."""
    try:
        kind = stat.S_IFMT(path.stat().st_mode)
    except OSError:
        return  # the call that opens it says why
    _refuse_other_kinds(kind, path, remedy)


def _refuse_other_kinds(kind: int, path: Path, remedy: str) -> None:
    if kind != stat.S_IFREG:
        code = errno.EISDIR if kind == stat.S_IFDIR else errno.EINVAL
        what = _KINDS.get(kind, "special file")
        raise OSError(code, f"it is a {what}, not a file; {remedy}", str(path))
