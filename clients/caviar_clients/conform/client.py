"""The client under test: a process that the kit starts for each life, or one that the user starts."""

from __future__ import annotations

import os
import shlex
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from caviar_clients.conform.wire import Wire
from caviar_protocol.errors import RunError

START_S = 30.0
"""[s] from its start until a process has said HELLO: interpreters and libraries take their time."""
BY_HAND_S = 300.0
"""[s] that a user has to start a client."""
CRASHES = (signal.SIGILL, signal.SIGABRT, signal.SIGBUS, signal.SIGFPE, signal.SIGSEGV, signal.SIGKILL)


@dataclass(frozen=True)
class End:
    """How a client ended; ``status`` is None where nobody can tell, for it was started by hand."""

    status: int | None
    output: str = ""
    """All that it printed."""

    @property
    def words(self) -> str:
        """The last line of that."""
        return next((line.strip() for line in reversed(self.output.split("\n")) if line.strip()), "")

    @property
    def crashed(self) -> bool:
        """Whether a signal of the kind that nobody intends ended it, as the kernel or a shell tells it."""
        return self.status is not None and any(self.status in (-n, 128 + n) for n in CRASHES)

    def __str__(self) -> str:
        status = "it ended" if self.status is None else f"it ended with status {self.status}"
        return f"{status} («{self.words[:200]}»)" if self.words else status


class Client(Protocol):
    """What the kit can do with a client."""

    start_s: float
    """[s] until HELLO has to be there."""

    def start(self) -> None:
        """See to it that a client comes."""

    def ended(self) -> End | None:
        """How it ended; None while it is there."""

    def terminate(self) -> bool:
        """Send SIGTERM; whether that can be done."""

    def dispose(self) -> None:
        """Have it gone, whatever it does."""

    def memory(self) -> int | None:
        """Its highest resident memory so far [B], where that can be told."""


def _search_path() -> str:
    """Folders of commands: ``python`` is the running interpreter, also where no environment is activated."""
    return os.pathsep.join([str(Path(sys.executable).parent), os.environ.get("PATH", os.defpath)])


class Started:
    """A client that the kit starts with a command line; ``{endpoint}`` and ``{name}`` are filled in."""

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
        handle, name = tempfile.mkstemp(dir=self._folder, suffix=".log")
        self._log = Path(name)
        try:
            self._process = subprocess.Popen(  # noqa: S603 - the command is the user's own
                self._words,
                stdin=subprocess.DEVNULL,
                stdout=handle,
                stderr=handle,
                start_new_session=True,
                env=os.environ | {"PATH": _search_path()},
            )
        except OSError as error:
            raise RunError(f"cannot start {self._words[0]!r}: {error.strerror}; see --command") from error
        finally:
            os.close(handle)

    def ended(self) -> End | None:
        """Its exit status, once it has one."""
        status = None if self._process is None else self._process.poll()
        return (
            None
            if status is None
            else End(status, self._log.read_text(errors="replace") if self._log else "")
        )

    def terminate(self) -> bool:
        """SIGTERM to the process."""
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
        """Its high-water mark as Linux tells it."""
        try:
            status = Path(f"/proc/{self._process.pid if self._process else 0}/status").read_text()
        except OSError:
            return None
        lines = [line.split() for line in status.splitlines() if line.startswith("VmHWM:")]
        return int(lines[0][1]) * 1024 if lines else None


class ByHand:
    """A client that the user starts when ``tell`` says so; it is gone when no connection is left."""

    start_s = BY_HAND_S

    def __init__(self, wire: Wire, address: str, tell: Callable[[str], None], timeout_s: float) -> None:
        self._wire, self._address, self._tell, self._timeout_s = wire, address, tell, timeout_s
        self._started = False

    def start(self) -> None:
        """Ask the user."""
        again = "start your client again" if self._started else "start your client"
        self._tell(f"{again}, with the broker's address {self._address}")
        self._started = True

    def ended(self) -> End | None:
        """Gone, with a status that nobody told."""
        return End(None) if self._wire.connections == 0 else None

    def terminate(self) -> bool:
        """Not the kit's to do."""
        return False

    def dispose(self) -> None:
        """Wait until it is gone; ask the user where it stays."""
        told, until = False, time.monotonic() + self._timeout_s
        while self._wire.connections:
            self._wire.poll(0.05)
            if not told and time.monotonic() > until:
                self._tell("your client is still connected: end it")
                told, until = True, time.monotonic() + BY_HAND_S
            elif told and time.monotonic() > until:
                raise RunError("the client was not ended; the kit cannot go on with the next case")

    def memory(self) -> int | None:
        """Not to be seen."""
        return None
