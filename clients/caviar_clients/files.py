"""Files that a command writes because its user asks for them: results, tables, pictures."""

from __future__ import annotations

import errno
import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from caviar_protocol.errors import CaviarError, RunError
from caviar_protocol.files import replace_file

_NO_SPACE = (errno.ENOSPC, errno.EDQUOT)


@contextmanager
def writing(path: Path) -> Iterator[None]:
    """Make the folders to a file that the block writes.

    Args:
        path: The file.

    Raises:
        RunError: The block raised `OSError`, or another error of a disk that is full; the text has file,
            cause and remedy.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        yield
    except OSError as error:
        raise RunError(f"cannot write {path}: {reason(path, error)}") from error
    except CaviarError:
        raise
    except Exception as error:
        # Libraries that write by themselves have errors of their own for a disk that is full.
        full = OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        if str(full.strerror) not in str(error):
            raise
        raise RunError(f"cannot write {path}: {reason(path, full)}") from error


def make_folder_of(path: Path) -> None:
    """Make the folders to a file, before the work whose result it gets.

    Raises:
        RunError: A folder cannot be made.
    """
    with writing(path):
        pass


def write_file(path: Path, text: str = "") -> None:
    """Write a file, and the folders to it; where that fails, the file stays as it was.

    Args:
        path: The file, a device or a pipe.
        text: What is written. Empty: nothing is, and what is there stays; so a command tries a file before
            its work, since one that cannot be written afterwards costs the results.

    Raises:
        RunError: The file cannot be written; the text has file, cause and remedy.
    """
    with writing(path):
        if not text:
            path.open("ab").close()
        elif path.exists() and not path.is_file():  # a device, a pipe
            path.write_text(text, encoding="utf-8")
        else:
            replace_file(path.resolve(), text.encode(), durable=False)


@contextmanager
def reserved(*paths: Path) -> Iterator[None]:
    """Try files before the work in the block, and leave nothing behind where the work fails.

    Where the block raises, files that are still empty are removed, and folders made for them.

    Raises:
        RunError: A file cannot be written.
    """
    files = [path for path in paths if not path.exists()]
    folders = {folder for path in paths for folder in path.parents if not folder.exists()}
    try:
        for path in paths:
            write_file(path)
        yield
    except BaseException:
        for file in files:
            if file.is_file() and not file.stat().st_size:
                file.unlink()
        for folder in sorted(folders, reverse=True):  # the deepest first
            with suppress(OSError):  # something else is in it, or it was not made
                folder.rmdir()
        raise


FILE_SUFFIXES = frozenset(
    (".eps", ".gif", ".jpeg", ".jpg", ".json", ".md", ".mp4", ".pdf", ".png", ".svg", ".webp")
)
"""Of files that users may think a command writes, where it writes several."""


def require_folder(option: str, path: Path, what: str) -> None:
    """Refuse the name of a file where that of a folder is asked for; a folder of that name is right.

    Args:
        option: As the user writes it, ``--out``.
        path: Its value.
        what: What comes into the folder, ``pictures``.

    Raises:
        RunError: The name ends as that of a file does.

    Example:
        >>> require_folder("--out", Path("x.png"), "pictures")
        Traceback (most recent call last):
        ...
        caviar_protocol.errors.RunError: --out x.png: several pictures are written; name a folder: --out x
    """
    if path.suffix.lower() in FILE_SUFFIXES and not path.is_dir():
        folder = path.with_suffix("")
        raise RunError(f"{option} {path}: several {what} are written; name a folder: {option} {folder}")


def file_in(folder: Path, name: str) -> str:
    """Say what to write where the name of a file is asked for and a folder is given.

    Example:
        >>> file_in(Path("runs"), "video.gif")
        'is a folder; write the name of a file in it, as runs/video.gif'
    """
    return f"is a folder; write the name of a file in it, as {folder / name}"


def printable(text: str) -> str:
    r"""Escape what would steer a terminal: control characters are written as Python writes them.

    Example:
        >>> print(printable("red: \x1b[31m"))
        red: \x1b[31m
    """
    return "".join(c if c.isprintable() or c == "\n" else repr(c)[1:-1] for c in text)


def reason(path: Path, error: OSError, what: str = "file") -> str:
    """Say why something cannot be written, and what mends that.

    Args:
        path: What was to be written.
        error: What that raised.
        what: ``file`` or ``folder``.

    Example:
        >>> reason(Path("a/b"), PermissionError(errno.EACCES, "Permission denied"))
        'Permission denied; choose another file'
    """
    if error.errno in _NO_SPACE:
        return f"{error.strerror}; free space there, or choose another folder"
    in_the_way = next((folder for folder in path.parents if folder.exists() and not folder.is_dir()), None)
    if in_the_way is not None:
        return f"{in_the_way} is a file, not a folder; choose another folder"
    return f"{error.strerror or error}; choose another {what}"
