"""The broker of a measured run: port, frame clock, deadlines, journal and latency record, as in any run."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory

import msgspec
import numpy as np

from caviar_broker.bench.client import Part, Topology, deliveries, parts
from caviar_broker.core import events as ev
from caviar_broker.core.plan import SECOND, RunPlan, ServicePlan, Timeouts
from caviar_broker.journal import JournalFile
from caviar_broker.launch import tune_garbage_collector
from caviar_broker.security.access import Access
from caviar_broker.server import BrokerServer
from caviar_broker.statistics import Statistics
from caviar_protocol.assets import AssetStore
from caviar_protocol.errors import RunError
from caviar_protocol.host import steady_memory
from caviar_protocol.keys import BROKER, BROKER_KEY_VARIABLE, KEY_VARIABLE, Pair, write_pair

WARM_UP = 50
"""Frames at the start that do not count."""
BUDGET_NS = SECOND
"""Of every service: long, so that a noisy machine does not turn up as misses, but kept watch over."""
CLIENT = "caviar_broker.bench.client"
CONNECT_NS = 30 * SECOND
"""Until all clients have to be there."""
# What the pair is called that all of them have.
_CLIENTS = "clients"
END_S = 10.0
"""[s] that a client gets to end after the run."""


class MicrosecondsPerFrame(msgspec.Struct, frozen=True):
    """Wall time between the ends of frames [µs]."""

    mean: float
    p50: float
    p99: float


class Measured(msgspec.Struct, frozen=True, kw_only=True):
    """What a run cost."""

    topology: Topology
    services: int
    payload: int
    """[B]"""
    curve: bool
    """Whether with keys, encrypted."""
    frames: int
    """That were measured, after the warm-up."""
    us_per_frame: MicrosecondsPerFrame
    bytes_per_second: float
    """Delivered to consumers [B/s]."""
    broker_cpu_us_per_frame: float
    """CPU time of the thread that serves [µs]; what ZeroMQ's threads do is not in it."""
    misses: int
    """Deadlines that were missed."""


class _Silent:
    """Observer that reports nothing."""

    def notice(self, notice: ev.Notice) -> None:
        """Problems end the run, whose outcome names them; misses are counted."""

    def frame(self, frame: ev.FrameFinished, statistics: Statistics) -> None:
        """Measured by the statistics."""


def measure(
    topology: Topology, services: int, payload: int, frames: int, *, curve: bool = False, ipc: bool = False
) -> Measured:
    """Run ``services`` clients, each a process, with products of ``payload`` bytes.

    With ``curve`` each of them has a key, and what it says is encrypted, as in a run with keys.

    Args:
        topology: Which client takes what from which.
        services: Number of clients.
        payload: Of each product [B].
        frames: That are measured, after the warm-up.
        curve: Whether with keys.
        ipc: Whether at a socket file, as the services of `caviar run`; else over TCP.

    Raises:
        RunError: The run, or one of the clients, does not come to its end.
    """
    declared = parts(topology, services)
    plan = RunPlan(
        run="bench",
        services=tuple(ServicePlan(name=p.name, role=p.role, budget_ns=BUDGET_NS) for p in declared),
        frames=frames + WARM_UP,
        sampling_period_ns=SECOND,
        record=("lidar",),
        timeouts=Timeouts(connect=CONNECT_NS),
    )
    with (
        TemporaryDirectory() as folder,
        closing(JournalFile(Path(folder) / "journal", plan.epoch)) as journal,
    ):
        store = AssetStore(Path(folder) / "assets")
        access = _keys(Path(folder), declared) if curve else None
        endpoint = f"ipc://{folder}/broker" if ipc else "tcp://127.0.0.1:0"
        server = BrokerServer(plan, endpoint, journal, _Silent(), store, access=access)
        tune_garbage_collector()
        steady_memory()
        keys = Path(folder) if curve else None
        with _clients(topology, services, payload, server.endpoint, keys):
            outcome = server.run()
            if outcome.error:
                raise RunError(f"the measured run did not come to its end: {outcome.error}")
    # From end to end of frames: what a user of the run sees, its client processes included.
    ends = np.asarray(server.statistics.finished_ns[WARM_UP - 1 :], np.int64)
    each = np.diff(ends) / 1e3
    mean = float(each.mean())
    return Measured(
        topology=topology,
        services=services,
        payload=payload,
        curve=curve,
        frames=frames,
        us_per_frame=MicrosecondsPerFrame(mean, float(np.median(each)), float(np.percentile(each, 99))),
        bytes_per_second=deliveries(topology, services) * payload / mean * 1e6,
        broker_cpu_us_per_frame=server.cpu_s / (frames + WARM_UP) * 1e6,
        misses=server.statistics.misses,
    )


def _keys(folder: Path, declared: Sequence[Part]) -> Access:
    """Make a pair for the broker, and one that all clients have."""
    write_pair(folder, BROKER, Pair.new())
    clients = Pair.new()
    write_pair(folder, _CLIENTS, clients)
    return Access(folder, clients.public, {part.name: part.role for part in declared})


@contextmanager
def _clients(
    topology: Topology, services: int, payload: int, endpoint: str, keys: Path | None
) -> Iterator[None]:
    """The clients as processes; none of them outlives the block."""
    command = [sys.executable, "-m", CLIENT, topology, str(services)]
    # Keys that the caller has for another broker are none of this one's.
    environment = {k: v for k, v in os.environ.items() if k not in (KEY_VARIABLE, BROKER_KEY_VARIABLE)}
    if keys is not None:
        environment[KEY_VARIABLE] = str(keys / f"{_CLIENTS}.key")
        environment[BROKER_KEY_VARIABLE] = str(keys / f"{BROKER}.pub")
    started: Sequence[subprocess.Popen[bytes]] = [
        subprocess.Popen([*command, str(number), str(payload), endpoint], env=environment)  # noqa: S603  # our own module
        for number in range(services)
    ]
    try:
        yield
        for process in started:
            process.wait(END_S)
    except subprocess.TimeoutExpired as error:
        raise RunError(f"a client did not end within {END_S:g} s of the measured run") from error
    finally:
        for process in started:
            process.kill()
            process.wait()
