"""A real broker server in a thread, and raw sockets that play its services."""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

import zmq

from caviar_broker.control.server import ControlServer
from caviar_broker.core import events as ev
from caviar_broker.core.plan import RunPlan, ServicePlan, Timeouts
from caviar_broker.journal import JournalFile
from caviar_broker.server import BrokerServer
from caviar_broker.statistics import Statistics
from caviar_protocol import messages as m
from caviar_protocol.assets import AssetStore
from caviar_protocol.codec import decode_message, encode_message
from caviar_protocol.digest import payload_digest
from caviar_protocol.keys import Credentials
from caviar_services.connection import dress

M = TypeVar("M", bound=m.Message)
MS = 1_000_000
PATIENCE_S = 10.0
"""[s] that a test waits for a message that must come."""

PAIR = ("world", "sensors")
INPUTS = {"world": (), "sensors": (m.Input(topic="scene"),), "link": (m.Input(topic="lidar"),)}
OUTPUTS = {"world": ("scene",), "sensors": ("lidar",), "link": ("link",)}


@dataclass
class Witness:
    """Observer that remembers."""

    notices: list[ev.Notice] = field(default_factory=list)
    frames: int = 0

    def notice(self, notice: ev.Notice) -> None:
        self.notices.append(notice)

    def frame(self, frame: ev.FrameFinished, statistics: Statistics) -> None:
        self.frames = statistics.frames

    def texts(self, service: str = "") -> str:
        return "\n".join(n.text for n in self.notices if not service or n.service == service)


@dataclass
class Serving:
    """A broker that serves in a thread."""

    server: BrokerServer
    witness: Witness
    directory: Path
    _thread: threading.Thread
    _failures: list[BaseException]

    @property
    def endpoint(self) -> str:
        return self.server.endpoint

    def outcome(self, within_s: float = PATIENCE_S) -> ev.Finished:
        """How the run ended; AssertionError where it does not in time."""
        self._thread.join(within_s)
        if self._failures:
            raise self._failures[0]
        assert self.server.outcome is not None, f"the run did not end within {within_s} s"
        return self.server.outcome


def plan(*services: str, limits: dict[str, int] | None = None, **run: Any) -> RunPlan:
    """A run of the services, each ``name`` or ``role:name``, with short time-outs."""
    times = {"connect": 10_000 * MS, "shutdown": 300 * MS, "ready": 10_000 * MS, "stall": 10_000 * MS}
    plans = []
    for service in services:
        role, _, name = service.rpartition(":")
        plans.append(ServicePlan(name=name, role=role or name, budget_ns=50 * MS))
    defaults = {"run": "test", "frames": 3, "sampling_period_ns": 100 * MS, "record": ("lidar",)}
    return RunPlan(services=tuple(plans), timeouts=Timeouts(**times | (limits or {})), **defaults | run)


@contextmanager
def serving(
    run: RunPlan,
    tmp_path: Path,
    journal: Callable[[Path], JournalFile] | None = None,
    desk: Path | None = None,
    **server_options: Any,
) -> Iterator[Serving]:
    """The broker of a run, until the block is left; with a desk in that directory."""
    witness, failures = Witness(), list[BaseException]()
    make = journal or (lambda path: JournalFile(path, 1))
    file = make(tmp_path / "journal.msgpack")
    store = AssetStore(tmp_path / "broker-cache")
    endpoint = server_options.pop("endpoint", "tcp://127.0.0.1:0")
    observer = witness if desk is None else ControlServer(desk, witness)
    server = BrokerServer(run, endpoint, file, observer, store, **server_options)
    if isinstance(observer, ControlServer):
        observer.attach(server)

    def body() -> None:
        try:
            server.run()
            if isinstance(observer, ControlServer):
                observer.close()
        except BaseException as error:
            failures.append(error)
            raise

    thread = threading.Thread(target=body, daemon=True)
    stop = _order_to_stop(server)
    thread.start()
    try:
        yield Serving(server, witness, tmp_path, thread, failures)
    finally:
        stop()
        thread.join(PATIENCE_S)
        file.close()
        assert not thread.is_alive(), "the broker's loop does not end"


def _order_to_stop(server: BrokerServer) -> Callable[[], None]:
    """An order from outside reaches the loop as it does in a process: through a descriptor."""
    read, write = os.pipe()

    def stop() -> None:
        server.loop.unwatch(read)
        server.feed(ev.StopRequested("the test is over"))

    def order() -> None:
        os.write(write, b"x")

    server.loop.watch(read, stop)
    return order


class Client:
    """One service, played by hand over real sockets."""

    def __init__(
        self,
        endpoint: str,
        name: str,
        role: str = "",
        *,
        inputs: Sequence[m.Input] | None = None,
        outputs: Sequence[str] | None = None,
        credentials: Credentials | None = None,
        routing_id: bytes = b"",
        **hello: Any,
    ) -> None:
        role = role or name
        self.context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
        self.socket = self.context.socket(zmq.DEALER)
        self.socket.linger = 0
        if routing_id:
            self.socket.setsockopt(zmq.ROUTING_ID, routing_id)
        self.credentials = credentials
        dress(self.socket, endpoint, credentials)
        self.socket.connect(endpoint)
        self.endpoint, self.name = endpoint, name
        declared = {"version": (1, 0), "name": name, "role": role}
        declared |= {"inputs": tuple(INPUTS[role] if inputs is None else inputs)}
        declared |= {"outputs": tuple(OUTPUTS[role] if outputs is None else outputs)}
        self.hello = m.Hello(**declared | hello)
        self.ids: dict[str, int] = {}
        self.parts: list[bytes] = []
        self.pulse: zmq.Socket[bytes] | None = None

    def __enter__(self) -> Client:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        self.socket.close()
        if self.pulse is not None:
            self.pulse.close(0)
        self.context.term()

    def send(self, message: m.Message, *parts: bytes) -> None:
        self.socket.send_multipart([encode_message(message), *parts])

    def receive(self, within_s: float = PATIENCE_S) -> m.Message:
        assert self.socket.poll(round(within_s * 1000)), f"{self.name}: nothing came within {within_s} s"
        header, *self.parts = self.socket.recv_multipart()
        return decode_message(header)

    def expect(self, cls: type[M], within_s: float = PATIENCE_S) -> M:
        message = self.receive(within_s)
        assert isinstance(message, cls), f"{self.name}: expected {cls.__name__}, got {message}"
        return message

    def quiet(self, for_ms: int = 100) -> bool:
        """Whether nothing comes for a while."""
        return not self.socket.poll(for_ms)

    # --- the ordinary course -------------------------------------------------------------------------

    def join(self) -> m.Welcome:
        self.send(self.hello)
        welcome = self.expect(m.Welcome)
        self.ids = {"epoch": welcome.epoch, "attempt": welcome.attempt}
        return welcome

    def attach(self) -> zmq.Socket[bytes]:
        self.pulse = self.context.socket(zmq.DEALER)
        self.pulse.linger = 0
        dress(self.pulse, self.endpoint, self.credentials)
        self.pulse.connect(self.endpoint)
        self.pulse.send(encode_message(m.Attach(**self.ids, name=self.name)))
        assert self.pulse.poll(round(PATIENCE_S * 1000))
        assert decode_message(self.pulse.recv()) == m.HeartbeatAck(sequence=0)
        return self.pulse

    def ready(self, **values: Any) -> m.Prepare:
        prepare = self.expect(m.Prepare)
        self.send(m.Ready(**self.ids, **values))
        return prepare

    def reset(self) -> None:
        reset = self.expect(m.Reset)
        self.send(m.ResetDone(**self.ids, episode=reset.episode))

    def done(self, grant: m.Grant, *products: tuple[str, bytes, bytes], **values: Any) -> None:
        headers = tuple(m.ProductHeader(topic=t, digest=payload_digest(h, b)) for t, h, b in products)
        parts = [part for _, header, body in products for part in (header, body)]
        ids = self.ids | {"episode": grant.episode, "frame": grant.frame}
        self.send(m.Done(**ids | values, products=headers), *parts)

    def answer(self, size: int = 100) -> m.Grant:
        """Take a grant and answer it with bytes that tell name and frame."""
        grant = self.expect(m.Grant)
        topic = self.hello.outputs[0]
        body = f"{self.name} {grant.frame} ".encode() * (size // 4)
        self.done(grant, (topic, b"\x80", body[:size]))
        return grant

    def bye(self) -> m.Shutdown:
        shutdown = self.expect(m.Shutdown)
        self.send(m.Bye(**self.ids))
        return shutdown


@contextmanager
def playing(endpoint: str, *services: str, **hello: Any) -> Iterator[list[Client]]:
    """Raw services that have joined, are ready and reset, up to their first grant."""
    clients = []
    for service in services:
        role, _, name = service.rpartition(":")
        clients.append(Client(endpoint, name, role, **hello))
    try:
        for client in clients:
            client.join()
        for client in clients:
            client.ready()
        for client in clients:
            client.reset()
        yield clients
    finally:
        for client in clients:
            client.close()


def play_to_the_end(clients: Sequence[Client], frames: int) -> None:
    """Answer every grant, in the order of the services, and take leave."""
    for _ in range(frames):
        for client in clients:
            client.answer()
    for client in clients:
        client.expect(m.EpisodeEnd)
    for client in clients:
        client.bye()


def finishes_well(broker: Serving) -> bool:
    """Whether a run came to its end, with all its frames."""
    outcome = broker.outcome()
    return outcome.error == "" and broker.witness.frames == broker.server.clock.plan.frames


def eventually(condition: Callable[[], object], what: str, within_s: float = PATIENCE_S) -> None:
    """Wait until a condition holds."""
    until = time.monotonic() + within_s
    pause = threading.Event()
    while not condition():
        assert time.monotonic() < until, f"not within {within_s} s: {what}"
        pause.wait(0.002)
