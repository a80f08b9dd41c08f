"""Folders for temporary files that go with their process, also where that is killed.

A process that is killed removes nothing. What it leaves is removed by the next one that makes such a folder:
the kernel tells whether a process still holds it, by a lock (flock(2)) that ends with the last one that does.
"""

from __future__ import annotations

import fcntl
import os
import shutil
import stat
import tempfile
import weakref
from contextlib import suppress
from pathlib import Path
from types import TracebackType

PREFIX = "caviar-"
MARK = ".caviar-process"
"""File that is made in a folder once it is locked: one without it is another program's, or not locked yet."""


class PrivateFolder:
    """A folder in the system's temporary one that only this user can enter (mode 0700).

    It is removed by `cleanup`, at the end of a ``with`` block, or when this process ends; where this process
    is killed, by the next that makes one, on this machine and for this user.

    Args:
        name: What the folder is for; stands in its name.

    Raises:
        OSError: It cannot be made.

    Example:
        >>> with PrivateFolder() as folder:
        ...     _ = (folder.path / "socket").write_text("of one run")
        >>> folder.path.exists()
        False
    """

    def __init__(self, name: str = "") -> None:
        remove_leftovers()
        self.path = Path(tempfile.mkdtemp(prefix=f"{PREFIX}{name}-" if name else PREFIX))
        """Where it is."""
        self._lock = os.open(self.path, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
        self._end = weakref.finalize(self, _remove, self.path, self._lock)
        # Of a file system without locks the folder is removed by its own process alone.
        with suppress(OSError):
            fcntl.flock(self._lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            (self.path / MARK).touch()

    def fileno(self) -> int:
        """Return the descriptor that holds the folder, also for a child that inherits it (``pass_fds``)."""
        return self._lock

    def cleanup(self) -> None:
        """Remove the folder with all that is in it; a second call does nothing."""
        self._end()

    def __enter__(self) -> PrivateFolder:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.cleanup()


def remove_leftovers() -> list[Path]:
    """Remove the folders of this user that no process holds any more.

    Returns:
        Those that were removed.
    """
    removed = []
    with suppress(OSError):  # a temporary folder that cannot be listed is none to tidy
        with os.scandir(tempfile.gettempdir()) as entries:
            found = [Path(entry.path) for entry in entries if entry.name.startswith(PREFIX)]
        removed = [folder for folder in found if _remove_if_left(folder)]
    return removed


def _remove_if_left(folder: Path) -> bool:
    try:
        lock = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW | os.O_CLOEXEC)
    except OSError:  # another user's, or gone meanwhile
        return False
    try:
        about = os.fstat(lock)
        if about.st_uid != os.getuid() or stat.S_IMODE(about.st_mode) != 0o700:
            return False
        os.stat(MARK, dir_fd=lock, follow_symlinks=False)
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:  # it has no mark, or a process holds it
        return False
    else:
        shutil.rmtree(folder, ignore_errors=True)
        return not folder.exists()
    finally:
        os.close(lock)


def _remove(folder: Path, lock: int) -> None:
    # While it is locked: no other process removes it at the same time.
    shutil.rmtree(folder, ignore_errors=True)
    with suppress(OSError):
        os.close(lock)
