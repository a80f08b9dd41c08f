"""Files of a run, opened only where they are files: a pipe in the place of one would never be through."""

from __future__ import annotations

import errno
import os
import stat
from io import BufferedReader
from pathlib import Path

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
