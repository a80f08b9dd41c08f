"""Processes of this machine that play episodes: how Dask starts, sets and ends them, and how they ended."""

from __future__ import annotations

import functools
import logging
import os
import signal
import time
from collections.abc import MutableMapping
from contextlib import ExitStack, suppress
from typing import TYPE_CHECKING, Any, ClassVar

from caviar_protocol.errors import SetupError
from caviar_protocol.files import PrivateFolder
from caviar_protocol.host import install_command, safe_path
from caviar_services.drjit_setup import THREADS_VARIABLE

# Part of the extra `datasets`: imported where it is used.
if TYPE_CHECKING:
    from distributed import Client, LocalCluster

CONNECT_S = 10.0
"""[s] within which a scheduler answers a first time, and has a worker."""

_CONFIG = {
    # Episodes are begun again by `Episodes`, which counts: one that kills its worker does so a few times.
    "distributed.scheduler.allowed-failures": 0,
    # [s] without a sign of life after which a process of this machine is started anew.
    "distributed.scheduler.worker-ttl": "120s",
    "distributed.worker.daemon": True,
    # Its samples of stacks grow by 0.3 MB an episode, for good (distributed 2026.8).
    "distributed.worker.profile.enabled": False,
    # A worker's memory is that of ray tracer and SUMO, of which Dask can spill nothing.
    "distributed.worker.memory.target": False,
    "distributed.worker.memory.spill": False,
    "distributed.worker.memory.pause": False,
    "distributed.worker.memory.terminate": False,
    # HTTP knows no credentials, and any user of the machine reaches it: nothing is served there.
    "distributed.scheduler.http.routes": [],
    "distributed.worker.http.routes": [],
    # `safe_path` is for the processes of workers, and not for what a service starts in them.
    "distributed.nanny.environ": {"PYTHONSAFEPATH": ""},
    "distributed.comm.timeouts.connect": f"{CONNECT_S:.0f}s",
    # One thread of the ray tracer in each process: two processes do 1.7 times the work of one with two.
    "distributed.nanny.pre-spawn-environ": {
        THREADS_VARIABLE: "1",
        "OMP_NUM_THREADS": "1",
        "OPENBLAS_NUM_THREADS": "1",
        "MKL_NUM_THREADS": "1",
    },
}


def set_up_dask() -> None:
    """Set Dask in this process, for all that it does from now on.

    Its logs are silenced: what follows from a lost connection is a note or an error of the command,
    and the tracebacks say nothing more.
    """
    import dask
    import distributed  # noqa: F401 - which sets levels of many of its loggers

    dask.config.set(_CONFIG)
    for name in ("asyncio", *logging.root.manager.loggerDict):
        if name.partition(".")[0] in ("asyncio", "distributed", "tornado"):
            logging.getLogger(name).setLevel(logging.CRITICAL)


def start_workers(workers: int, stack: ExitStack) -> Client:
    """Start a scheduler and processes on this machine.

    Args:
        workers: Number of processes.
        stack: Ends them.

    Returns:
        A client of them.

    Raises:
        SetupError: What makes certificates for TLS is not installed.
    """
    import dask
    from distributed import Client, LocalCluster, Security

    # A scheduler runs the code of any client, and any user of the machine reaches its port.
    try:
        security = Security.temporary()
    except ImportError as error:
        raise SetupError(f"{error}, for TLS between processes: {install_command('datasets')}") from error
    stack.enter_context(safe_path())
    folder = stack.enter_context(PrivateFolder("dask")).path
    stack.enter_context(dask.config.set({"temporary-directory": str(folder)}))
    # In two steps, since Ctrl-C may end the second one, which leaves a cluster that is half made.
    cluster = LocalCluster.__new__(LocalCluster)
    stack.callback(_abandon, cluster)
    cluster.__init__(
        security=security,
        n_workers=workers,
        threads_per_worker=1,
        worker_class=noting_nanny(),
        host="127.0.0.1",
        dashboard_address="127.0.0.1:0",
        scheduler_kwargs={"dashboard": False},
        memory_limit=0,
        silence_logs=logging.CRITICAL,
    )
    stack.enter_context(cluster)
    client: Client = stack.enter_context(Client(cluster, set_as_default=False))
    return client


def _abandon(cluster: LocalCluster) -> None:
    """Close a cluster, half made, whole or closed, so that Dask does not at the end of the process."""
    cluster.shutdown_on_close = False
    with suppress(Exception):  # workers that have not started yet are in the way of its own order
        if cluster.status.name not in ("closing", "closed"):
            cluster.close(timeout=5)


# --- how processes end --------------------------------------------------------------------------------------

KNOWN_S = 2.0
"""[s] within which an exit is noted, once the scheduler has noted the loss of its worker."""

exit_codes: MutableMapping[str, int] = {}
"""Status of each process that has ended, by the address of its worker; −N: it ended by signal N."""

_HINTS = {
    signal.SIGKILL: ", as by the system where memory lacks",
    signal.SIGSEGV: ", a fault in compiled code",
    signal.SIGABRT: ", a fault in compiled code",
    signal.SIGBUS: ", a fault in compiled code or a full memory disk",
}


@functools.cache
def noting_nanny() -> Any:
    """The class that starts the processes of a cluster on this machine.

    Dask is imported here, since it is of the extra ``datasets``.
    """
    from distributed import Nanny

    class NotingNanny(Nanny):  # type: ignore[misc]  # distributed has no types
        """Starts the process of a worker anew when it ends, as its base does, and notes how it ended.

        Ctrl-C in a terminal, which goes to all processes of the command, is left to the command.
        """

        at_once: ClassVar[bool] = False
        """Whether processes are ended without waiting for their steps: what is complete is in its place."""

        async def instantiate(self) -> Any:
            """Start the process."""
            # A process inherits what the thread that starts it blocks, here that of Dask's loop. A handler in
            # the process itself would come too late: it loads for a second.
            signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
            return await super().instantiate()

        async def kill(self, *arguments: Any, **named: Any) -> None:
            """End the process."""
            if self.at_once and self.pid is not None:
                with suppress(ProcessLookupError):
                    os.kill(self.pid, signal.SIGKILL)
            await super().kill(*arguments, **named)

        def _on_worker_exit_sync(self, exitcode: int) -> None:
            if address := self.worker_address:
                exit_codes[address] = exitcode
            super()._on_worker_exit_sync(exitcode)

    return NotingNanny


def exit_of(worker: str, wait_s: float = KNOWN_S) -> str:
    """Say how the process of a worker ended: its status, or the name of the signal.

    Args:
        worker: Its address.
        wait_s: For how long its exit may still be noted [s]; 0: another program started it.

    Returns:
        That it is not known, where another program started the process.
    """
    deadline = time.monotonic() + wait_s
    while worker not in exit_codes and time.monotonic() < deadline:
        time.sleep(0.02)
    code = exit_codes.get(worker)
    return f"how is in the log of the worker {worker}" if code is None else exit_text(code)


def exit_text(code: int) -> str:
    """Say what an exit code means.

    Args:
        code: Status of a process; −N: signal N ended it.

    Example:
        >>> print(exit_text(3))
        it exited with status 3 (no signal), as os._exit(3) does
        >>> print(exit_text(-9))
        signal SIGKILL ended it, as by the system where memory lacks
    """
    if code >= 0:
        return f"it exited with status {code} (no signal), as os._exit({code}) does"
    try:
        name = signal.Signals(-code)
    except ValueError:  # a real-time signal
        return f"signal {-code} ended it"
    return f"signal {name.name} ended it{_HINTS.get(name, '')}"
