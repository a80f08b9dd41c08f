"""Where a broker's desk is found: ``control.sock`` and ``control.json`` in the directory of its run."""

from __future__ import annotations

import fcntl
import json
import os
import shutil
import socket
import struct
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from caviar_broker.aside import call_aside
from caviar_protocol.errors import RunError
from caviar_protocol.files import read_regular, refuse_other_kinds

SOCKET, NOTE = "control.sock", "control.json"
BACKLOG = 16
REMOVE_S = 1.0
"""[s] that is waited for the disk to remove them."""
REACH_S = 2.0
"""[s] that a broker gets to accept a connection and to answer a request."""


class DeskPlace:
    """The listening socket of a desk, and the note that says where it is.

    Only the user that runs the broker may connect. Where the run's file system takes no sockets, it is
    in a directory of its own below that for temporary files, and the note says so.
    """

    def __init__(self, directory: Path) -> None:
        self._directory, self._elsewhere = directory, ""
        self._told: dict[str, str | int] = {}
        refuse_second(directory)
        self.socket = _listening()
        path = directory / SOCKET
        try:
            path.unlink(missing_ok=True)
            with _short(directory) as folder:
                self.socket.bind(f"{folder}/{SOCKET}")
        except OSError:
            self._elsewhere = tempfile.mkdtemp(prefix="caviar-")
            path = Path(self._elsewhere, SOCKET)
            self.socket.close()
            self.socket = _listening()
            self.socket.bind(str(path))
        self.socket.listen(BACKLOG)
        self._told["socket"] = str(path)

    def announce(self, **told: str | int) -> None:
        """Write more into the note."""
        self._told |= told
        note = self._directory / NOTE
        draft = note.with_suffix(".new")
        try:
            refuse_other_kinds(note)
            draft.write_text(json.dumps(self._told, indent=2) + "\n")
            draft.replace(note)
        except OSError as error:
            raise RunError(f"cannot write {note}: {error.strerror}") from error

    def close(self) -> None:
        """Remove socket and note, unless the disk does not answer."""
        self.socket.close()
        call_aside(self._remove, REMOVE_S)

    def _remove(self) -> None:
        for name in (SOCKET, NOTE):
            with suppress(OSError):  # what was there before and is no file stays
                (self._directory / name).unlink(missing_ok=True)
        if self._elsewhere:
            shutil.rmtree(self._elsewhere, ignore_errors=True)


def refuse_second(directory: Path) -> None:
    """Raises `RunError` where a broker runs in a directory."""
    if _answers(directory):
        raise RunError(f"another broker runs in {directory} already; stop it, or choose another directory")


@contextmanager
def held(directory: Path) -> Iterator[None]:
    """Have a run's directory to oneself within the block, or until this process ends.

    Two brokers that go on with a run at the same instant both find that no other answers, and the second
    would cut the journal of the first. A file system without locks (some network ones) holds nothing.

    Raises `RunError` where another broker has the directory.
    """
    fd = os.open(directory, os.O_RDONLY | os.O_CLOEXEC)
    try:
        try:
            fcntl.flock(fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise RunError(
                f"another broker runs in {directory} already; stop it, or choose another directory"
            ) from None
        except OSError:
            pass
        yield
    finally:
        os.close(fd)


def connect(directory: Path) -> socket.socket:
    """A connection to the desk of the broker that runs in a directory.

    Raises `RunError` where none does.
    """
    note = directory / NOTE
    try:
        path = Path(json.loads(read_regular(note))["socket"])
    except (OSError, ValueError, KeyError, TypeError):
        path = directory / SOCKET
    connection = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    # With a timeout of Python's, a full backlog would be an error at once.
    connection.setsockopt(socket.SOL_SOCKET, socket.SO_SNDTIMEO, struct.pack("ll", round(REACH_S), 0))
    if path.parent.is_dir() and path.name == SOCKET:
        with _short(path.parent) as folder:
            try:
                connection.connect(f"{folder}/{SOCKET}")
            except BlockingIOError:
                connection.close()
                raise _no_answer(directory) from None
            except OSError:
                connection.close()
            else:
                connection.settimeout(REACH_S)
                return connection
    connection.close()
    if not directory.is_dir():
        raise RunError(f"there is no directory {directory}; give that of a run, such as runs/NAME-DATE-TIME")
    raise RunError(f"no broker runs in {directory}: it has ended, or was never started there")


def ask(directory: Path, **request: Any) -> dict[str, Any]:
    """The answer of a broker's desk to one request: ``ask(run, do="why")``.

    Raises `RunError` where no broker runs there, where it does not answer, or with what it refuses.
    """
    line = b""
    with connect(directory) as connection:
        try:
            connection.sendall(json.dumps(request).encode() + b"\n")
            while not line.endswith(b"\n") and (data := connection.recv(1 << 16)):
                line += data
        except TimeoutError:
            raise _no_answer(directory) from None
        except OSError as error:
            raise RunError(f"the broker in {directory} hung up: {error.strerror}") from error
    if not line.endswith(b"\n"):
        raise RunError(f"the broker in {directory} hung up: its run is over, or too many ask it at once")
    answer: dict[str, Any] = json.loads(line)
    if not answer["ok"]:
        raise RunError(f"the broker in {directory} refuses: {answer['error']}")
    return answer


def _no_answer(directory: Path) -> RunError:
    return RunError(
        f"the broker in {directory} did not answer within {REACH_S:g} s: "
        "its process is stopped, or its machine is overloaded"
    )


def _answers(directory: Path) -> bool:
    try:
        connect(directory).close()
    except RunError:
        return False
    return True


def _listening() -> socket.socket:
    found = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM | socket.SOCK_NONBLOCK | socket.SOCK_CLOEXEC)
    os.fchmod(found.fileno(), 0o600)  # before it has a name, so that there is no moment without
    return found


@contextmanager
def _short(directory: Path) -> Iterator[str]:
    """A short name of a directory: the path of a socket may have 107 bytes at most."""
    fd = os.open(directory, os.O_PATH | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        yield f"/proc/self/fd/{fd}"
    finally:
        os.close(fd)
