"""Folder of a dataset: the name of each file that CAVIAR writes there, and the lock of who writes."""

from __future__ import annotations

import errno
import fcntl
import os
import shutil
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

from caviar_protocol.errors import RunError
from caviar_protocol.run_directory import RunDirectory

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
        """Catalogue of what there is and what is to be done: a SQLite database (`catalogue`)."""
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
            RunError: The folder cannot be read, or has a folder whose name is nearly that of an episode.
        """
        try:
            with os.scandir(self.episodes) as entries:
                names = [entry.name for entry in entries]
            return sorted(self.numbers_of(names, self.episodes))
        except FileNotFoundError:
            return []
        except OSError as error:
            raise RunError(
                f"{self.episodes} cannot be read: {error.strerror} (errno {error.errno})"
            ) from error

    def size_of(self, number: int) -> int:
        """Size of the recording of an episode, from its directory entries [B]; 0 where it has no manifest.

        Args:
            number: Of the episode.

        Raises:
            RunError: The folder cannot be read.
        """
        run = RunDirectory(self.episode(number))
        try:
            return sum(file.stat().st_size for file in run.segments()) if run.manifest.is_file() else 0
        except OSError as error:
            raise RunError(
                f"{run.path} cannot be read: {error.strerror} (errno {error.errno}); allow reading it, or "
                "remove it: the same command plays the episode again"
            ) from error

    @staticmethod
    def number_of(name: str) -> int | None:
        """Number of the episode whose folder has a name; None where it is no such folder.

        Args:
            name: Last part of a path.

        Example:
            >>> DatasetDirectory.number_of("episode-000007"), DatasetDirectory.number_of("episode-7")
            (7, None)
        """
        digits = name.removeprefix(_EPISODE)
        if digits == name or not digits.isascii() or not digits.isdecimal() or len(digits) > 18:
            return None
        return int(digits) if name == f"{_EPISODE}{int(digits):06d}" else None

    @classmethod
    def numbers_of(cls, names: Iterable[str], place: str | Path) -> Iterator[int]:
        """Numbers of the episodes that have folders; other names are passed over.

        Args:
            names: In the folder of the recordings.
            place: Of that folder, for an error.

        Raises:
            RunError: A name begins like that of an episode, and is none.
        """
        for name in names:
            number = cls.number_of(name)
            if number is not None:
                yield number
            elif name.startswith(_EPISODE):
                raise RunError(
                    f"{place}/{name} is named like an episode, which would be {_EPISODE}000009 for number 9: "
                    "rename it, or move it out of there"
                )


@contextmanager
def writing_dataset(directory: DatasetDirectory, *, elsewhere: bool = False) -> Iterator[None]:
    """Hold a dataset for as long as the block lasts, and remove what killed processes left half-written.

    The folder of half-written recordings goes with the block.

    Args:
        directory: Of the dataset; it is made where it is not there.
        elsewhere: Whether processes that this one does not end write there: after a fault their recordings
            are left.

    Raises:
        RunError: Another process writes it, or it cannot be written.
    """
    try:
        directory.episodes.mkdir(parents=True, exist_ok=True)
        # Not the folder of what is half-written, which is removed: a lock on it would bind no other process.
        lock = os.open(directory.path, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    except OSError as error:
        raise unwritable(error.filename or directory.path, error) from error
    try:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise RunError(
                f"another process writes the dataset {directory.path}: wait for it, or give another --out"
            ) from error
        try:
            directory.work.mkdir(exist_ok=True)
            clear_work(directory)
        except OSError as error:
            raise unwritable(error.filename or directory.work, error) from error
        is_over = not elsewhere
        try:
            yield
            is_over = True
        finally:
            with suppress(OSError):
                if is_over:
                    clear_work(directory)
                directory.work.rmdir()
    finally:
        os.close(lock)


def rename_unless_there(folder: Path, target: Path) -> None:
    """Rename a folder in one step; where another process was quicker, its folder stays.

    Args:
        folder: Complete, on the same file system.
        target: Its new path.
    """
    if target.exists():
        return
    try:
        folder.rename(target)
    except OSError:
        if not target.exists():
            raise


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
