"""Keys, an eight-service run in the background, and peers that mean ill."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path

import zmq
from broker_harness import INPUTS, MS, Client, Serving, eventually, plan, serving

from caviar_broker.core.plan import RunPlan
from caviar_broker.security.access import Access
from caviar_broker.security.limits import PeerLimits
from caviar_protocol import keys as k
from caviar_protocol import messages as m

EIGHT = ("world", *(f"sensors:s{number}" for number in range(7)))
"""A world and seven that look at its scene."""


def pair() -> k.Pair:
    public, secret = zmq.curve_keypair()
    return k.Pair(public=public.decode(), secret=secret.decode())


@dataclass
class Ring:
    """A keys directory, and the credentials of the peers that have a key there."""

    directory: Path
    pairs: dict[str, k.Pair] = field(default_factory=dict)

    def authorize(self, name: str, role: str, topics: tuple[str, ...] | None = None) -> k.Credentials:
        made = self.pairs[name] = pair()
        entry = k.Authorization(name=name, role=role, public=made.public, topics=topics)  # type: ignore[arg-type]
        k.write_authorized(self.directory, [*k.read_authorized(self.directory), entry])
        return self.of(made)

    def of(self, own: k.Pair) -> k.Credentials:
        return k.Credentials(own, self.pairs[k.BROKER].public)

    def revoke(self, name: str) -> None:
        kept = [entry for entry in k.read_authorized(self.directory) if entry.name != name]
        k.write_authorized(self.directory, kept)

    def access(self) -> Access:
        return Access(self.directory)


def ring(directory: Path) -> Ring:
    """A keys directory with the broker's own pair."""
    made = Ring(directory, {k.BROKER: pair()})
    k.write_pair(directory, k.BROKER, made.pairs[k.BROKER])
    return made


@dataclass
class Background:
    """A run whose services answer at once, in a thread, until it is stopped."""

    broker: Serving
    frames: int = 0
    over: threading.Event = field(default_factory=threading.Event)
    failures: list[BaseException] = field(default_factory=list)

    def go_on_for(self, seconds: float) -> None:
        """Let it run; AssertionError where the frames do not go on, if late on a busy machine."""
        before, until = self.frames, time.monotonic() + seconds
        while time.monotonic() < until:
            self.over.wait(0.02)
            assert not self.failures, self.failures
        eventually(lambda: self.frames > before, "the frames go on")

    @property
    def misses(self) -> int:
        return sum(notice.kind == "miss" for notice in list(self.broker.witness.notices))


def steady(limits: dict[str, int] | None = None, frames: int = 100_000) -> RunPlan:
    """A run in real time, 20 ms a frame. The budgets leave room for the test's own eight services, which
    share one thread, and for a machine that is busy with other things."""
    run = plan(*EIGHT, frames=frames, sampling_period_ns=20 * MS, realtime=True, limits=limits)
    return replace(run, services=tuple(replace(service, budget_ns=250 * MS) for service in run.services))


@contextmanager
def eight_services(tmp_path: Path, peer_limits: PeerLimits | None = None) -> Iterator[Background]:
    """An eight-service run that goes on by itself."""
    with serving(steady(), tmp_path, peer_limits=peer_limits) as broker:
        background = Background(broker)
        thread = threading.Thread(target=_play, args=(background,), daemon=True)
        thread.start()
        try:
            background.go_on_for(0.5)
            yield background
            assert not background.failures, background.failures
        finally:
            background.over.set()
            thread.join(10.0)


def _play(background: Background) -> None:
    clients = [_client(background.broker.endpoint, service) for service in EIGHT]
    try:
        for client in clients:
            client.join()
        for client in clients:
            client.attach()
        for client in clients:
            client.ready()
        for client in clients:
            client.reset()
        _answer_all(background, clients)
    except BaseException as error:
        background.failures.append(error)
    finally:
        for client in clients:
            client.close()


def _answer_all(background: Background, clients: list[Client]) -> None:
    poller = zmq.Poller()
    by_socket = {client.socket: client for client in clients}
    for client in clients:
        poller.register(client.socket, zmq.POLLIN)
    while not background.over.is_set():
        for socket, _ in poller.poll(50):
            client = by_socket[socket]
            message = client.receive()
            if isinstance(message, m.Grant):
                client.done(message, (client.hello.outputs[0], b"\x80", b"x" * 1000))
                background.frames += client.name == "world"
            else:
                assert not isinstance(message, m.Shutdown | m.Refuse | m.Error), f"{client.name}: {message}"


def _client(endpoint: str, service: str) -> Client:
    role, _, name = service.rpartition(":")
    outputs = ("scene",) if name == "world" else ("lidar",)
    return Client(endpoint, name, role or name, inputs=INPUTS[role or name], outputs=outputs)
