"""Programs of `python -m MODULE` as forks of a process that has imported what they need.

Tests start some hundred services and gateways; to start Python and to import takes most of their time. A
fork is a process of its own, with its own sockets and signals, and a child of the process of the tests.

``python forked.py MODULE …`` imports the modules and forks for each order on its standard input, a socket.
"""

from __future__ import annotations

import atexit
import ctypes
import functools
import gc
import importlib
import json
import os
import runpy
import socket
import subprocess
import sys
from pathlib import Path
from typing import Any

_NAME, _SUBREAPER = 15, 36
"""``PR_SET_NAME`` and ``PR_SET_CHILD_SUBREAPER`` of prctl(2): orphans below a process become its children."""
_LARGEST = 1 << 20
"""[byte] of an order: environments are the largest part."""


class Forked(subprocess.Popen[Any]):
    """`subprocess.Popen` of ``[python, "-m", MODULE, …]``, with a fork in place of a new interpreter.

    Args:
        command: Whose first word is not looked at.
        preload: Modules that a process imports beforehand that is shared by all with the same ones.
        more: Pipes, text and environment, as for `subprocess.Popen`.
    """

    def __init__(self, command: list[str], preload: tuple[str, ...], **more: Any) -> None:
        self._preload = preload
        super().__init__(command, **more)

    def _execute_child(self, args: Any, *given: Any) -> None:
        cwd, env = given[4:6]
        in_read, in_write, out_read, out_write, error_read, error_write = given[9:15]
        order = {
            "argv": [str(word) for word in args[2:]],
            "cwd": str(cwd or Path.cwd()),
            "env": dict(os.environ if env is None else env),
        }
        inner = [fd if fd != -1 else number for number, fd in enumerate((in_read, out_write, error_write))]
        prctl = ctypes.CDLL(None).prctl
        nursery = _nursery(self._preload)
        prctl(_SUBREAPER, 1, 0, 0, 0)
        try:
            socket.send_fds(nursery, [json.dumps(order).encode()], inner)
            self.pid = int(nursery.recv(64))
        finally:
            prctl(_SUBREAPER, 0, 0, 0, 0)
        self._child_created = True
        for ours, theirs in ((in_write, in_read), (out_read, out_write), (error_read, error_write)):
            if ours != -1:
                os.close(theirs)


@functools.cache
def _nursery(preload: tuple[str, ...]) -> socket.socket:
    """Socket of a process that forks; it ends with the socket."""
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    for end in (ours, theirs):
        end.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _LARGEST)
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


def _become(order: dict[str, Any], fds: list[int]) -> None:
    """Run the program of an order as the interpreter would."""
    ctypes.CDLL(None).prctl(_NAME, b"forked", 0, 0, 0)
    for target, fd in enumerate(fds):
        os.dup2(fd, target)
    os.closerange(3, 1 << 12)
    before = set(filter(None, os.environ.get("PYTHONPATH", "").split(os.pathsep)))
    os.chdir(order["cwd"])
    os.environ.clear()
    os.environ.update(order["env"])
    wanted = filter(None, os.environ.get("PYTHONPATH", "").split(os.pathsep))
    sys.path[1:1] = [folder for folder in wanted if folder not in before]
    module, *sys.argv[1:] = order["argv"]
    runpy.run_module(module, run_name="__main__", alter_sys=True)


def main() -> None:
    """Fork for one order after another, until the other end of the socket is closed."""
    ctypes.CDLL(None).prctl(_NAME, b"nursery", 0, 0, 0)  # tests do not count it among what is left over
    orders = socket.socket(fileno=os.dup(0))
    sys.path[0] = ""
    for module in sys.argv[1:]:
        importlib.import_module(module)
    gc.collect()
    gc.freeze()
    while True:
        text, fds, *_ = socket.recv_fds(orders, _LARGEST, 3)
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
