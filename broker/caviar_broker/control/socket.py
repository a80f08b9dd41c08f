"""The control socket of a running broker, and its clients: blocking, and for an event loop.

``control.sock`` and ``control.json``, which says where the socket is, stand in the directory of a run.
"""

from __future__ import annotations

import fcntl
import json
import os
import socket
import struct
from collections.abc import Awaitable, Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from caviar_broker.event_loop import call_with_timeout
from caviar_protocol.errors import RunError
from caviar_protocol.files import PrivateFolder, read_regular, refuse_other_kinds, replace_file
from caviar_protocol.run_directory import RunDirectory

BACKLOG = 16
"""Connections that wait for the broker's loop; with more, a client waits `REACH_S` for its place."""
REMOVE_S = 1.0
"""[s] that is waited for the disk to remove socket and note."""
REACH_S = 2.0
"""[s] that a broker gets to accept a connection and to answer a request."""


Ask = Callable[..., Awaitable[dict[str, Any]]]
"""`ask_in_thread` of one run: ``await ask(do="why")``."""


class RequestRefusedError(RunError):
    """A broker refuses a request; ``reason`` says why, in the broker's words."""

    def __init__(self, directory: Path, reason: str) -> None:
        self.reason = reason
        super().__init__(f"the broker in {directory} refuses: {reason}")


class ControlSocket:
    """The listening socket of a broker, and the note that says where it is.

    Only the user that runs the broker may connect. Where the run's file system takes no sockets, it is
    in a directory of its own below that for temporary files, and the note says so.

    Args:
        directory: Of the run.

    Raises:
        RunError: Another broker serves that directory.
    """

    def __init__(self, directory: Path) -> None:
        # A socket file may be left by a broker that was killed: only a connection shows whether one is there.
        refuse_second_broker(directory)
        self._files = RunDirectory(directory)
        self._elsewhere: PrivateFolder | None = None
        self.socket = _listening()
        path = self._files.control_socket
        try:
            path.unlink(missing_ok=True)
            with _short(directory) as folder:
                self.socket.bind(f"{folder}/{path.name}")
        except OSError:  # the file system takes no sockets
            self._elsewhere = PrivateFolder("control")
            path = self._elsewhere.path / path.name
            self.socket.close()
            self.socket = _listening()
            self.socket.bind(str(path))
        self.socket.listen(BACKLOG)
        self._announced: dict[str, str | int] = {"socket": str(path)}

    def announce(self, **facts: str | int) -> None:
        """Add facts to the note.

        Args:
            facts: Its fields, such as ``pid`` and ``http``.

        Raises:
            RunError: The note cannot be written.
        """
        self._announced |= facts
        note = self._files.control_note
        try:
            refuse_other_kinds(note)
            # In one step, for readers that poll it; not durable, since it is worth nothing after a crash.
            replace_file(note, json.dumps(self._announced, indent=2).encode() + b"\n", durable=False)
        except OSError as error:
            raise RunError(f"cannot write {note}: {error.strerror}") from error

    def close(self) -> None:
        """Remove socket and note, unless the disk does not answer."""
        self.socket.close()
        call_with_timeout(self._remove, REMOVE_S)

    def _remove(self) -> None:
        for file in (self._files.control_socket, self._files.control_note):
            with suppress(OSError):  # what was there before and is no file stays
                file.unlink(missing_ok=True)
        if self._elsewhere is not None:
            self._elsewhere.cleanup()


def refuse_second_broker(directory: Path) -> None:
    """Raise `RunError` where a broker runs in a directory."""
    try:
        connect(directory).close()
    except RunError:
        return
    raise _second_broker(directory)


@contextmanager
def locked(directory: Path) -> Iterator[None]:
    """Lock a run's directory within the block, or until this process ends.

    Two brokers that resume a run at the same instant both find that no other answers, and the second
    would cut the journal of the first. A file system without locks (some network ones) locks nothing.

    Raises:
        RunError: Another broker has the directory.
    """
    fd = os.open(directory, os.O_RDONLY | os.O_CLOEXEC)
    try:
        try:
            fcntl.flock(fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise _second_broker(directory) from None
        except OSError:
            pass
        yield
    finally:
        os.close(fd)


def connect(directory: Path) -> socket.socket:
    """Connect to the broker that runs in a directory.

    Args:
        directory: Directory of the run.

    Returns:
        A blocking socket with a time-out of `REACH_S`.

    Raises:
        RunError: No broker runs there, or it does not answer within `REACH_S`.
    """
    files = RunDirectory(directory)
    try:
        path = Path(json.loads(read_regular(files.control_note))["socket"])
    except (OSError, ValueError, KeyError, TypeError):
        path = files.control_socket
    connection = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    # With a timeout of Python's, a full backlog would be an error at once.
    connection.setsockopt(socket.SOL_SOCKET, socket.SO_SNDTIMEO, struct.pack("ll", round(REACH_S), 0))
    if path.parent.is_dir() and path.name == files.control_socket.name:
        with _short(path.parent) as folder:
            try:
                connection.connect(f"{folder}/{path.name}")
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
    """Ask the broker that runs in a directory.

    Args:
        directory: Directory of the run.
        request: Fields of the request, ``do`` and what belongs to it.

    Returns:
        The answer, with ``ok`` and what was asked for, as ``ask(run, do="why")["why"]["state"]``.

    Raises:
        RequestRefusedError: The broker refuses the request.
        RunError: No broker runs there, or it does not answer within `REACH_S`.

    Example:
        >>> ask(Path("runs/gone"), do="why")  # doctest: +IGNORE_EXCEPTION_DETAIL
        Traceback (most recent call last):
        RunError: there is no directory runs/gone; give that of a run
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
        raise RequestRefusedError(directory, answer["error"])
    return answer


async def ask_in_thread(directory: Path, **request: Any) -> dict[str, Any]:
    """Do the same as `ask` for a caller in an event loop, which goes on meanwhile."""
    # In a thread, so that there is one client of the socket and not another one for event loops.
    # Here and below: a broker without HTTP does not load asyncio, which takes 25 ms with ssl and logging.
    import asyncio

    return await asyncio.to_thread(lambda: ask(directory, **request))


def call_at_end(connection: socket.socket, callback: Callable[[], None]) -> None:
    """Have the running event loop call back once the broker ends.

    Args:
        connection: An idle connection to it; without a subscription nothing ever comes over it.
        callback: Called once, when the connection is closed.
    """
    import asyncio

    loop = asyncio.get_running_loop()
    connection.setblocking(False)

    def read() -> None:
        with suppress(BlockingIOError):
            with suppress(ConnectionError):
                if connection.recv(1 << 12):
                    return
            loop.remove_reader(connection)
            connection.close()
            callback()

    loop.add_reader(connection, read)


def _second_broker(directory: Path) -> RunError:
    return RunError(f"another broker runs in {directory} already; stop it, or choose another directory")


def _no_answer(directory: Path) -> RunError:
    return RunError(
        f"the broker in {directory} did not answer within {REACH_S:g} s: "
        "its process is stopped, or its machine is overloaded"
    )


def _listening() -> socket.socket:
    found = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM | socket.SOCK_NONBLOCK | socket.SOCK_CLOEXEC)
    os.fchmod(found.fileno(), 0o600)  # before it has a name, so that there is no moment without
    return found


@contextmanager
def _short(directory: Path) -> Iterator[str]:
    """Yield a short name of a directory: the path of a socket may have 107 bytes at most."""
    # sun_path of struct sockaddr_un has 108 bytes with the final NUL (unix(7)); run directories are longer.
    fd = os.open(directory, os.O_PATH | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        yield f"/proc/self/fd/{fd}"
    finally:
        os.close(fd)
