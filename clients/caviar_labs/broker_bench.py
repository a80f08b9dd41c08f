"""Cost of a frame in the broker: a run of clients that do nothing but exchange products.

The broker is that of any run: port, frame clock, deadlines, journal and latency record. A client speaks the
protocol, and nothing else: ``python -m caviar_labs.broker_bench TOPOLOGY SERVICES NUMBER PAYLOAD ENDPOINT``,
with keys where CAVIAR_KEY and CAVIAR_BROKER_KEY name them.
"""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Literal, get_args

import msgspec
import numpy as np
import zmq

from caviar_broker.core import events as ev
from caviar_broker.core.plan import SECOND, RunPlan, ServicePlan, Timeouts
from caviar_broker.journal import JournalFile
from caviar_broker.launch import tune_garbage_collector
from caviar_broker.security.access import Access
from caviar_broker.server import BrokerServer
from caviar_broker.statistics import Statistics
from caviar_protocol import messages as m
from caviar_protocol.assets import AssetStore
from caviar_protocol.codec import encode_message
from caviar_protocol.digest import payload_digest
from caviar_protocol.errors import RunError
from caviar_protocol.host import PYTHON, host_identity, steady_memory
from caviar_protocol.keys import BROKER, BROKER_KEY_VARIABLE, KEY_VARIABLE, Pair, credentials, write_pair
from caviar_protocol.messages import Input, Role

WARM_UP = 50
"""Frames at the start that do not count."""
BUDGET_NS = SECOND
"""Of every service: long, so that a noisy machine does not turn up as misses, but kept watch over."""
CLIENT = "caviar_labs.broker_bench"
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
    """Costs of a run."""

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
    command = [*PYTHON, "-m", CLIENT, topology, str(services)]
    # Keys that the caller has for another broker are none of this one's.
    environment = {k: v for k, v in os.environ.items() if k not in (KEY_VARIABLE, BROKER_KEY_VARIABLE)}
    if keys is not None:
        environment[KEY_VARIABLE] = str(keys / f"{_CLIENTS}.key")
        environment[BROKER_KEY_VARIABLE] = str(keys / f"{BROKER}.pub")
    started: Sequence[subprocess.Popen[bytes]] = [
        subprocess.Popen(  # noqa: S603  # our own module
            [*command, str(number), str(payload), endpoint],
            env=environment,
            start_new_session=True,  # Ctrl-C is this process's, which ends those
        )
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


Topology = Literal["hub", "all"]

HUB = "hub"


class Part(msgspec.Struct, frozen=True):
    """One service of a measured run."""

    name: str
    role: Role
    inputs: tuple[Input, ...]
    output: str


def parts(topology: Topology, services: int) -> tuple[Part, ...]:
    """Make the services of a run.

    Args:
        topology: ``hub``: one takes the products of all others in the same frame, and they take its product
            of the frame before. ``all``: each takes what every other made in the frame before.
        services: Number of services.

    Example:
        >>> [part.name for part in parts("hub", 3)]
        ['hub', 'leaf-1', 'leaf-2']
    """
    if topology == "hub":
        leaf = (Input(topic="link", lag=1, required=False),)
        leaves = [Part(f"leaf-{i}", "sensors", leaf, "lidar") for i in range(1, services)]
        return (Part(HUB, "link", (Input(topic="lidar"),), "link"), *leaves)
    everyone = (Input(topic="lidar", lag=1, required=False),)
    return tuple(Part(f"peer-{i}", "sensors", everyone, "lidar") for i in range(services))


def deliveries(topology: Topology, services: int) -> int:
    """Count the products that consumers get in a frame.

    Example:
        >>> deliveries("hub", 3), deliveries("all", 3)
        (4, 9)
    """
    # A service of `all` gets its own product too: the topic has all of them as sources.
    return 2 * (services - 1) if topology == "hub" else services * services


# Plain integers, and no multipart calls: pyzmq's flags are enumerations, which cost more than a small send.
_MORE = int(zmq.SNDMORE)
# [B] from which a payload is sent without a copy.
_COPIED = 1 << 16


def speak(part: Part, payload: int, endpoint: str) -> None:
    """Take part in a run until the broker ends it, with a product of the same size in every frame.

    Args:
        part: The service.
        payload: Size of its products [B].
        endpoint: Address of the broker.
    """
    with zmq.Context() as context, context.socket(zmq.DEALER) as socket:
        keys = credentials()
        if keys is not None:
            keys.apply_to(socket)
        socket.connect(endpoint)
        socket.send(encode_message(_hello(part)))
        header, body = b"\x80", bytes(payload)
        # Hashed once, since it is the same in every frame: hashing is the producer's work, not the broker's.
        products = (m.ProductHeader(topic=part.output, digest=payload_digest(header, body)),)
        done = _Done(epoch=0, attempt=0, episode=0, frame=0, products=products)
        # Looked up once: at 100 B the exchange itself is what is measured.
        receive, send = socket.recv, socket.send
        while True:
            first = rest = receive(0, False)
            while rest.more:  # payloads come into this process, and are not looked at
                rest = receive(0, False)
            message = _decoder.decode(first.buffer)
            if message.type == "GRANT":
                done.episode, done.frame = message.episode, message.frame
                send(_encoder.encode(done), _MORE)
                send(header, _MORE)
                send(body, 0, payload < _COPIED)
                continue
            epoch, attempt = done.epoch, done.attempt
            match message.type:
                case "WELCOME":
                    done.epoch, done.attempt = message.epoch, message.attempt
                case "PREPARE":
                    send(encode_message(m.Ready(epoch=epoch, attempt=attempt)))
                case "RESET":
                    send(encode_message(m.ResetDone(epoch=epoch, attempt=attempt, episode=message.episode)))
                case "SHUTDOWN":
                    send(encode_message(m.Bye(epoch=epoch, attempt=attempt)))
                    return
                case "REFUSE":
                    raise SystemExit(f"{part.name}: {message.message}")


class _Received(msgspec.Struct):
    """Fields that a client reads of a message: those that an answer needs.

    What a service does with its inputs is its own cost.
    """

    type: str
    epoch: int = 0
    attempt: int = 0
    episode: int = 0
    frame: int = 0
    message: str = ""


class _Done(msgspec.Struct, tag="DONE"):
    """Fields of `caviar_protocol.messages.Done` that this client fills in, anew in every frame."""

    epoch: int
    attempt: int
    episode: int
    frame: int
    products: tuple[m.ProductHeader, ...]


_decoder = msgspec.msgpack.Decoder(_Received)
_encoder = msgspec.msgpack.Encoder()


def _hello(part: Part) -> m.Hello:
    return m.Hello(
        version=m.PROTOCOL_VERSION,
        name=part.name,
        role=part.role,
        inputs=part.inputs,
        outputs=(part.output,),
        host=host_identity(),
        pid=os.getpid(),
    )


def main() -> None:
    """Take part as the command line says."""
    topology, services, number, payload, endpoint = sys.argv[1:]
    chosen: Topology = next(t for t in get_args(Topology) if t == topology)
    speak(parts(chosen, int(services))[int(number)], int(payload), endpoint)


if __name__ == "__main__":
    main()
