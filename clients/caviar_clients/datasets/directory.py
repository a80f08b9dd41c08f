"""Folder of a dataset: the name of each file that CAVIAR writes there, and the lock of who writes."""

from __future__ import annotations

import errno
import fcntl
import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from caviar_protocol.errors import RunError

_EPISODE = "episode-"


@dataclass(frozen=True)
class DatasetDirectory:
    """The folder of one dataset, with a property for each file that a part of CAVIAR writes there.

    Nothing is read or made: a property is a path, whether or not the file exists.

    Example:
        >>> data = DatasetDirectory(Path("d"))
        >>> data.catalogue.name, data.episode(7).relative_to(data.path).as_posix()
        ('catalogue.sqlite', 'episodes/episode-000007')
    """

    path: Path

    @property
    def catalogue(self) -> Path:
        """What the dataset holds and what is to be done: a SQLite database (`catalogue`)."""
        return self.path / "catalogue.sqlite"

    @property
    def tables(self) -> Path:
        """Folder of the catalogue's tables as files."""
        return self.path / "tables"

    @property
    def page(self) -> Path:
        """Page that shows what the dataset is (`look`)."""
        return self.path / "look.html"

    @property
    def episodes(self) -> Path:
        """Folder of the recordings."""
        return self.path / "episodes"

    def episode(self, number: int) -> Path:
        """Folder of the recording of an episode; it is there once the recording is complete."""
        return self.episodes / f"{_EPISODE}{number:06d}"

    @property
    def assets(self) -> Path:
        """Folder of the scenery, which all episodes share, files at their asset names."""
        return self.path / "assets"

    @property
    def work(self) -> Path:
        """Folder of what is being written; what is left there after a kill is removed."""
        return self.path / ".work"

    def finished(self) -> list[int]:
        """Numbers of the episodes whose recordings are there, in order.

        Raises:
            RunError: The folder cannot be read.
        """
        try:
            with os.scandir(self.episodes) as entries:
                names = [entry.name for entry in entries if entry.name.startswith(_EPISODE)]
        except FileNotFoundError:
            return []
        except OSError as error:
            raise RunError(
                f"{self.episodes} cannot be read: {error.strerror} (errno {error.errno})"
            ) from error
        numbers = (name.removeprefix(_EPISODE) for name in names)
        return sorted(int(number) for number in numbers if number.isascii() and number.isdecimal())


@contextmanager
def writing_dataset(directory: DatasetDirectory) -> Iterator[None]:
    """Hold a dataset for as long as the block lasts, and remove what killed processes left half-written.

    Args:
        directory: Of the dataset; it is made where it is not there.

    Raises:
        RunError: Another process writes it, or it cannot be written.
    """
    try:
        for folder in (directory.episodes, directory.work):
            folder.mkdir(parents=True, exist_ok=True)
        lock = os.open(directory.work, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    except OSError as error:
        raise unwritable(error.filename or directory.path, error) from error
    try:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise RunError(
                f"another process writes the dataset {directory.path}: wait for it, or give another --out"
            ) from error
        clear_work(directory)
        yield
        clear_work(directory)
    finally:
        os.close(lock)


def clear_work(directory: DatasetDirectory) -> None:
    """Remove what is half-written."""
    for entry in directory.work.iterdir():
        shutil.rmtree(entry, ignore_errors=True)


_REMEDIES = {
    errno.ENOSPC: "free space there; the same command then goes on",
    errno.EDQUOT: "free space within your quota; the same command then goes on",
    errno.EROFS: "its file system can only be read: give another --out",
    errno.EACCES: "allow writing there, or give another --out",
    errno.ENOTDIR: "a part of it is a file: give another --out",
    errno.EEXIST: "a part of it is a file: give another --out",
}


def unwritable(path: str | Path, error: OSError) -> RunError:
    """The error of a dataset that cannot be written.

    Args:
        path: The file or folder.
        error: What the operating system said.

    Example:
        >>> print(unwritable("d", OSError(errno.EROFS, "Read-only file system")))
        the dataset cannot be written: d: Read-only file system (errno 30); its file system can only be \
read: give another --out
    """
    remedy = _REMEDIES.get(error.errno or 0, "give another --out")
    said = error.strerror or str(error)
    return RunError(f"the dataset cannot be written: {path}: {said} (errno {error.errno}); {remedy}")
