"""Runs of the real launcher, broker and services whose processes are forked in place of being executed.

Starting Python and importing takes most of the time of a short run. This process imports once and forks
each case from itself; the case's process runs `caviar_clients.cli.launch.Launcher`, and the broker and
the services that it starts are forked likewise: real processes, sockets and files all the same.

``python fault_nursery.py`` takes a case as a line of JSON on standard input (`Case`) and answers with a
line of JSON (`Result`).
"""

from __future__ import annotations

import ctypes
import gc
import importlib
import os
import select
import signal
import subprocess
import sys
import time
import traceback
from collections.abc import Mapping, Sequence
from contextlib import suppress
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace
from typing import Any, BinaryIO

import msgspec

IMPORTED = (
    "fault_kinds",
    "stateful",
    "caviar_broker.launch",
    "caviar_clients.cli.launch",
    "caviar_services.runner",
    "caviar_services.agent.baselines",
    "caviar_services.channel.statistical.free_space",
    "caviar_services.link.beam_scores",
    "caviar_services.recorder.mcap",
    "caviar_services.world.trajectory",
)
"""What processes are forked for: they find it imported."""
REMOTE_ENDS_S = 5.0
"""[s] that services started by hand get to end after the run."""
_SUBREAPER = 36
"""``PR_SET_CHILD_SUBREAPER`` of prctl(2): orphans below this process become its children."""


class Case(msgspec.Struct, frozen=True, kw_only=True):
    """One run, and what goes wrong in it."""

    scenario: str
    directory: str
    victim: str = ""
    """Name of the service, or ``broker``; "" for an undisturbed run."""
    fault: str = ""
    """Name of a function of `fault_kinds`."""
    frame: int = 10
    """In which frame, once in the run."""
    remote: str = ""
    """``ROLE:NAME`` of a victim that is started by hand, as if elsewhere, and again when it is away."""
    limit_s: float = 20.0
    """After which the case is ended by force."""


class Result(msgspec.Struct, frozen=True, kw_only=True):
    """How a run went."""

    error: str
    culprit: str = ""
    digest: str = ""
    frames: int = 0
    seconds: float = 0.0
    notices: list[dict[str, Any]] = msgspec.field(default_factory=list)
    """As the broker reported them, each with ``at``, the monotonic time of its arrival [s]."""
    fault_at: float = 0.0
    """Monotonic time of the fault [s]; 0: there was none."""
    remotes: list[int] = msgspec.field(default_factory=list)
    """Exit statuses of the processes that were started by hand."""
    leftovers: list[str] = msgspec.field(default_factory=list)
    """Processes that survived the run."""


class Forked:
    """What the launcher needs of `subprocess.Popen`, with a fork of this process in place of a new one."""

    def __init__(
        self,
        command: list[str],
        *,
        stdin: Any = None,
        stdout: Any = None,
        stderr: Any = None,
        bufsize: int = -1,
        start_new_session: bool = False,
        env: Mapping[str, str] | None = None,
        pass_fds: Sequence[int] = (),
    ) -> None:
        self.returncode: int | None = None
        self.stdin: BinaryIO | None = None
        self.stdout: BinaryIO | None = None
        inner = [_inner(stdin, 0), _inner(stdout, 1), _inner(stderr, 2)]
        if stdin == subprocess.PIPE:
            inner[0], outer = os.pipe()
            self.stdin = os.fdopen(outer, "wb", 0)
        if stdout == subprocess.PIPE:
            outer, inner[1] = os.pipe()
            self.stdout = os.fdopen(outer, "rb", 0)
        self.pid = os.fork()
        if self.pid == 0:
            _become(command, inner, start_new_session, env, pass_fds)
        for fd, given in zip(inner, (stdin, stdout, stderr), strict=True):
            if given in (subprocess.PIPE, subprocess.DEVNULL):
                os.close(fd)

    def poll(self) -> int | None:
        """Its exit status, once it has one."""
        if self.returncode is None:
            pid, status = os.waitpid(self.pid, os.WNOHANG)
            if pid:
                self.returncode = os.waitstatus_to_exitcode(status)
        return self.returncode

    def wait(self, timeout: float | None = None) -> int:
        """Wait for its exit status."""
        if self.poll() is None:
            fd = os.pidfd_open(self.pid)
            try:
                ended = select.select([fd], [], [], timeout)[0]
            finally:
                os.close(fd)
            if not ended:
                raise subprocess.TimeoutExpired([], timeout or 0.0)
        status = self.poll()
        assert status is not None
        return status

    def send_signal(self, number: int) -> None:
        """Send it a signal, unless it has ended."""
        if self.poll() is None:
            os.kill(self.pid, number)

    def kill(self) -> None:
        """End it by force."""
        self.send_signal(signal.SIGKILL)


def _inner(given: Any, default: int) -> int:
    if given == subprocess.DEVNULL:
        return os.open(os.devnull, os.O_RDWR)
    return default if given is None or given == subprocess.PIPE else int(given.fileno())


def _become(
    command: list[str],
    fds: list[int],
    session: bool,
    env: Mapping[str, str] | None,
    passed: Sequence[int],
) -> None:
    """In the child: what ``python -m MODULE ARGUMENTS`` would do."""
    status = 1
    try:
        if session:
            os.setsid()
        for target, fd in enumerate([os.dup(fd) for fd in fds]):
            os.dup2(fd, target)
        for low, high in pairwise([2, *sorted(passed), 1 << 12]):
            os.closerange(low + 1, high)
        if env is not None:
            os.environ.clear()
            os.environ.update(env)
        module, *arguments = command[command.index("-m") + 1 :]
        status = _run(module, arguments)
    except SystemExit as order:
        status = order.code if isinstance(order.code, int) else 1
    except BaseException:
        traceback.print_exc()
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(status)


def _run(module: str, arguments: list[str]) -> int:
    import fault_kinds

    import caviar_broker.launch as broker
    import caviar_services.runner as services

    sys.argv = [module, *arguments]
    if module == "caviar_broker":
        fault_kinds.arm_broker(_case)
        return broker.main()
    assert module == "caviar_services"
    fault_kinds.arm_service(_case, arguments[0])
    return services.main()


_case = Case(scenario="", directory="")


def follow(case: Case) -> Result:
    """Run a case as ``caviar run`` would."""
    from caviar_clients.cli import launch
    from caviar_clients.session.prepared import implemented
    from caviar_protocol.errors import CaviarError
    from caviar_protocol.scenario import load_scenario

    global _case
    _case = case
    launch.subprocess = SimpleNamespace(**vars(subprocess) | {"Popen": Forked})  # type: ignore[attr-defined]
    path, directory = Path(case.scenario), Path(case.directory)
    launcher = launch.Launcher(implemented(load_scenario(path)), path, directory)
    notices: list[dict[str, Any]] = []
    remotes: list[Forked] = []
    outcome: Mapping[str, Any] = {}
    error = ""
    started = time.monotonic()
    try:
        with launcher:
            for event in launcher.events():
                if event["event"] == "notice":
                    notices.append(dict(event) | {"at": time.monotonic()})
                away = event["event"] == "notice" and event["kind"] == "away"
                if case.remote and (away or event["event"] == "listening"):
                    for before in remotes:
                        before.send_signal(signal.SIGCONT)
                    if not remotes or case.fault == "kill":  # what lives comes back by itself
                        remotes.append(_remote(case, launcher))
                elif event["event"] == "finished":
                    outcome = event
    except CaviarError as raised:
        error = str(raised)
    statuses = [remote.wait(REMOTE_ENDS_S) for remote in remotes]
    mark = directory / "fault"
    return Result(
        error=error or outcome["error"],
        culprit=outcome.get("culprit", ""),
        digest=outcome.get("digest", ""),
        frames=outcome.get("frames", 0),
        seconds=time.monotonic() - started,
        notices=notices,
        remotes=statuses,
        fault_at=float(mark.read_text()) if mark.exists() else 0.0,
    )


def _remote(case: Case, launcher: Any) -> Forked:
    """The victim, started by hand."""
    command = [sys.executable, "-m", "caviar_services", case.victim, "--use", case.remote]
    with (Path(case.directory) / "remote.log").open("ab") as log:
        return Forked([*command, "--broker", launcher.endpoint], stdout=log, stderr=log)


def _attend(case: Case) -> Result:
    """Run a case in a process of its own, and see what it leaves behind."""
    outbox = Path(case.directory) / "result"
    outbox.parent.mkdir(parents=True, exist_ok=True)
    pid = os.fork()
    if pid == 0:
        try:
            outbox.write_bytes(msgspec.json.encode(follow(case)))
        except BaseException:
            outbox.with_name("traceback").write_text(traceback.format_exc())
        finally:
            os._exit(0)
    fd = os.pidfd_open(pid)
    hung = not select.select([fd], [], [], case.limit_s)[0]
    os.close(fd)
    if hung:
        os.kill(pid, signal.SIGKILL)
    os.waitpid(pid, 0)
    leftovers = _end_orphans(outbox.parent)
    if hung or not outbox.exists():
        report = outbox.with_name("traceback")
        text = report.read_text() if report.exists() else f"the case hung for {case.limit_s:g} s"
        return Result(error=text, culprit="the test", leftovers=leftovers)
    result = msgspec.json.decode(outbox.read_bytes(), type=Result)
    return msgspec.structs.replace(result, leftovers=leftovers)


def _end_orphans(directory: Path) -> list[str]:
    """End whatever is still alive below this process; what it was."""
    found = []
    while children := Path(f"/proc/self/task/{os.getpid()}/children").read_text().split():
        for child in map(int, children):
            with suppress(OSError):
                state = Path(f"/proc/{child}/stat").read_text().rpartition(")")[2].split()[0]
                if state != "Z":
                    found.append(f"{child} ({state}) in {directory}")
                    os.kill(child, signal.SIGKILL)
            with suppress(ChildProcessError):
                os.waitpid(child, 0)
    return found


def main() -> None:
    """Attend to one case after another."""
    ctypes.CDLL(None).prctl(_SUBREAPER, 1, 0, 0, 0)
    for module in IMPORTED:
        importlib.import_module(module)
    gc.collect()
    gc.freeze()
    answers = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)
    for line in sys.stdin.buffer:
        result = _attend(msgspec.json.decode(line, type=Case))
        answers.write(msgspec.json.encode(result).decode() + "\n")
        answers.flush()


if __name__ == "__main__":
    sys.modules["fault_nursery"] = sys.modules["__main__"]
    main()
