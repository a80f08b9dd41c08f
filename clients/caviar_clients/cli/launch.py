"""Start of a run: the broker and every service as processes of their own; their end, and what Ctrl-C does."""

from __future__ import annotations

import json
import os
import selectors
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import dropwhile
from pathlib import Path
from types import FrameType
from typing import Any

import zmq

from caviar_broker.supervision import describe_exit, describe_stop, is_stopped
from caviar_clients.cli.keys import BorrowedKey
from caviar_clients.session.prepared import PreparedScenario, module_folders
from caviar_protocol.errors import RunError
from caviar_protocol.files import PrivateFolder, file_system_of, open_to_append
from caviar_protocol.host import PYTHON
from caviar_protocol.run_directory import RunDirectory
from caviar_protocol.scenario import Scenario, ServiceSpec
from caviar_services.drjit_setup import THREADS_VARIABLE, share_of_each

KILLED_S = 2.0
"""[s] within which a process ends that is killed, unless it waits for a disk."""
TAIL = 1 << 16
"""[B] of a log that are looked at for its last line."""
_CRASH = "Fatal Python error: "
_AFTER_A_CRASH = ("Extension modules: ", "  File ", "  Binary file ")
ORDERS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
"""Signals that end a run: of the terminal, of a supervisor, of a terminal that is closed."""
PYTHON_S = 0.5
"""[s] that the interpreter has to handle a signal: while a service computes in a library of C, it handles
none."""


@dataclass
class Child:
    """The process of one service."""

    name: str
    process: subprocess.Popen[bytes]
    log: Path
    pidfd: int
    """Readable once the process is dead."""

    @classmethod
    def start(cls, name: str, command: Sequence[str], log: Path, environment: Mapping[str, str]) -> Child:
        """Start a process.

        Args:
            name: Of the service.
            command: Program and arguments.
            log: Gets what the process prints, after what a process before it printed.
            environment: All of its environment.
        """
        with open_to_append(log) as file:
            process = subprocess.Popen(  # noqa: S603  # our own module with checked arguments
                command,
                stdin=subprocess.DEVNULL,
                stdout=file,
                stderr=file,
                start_new_session=True,  # Ctrl-C is the launcher's, which ends the run in order
                env=environment,
            )
        # A process id may be another process's a moment later; the descriptor stays that of this one.
        return cls(name, process, log, os.pidfd_open(process.pid))

    def last_line(self) -> str:
        """The last line that the process printed, or what it died of in a library; empty if it printed
        nothing."""
        if not self.log.exists():  # the run's directory was deleted
            return ""
        with self.log.open("rb") as file:
            file.seek(max(0, file.seek(0, os.SEEK_END) - TAIL))
            lines = file.read().decode(errors="replace").strip().splitlines()
        if not lines:
            return ""
        # After a crash faulthandler lists all threads and libraries; what counts stands above them.
        if lines[-1].startswith(_AFTER_A_CRASH):
            crashes = (number for number in reversed(range(len(lines))) if lines[number].startswith(_CRASH))
            if (number := next(crashes, None)) is not None:
                trace = dropwhile(lambda line: not line.startswith("Current thread "), lines[number:])
                place = next((line.strip() for line in trace if line.startswith("  File ")), "no Python code")
                return f"{lines[number]}, {place}"
        return lines[-1]


def end(processes: Sequence[subprocess.Popen[bytes]], seconds: float) -> list[int]:
    """End processes: SIGTERM, and SIGKILL for those that are left later.

    Args:
        processes: Which; those that have ended already are left out.
        seconds: Time between the two signals [s].

    Returns:
        Process ids of those that still live, since they wait for a disk.
    """
    for process in processes:
        if process.poll() is None:
            process.send_signal(signal.SIGTERM)
    wait(processes, seconds)
    for process in processes:
        if process.poll() is None:
            process.kill()
    # A process in uninterruptible sleep takes no signal, SIGKILL neither: the launcher must not wait for it.
    wait(processes, KILLED_S)
    return [process.pid for process in processes if process.poll() is None]


def wait(processes: Sequence[subprocess.Popen[bytes]], seconds: float) -> None:
    """Wait until all processes have ended, but for ``seconds`` at most [s]."""
    until = time.monotonic() + seconds
    for process in processes:
        try:
            process.wait(max(0.0, until - time.monotonic()))
        except subprocess.TimeoutExpired:
            continue


class Interruption:
    """Turns signals into an order to end the run, for as long as a ``with`` block lasts.

    Python hands signals to the main thread alone: in another one a block leaves them as they are.

    Args:
        stop: Orders an orderly end, for a reason. Called from a signal handler; with ``in_process`` from a
            thread, too.
        in_process: Whether services run in this process. Python handles no signal while one of them computes
            in a library of C: a thread then takes the signals, and ends the process with status 130.

    Example:
        >>> reasons = []
        >>> with Interruption(reasons.append) as interruption:
        ...     os.kill(os.getpid(), signal.SIGTERM)
        >>> interruption.came, reasons
        (True, ['stopped by SIGTERM'])
    """

    def __init__(self, stop: Callable[[str], None], *, in_process: bool = False) -> None:
        self._stop, self._in_process = stop, in_process
        self._before = dict[signal.Signals, Any]()
        self.came = False
        """Whether a signal came."""
        self._is_ordered = False  # by the handler
        self._handled_at = 0.0
        self._thread: threading.Thread | None = None
        self._is_over = threading.Event()

    def __enter__(self) -> Interruption:
        if threading.current_thread() is not threading.main_thread():
            return self
        self._before = {order: signal.signal(order, self._handle) for order in ORDERS}
        if self._in_process:
            self._read, self._write = os.pipe()
            os.set_blocking(self._write, False)  # as `set_wakeup_fd` has to have it
            self._fd_before = signal.set_wakeup_fd(self._write, warn_on_full_buffer=False)
            self._thread = threading.Thread(target=self._take, name="caviar-signals", daemon=True)
            self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._is_over.set()
        if self._thread is not None:
            signal.set_wakeup_fd(self._fd_before)
            os.close(self._write)  # the end of what the thread reads
            self._thread.join()
            os.close(self._read)
        for number, handler in self._before.items():
            signal.signal(number, handler)

    def _handle(self, number: int, _: FrameType | None) -> None:
        self._handled_at = time.monotonic()
        if self._is_ordered:
            raise KeyboardInterrupt  # through the launcher's block, which ends all processes
        self._is_ordered = True
        self._order(number)

    def _order(self, number: int) -> None:
        self.came = True
        name = "Ctrl-C" if number == signal.SIGINT else signal.Signals(number).name
        self._stop(f"stopped by {name}")

    def _take(self) -> None:
        """Take the numbers of the signals as they arrive, and act on those that are not handled."""
        while numbers := os.read(self._read, 64):
            arrived = time.monotonic()
            if not set(numbers) & set(ORDERS) or self._is_over.wait(PYTHON_S):
                continue
            # One that was handled just before it is read here counts, too: Python merges signals that come
            # together.
            if self._handled_at > arrived - PYTHON_S:
                continue
            if self.came:
                _end_at_once()
            self._order(next(number for number in numbers if number in ORDERS))


def _end_at_once() -> None:
    """End this process from a thread, whatever the others do."""
    if sys.stderr.isatty():
        sys.stderr.write("\x1b[?25h")  # the cursor, which the bar hides
    sys.stderr.write("caviar: ended at once, from within a call that does not return: nothing was closed\n")
    sys.stderr.flush()
    os._exit(128 + signal.SIGINT)


KILL_AFTER_S = 1.0
"""[s] that a process gets after SIGTERM before SIGKILL, beyond the run's ``shutdown_s``."""
BROKER_S = 30.0
"""[s] that the broker gets to end after its last service, beyond the run's ``shutdown_s``."""
MAX_RESTARTS = 5
"""Processes that are started for a service that died, before it comes back."""
LISTEN_S = 120.0
"""[s] from its start until the broker listens: one that resumes a run reads its journal before."""
ANY_PORT = "tcp://127.0.0.1:0"
# Of services that trace rays, or may.
_TRACING_ROLES = ("channel", "sensors")
LOOK_S = 0.05
"""[s] between looks at whether the broker's process is stopped; its death shows at once."""


@dataclass
class Launcher:
    """Runs one scenario as processes of this machine.

    Use as a context manager: however the block is left, no process of the run survives it. `events` yields
    what the broker reports, until the run is over. Remote services are started by the user, at ``endpoint``.

    Args:
        prepared: The scenario, as `prepare` returns it.
        path: The scenario's file.
        directory: The run's directory.
        frames, seed, pace: What replaces the scenario's; None: nothing.
        bind: Address of the broker; empty for a socket file of this user alone, where every service is local.
        keys: Keys directory of the broker; None: a run without keys.
        http: ``HOST:PORT`` at which the broker has HTTP served; empty: nowhere.
        resume: Whether the run in the directory is resumed, whatever path, frames, seed and pace are.
        force: Whether it is, though code, libraries or files have changed.
        attachments: ``NAME=VALUE`` each, what is attached to the scenario.
        settings: ``KEY=VALUE`` each, in place of what the scenario's file says.
    """

    prepared: PreparedScenario
    path: Path
    directory: Path
    frames: int | None = None
    seed: int | None = None
    bind: str = ANY_PORT
    keys: Path | None = None
    http: str = ""
    resume: bool = False
    force: bool = False
    pace: str | None = None
    attachments: Sequence[str] = ()
    settings: Sequence[str] = ()
    scenario: Scenario = field(init=False)
    endpoint: str = ""
    """Address at which the broker listens; empty before it does."""
    refused: bool = False
    """Whether the broker ended before it listened, with an error that says why."""
    _key: BorrowedKey = field(init=False)
    # Where the socket file of the broker is; None where it listens elsewhere.
    _socket_folder: PrivateFolder | None = None
    _children: dict[str, Child] = field(default_factory=dict)
    _broker: subprocess.Popen[bytes] | None = None
    # Why the broker was ended by force; "" if it was not.
    _verdict: str = ""
    _selector: selectors.BaseSelector = field(default_factory=selectors.DefaultSelector)
    _rest: bytes = b""
    # Services that died and that the broker waits for.
    _awaited: set[str] = field(default_factory=set)
    # Brokers that were started after others that died, since a frame was last finished.
    _brokers: int = 0
    # Services that the broker gave up: no SHUTDOWN reaches them.
    _lost: set[str] = field(default_factory=set)
    # Processes that were started since a service was last there.
    _restarts: dict[str, int] = field(default_factory=dict)
    # Whether the broker has reported how the run ended.
    _over: bool = False
    # Frames that the run had, once it is over.
    _frames: int = 0
    # Why the run is to end by the user's wish; "" where it is not.
    _stopping: str = ""
    # Whether the broker's output has ended.
    _finished: bool = False
    # Why processes of the run may not end; "" where the disk answers.
    _disk: str = ""
    # When a broker that all services have left must have ended [s]; None while one is left.
    _give_up_at: float | None = None
    # When a broker that was started must listen [s]; None once it does.
    _listen_until: float | None = None

    def __post_init__(self) -> None:
        self.scenario = self.prepared.scenario
        self._key = BorrowedKey(self.keys)
        if not self.bind and self.keys is None and len(self._local) == len(self.scenario.services):
            self.bind = self._private_address()
        if not self.bind and not self.resume:
            self.bind = ANY_PORT

    def _private_address(self) -> str:
        """An ``ipc://`` address in a new directory of mode 0700; "" where its path is too long for one."""
        # A socket file needs no port that another program may take, and no other user reaches it.
        folder = PrivateFolder()
        socket = folder.path / "broker"
        if len(os.fsencode(socket)) > zmq.IPC_PATH_MAX_LEN:
            folder.cleanup()
            return ""
        self._socket_folder = folder
        return f"ipc://{socket}"

    def __enter__(self) -> Launcher:
        return self

    def __exit__(self, *_: object) -> None:
        self._end_all()
        self._selector.close()
        self._key.close()
        if self._socket_folder is not None:
            self._socket_folder.cleanup()

    def events(self) -> Iterator[Mapping[str, Any]]:
        """Start broker and services, and yield what the broker reports, then what became of its process.

        Called again, the iteration continues where it was left.

        Raises:
            RunError: The broker cannot start, does not answer, or died and cannot be followed by another.
        """
        if self._broker is None:
            self._start_broker()
        while not self._finished:
            if not self._over and not self.directory.exists():
                self.stop("its directory was deleted")
            for key, _ in self._selector.select(LOOK_S):
                if self._selector.get_map().get(key.fd) is not key:
                    # An earlier event of this batch, the broker's end, replaced all services, and one of
                    # the new ones may have the same descriptor.
                    continue
                if isinstance(key.data, Child):
                    self._child_died(key.data)
                else:
                    yield from self._broker_said()
            self._look_after_broker()
            if self._give_up_at is not None and time.monotonic() > self._give_up_at:
                raise RunError("the broker does not answer: all services have ended, and it does not")
            if self._listen_until is not None and time.monotonic() > self._listen_until:
                raise RunError(
                    f"the broker has not begun to listen within {LISTEN_S:g} s, and is ended; it waits for "
                    f"a file in {self.directory} ({file_system_of(self.directory)}); its log: {self._log}"
                )

    def stop(self, reason: str) -> None:
        """Ask for an orderly end. May be called from a signal handler."""
        self._stopping = reason
        self._order({"stop": reason})

    def log_of(self, service: str) -> Path | None:
        """Find the file to which a service printed something; None for one that printed nothing, or that has
        no process here."""
        child = self._children.get(service)
        return child.log if child and child.log.stat().st_size else None

    @property
    def _local(self) -> dict[str, ServiceSpec]:
        """The services that are started here."""
        return {name: spec for name, spec in self.scenario.services.items() if not spec.remote}

    # --- starting ----------------------------------------------------------------------------------

    @property
    def _log(self) -> Path:
        """File to which the broker prints."""
        return RunDirectory(self.directory).log("broker")

    def _broker_arguments(self) -> list[str]:
        if self.resume:
            bind = ["--bind", self.bind] if self.bind else []
            return ["--resume", str(self.directory), *bind, *["--force"] * self.force]
        given = {"--frames": self.frames, "--seed": self.seed, "--pace": self.pace}
        return [
            *(str(self.path), "--bind", self.bind, "--directory", str(self.directory)),
            *(f"{option}={value}" for option, value in given.items() if value is not None),
            *(f"--attach={text}" for text in self.attachments),
            *(f"--set={text}" for text in self.settings),
        ]

    def _start_broker(self) -> None:
        command = [*PYTHON, "-m", "caviar_broker", *self._broker_arguments()]
        command += ["--http", self.http] if self.http else []
        command += [*self._key.options(), "--control", "--supervised", *self._local]
        with open_to_append(self._log) as log:
            self._broker = subprocess.Popen(  # noqa: S603  # our own module with checked arguments
                command,
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=log,
                # The folder of the socket is the broker's as well: it may outlive this process by a moment.
                pass_fds=() if self._socket_folder is None else (self._socket_folder.fileno(),),
                bufsize=0,  # orders are given from signal handlers too, where a buffer would not be safe
                start_new_session=True,
            )
        if self._broker.stdin is None or self._broker.stdout is None:
            raise RunError("the broker has no standard input or output")
        os.set_blocking(self._broker.stdin.fileno(), False)
        if self._stopping:  # the order came before there was a broker to take it
            self._order({"stop": self._stopping})
        self._selector.register(self._broker.stdout, selectors.EVENT_READ)
        self._listen_until = time.monotonic() + LISTEN_S

    def _start_services(self) -> None:
        for name in self._local:
            self._start(name)

    def _start(self, name: str) -> None:
        spec, path = self._local[name], RunDirectory(self.directory).log(name)
        command = [*PYTHON, "-m", "caviar_services", name]
        command += ["--use", f"{spec.role}:{spec.use}", "--broker", self.endpoint]
        if wanted := self.prepared.services[name].cls.inputs_with(spec.settings):
            command += ["--inputs", *(".".join((i.topic, *i.parts)) for i in wanted)]
        for folder in module_folders(self.scenario):
            command += ["--modules", str(folder)]
        child = Child.start(name, command, path, {**self._threads, **self._key.environment()})
        before, self._children[name] = self._children.get(name), child
        if before is not None:
            os.close(before.pidfd)
        self._selector.register(child.pidfd, selectors.EVENT_READ, child)
        self._give_up_at = None

    @property
    def _threads(self) -> Mapping[str, str]:
        """The environment that limits the threads of services that trace rays to their share of the cores."""
        tracers = [spec for spec in self._local.values() if spec.role in _TRACING_ROLES]
        return {THREADS_VARIABLE: str(share_of_each(len(tracers)))}

    def _start_again(self, name: str) -> None:
        """Start a service that died and that the broker waits for, `MAX_RESTARTS` times in a row at most."""
        self._restarts[name] = number = self._restarts.get(name, 0) + 1
        if number <= MAX_RESTARTS:
            self._start(name)
            self._order({"restarted": name, "text": f"a new process was started, number {number}"})

    # --- while it runs -----------------------------------------------------------------------------

    def _broker_said(self) -> Iterator[Mapping[str, Any]]:
        broker = self._broker
        if broker is None or broker.stdout is None:
            return
        # Unbuffered: a reader's buffer could hold a line of which the selector would not know.
        data = os.read(broker.stdout.fileno(), 65536)
        if not data:
            self._selector.unregister(broker.stdout)
            if self._may_resume():
                self._resume_broker(broker)
                return
            self._finished = True
            yield self._broker_ended(broker)
            return
        *lines, self._rest = (self._rest + data).split(b"\n")
        for line in lines:
            event = json.loads(line)
            if event["event"] == "listening":
                self.endpoint, self._listen_until = event["endpoint"], None
                if not self._children:  # else they were started beside a broker that goes on
                    self._start_services()
            if event["event"] == "notice" and event.get("service") in self._children:
                self._note(event["kind"], event["service"])
            if event["event"] == "frame":
                self._brokers = 0
            if event["event"] == "finished":
                self._over, self._frames = True, event["frames"]
                self._disk = event.get("disk", "")
            yield event
            if self._disk:  # the broker ends once the disk answers
                self._finished = True
                yield {"event": "ended", "status": 1}

    def _look_after_broker(self) -> None:
        """End a broker that is stopped (SIGSTOP, a debugger); its end is then handled like any other."""
        broker = self._broker
        if not self._verdict and broker is not None and broker.poll() is None and is_stopped(broker.pid):
            self._verdict = describe_stop(broker.pid)
            broker.kill()

    # --- another broker ----------------------------------------------------------------------------

    def _may_resume(self) -> bool:
        """Tell whether a broker that died is followed by another: services may rejoin the run, the broker had
        begun, and those before it finished frames."""
        waits = (self.scenario.timeouts.rejoin_s or 0.0) > 0.0
        return (
            waits
            and not self._over
            and not self._stopping
            and bool(self.endpoint)
            and self._brokers < MAX_RESTARTS
        )

    def _resume_broker(self, broker: subprocess.Popen[bytes]) -> None:
        """Start a broker that resumes the run, at the same address, and with it all services."""
        if broker.stdin is not None:
            broker.stdin.close()
        if broker.stdout is not None:
            broker.stdout.close()
        wait([broker], KILL_AFTER_S)
        if broker.poll() is None:
            broker.kill()
        status = broker.wait()  # it has closed its output and got SIGKILL, if it needed that
        verdict, self._verdict = self._verdict or describe_exit(status), ""
        self._end_services()  # the new broker knows none of their connections
        self._brokers += 1
        self.resume, self.bind, self._rest = True, self.endpoint, b""
        self._awaited.clear()
        self._lost.clear()
        self._restarts.clear()
        self._start_broker()
        self._start_services()
        text = f"the broker died ({verdict}); another one resumes the run, number {self._brokers}"
        self._order({"restarted": "", "text": text})

    def _end_services(self) -> None:
        processes = [child.process for child in self._children.values()]
        end(processes, KILL_AFTER_S)
        for child in self._children.values():
            if child.pidfd in self._selector.get_map():
                self._selector.unregister(child.pidfd)
            os.close(child.pidfd)
        self._children.clear()

    def _broker_ended(self, broker: subprocess.Popen[bytes]) -> Mapping[str, Any]:
        wait([broker], self.scenario.timeouts.shutdown_s + BROKER_S)
        status = broker.poll()
        if status is None:
            raise RunError("the broker closed its output and does not end")
        if not self._over:
            log = self._log.read_text(errors="replace").strip()
            last = self._verdict or (log.splitlines()[-1] if log else describe_exit(status))
            own = last.startswith("caviar broker: ")  # its own error, and no crash
            self.refused = own and not self.endpoint
            raise RunError(last.removeprefix("caviar broker: ") if own else f"the broker died: {last}")
        return {"event": "ended", "status": status}

    def _note(self, kind: str, name: str) -> None:
        """Note that the broker waits for a service (``timeouts.rejoin_s``), gave it up, or has it back."""
        if kind == "lost":
            self._lost.add(name)
        elif kind == "back":
            self._lost.discard(name)
            self._awaited.discard(name)
            self._restarts.pop(name, None)
        elif kind == "away" and not self._over:
            self._awaited.add(name)
            process = self._children[name].process
            if process.poll() is None:
                process.kill()  # stopped, or cut off; its end is seen like any other
            elif name not in self._unhandled():
                self._start_again(name)

    def _unhandled(self) -> set[str]:
        """Names of services whose end has not been handled yet."""
        return {key.data.name for key in self._selector.get_map().values() if isinstance(key.data, Child)}

    def _child_died(self, child: Child) -> None:
        self._selector.unregister(child.pidfd)
        status = child.process.wait()
        if all(other.process.poll() is not None for other in self._children.values()):
            self._give_up_at = time.monotonic() + self.scenario.timeouts.shutdown_s + BROKER_S
        if not self._over:
            verdict = describe_exit(status)
            tail = child.last_line()
            self._order({"lost": child.name, "verdict": f"{verdict}, saying: {tail}" if tail else verdict})
            if child.name in self._awaited:
                self._start_again(child.name)

    def _order(self, order: Mapping[str, str]) -> None:
        if self._broker is None or self._broker.stdin is None:
            return
        try:
            self._broker.stdin.write(json.dumps(order).encode() + b"\n")
        except (BrokenPipeError, ValueError):
            return  # it is ending already; its output says why

    # --- ending --------------------------------------------------------------------------------------

    def _end_all(self) -> None:
        processes = [child.process for child in self._children.values()]
        for name in self._lost & self._children.keys():
            self._children[name].process.kill()  # stopped, or cut off
        if self._broker is not None:
            processes.append(self._broker)
            if self._broker.stdin is not None:
                self._broker.stdin.close()
        # Before the first frame some services may not have connected, so that no SHUTDOWN reached them.
        grace = self.scenario.timeouts.shutdown_s if self._frames else 0.0
        wait(processes, 0.0 if self._disk else grace)
        end(processes, KILL_AFTER_S + (0.0 if self._disk else self.scenario.timeouts.shutdown_s))
        for child in self._children.values():
            os.close(child.pidfd)
        if self._broker is not None and self._broker.stdout is not None:
            self._broker.stdout.close()
