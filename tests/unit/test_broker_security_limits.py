"""The connections under a socket, and who is barred: what the tests with whole runs cannot bring about."""

from __future__ import annotations

import os
import resource
import socket
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
import zmq
from broker_harness import MS, Client, eventually, plan, serving
from security_harness import ring

from caviar_broker import launch as broker_main
from caviar_broker.connections import Router
from caviar_broker.security.access import BAR_NS, Access
from caviar_broker.security.limits import PeerLimits
from caviar_broker.security.tcp import TcpConnection, TcpConnections, _identity
from caviar_protocol import messages as m
from caviar_protocol.errors import RunError
from caviar_protocol.scenario import Limits
from caviar_services.connection import Connection, Termination

SMOKE = Path(__file__).parents[2] / "deploy" / "caviar_scenarios" / "smoke.toml"
LIMITS = """
[limits]
connections = 51
connections_before_hello = 52
messages_before_hello = 53
waiting_before_hello_mib = 54
messages_at_once = 155
messages_per_s = 56.5
part_mib = 57
waiting_mib = 58
"""


@pytest.fixture
def couple() -> Iterator[tuple[socket.socket, socket.socket]]:
    """Two ends of a TCP connection."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        near = socket.create_connection(server.getsockname())
        far, _ = server.accept()
        with near, far:
            yield near, far


@pytest.fixture
def wires() -> Iterator[TcpConnections]:
    with zmq.Context() as context, context.socket(zmq.ROUTER) as router:
        made = TcpConnections(context, router)
        yield made
        made.close()


def wire_of(end: socket.socket) -> TcpConnection:
    return TcpConnection(end.fileno(), os.fstat(end.fileno()).st_ino, "127.0.0.1", 0)


def counted(end: socket.socket) -> tuple[int, int]:
    found = wire_of(end).transferred()
    assert found is not None
    return found


def test_the_bytes_of_a_connection_are_counted_in_both_directions(couple) -> None:
    near, far = couple
    near.sendall(bytes(1000))
    far.sendall(bytes(300))
    eventually(lambda: counted(far)[1] == 1000, "what came is counted")
    eventually(lambda: counted(far)[0] in (300, 301), "what went is counted")  # 1 is the SYN


def test_a_descriptor_that_is_another_connection_by_now_is_left_alone(couple) -> None:
    near, far = couple
    stale = TcpConnection(far.fileno(), os.fstat(far.fileno()).st_ino + 1, "127.0.0.1", 0)
    stale.end()
    assert stale.transferred() is None
    near.sendall(b"alive")
    assert far.recv(10) == b"alive"


def test_a_descriptor_that_is_no_socket_is_left_alone(tmp_path: Path) -> None:
    with (tmp_path / "file").open("wb") as file:
        wire = TcpConnection(file.fileno(), os.fstat(file.fileno()).st_ino, "127.0.0.1", 0)
        wire.end()
        assert wire.transferred() is None
        file.write(b"x")


def test_what_may_be_of_the_connection_before_is_not_taken_for_the_present_one(
    wires: TcpConnections, couple
) -> None:
    """A descriptor is used again at once: a late message of the one before must not end its successor."""
    _, far = couple
    first = wires._begun(far.fileno())
    wires._ended(far.fileno())
    second = wires._begun(far.fileno())
    assert wires.at(far.fileno()) is second
    assert not wires.claim(second, "127.0.0.1")
    second.unclear_until = 0
    assert not wires.claim(first, "127.0.0.1"), "it has ended"
    assert not wires.claim(second, "10.0.0.1")
    assert wires.claim(second, "127.0.0.1")
    assert not wires.claim(second, "127.0.0.1"), "one routing id, one connection"


def test_a_connection_over_ipv4_to_an_ipv6_port_is_known(tmp_path: Path) -> None:
    """libzmq tells of its address in one form, the operating system in another."""
    mapped = "tcp://[::ffff:127.0.0.1]:0"
    with (
        serving(plan("world"), tmp_path, endpoint=mapped) as broker,
        Client(f"tcp://127.0.0.1:{broker.endpoint.rpartition(':')[2]}", "world") as world,
    ):
        world.join()
        (peer,) = broker.server._guard._peers.values()
        assert peer.address == "127.0.0.1"
        assert peer.wire is not None


def test_a_service_at_a_socket_file_may_be_sent_more_than_may_wait_for_it(tmp_path: Path) -> None:
    """How much of it waits is not known there: a long run would end with the first GiB."""
    limits = PeerLimits(queued=1 << 16)
    with (
        serving(plan("world"), tmp_path, endpoint=f"ipc://{tmp_path}/broker", peer_limits=limits) as broker,
        Client(broker.endpoint, "world") as world,
    ):
        world.join()
        guard = broker.server._guard
        (peer,) = guard._peers.values()
        peer.sent = 1 << 30
        begun = time.monotonic_ns()
        eventually(lambda: guard._scan_at > begun + 250 * MS, "its connection was looked at")
        assert not peer.cut


def test_a_connection_is_known_where_no_descriptor_is_left(couple) -> None:
    _, far = couple
    limits = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (far.fileno() + 1, limits[1]))
    try:
        found = _identity(far.fileno())
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, limits)
    assert found == (os.fstat(far.fileno()).st_ino, "127.0.0.1", None)
    assert far.send(b"x") == 1, "it is still open"


def test_an_address_is_barred_unless_a_good_service_is_at_home_there() -> None:
    port = Router("tcp://127.0.0.1:0", 1500 * MS)
    try:
        guard = port.guard
        guard._bar("10.0.0.1")
        guard._bar("127.0.0.1")
        guard._bar("::1")
        assert set(guard._barred) == {"10.0.0.1"}
        with zmq.Context() as context, context.socket(zmq.DEALER) as dealer:
            dealer.linger = 0
            dealer.connect(port.endpoint)
            dealer.send(b"x")
            port.guard.start(_NoLoop(), lambda *_: False, lambda *_: None, lambda *_: None)  # type: ignore[arg-type]
            received = []
            eventually(
                lambda: (guard._authenticate(), received.append(port.receive()), received[-1])[-1], "it came"
            )
            route, _ = received[-1]  # type: ignore[misc]
            guard._peers[route].address = "10.0.0.2"
            guard.admit_service(route, "world")
            guard._bar("10.0.0.2")
        assert set(guard._barred) == {"10.0.0.1"}
    finally:
        port.close()


class _NoLoop:
    def watch(self, *_: object) -> None:
        """The test calls back itself."""


def test_a_key_that_was_cut_off_is_barred_for_a_while(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    keys = ring(tmp_path / "keys")
    own = keys.authorize("world", "world")
    limits = PeerLimits(burst=10.0, rate=1.0)
    access, now = keys.access(), time.monotonic_ns
    with (
        serving(plan("world", "sensors"), tmp_path, access=access, peer_limits=limits) as broker,
        Client(broker.endpoint, "world", credentials=own) as client,
    ):
        client.join()
        for _ in range(50):
            client.send(m.ResetDone(**client.ids, episode=7))
        eventually(lambda: "cut off" in broker.witness.texts("world"), "it is cut off")
    assert "was cut off and is barred for 10 s" in access.admits(own.pair.public)
    monkeypatch.setattr(time, "monotonic_ns", lambda: now() + BAR_NS)
    assert access.admits(own.pair.public) == ""


def test_a_barred_key_is_told_so_by_its_own_side(tmp_path: Path) -> None:
    keys = ring(tmp_path / "keys")
    own = keys.authorize("world", "world")
    access: Access = keys.access()
    access.bar(own.pair.public)
    with serving(plan("world"), tmp_path, access=access) as broker:
        connection = Connection("world", broker.endpoint, Termination(), own)
        connection.send(m.Hello(version=(1, 0), name="world", role="world"))
        with pytest.raises(RunError, match="or barred for a while"):
            connection.receive(10.0)
        connection.close()


def test_a_connection_that_is_not_known_any_more_may_appear_as_nobody(tmp_path: Path) -> None:
    keys = ring(tmp_path)
    keys.authorize("world", "world")
    port = Router("tcp://127.0.0.1:0", 300 * MS, keys.access())
    try:
        assert "not known any more" in port.guard.refusal(b"gone", "world", "world")
    finally:
        port.close()


def test_a_scenario_that_says_nothing_of_limits_has_the_usual_ones() -> None:
    assert PeerLimits.from_scenario(Limits()) == PeerLimits()


def test_the_limits_of_a_scenario_are_those_of_its_broker(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    class MadeError(Exception):
        pass

    def made(*_: object, peer_limits: PeerLimits, **__: object) -> None:
        assert peer_limits == PeerLimits(
            connections=51,
            strangers=52,
            stranger_messages=53,
            stranger_bytes=54 << 20,
            burst=155.0,
            rate=56.5,
            queued=58 << 20,
            part=57 << 20,
        )
        raise MadeError

    monkeypatch.setattr(broker_main, "BrokerServer", made)
    monkeypatch.setattr(broker_main, "Reporter", lambda *_: None)
    monkeypatch.setattr(broker_main, "steady_memory", lambda: None)
    monkeypatch.setattr(broker_main, "raise_priority", lambda: "")
    scenario = tmp_path / "scenario.toml"
    scenario.write_text(f"{SMOKE.read_text()}{LIMITS}")
    arguments = broker_main.parser().parse_args([str(scenario), "--directory", str(tmp_path / "run")])
    with pytest.raises(MadeError):
        broker_main.serve(arguments)
