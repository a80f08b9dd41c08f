"""Files that a command writes because it was asked to: results, tables, pictures."""

from __future__ import annotations

import errno
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from caviar_protocol.errors import RunError
from caviar_protocol.files import replace_file

_NO_SPACE = (errno.ENOSPC, errno.EDQUOT)


@contextmanager
def writing(path: Path) -> Iterator[None]:
    """Make the folders to a file that the block writes.

    Raises `RunError` naming the file, why it cannot be written, and what mends that.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        yield
    except OSError as error:
        raise RunError(f"cannot write {path}: {reason(path, error)}") from error


def make_folder_of(path: Path) -> None:
    """Make the folders to a file before the work that it takes. Raises `RunError` as `writing` does."""
    with writing(path):
        pass


def write_file(path: Path, text: str = "") -> None:
    """Write a file, and the folders to it; where that fails, the file stays as it was.

    Called without text before the work, which leaves what is there: afterwards, a file that cannot be written
    would cost the results. Raises `RunError` as `writing` does.
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
    """Try files before the work in the block, and leave nothing behind where that fails.

    What the block raises goes on; files that are still empty, and folders made for them, are removed first.
    Raises `RunError` as `writing` does.
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


def printable(text: str) -> str:
    """A text without what would steer a terminal: control characters are written as Python escapes them."""
    return "".join(c if c.isprintable() or c == "\n" else repr(c)[1:-1] for c in text)


def reason(path: Path, error: OSError, what: str = "file") -> str:
    """Why a ``file`` or ``folder`` cannot be written, and what mends that."""
    if error.errno in _NO_SPACE:
        return f"{error.strerror}; free space there, or choose another folder"
    in_the_way = next((folder for folder in path.parents if folder.exists() and not folder.is_dir()), None)
    if in_the_way is not None:
        return f"{in_the_way} is a file, not a folder; choose another folder"
    return f"{error.strerror or error}; choose another {what}"
