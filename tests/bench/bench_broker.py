"""What a frame costs in the broker, beside a bare ROUTER/DEALER loop that forwards the same products.

    python tests/bench/bench_broker.py [--services 2 4 8] [--frames 2000] [--size 100] [--profile]

One hub and N − 1 leaves, each a process of its own. In every frame the hub's product goes to all
leaves, and the product of each leaf goes to the hub in the next frame. Three loops run in turn:

- *bare*: a ROUTER loop that knows nothing but this pattern, and clients that echo bytes;
- *broker*: the broker with its frame clock and journal, and clients that speak the protocol;
- *runner*: the same broker, and clients that are services in the runner that all services share.

Times are medians over the rounds, ratios are to *bare* in the same round. With ``--size 1000000`` the
hub's product is large and goes one way; then bytes a second delivered to the leaves are printed too.
"""

from __future__ import annotations

import argparse
import cProfile
import os
import pstats
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, ClassVar

import msgspec
import numpy as np
import zmq

from caviar_broker.__main__ import tune_collector
from caviar_broker.core import events as ev
from caviar_broker.core.plan import Limits, RunPlan, ServicePlan
from caviar_broker.journal import JournalFile
from caviar_broker.server import BrokerServer
from caviar_broker.statistics import Statistics
from caviar_protocol import messages as m
from caviar_protocol.assets import AssetStore
from caviar_protocol.codec import decode_message, encode_message
from caviar_protocol.digest import payload_digest
from caviar_protocol.host import host_identity
from caviar_protocol.topics import Lidar, Scene
from caviar_services.service import Frame, Preparation, Prepared, RunInfo, Service, StepResult

SECOND = 1_000_000_000
LEAF_SIZE = 100
WARM_UP = 50
"""Frames at the start that do not count."""

HUB_INPUTS = (m.Input(topic="lidar", lag=1, required=False),)
LEAF_INPUTS = (m.Input(topic="scene"),)


class Silent:
    """Observer that tells nobody."""

    def notice(self, notice: ev.Notice) -> None:
        """Problems end the run, which is told."""

    def frame(self, frame: ev.FrameFinished, statistics: Statistics) -> None:
        """Measured by the statistics."""


def main() -> None:
    arguments = parser().parse_args()
    if arguments.client:
        kind, name, endpoint = arguments.client
        CLIENTS[kind](name, endpoint, arguments.size)
        return
    for count in arguments.services:
        rows: dict[str, list[float]] = {}
        for _ in range(arguments.rounds):
            for kind in arguments.kinds:
                measured = (bare if kind == "bare" else real)(
                    kind, count, arguments.frames, arguments.size, arguments.profile
                )
                rows.setdefault(kind, []).append(measured)
        report(count, arguments.size, rows)


def report(count: int, size: int, rows: dict[str, list[float]]) -> None:
    """One line for each kind of loop."""
    for kind, seconds in rows.items():
        line = f"N = {count}  {kind:7}{statistics.median(seconds) * 1e6:9.0f} µs a frame"
        if "bare" in rows and kind != "bare":
            ratios = [mine / bare for mine, bare in zip(seconds, rows["bare"], strict=True)]
            line += f"   {statistics.median(ratios):5.2f} × bare ({min(ratios):.2f}–{max(ratios):.2f})"
        if size >= 100_000:
            line += f"   {(count - 1) * size / statistics.median(seconds) / 1e9:.2f} GB/s delivered"
        sys.stdout.write(line + "\n")
    sys.stdout.flush()


# --- the loops ------------------------------------------------------------------------------------------


def bare(kind: str, count: int, frames: int, size: int, profile: bool) -> float:
    """Seconds a frame of a loop that knows nothing but the pattern."""
    context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
    socket = context.socket(zmq.ROUTER)
    socket.bind("tcp://127.0.0.1:0")
    with clients(kind, count, socket.getsockopt_string(zmq.LAST_ENDPOINT), size):
        routes = {}
        while len(routes) < count:
            route, name = socket.recv_multipart()
            routes[name.decode()] = route
        hub, *leaves = (routes[name] for name in names(count))
        header = encode_message(m.Cancel(epoch=1, attempt=1, episode=0, frame=0))
        back: list[Any] = []
        started = 0.0
        for frame in range(frames + WARM_UP):
            if frame == WARM_UP:
                started = time.perf_counter()
            socket.send_multipart([hub, header, *back], copy=False)
            _, _, *product = socket.recv_multipart(copy=False)
            for leaf in leaves:
                socket.send_multipart([leaf, header, *product], copy=False)
            back = []
            for _ in leaves:
                back += socket.recv_multipart(copy=False)[2:]
        elapsed = time.perf_counter() - started
        for route in routes.values():
            socket.send_multipart([route, b""])
    socket.close(0)
    context.term()
    return elapsed / frames


def real(kind: str, count: int, frames: int, size: int, profile: bool) -> float:
    """Seconds a frame of the broker."""
    services = tuple(
        ServicePlan(name=name, role="world" if name == "hub" else "sensors", budget_ns=SECOND)
        for name in names(count)
    )
    plan = RunPlan(
        run="bench",
        services=services,
        frames=frames + WARM_UP,
        sampling_period_ns=SECOND,
        record=("lidar",),
        limits=Limits(),
    )
    with tempfile.TemporaryDirectory() as folder:
        journal = JournalFile(Path(folder) / "journal", 1)
        server = BrokerServer(plan, "tcp://127.0.0.1:0", journal, Silent(), AssetStore(Path(folder)))
        tune_collector()
        with clients(kind, count, server.endpoint, size):
            profiler = cProfile.Profile()
            outcome = profiler.runcall(server.run) if profile else server.run()
        journal.close()
    if outcome.error:
        raise SystemExit(outcome.error)
    if profile:
        pstats.Stats(profiler).sort_stats("tottime").print_stats(28)
    finished = server.statistics.finished_ns
    return (finished[-1] - finished[WARM_UP - 1]) / 1e9 / frames


def names(count: int) -> list[str]:
    return ["hub", *(f"leaf-{number}" for number in range(1, count))]


@contextmanager
def clients(kind: str, count: int, endpoint: str, size: int) -> Iterator[None]:
    """The services as processes."""
    command = [sys.executable, __file__, "--size", str(size), "--client", kind]
    path = os.pathsep.join([str(Path(__file__).parent), os.environ.get("PYTHONPATH", "")])
    environment = os.environ | {"PYTHONPATH": path, "CAVIAR_BENCH_SIZE": str(size)}
    started = [subprocess.Popen([*command, name, endpoint], env=environment) for name in names(count)]
    try:
        yield
        for process in started:
            process.wait(10)
    finally:
        for process in started:
            process.kill()
            process.wait()


# --- the services ------------------------------------------------------------------------------------------


def product(name: str, size: int) -> tuple[bytes, bytes]:
    return b"\x80", bytes(size if name == "hub" else LEAF_SIZE)


def connected(endpoint: str) -> zmq.Socket[bytes]:
    socket = zmq.Context.instance().socket(zmq.DEALER)
    socket.connect(endpoint)
    return socket


def echo(name: str, endpoint: str, size: int) -> None:
    """Client of the bare loop."""
    socket = connected(endpoint)
    socket.send(name.encode())
    header, body = product(name, size)
    answer = encode_message(m.Cancel(epoch=1, attempt=1, episode=0, frame=0))
    while True:
        first, *_ = socket.recv_multipart(copy=False)
        if not first.bytes:
            return
        socket.send_multipart([answer, header, body], copy=False)


def speak(name: str, endpoint: str, size: int) -> None:
    """Client of the broker: the protocol and nothing else."""
    socket, hub = connected(endpoint), name == "hub"
    hello = m.Hello(
        version=m.PROTOCOL_VERSION,
        name=name,
        role="world" if hub else "sensors",
        inputs=HUB_INPUTS if hub else LEAF_INPUTS,
        outputs=("scene",) if hub else ("lidar",),
        host=host_identity(),
        pid=os.getpid(),
    )
    socket.send(encode_message(hello))
    header, body = product(name, size)
    products = (m.ProductHeader(topic=hello.outputs[0], digest=payload_digest(header, body)),)
    ids: dict[str, int] = {}
    while True:
        first, *_ = socket.recv_multipart(copy=False)
        message = decode_message(first.buffer)
        match message:
            case m.Grant():
                done = m.Done(**ids, episode=message.episode, frame=message.frame, products=products)
                socket.send_multipart([encode_message(done), header, body], copy=False)
            case m.Welcome():
                ids = {"epoch": message.epoch, "attempt": message.attempt}
            case m.Prepare():
                socket.send(encode_message(m.Ready(**ids)))
            case m.Reset():
                socket.send(encode_message(m.ResetDone(**ids, episode=message.episode)))
            case m.Shutdown():
                socket.send(encode_message(m.Bye(**ids)))
                return


def serve(name: str, endpoint: str, size: int) -> None:
    """Client of the broker: a service in the runner."""
    from caviar_services.runner import CONNECT_TIMEOUT_S, run_service

    hub = name == "hub"
    place = "bench_broker:Hub" if hub else "bench_broker:Leaf"
    run_service(name, "world" if hub else "sensors", place, endpoint, CONNECT_TIMEOUT_S)


class Settings(msgspec.Struct, frozen=True):
    """None."""


class Hub(Service[Settings]):
    """A world whose product is one image-like array."""

    role: ClassVar[m.Role] = "world"
    inputs: ClassVar[tuple[m.Input, ...]] = HUB_INPUTS
    outputs: ClassVar[tuple[str, ...]] = ("scene",)
    Settings: ClassVar[type[msgspec.Struct]] = Settings

    def __init__(self, settings: Settings, run: RunInfo) -> None:
        super().__init__(settings, run)
        count = int(os.environ["CAVIAR_BENCH_SIZE"]) // 104 + 1  # position, orientation, velocity, dimensions
        self._scene = Scene(
            names=tuple(f"o{n:06}" for n in range(count)),
            classes=("car",) * count,
            assets=("",) * count,
            position=np.zeros((count, 3)),
            orientation=np.tile([1.0, 0.0, 0.0, 0.0], (count, 1)),
            velocity=np.zeros((count, 3)),
            dimensions=np.ones((count, 3)),
        )

    def prepare(self, preparation: Preparation) -> Prepared:
        return Prepared(prefixes=("o",))

    def step(self, frame: Frame) -> StepResult:
        return StepResult(products={"scene": self._scene})


class Leaf(Service[Settings]):
    """Sensors that see nothing."""

    role: ClassVar[m.Role] = "sensors"
    inputs: ClassVar[tuple[m.Input, ...]] = LEAF_INPUTS
    outputs: ClassVar[tuple[str, ...]] = ("lidar",)
    Settings: ClassVar[type[msgspec.Struct]] = Settings

    def step(self, frame: Frame) -> StepResult:
        return StepResult(products={"lidar": Lidar(object_names=(), scans=())})


CLIENTS: dict[str, Callable[[str, str, int], None]] = {"bare": echo, "broker": speak, "runner": serve}


def parser() -> argparse.ArgumentParser:
    found = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    found.add_argument("--services", type=int, nargs="+", default=[2, 4, 8], help="N")
    found.add_argument("--frames", type=int, default=2000)
    found.add_argument("--rounds", type=int, default=3)
    found.add_argument("--size", type=int, default=100, help="bytes of the hub's product")
    found.add_argument("--kinds", nargs="+", choices=list(CLIENTS), default=["bare", "broker", "runner"])
    found.add_argument("--profile", action="store_true", help="profile the broker's loop")
    found.add_argument("--client", nargs=3, help=argparse.SUPPRESS)
    return found


if __name__ == "__main__":
    main()
