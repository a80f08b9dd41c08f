"""Programs of Python as forks of a process that has imported what they need.

Tests start some thousand brokers, services and gateways; to start Python and to import takes most of their
time. A fork is a process of its own, with its own sockets and signals, and a child of the process that asks
for it: the tests', or that of ``caviar run`` for the broker and services of its run.

``python forked.py MODULE …`` imports the modules and forks for each order on its standard input, a socket.
"""

from __future__ import annotations

import atexit
import ctypes
import fcntl
import functools
import gc
import importlib
import itertools
import json
import multiprocessing.util
import os
import runpy
import socket
import subprocess
import sys
import threading
import types
from pathlib import Path
from typing import Any

_NAME, _SUBREAPER = 15, 36
"""``PR_SET_NAME`` and ``PR_SET_CHILD_SUBREAPER`` of prctl(2): orphans below a process become its children."""
_LARGEST = 1 << 20
"""[byte] of an order: environments are the largest part."""
_OF_A_RUN = "caviar_clients.cli.launch"
"""Module that starts the broker and the services of a run."""
MARK = "CAVIAR_TEST_RUN"
"""Environment variable by which the processes of a command are found (`scenarios_support.marked`)."""


class Forked(subprocess.Popen[Any]):
    """`subprocess.Popen` of ``[python, "-m", MODULE, …]`` or ``[python, FILE, …]``, with a fork in place of a
    new interpreter.

    Args:
        command: Whose interpreter is not looked at.
        preload: Modules that a process imports beforehand that is shared by all with the same ones.
        more: Pipes, text, environment, session and descriptors, as for `subprocess.Popen`.
    """

    def __init__(self, command: list[str], preload: tuple[str, ...], **more: Any) -> None:
        self._preload = preload
        super().__init__(command, **more)

    def _execute_child(self, args: Any, *given: Any) -> None:
        passed, cwd, env, session = sorted(given[3]), *given[4:6], given[20]
        in_read, _, _, out_write, _, error_write = given[9:15]
        order = {
            "argv": [str(word) for word in args[1:]],
            "cwd": str(cwd or Path.cwd()),
            "env": dict(os.environ if env is None else env),
            "session": session,
            "passed": passed,
        }
        inner = [fd if fd != -1 else number for number, fd in enumerate((in_read, out_write, error_write))]
        prctl = ctypes.CDLL(None).prctl
        nursery = _nursery(self._preload)
        prctl(_SUBREAPER, 1, 0, 0, 0)
        try:
            socket.send_fds(nursery, [json.dumps(order).encode()], [*inner, *passed])
            self.pid = int(nursery.recv(64))
        finally:
            prctl(_SUBREAPER, 0, 0, 0, 0)
        self._child_created = True
        self._close_pipe_fds(*given[9:15])

    def abandoned(self) -> int:
        """Return the process id; another object waits for the process."""
        self.returncode = 0  # as far as this one is concerned
        return self.pid


@functools.cache
def _nursery(preload: tuple[str, ...]) -> socket.socket:
    """Socket of a process that forks; it ends with the socket."""
    ours, theirs = _sockets()
    process = subprocess.Popen(
        [sys.executable, __file__, *preload],
        stdin=theirs,
        stdout=subprocess.DEVNULL,  # what is loaded finds no terminal
        env=os.environ | {"OPENBLAS_NUM_THREADS": "1", "COLUMNS": "200"},
    )
    theirs.close()

    def close() -> None:
        ours.close()
        process.wait()

    atexit.register(close)
    return ours


def _sockets() -> tuple[socket.socket, socket.socket]:
    """Two connected ends, each of which takes the largest order."""
    ends = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    for end in ends:
        end.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _LARGEST)
    return ends


def _fork_processes_of_this_one() -> None:
    """Fork the broker and the services of this command's runs, too, and processes of `multiprocessing`.

    They have to be its children. So this process, before it has threads, forks the one that they come from.
    """
    ours, theirs = _sockets()
    if os.fork() == 0:
        os.setsid()  # Ctrl-C of a terminal, which a test sends to a group, is not for it
        ours.close()
        null = os.open(os.devnull, os.O_RDWR)
        for target in range(3):
            os.dup2(null, target)
        ctypes.CDLL(None).prctl(_NAME, b"nursery", 0, 0, 0)
        _attend(theirs)
        sys.exit()  # of this process and of its forks, and not what the command does
    theirs.close()
    global _nursery
    _nursery = lambda preload: ours  # noqa: E731
    if launch := sys.modules.get(_OF_A_RUN):
        launch.subprocess = forking()
    execute = multiprocessing.util.spawnv_passfds
    turn = threading.Lock()

    def start(path: bytes, args: list[str], passed: list[int]) -> int:
        if "--multiprocessing-fork" not in args:
            return execute(path, args, passed)
        with turn:
            return Forked(args, (), pass_fds=passed).abandoned()

    multiprocessing.util.spawnv_passfds = start


def forking(preload: tuple[str, ...] = ()) -> types.SimpleNamespace:
    """Module `subprocess` with forks in place of processes: what a test gives the launcher."""

    def start(command: list[str], **more: Any) -> subprocess.Popen[Any]:
        return Forked(command, preload, **more)

    return types.SimpleNamespace(**vars(subprocess) | {"Popen": start})


def _become(order: dict[str, Any], fds: list[int]) -> None:
    """Run the program of an order as the interpreter would."""
    ctypes.CDLL(None).prctl(_NAME, b"forked", 0, 0, 0)
    if order["session"]:
        os.setsid()
    targets = [0, 1, 2, *order["passed"]]
    fds = [fcntl.fcntl(fd, fcntl.F_DUPFD, targets[-1] + 1) for fd in fds]
    for target, fd in zip(targets, fds, strict=True):
        os.dup2(fd, target)
    for below, above in itertools.pairwise([*targets, 1 << 12]):
        os.closerange(below + 1, above)
    before = set(filter(None, os.environ.get("PYTHONPATH", "").split(os.pathsep)))
    os.chdir(order["cwd"])
    os.environ.clear()
    os.environ.update(order["env"])
    wanted = filter(None, os.environ.get("PYTHONPATH", "").split(os.pathsep))
    sys.path[1:1] = [folder for folder in wanted if folder not in before]
    words = order["argv"]
    if "-c" in words:  # of `multiprocessing`, after options of the interpreter
        words = words[words.index("-c") :]
    safe, option = words[0] == "-P", next((word for word in words[:2] if word in ("-m", "-c")), "")
    program, *sys.argv[1:] = words[safe + bool(option) :]
    if mark := os.environ.get(MARK):
        # Linux shows the environment and the words with which a program was executed, which a fork was not.
        os.memfd_create(f"{MARK}={mark} {' '.join(words)}"[:200])
    if program == "caviar_clients":
        _fork_processes_of_this_one()
    try:
        if option == "-m":
            del sys.path[:safe]
            runpy.run_module(program, run_name="__main__", alter_sys=True)
        elif option == "-c":
            exec(program, {"__name__": "__main__"})  # noqa: S102 - what a new interpreter would do
        else:
            sys.argv[0], sys.path[0] = program, str(Path(program).parent)
            runpy.run_path(program, run_name="__main__")
    except SystemExit as end:
        if end.code is not None and not isinstance(end.code, int):
            raise  # a message is printed, and the status is 1
        # To free what the process before it has loaded takes longer than most programs.
        threading._shutdown()
        atexit._run_exitfuncs()
        for stream in (sys.stdout, sys.stderr):
            stream.flush()
        os._exit(end.code or 0)


def main() -> None:
    """Fork for one order after another, until the other end of the socket is closed."""
    ctypes.CDLL(None).prctl(_NAME, b"nursery", 0, 0, 0)  # tests do not count it among what is left over
    orders = socket.socket(fileno=os.dup(0))
    sys.path[0] = ""
    for module in sys.argv[1:]:
        importlib.import_module(module)
    gc.collect()
    gc.freeze()
    _attend(orders)


def _attend(orders: socket.socket) -> None:
    """Fork for each order; a fork returns when its program has."""
    while True:
        text, fds, *_ = socket.recv_fds(orders, _LARGEST, 16)
        if not text:
            return
        read_end, write_end = os.pipe()
        between = os.fork()
        if between == 0:
            pid = os.fork()
            if pid:
                os.write(write_end, str(pid).encode())
                os._exit(0)
            _become(json.loads(text), fds)
            return
        os.waitpid(between, 0)  # now its child is that of the tests
        orders.send(os.read(read_end, 64))
        for fd in (read_end, write_end, *fds):
            os.close(fd)


if __name__ == "__main__":
    main()
