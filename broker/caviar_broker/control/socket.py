"""The broker's desk, asked from an event loop."""

from __future__ import annotations

import asyncio
import fcntl
import json
import os
import shutil
import socket
import struct
import tempfile
from collections.abc import AsyncIterator, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from caviar_broker.event_loop import call_with_timeout
from caviar_protocol.errors import RunError
from caviar_protocol.files import read_regular, refuse_other_kinds, replace_file
from caviar_protocol.run_directory import RunDirectory

BACKLOG = 16
REMOVE_S = 1.0
"""[s] that is waited for the disk to remove them."""
REACH_S = 2.0
"""[s] that a broker gets to accept a connection and to answer a request."""


class ControlSocket:
    """The listening socket of a desk, and the note that says where it is.

    Only the user that runs the broker may connect. Where the run's file system takes no sockets, it is
    in a directory of its own below that for temporary files, and the note says so.
    """

    def __init__(self, directory: Path) -> None:
        self._files, self._elsewhere = RunDirectory(directory), ""
        self._told: dict[str, str | int] = {}
        refuse_second_broker(directory)
        self.socket = _listening()
        path = self._files.control_socket
        try:
            path.unlink(missing_ok=True)
            with _short(directory) as folder:
                self.socket.bind(f"{folder}/{path.name}")
        except OSError:
            self._elsewhere = tempfile.mkdtemp(prefix="caviar-")
            path = Path(self._elsewhere, path.name)
            self.socket.close()
            self.socket = _listening()
            self.socket.bind(str(path))
        self.socket.listen(BACKLOG)
        self._told["socket"] = str(path)

    def announce(self, **told: str | int) -> None:
        """Write more into the note."""
        self._told |= told
        note = self._files.control_note
        try:
            refuse_other_kinds(note)
            replace_file(note, json.dumps(self._told, indent=2).encode() + b"\n", durable=False)
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
        if self._elsewhere:
            shutil.rmtree(self._elsewhere, ignore_errors=True)


def refuse_second_broker(directory: Path) -> None:
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


MAX_LINE = 1 << 24
"""[B] of an answer."""

_Streams = tuple[asyncio.StreamReader, asyncio.StreamWriter]


class RequestRefusedError(RunError):  # it is an answer, and named as the desk names it
    """The desk was asked for what cannot be now."""


class ControlClient:
    """Asks the desk of the broker that runs in a directory; one question at a time."""

    def __init__(self, run: Path) -> None:
        self._run = run
        self._streams: _Streams | None = None
        self._turn = asyncio.Lock()

    async def ask(self, do: str, **request: Any) -> dict[str, Any]:
        """The answer; `RequestRefusedError`, or `RunError` where the broker does not answer or is gone."""
        async with self._turn:
            try:
                async with asyncio.timeout(REACH_S):
                    answer = await self._exchange({"do": do, **request})
            except (TimeoutError, OSError, ValueError) as error:
                self.close()
                told = (
                    f"does not answer within {REACH_S:g} s" if isinstance(error, TimeoutError) else "is gone"
                )
                raise RunError(f"the broker {told}") from error
        if not answer["ok"]:
            raise RequestRefusedError(answer["error"])
        return answer

    async def _exchange(self, request: dict[str, Any]) -> dict[str, Any]:
        if self._streams is None:
            self._streams = await _open(self._run)
        reader, writer = self._streams
        writer.write(json.dumps(request).encode() + b"\n")
        await writer.drain()
        answer: dict[str, Any] = json.loads(await reader.readline())
        return answer

    async def events(self) -> AsyncIterator[dict[str, Any]]:
        """What happens in the run, until the broker ends."""
        reader, writer = await _open(self._run)
        try:
            writer.write(b'{"do": "subscribe"}\n')
            while line := await reader.readline():
                event = json.loads(line)
                if "event" in event:
                    yield event
        except OSError:
            return
        finally:
            writer.close()

    def close(self) -> None:
        """Hang up."""
        if self._streams is not None:
            self._streams[1].close()
            self._streams = None


async def _open(run: Path) -> _Streams:
    connection = connect(run)
    connection.setblocking(False)
    return await asyncio.open_unix_connection(sock=connection, limit=MAX_LINE)
