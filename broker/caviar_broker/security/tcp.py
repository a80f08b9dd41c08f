"""The connections under a ZeroMQ socket: whose they are, what waits in them, and ending one of them.

libzmq has no call that ends one connection of a socket, and none that says how much memory one takes. But
its messages carry the descriptor that they came from (``__fd``), a monitor tells when connections begin and
end, Linux counts the bytes of each (``TCP_INFO``), and `shutdown` of a descriptor ends that one alone.
"""

from __future__ import annotations

import os
import socket
import stat
import struct
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import zmq

_EVENT = struct.Struct("=HI")
_BYTES = struct.Struct("=QQ")
# Of struct ucred: process, user and group (unix(7)).
_PEER = struct.Struct("=iII")
COMMAND = 80
"""Letters of a command line that are shown."""
# Where ``tcpi_bytes_acked`` and ``tcpi_bytes_received`` stand in struct tcp_info (linux/tcp.h).
_BYTES_AT = 120
_WATCHED = int(zmq.EVENT_ACCEPTED) | int(zmq.EVENT_DISCONNECTED) | int(zmq.EVENT_CLOSED)
UNKNOWN = "somewhere"
"""Address of a connection that ended before it could be asked for."""
UNCLEAR_NS = 2_000_000_000
"""[ns] for which messages of a closed connection may still come, while its descriptor is another's."""


@dataclass(eq=False, slots=True)
class TcpConnection:
    """One accepted connection."""

    fd: int
    inode: int
    """Of the socket: tells it from a later one with the same descriptor."""
    address: str
    since: int
    """When it was accepted [ns]."""
    unclear_until: int = 0
    """Until then a message with this descriptor may be of the connection before [ns]."""
    claimed: bool = False
    """Whether a routing id is known to be this connection."""
    open: bool = True
    dismissed: bool = False
    """Whether the broker ended it."""
    process: str = ""
    """What connected to a socket file, which has no address: its process id and command line."""
    is_sibling: bool = False
    """Whether that process was started by the one that started the broker, as services of a run are."""

    @property
    def origin(self) -> str:
        """Origin of the connection in words: an address, or a process of this machine."""
        return self.address or self.process

    def end(self) -> None:
        """End the connection; does nothing where it has ended."""
        self.dismissed = True
        # `shutdown`, not `close`: the descriptor is libzmq's, which closes it when it reads the end.
        with self._socket() as found:
            if found is not None:
                try:
                    found.shutdown(socket.SHUT_RDWR)
                except OSError:
                    return  # it ended by itself

    def transferred(self) -> tuple[int, int] | None:
        """Count the bytes that the peer has acknowledged, and those that came from it [B].

        Returns:
            Both; None where the system counts none, as of a socket file.
        """
        with self._socket() as found:
            if found is None or found.family not in (socket.AF_INET, socket.AF_INET6):
                return None
            info = found.getsockopt(socket.IPPROTO_TCP, socket.TCP_INFO, _BYTES_AT + _BYTES.size)
        return _BYTES.unpack_from(info, _BYTES_AT) if len(info) >= _BYTES_AT + _BYTES.size else None

    @contextmanager
    def _socket(self) -> Iterator[socket.socket | None]:
        # A duplicate: libzmq's thread may close its descriptor at any moment, and the number is another
        # connection's then, which the inode shows.
        duplicate = _duplicate(self.fd)
        if duplicate is None:
            yield None
            return
        with duplicate:
            same = os.fstat(duplicate.fileno()).st_ino == self.inode
            yield duplicate if same else None


class TcpConnections:
    """The open connections of a bound socket.

    Args:
        context: Of the socket.
        watched: The bound socket.
    """

    def __init__(self, context: zmq.Context[Any], watched: zmq.Socket[Any]) -> None:
        address = f"inproc://monitor-{id(self)}"
        watched.monitor(address, _WATCHED)
        self._watched = watched
        self.monitor = context.socket(zmq.PAIR)
        """Readable when `update` has something to do."""
        self.monitor.rcvhwm = 0  # a full one would hold up libzmq's thread, and with it every peer
        self.monitor.connect(address)
        self._open: dict[int, TcpConnection] = {}
        # Descriptor to when a connection ended that no routing id was known of [ns].
        self._closed: dict[int, int] = {}

    def __iter__(self) -> Iterator[TcpConnection]:
        return iter(tuple(self._open.values()))

    def __len__(self) -> int:
        return len(self._open)

    def update(self) -> tuple[list[TcpConnection], list[TcpConnection]]:
        """Process what began and ended since the last call.

        Returns:
            The new connections, and those that ended by themselves before their routing id was known, as
            connections do that are not ZeroMQ's or have no key.
        """
        fresh: dict[int, TcpConnection] = {}
        failures: list[TcpConnection] = []
        while (event := self._next()) is not None:
            kind, fd = event
            if kind == zmq.EVENT_ACCEPTED:
                self._ended(fd)
                fresh.pop(fd, None)
                wire = self._begun(fd)
                if wire.open:
                    fresh[fd] = wire
                else:
                    # At a socket file it is hardly another than a service of the run that was ended.
                    wire.is_sibling = self._is_at_socket_file
                    failures.append(wire)
                    self._closed[fd] = time.monotonic_ns()
            else:
                ended = self._ended(fd)
                fresh.pop(fd, None)
                if ended is not None and not ended.claimed and not ended.dismissed:
                    failures.append(ended)
        return list(fresh.values()), failures

    def at(self, fd: int) -> TcpConnection | None:
        """Return the open connection with this descriptor."""
        return self._open.get(fd)

    def claim(self, wire: TcpConnection, address: str) -> bool:
        """Tie a connection to a routing id that had a message with its descriptor, if that is certain.

        Args:
            wire: The connection.
            address: Address that libzmq states for the routing id.

        Returns:
            Whether it is certain; no other routing id claims the connection then.
        """
        if not wire.open or wire.claimed or time.monotonic_ns() < wire.unclear_until:
            return False
        if address and wire.address and address != wire.address:
            return False
        wire.claimed = True
        return True

    def close(self) -> None:
        """Stop watching."""
        self._watched.disable_monitor()
        self.monitor.close(0)

    @property
    def _is_at_socket_file(self) -> bool:
        return self._watched.getsockopt_string(zmq.LAST_ENDPOINT).startswith("ipc:")

    def _next(self) -> tuple[int, int] | None:
        try:
            header, _ = self.monitor.recv_multipart(zmq.NOBLOCK)
        except zmq.Again:
            return None
        kind, value = _EVENT.unpack(header)
        return kind, value

    def _begun(self, fd: int) -> TcpConnection:
        """A new connection; not an open one where it has ended already."""
        now = time.monotonic_ns()
        found = _identity(fd)
        if found is None:
            return TcpConnection(fd, 0, UNKNOWN, now, open=False)
        inode, address, pid = found
        until = self._closed.pop(fd, -UNCLEAR_NS) + UNCLEAR_NS
        wire = self._open[fd] = TcpConnection(fd, inode, address, now, until)
        if pid is not None:
            wire.process, wire.is_sibling = _process(pid)
        return wire

    def _ended(self, fd: int) -> TcpConnection | None:
        wire = self._open.pop(fd, None)
        if wire is not None:
            wire.open = False
            if not wire.claimed:
                self._closed[fd] = time.monotonic_ns()
        return wire


def plain(address: str) -> str:
    """Normalise an address: of an IPv4 peer at an IPv6 port that of IPv4, and without a scope.

    Example:
        >>> plain("::ffff:10.0.0.7"), plain("fe80::1%eth0")
        ('10.0.0.7', 'fe80::1')
    """
    return address.removeprefix("::ffff:").partition("%")[0]


def _identity(fd: int) -> tuple[int, str, int | None] | None:
    """Inode and peer address of libzmq's socket, and the process at the other end of a socket file, also
    where no descriptor is left for one of our own; None where it is no socket."""
    pid = None
    try:
        found = os.fstat(fd)
        if not stat.S_ISSOCK(found.st_mode):
            return None
        borrowed = socket.socket(fileno=fd)
    except OSError:
        return None
    try:
        name = borrowed.getpeername()
        if borrowed.family == socket.AF_UNIX:
            pid, _, _ = _PEER.unpack(borrowed.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, _PEER.size))
    except OSError:
        name = ""
    finally:
        borrowed.detach()
    return found.st_ino, plain(str(name[0])) if isinstance(name, tuple) else "", pid


def _process(pid: int) -> tuple[str, bool]:
    """A process as people know it, and whether it has the same parent as this one."""
    folder = Path("/proc", str(pid))
    try:
        words = (folder / "cmdline").read_bytes().replace(b"\0", b" ").decode(errors="replace").split()
        # After the name, in brackets, which may hold anything: the state, then the parent.
        parent = int((folder / "stat").read_bytes().rpartition(b")")[2].split()[1])
    except (OSError, ValueError, IndexError):
        return f"process {pid}", False
    return f"process {pid} ({' '.join(words)[:COMMAND]})", parent == os.getppid()


def _duplicate(fd: int) -> socket.socket | None:
    """A socket of our own on libzmq's descriptor; None where that is no socket."""
    try:
        if not stat.S_ISSOCK(os.fstat(fd).st_mode):
            return None
        return socket.socket(fileno=os.dup(fd))
    except OSError:
        return None
