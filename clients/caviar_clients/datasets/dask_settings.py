"""How Dask is set for a generation: processes, memory, and what it may write on the terminal."""

from __future__ import annotations

import logging

from caviar_services.drjit_setup import THREADS_VARIABLE

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
