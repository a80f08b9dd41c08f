"""Files of a run, opened only where they are files: a pipe in the place of one would never be through."""

from __future__ import annotations

import errno
import os
import stat
from io import BufferedReader, FileIO
from pathlib import Path

from caviar_protocol.errors import RunError

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
