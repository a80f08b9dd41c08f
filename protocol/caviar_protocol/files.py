"""Files of a run, written in one step, put on the disk, and opened; temporary folders.

A process that dies loses nothing that it handed to the operating system. A
machine that dies loses what was not synchronised yet, so ``run.durability`` says when that happens:

* ``none``: whenever the operating system likes.
* ``periodic``: at most `SYNC_PERIOD_S` after a frame.
* ``frame``: before the next frame relies on it.

A process that is killed removes no temporary folder. What it leaves is removed by the next one that makes
such a folder: the kernel tells whether a process still holds it, by a lock (flock(2)) that ends with the last
one that does.
"""

from __future__ import annotations

import errno
import fcntl
import mmap
import os
import shutil
import stat
import tempfile
import weakref
from contextlib import suppress
from io import BufferedReader, FileIO
from pathlib import Path
from types import TracebackType
from typing import Literal
from uuid import uuid4

from caviar_protocol.errors import RunError

Durability = Literal["none", "periodic", "frame"]

SYNC_PERIOD_S = 1.0
"""[s] of a run that a loss of power costs at most under ``periodic``, beside one frame."""
PUT_BACK = "move it away, and put the file of the run back"
_KINDS = {
    stat.S_IFDIR: "directory",
    stat.S_IFIFO: "named pipe",
    stat.S_IFSOCK: "socket",
    stat.S_IFCHR: "device",
    stat.S_IFBLK: "device",
}


FOLDER_PREFIX = "caviar-"
FOLDER_MARK = ".caviar-process"
"""File that is made in a folder once it is locked: one without it is another program's, or not locked yet."""


def replace_file(
    path: Path,
    data: bytes | memoryview,
    *,
    durable: bool = True,
    mode: int = 0o666,
    concurrent: bool = False,
) -> None:
    """Write a file atomically: readers see all of it or the earlier content, after a loss of power too.

    Args:
        path: The file; its folder exists.
        data: The whole content.
        durable: Whether the content and its name are on the disk when this returns.
        mode: Permission bits of the file, of which the process's umask takes some away.
        concurrent: Whether several processes may write the file at the same time. Their drafts then have
            names of their own, and a process that is killed leaves its draft behind.

    Raises:
        OSError: The file cannot be written; the earlier one is as it was.

    Example:
        >>> replace_file(Path("result.json"), b"{}")
        >>> Path("result.json").read_bytes()
        b'{}'
    """
    draft = path.with_name(f"{path.name}.{uuid4().hex}.partial" if concurrent else f"{path.name}.partial")
    try:
        # O_NONBLOCK: a pipe that has the draft's name is an error, not a wait for a reader.
        flags = os.O_WRONLY | os.O_CREAT | os.O_TRUNC | os.O_CLOEXEC | os.O_NONBLOCK
        descriptor = os.open(draft, flags, mode)
        with os.fdopen(descriptor, "wb") as file:
            file.write(data)
            if durable:
                file.flush()
                os.fsync(file.fileno())
        # The rename is the only step that a reader can see; it is atomic on every POSIX file system.
        draft.replace(path)
    except BaseException:
        draft.unlink(missing_ok=True)
        raise
    # A rename is on the disk only when the folder is: fsync of the file alone leaves the old name.
    if durable:
        sync_file(path.parent)


def sync_file(path: Path) -> None:
    """Have the disk hold what the operating system holds of a file or a directory.

    Args:
        path: A file, or a folder for the names in it.

    Raises:
        OSError: The disk refuses; the error has the path as its ``filename``.
    """
    fd = os.open(path, os.O_RDONLY | os.O_CLOEXEC)
    try:
        os.fsync(fd)
    except OSError as error:
        error.filename = str(path)
        raise
    finally:
        os.close(fd)


def open_regular(path: Path, remedy: str = PUT_BACK) -> BufferedReader:
    """Open a regular file, or a link to one, to be read.

    Args:
        path: The file.
        remedy: What mends that it is of another kind.

    Raises:
        OSError: ``strerror`` says what the path is where that is no file, and what mends it.
    """
    # Opening a pipe without O_NONBLOCK waits for a writer, which may never come.
    fd = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
    try:
        _refuse_kind(os.fstat(fd), path, remedy)
        return os.fdopen(fd, "rb")
    except BaseException:
        os.close(fd)
        raise


def read_regular(path: Path, remedy: str = PUT_BACK) -> bytes:
    """Read the content of a regular file, as `open_regular` opens it.

    Args:
        path: The file.
        remedy: What an error says to do about what is no file.

    Raises:
        OSError: It cannot be read, or is no file; ``strerror`` says what it is and what mends it.
    """
    with open_regular(path, remedy) as file:
        return file.read()


def map_regular(path: Path) -> memoryview:
    """Map a regular file into memory, to be read; nothing of it is read before it is looked at.

    Args:
        path: The file.

    Raises:
        OSError: It cannot be read, or is no file; ``strerror`` says what it is and what mends it.
    """
    with open_regular(path) as file:
        # An empty file cannot be mapped; it is what a writer leaves that is killed as it opens one.
        if not file.seek(0, os.SEEK_END):
            return memoryview(b"")
        return memoryview(mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ))


def open_to_append(path: Path) -> FileIO:
    """Open a file of a run at its end, to be written and read; make it and its folder where missing.

    Args:
        path: The file.

    Raises:
        RunError: The file cannot be written; the text names it, says why and what mends that.
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
    """Check that a path is a regular file, or free.

    Args:
        path: Where a file is to be written.
        remedy: What mends that something else is there.

    Raises:
        OSError: It is a directory, a pipe, a socket or a device; ``strerror`` says which, and ``remedy``.
    """
    try:
        status = path.stat()
    except OSError:
        # A path that is not there, or not readable, is not of another kind.
        return  # the call that opens it says why
    _refuse_kind(status, path, remedy)


def _refuse_kind(status: os.stat_result, path: Path, remedy: str) -> None:
    kind = stat.S_IFMT(status.st_mode)
    if kind != stat.S_IFREG:
        code = errno.EISDIR if kind == stat.S_IFDIR else errno.EINVAL
        what = _KINDS.get(kind, "special file")
        raise OSError(code, f"it is a {what}, not a file; {remedy}", str(path))


def file_system_of(path: Path) -> str:
    """Describe the file system that holds a path, for an error: ``ext4 on /dev/sda1, mounted at /data``.

    Args:
        path: Any path; it need not exist.
    """
    found, best = "its file system is unknown", ""
    try:
        lines = Path("/proc/self/mountinfo").read_text().splitlines()
    except OSError:
        return found
    # Only the kernel's list is read: Path.resolve would ask the disk, which may be the one that hangs.
    place = f"{os.path.abspath(path)}/"  # noqa: PTH100
    for line in lines:
        fields, _, rest = line.partition(" - ")
        mount, kind = fields.split()[4], rest.split()
        if place.startswith(mount.rstrip("/") + "/") and len(mount) >= len(best):
            found, best = f"{kind[0]} on {kind[1]}, mounted at {mount}", mount
    return found


# --- folders for temporary files that go with their process ----------------------------------------


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
        self.path = Path(tempfile.mkdtemp(prefix=f"{FOLDER_PREFIX}{name}-" if name else FOLDER_PREFIX))
        """Where it is."""
        self._lock = os.open(self.path, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
        self._end = weakref.finalize(self, _remove_folder, self.path, self._lock)
        # Of a file system without locks the folder is removed by its own process alone.
        with suppress(OSError):
            fcntl.flock(self._lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            (self.path / FOLDER_MARK).touch()

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
            found = [Path(entry.path) for entry in entries if entry.name.startswith(FOLDER_PREFIX)]
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
        os.stat(FOLDER_MARK, dir_fd=lock, follow_symlinks=False)
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:  # it has no mark, or a process holds it
        return False
    else:
        shutil.rmtree(folder, ignore_errors=True)
        return not folder.exists()
    finally:
        os.close(lock)


def _remove_folder(folder: Path, lock: int) -> None:
    # While it is locked: no other process removes it at the same time.
    shutil.rmtree(folder, ignore_errors=True)
    with suppress(OSError):
        os.close(lock)
