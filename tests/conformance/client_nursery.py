"""Lives of clients as forks of a process that has imported what they need.

The kit starts each client a dozen times: interpreters that import the same libraries again took more than
half of the processor time of its tests. The nursery imports them once and runs no client itself, so that a
fork of it begins as a new interpreter does. Orders and answers are lines of JSON.
"""

from __future__ import annotations

import itertools
import json
import os
import runpy
import select
import signal
import subprocess
import sys
import tempfile
import threading
from contextlib import suppress
from pathlib import Path
from typing import Any

from caviar_labs.conform.client import End, Started

TICK_S = 0.005
"""[s] between two looks of the nursery at what has ended."""


class Nursery:
    """The process that forks; thread-safe."""

    def __init__(self) -> None:
        # Without threads of NumPy's library: a fork has only the thread that forks.
        self._process = subprocess.Popen(
            [sys.executable, __file__],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            env=os.environ | {"OPENBLAS_NUM_THREADS": "1"},
        )
        self._numbers = itertools.count()
        self._events: dict[int, dict[str, int]] = {}
        self._changed = threading.Condition()
        self._thread = threading.Thread(target=self._listen, daemon=True)
        self._thread.start()

    def start(self, words: list[str], log: Path) -> int:
        """Start ``python WORDS…`` with its output in a file; the number of the life."""
        assert self._process.stdin is not None
        with self._changed:
            number = next(self._numbers)
            order = {"number": number, "words": words, "log": str(log), "environment": dict(os.environ)}
            self._process.stdin.write(json.dumps(order) + "\n")
            self._process.stdin.flush()
        return number

    def wait(self, number: int, key: str) -> int:
        """``pid`` or ``status`` of a life, once it is known."""
        with self._changed:
            assert self._changed.wait_for(lambda: key in self._events.get(number, {}), 30.0)
            return self._events[number][key]

    def status(self, number: int) -> int | None:
        """How a life ended, as `subprocess` says it; None while it lasts."""
        with self._changed:
            return self._events.get(number, {}).get("status")

    def close(self) -> None:
        """End the nursery; its lives are their kits' to end."""
        assert self._process.stdin is not None
        self._process.stdin.close()
        self._thread.join()
        self._process.wait()

    def _listen(self) -> None:
        assert self._process.stdout is not None
        with self._process.stdout as lines:
            for line in lines:
                event = json.loads(line)
                with self._changed:
                    self._events.setdefault(event.pop("number"), {}).update(event)
                    self._changed.notify_all()


class Forked(Started):
    """A client that the kit starts: a Python program from the nursery, any other as `Started` does."""

    nursery: Nursery

    def __init__(self, command: str, endpoint: str, name: str, folder: Path) -> None:
        super().__init__(command, endpoint, name, folder)
        program, first, *_ = [*self._words, ""]
        self._is_python = program == sys.executable and (first == "-m" or Path(first).is_file())
        self._number: int | None = None

    def start(self) -> None:
        if not self._is_python:
            super().start()
            return
        self.dispose()
        handle, name = tempfile.mkstemp(dir=self._folder, suffix=".log")
        os.close(handle)
        self._log = Path(name)
        self._number = self.nursery.start(self._words[1:], self._log)

    def ended(self) -> End | None:
        if self._number is None:
            return super().ended()
        status = self.nursery.status(self._number)
        return None if status is None else End(status, self._log.read_text() if self._log else "")

    def terminate(self) -> bool:
        if self._number is None:
            return super().terminate()
        if self.nursery.status(self._number) is None:
            with suppress(ProcessLookupError):  # it has ended, and its status is on its way
                os.kill(self.nursery.wait(self._number, "pid"), signal.SIGTERM)
        return True

    def dispose(self) -> None:
        if self._number is None:
            super().dispose()
            return
        if self.nursery.status(self._number) is None:
            with suppress(ProcessLookupError):
                os.killpg(self.nursery.wait(self._number, "pid"), signal.SIGKILL)
            self.nursery.wait(self._number, "status")
        self._number = None

    def memory(self) -> int | None:
        if self._number is None:
            return super().memory()
        try:
            text = Path(f"/proc/{self.nursery.wait(self._number, 'pid')}/status").read_text()
        except OSError:
            return None
        return next(int(line.split()[1]) << 10 for line in text.splitlines() if line.startswith("VmHWM:"))


def preload() -> None:
    """Import what the clients of these tests import."""
    import msgpack  # type: ignore[import-untyped]  # noqa: F401
    import zmq  # noqa: F401

    import caviar_labs.conform.street
    import caviar_services.runner  # noqa: F401
    from caviar_services.registry import load

    for name in ("world:trajectory", "world:flight", "channel:free-space", "link:beams", "agent:los-beam"):
        role, _, use = name.partition(":")
        load(role, use)  # type: ignore[arg-type]
    load("recorder", "mcap")
    # A channel of the broken client takes its answers from there, and would import it in each life.
    caviar_labs.conform.street.product("scene", "traffic", 0)


def live(order: dict[str, Any]) -> None:
    """Be the client of an order, in a process group of its own; does not return."""
    os.setpgid(0, 0)
    log = os.open(order["log"], os.O_WRONLY | os.O_APPEND)
    null = os.open(os.devnull, os.O_RDONLY)
    for source, target in ((null, 0), (log, 1), (log, 2)):
        os.dup2(source, target)
    os.environ.clear()
    os.environ.update(order["environment"])
    words = order["words"]
    status: Any = 1
    try:
        if words[0] == "-m":
            sys.argv = [words[1], *words[2:]]
            runpy.run_module(words[1], run_name="__main__", alter_sys=True)
        else:
            sys.argv = words
            sys.path.insert(0, str(Path(words[0]).parent))
            runpy.run_path(words[0], run_name="__main__")
        status = 0
    except SystemExit as end:
        status = end.code if isinstance(end.code, int) else int(end.code is not None)
        if isinstance(end.code, str):
            sys.stderr.write(end.code + "\n")
    except BaseException:
        sys.excepthook(*sys.exc_info())  # type: ignore[arg-type]
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(status)


def main() -> None:
    """Fork at each order, and say how each life ended; until there are no more orders."""
    preload()
    numbers: dict[int, int] = {}
    received, orders = b"", sys.stdin.fileno()

    def say(**event: int) -> None:
        sys.stdout.write(json.dumps(event) + "\n")
        sys.stdout.flush()

    while True:
        if select.select([orders], [], [], TICK_S)[0]:
            data = os.read(orders, 1 << 16)
            if not data:
                return
            *lines, received = (received + data).split(b"\n")
            for order in map(json.loads, lines):
                pid = os.fork()
                if pid == 0:
                    live(order)
                # Here too, since the group may be killed as soon as its number is known.
                with suppress(OSError):
                    os.setpgid(pid, pid)
                numbers[pid] = order["number"]
                say(number=order["number"], pid=pid)
        while numbers:
            pid, status = os.waitpid(-1, os.WNOHANG)
            if pid == 0:
                break
            say(number=numbers.pop(pid), status=os.waitstatus_to_exitcode(status))


if __name__ == "__main__":
    main()
