"""The client under test, and the socket that it comes to.

`Wire` is one ROUTER with messages as plain MessagePack maps and a count of connections. `Started` is a client
that the kit starts for each life, `ByHand` one that the user starts.
"""

from __future__ import annotations

import os
import shlex
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

import msgpack  # type: ignore[import-untyped]
import zmq
from zmq.utils.monitor import recv_monitor_message

from caviar_protocol.errors import RunError

BROKEN = (ValueError, TypeError, RecursionError, msgpack.exceptions.UnpackException)
"""What `unpack` raises for bytes that are no MessagePack."""


def pack(value: Any) -> bytes:
    """Encode a value as MessagePack, everything in its shortest form.

    Example:
        >>> pack({"frame": 300}).hex()
        '81a56672616d65cd012c'
    """
    # The plain package, and not the product's codec: a defect of that must not judge itself. It writes every
    # float in nine bytes, as the canonical form does.
    packed: bytes = msgpack.packb(value)
    return packed


def unpack(data: bytes) -> Any:
    """Decode all these bytes; raises one of `BROKEN`.

    Example:
        >>> unpack(bytes.fromhex("81a56672616d65cd012c"))
        {'frame': 300}
    """
    return msgpack.unpackb(data, raw=False)


def in_order(value: Any) -> Any:
    """Sort the keys of all maps of a plain value as the canonical form does: by their UTF-8 bytes.

    Example:
        >>> in_order({"t_ns": 0, "frame": [{"b": 1, "a": 2}]})
        {'frame': [{'a': 2, 'b': 1}], 't_ns': 0}
    """
    if isinstance(value, dict):
        return {key: in_order(value[key]) for key in sorted(value, key=str.encode)}
    return [in_order(item) for item in value] if isinstance(value, list) else value


MAX_PART = 1 << 30
"""[B] of a part; a client that sends more is disconnected."""

Fields = dict[str, Any]


class Failed(Exception):  # noqa: N818 - a verdict, not an error of this program
    """The client did something else than it should.

    Args:
        expected: What should have come, as a phrase.
        got: What came, as a phrase.
    """

    def __init__(self, expected: str, got: str) -> None:
        super().__init__(f"expected {expected}; got {got}")
        self.expected, self.got = expected, got


class NotApplicable(Exception):  # noqa: N818 - a verdict, not an error of this program
    """The case does not concern this client; the text says why."""


@dataclass(frozen=True)
class Rules:
    """Statements of the kit's user about the client.

    Args:
        timeout_s: Time [s] that the client has for each answer.
        name: Name that HELLO has to state; empty: any.
        role: Role that HELLO has to state; empty: any.
        settings: ``settings`` of WELCOME.
        directory: Folder below which each life of a recorder gets one of its own; None: that for temporary
            files.
        mark: Text that makes the scenery of this run, and so its digests, unlike that of any other: no cache
            of the client has it.

    Example:
        >>> Rules(role="agent", timeout_s=2.0).role
        'agent'
    """

    timeout_s: float = 5.0
    name: str = ""
    role: str = ""
    settings: Fields = field(default_factory=dict)
    directory: str | None = None
    mark: str = ""


@dataclass(frozen=True)
class Received:
    """One multipart message, with the routing id of the connection that it came over."""

    route: bytes
    parts: list[bytes]

    @property
    def fields(self) -> Fields:
        """The header, or an empty map where it is none."""
        try:
            header = unpack(self.parts[0])
        except (*BROKEN, IndexError):
            return {}
        return header if isinstance(header, dict) else {}

    @property
    def kind(self) -> str:
        """The field ``type``; empty where there is none."""
        kind = self.fields.get("type", "")
        return kind if isinstance(kind, str) else ""


class Wire:
    """The kit's ROUTER socket.

    Args:
        endpoint: ZeroMQ address to listen at; port 0 takes any.

    Raises:
        RunError: Nothing can listen there.
    """

    def __init__(self, endpoint: str) -> None:
        self._context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
        self._socket = self._context.socket(zmq.ROUTER)
        self._socket.linger = 0
        self._socket.setsockopt(zmq.MAXMSGSIZE, MAX_PART)
        # A ROUTER does not say when a peer goes; its monitor does, by descriptors.
        self._monitor = self._socket.get_monitor_socket(zmq.EVENT_ACCEPTED | zmq.EVENT_DISCONNECTED)
        self._open: set[int] = set()
        try:
            self._socket.bind(endpoint.removesuffix(":0") + ":*" if endpoint.endswith(":0") else endpoint)
        except zmq.ZMQError as error:
            self.close()
            remedy = "an address is like tcp://127.0.0.1:5590"
            if error.errno == zmq.EADDRINUSE:
                remedy = "end what uses that port, or choose another with --listen (0: any free one)"
            raise RunError(
                f"cannot listen at {endpoint!r}: {zmq.strerror(error.errno or 0)}; {remedy}"
            ) from error
        self.endpoint = self._socket.getsockopt_string(zmq.LAST_ENDPOINT)

    @property
    def connections(self) -> int:
        """Number of open connections."""
        while self._monitor.poll(0):
            event = recv_monitor_message(self._monitor, zmq.NOBLOCK)
            change = self._open.add if event["event"] == zmq.EVENT_ACCEPTED else self._open.discard
            change(event["value"])
        return len(self._open)

    def send(self, route: bytes, header: Fields, *parts: bytes) -> None:
        """Send a message; one to a connection that is gone is lost."""
        self.send_parts(route, [pack(header), *parts])

    def send_parts(self, route: bytes, parts: list[bytes]) -> None:
        """Send parts as they are; they need not be a message."""
        self._socket.send_multipart([route, *parts])

    def poll(self, seconds: float) -> Received | None:
        """Return the message that comes within this time [s]; None where none does."""
        if not self._socket.poll(max(0, round(seconds * 1000))):
            return None
        route, *parts = self._socket.recv_multipart()
        return Received(route, parts)

    def close(self) -> None:
        """Close everything; what is not sent is lost."""
        self._socket.disable_monitor()
        self._monitor.close(0)
        self._socket.close()
        self._context.term()


START_S = 30.0
"""[s] from its start until a process has said HELLO: interpreters and libraries take their time."""
BY_HAND_S = 300.0
"""[s] that a user has to start a client."""
# SIGTERM and SIGINT are missing: a client that they end obeys.
CRASHES = (signal.SIGILL, signal.SIGABRT, signal.SIGBUS, signal.SIGFPE, signal.SIGSEGV, signal.SIGKILL)


@dataclass(frozen=True)
class End:
    """End of a client's process.

    Args:
        status: Exit status as `subprocess` states it; None for a client that was started by hand.
        output: All that it printed.
    """

    status: int | None
    output: str = ""

    @property
    def words(self) -> str:
        """Last line of the output that is not empty."""
        return next((line.strip() for line in reversed(self.output.split("\n")) if line.strip()), "")

    @property
    def crashed(self) -> bool:
        """Tell whether a signal of `CRASHES` ended it."""
        # A shell in between reports a signal n as status 128 + n.
        return self.status is not None and any(self.status in (-n, 128 + n) for n in CRASHES)

    def check_failure(self, expected: str) -> str:
        """Check that it says by its status that something was wrong; raises `Failed` otherwise."""
        if self.crashed or self.status == 0:
            raise Failed(expected, str(self))
        return str(self)

    def __str__(self) -> str:
        status = "it ended" if self.status is None else f"it ended with status {self.status}"
        return f"{status} («{self.words[:200]}»)" if self.words else status


class Client(Protocol):
    """A client under test, as the kit drives it."""

    start_s: float
    """[s] until HELLO has to be there."""

    def start(self) -> None:
        """Start a life of the client, or have the user start one."""

    def ended(self) -> End | None:
        """Return how it ended; None while it is there."""

    def terminate(self) -> bool:
        """Send SIGTERM; False where the kit cannot."""

    def dispose(self) -> None:
        """End the client, whatever it does."""

    def memory(self) -> int | None:
        """Return its highest resident memory so far [B]; None where the kit cannot see it."""


class Started:
    """A client that the kit starts.

    Args:
        command: Command line; ``{endpoint}`` and ``{name}`` are filled in.
        endpoint: Address that the client connects to.
        name: Name of the client.
        folder: Where its output goes.

    Raises:
        RunError: The command is empty.
    """

    start_s = START_S

    def __init__(self, command: str, endpoint: str, name: str, folder: Path) -> None:
        self._words = [
            word.replace("{endpoint}", endpoint).replace("{name}", name) for word in shlex.split(command)
        ]
        if not self._words:
            raise RunError("the command is empty; give one such as 'node agent.mjs {endpoint} {name}'")
        self._folder = folder
        self._process: subprocess.Popen[bytes] | None = None
        self._log: Path | None = None

    def start(self) -> None:
        """Start the process, in a process group of its own."""
        self.dispose()
        # `python` in a command is the running interpreter, also where no environment is activated.
        search = os.pathsep.join([str(Path(sys.executable).parent), os.environ.get("PATH", os.defpath)])
        handle, name = tempfile.mkstemp(dir=self._folder, suffix=".log")
        self._log = Path(name)
        try:
            # A file and not a pipe takes the output: nothing reads while a case waits, and a full pipe would
            # stop a talkative client.
            self._process = subprocess.Popen(  # noqa: S603 - the command is the user's own
                self._words,
                stdin=subprocess.DEVNULL,
                stdout=handle,
                stderr=handle,
                start_new_session=True,
                env=os.environ | {"PATH": search},
            )
        except OSError as error:
            raise RunError(f"cannot start {self._words[0]!r}: {error.strerror}; see --command") from error
        finally:
            os.close(handle)

    def ended(self) -> End | None:
        """Return its exit status and output, once it has ended."""
        status = None if self._process is None else self._process.poll()
        if status is None or self._log is None:
            return None
        return End(status, self._log.read_text(errors="replace"))

    def terminate(self) -> bool:
        """Send SIGTERM to the process."""
        if self._process is not None:
            self._process.terminate()
        return True

    def dispose(self) -> None:
        """Kill the process, and what it started in its group."""
        if self._process is None:
            return
        if self._process.poll() is None:
            os.killpg(self._process.pid, signal.SIGKILL)
            self._process.wait()
        self._process = None

    def memory(self) -> int | None:
        """Return its high-water mark [B] as Linux states it in ``/proc/PID/status``."""
        try:
            status = Path(f"/proc/{self._process.pid if self._process else 0}/status").read_text()
        except OSError:
            return None
        lines = [line.split() for line in status.splitlines() if line.startswith("VmHWM:")]
        return int(lines[0][1]) * 1024 if lines else None


class ByHand:
    """A client that the user starts; it is gone when no connection is left.

    Args:
        wire: The kit's socket, which counts connections.
        address: Address that the user is asked to connect the client to.
        tell: Shows the user a text.
        timeout_s: Time [s] that a client has to go, before the user is asked to end it.
    """

    start_s = BY_HAND_S

    def __init__(self, wire: Wire, address: str, tell: Callable[[str], None], timeout_s: float) -> None:
        self._wire, self._address, self._tell, self._timeout_s = wire, address, tell, timeout_s
        self._started = False

    def start(self) -> None:
        """Ask the user for a life of the client."""
        again = "start your client again" if self._started else "start your client"
        self._tell(f"{again}, with the broker's address {self._address}")
        self._started = True

    def ended(self) -> End | None:
        """Gone, with a status that the kit cannot see."""
        return End(None) if self._wire.connections == 0 else None

    def terminate(self) -> bool:
        """False: the process is the user's."""
        return False

    def dispose(self) -> None:
        """Wait until it is gone; ask the user to end it where it stays."""
        for seconds, request in (
            (self._timeout_s, "your client is still connected: end it"),
            (BY_HAND_S, ""),
        ):
            until = time.monotonic() + seconds
            while self._wire.connections:
                self._wire.poll(0.05)
                if time.monotonic() > until:
                    break
            else:
                return
            if not request:
                raise RunError("the client was not ended; the kit cannot continue with the next case")
            self._tell(request)

    def memory(self) -> int | None:
        """None: the kit does not know the process."""
        return None
