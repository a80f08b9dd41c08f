"""A broker with keys: who is let in, as what, and until when."""

from __future__ import annotations

import socket
import time
from pathlib import Path

import pytest
import zmq
from broker_harness import MS, PATIENCE_S, Client, eventually, plan, play_to_the_end, serving
from security_harness import Ring, pair, ring
from zmq.utils.monitor import recv_monitor_message

from caviar_broker.connections import Router
from caviar_broker.security.access import Access, answer, check_bind, is_local
from caviar_protocol import keys as k
from caviar_protocol import messages as m
from caviar_protocol.errors import CaviarError, RunError, SetupError
from caviar_services.connection import Connection, Termination

pytestmark = pytest.mark.slow

REVOKED_WITHIN_S = 10.0


@pytest.fixture
def keys(tmp_path: Path) -> Ring:
    return ring(tmp_path / "keys")


def joined(client: Client) -> m.Message:
    client.send(client.hello)
    return client.receive()


def test_services_with_authorized_keys_play_a_run(tmp_path: Path, keys: Ring) -> None:
    shown = {
        "world": keys.authorize("world", "world"),
        "sensors": keys.authorize("sensors", "sensors", ("lidar",)),
    }
    with serving(plan("world", "sensors"), tmp_path, access=keys.access()) as broker:
        clients = [Client(broker.endpoint, name, credentials=own) for name, own in shown.items()]
        for client in clients:
            client.join()
            client.attach()
        for client in clients:
            client.ready()
        for client in clients:
            client.reset()
        play_to_the_end(clients, 3)
        assert not broker.outcome().error
        for client in clients:
            client.close()


@pytest.mark.parametrize(
    ("name", "role", "outputs", "words"),
    [
        ("sensors", "world", ("scene",), "authorized for the name 'world', not for 'sensors'"),
        ("world", "sensors", ("scene",), "authorized for 'world' as world, not as sensors"),
        ("world", "world", ("scene", "secrets"), "for the topics scene, not for secrets"),
    ],
)
def test_a_key_is_refused_for_another_name_role_or_topic(
    tmp_path: Path, keys: Ring, name: str, role: str, outputs: tuple[str, ...], words: str
) -> None:
    own = keys.authorize("world", "world", ("scene",))
    with (
        serving(plan("world", "sensors"), tmp_path, access=keys.access()) as broker,
        Client(broker.endpoint, name, role, inputs=(), outputs=outputs, credentials=own) as client,
    ):
        refusal = joined(client)
        assert isinstance(refusal, m.Refuse)
        assert refusal.code == "unauthorized"
        assert words in refusal.message
        eventually(lambda: words in broker.witness.texts(), "the user reads it")


def test_a_heartbeat_connection_needs_the_key_of_its_service(tmp_path: Path, keys: Ring) -> None:
    world, other = keys.authorize("world", "world"), keys.authorize("sensors", "sensors")
    with (
        serving(plan("world", "sensors"), tmp_path, access=keys.access()) as broker,
        Client(broker.endpoint, "world", credentials=world) as client,
        Client(broker.endpoint, "sensors", credentials=other) as impostor,
    ):
        welcome = client.join()
        impostor.send(m.Attach(epoch=welcome.epoch, attempt=welcome.attempt, name="world"))
        refusal = impostor.expect(m.Refuse)
        assert refusal.code == "unauthorized"
        client.attach()


@pytest.mark.parametrize("which", ["not authorized", "wrong broker key", "no key", "broker without keys"])
def test_a_service_without_the_right_key_ends_within_seconds_with_the_remedy(
    tmp_path: Path, keys: Ring, which: str
) -> None:
    good = keys.authorize("world", "world")
    shown = {
        "not authorized": (keys.of(pair()), "caviar keys authorize"),
        "wrong broker key": (k.Credentials(good.pair, pair().public), "--broker-key"),
        "no key": (None, "asks for keys"),
        "broker without keys": (good, "has no keys"),
    }
    credentials, remedy = shown[which]
    access = None if which == "broker without keys" else keys.access()
    with serving(plan("world"), tmp_path, access=access) as broker:
        connection = Connection("world", broker.endpoint, Termination(), credentials)
        started = time.monotonic()
        connection.send(m.Hello(version=(1, 0), name="world", role="world"))
        with pytest.raises(RunError, match=remedy):
            connection.receive(100.0)
        connection.close()
        assert time.monotonic() - started < 50.0
        assert broker.server.clock.member("world").attempt == 0  # type: ignore[union-attr]
        eventually(lambda: "a connection from " in broker.witness.texts(), "the user reads it")


def test_a_revoked_key_is_cut_off_and_named_within_a_second(tmp_path: Path, keys: Ring) -> None:
    shown = {name: keys.authorize(name, name) for name in ("world", "sensors")}
    with serving(plan("world", "sensors"), tmp_path, access=keys.access()) as broker:
        clients = [Client(broker.endpoint, name, credentials=own) for name, own in shown.items()]
        for client in clients:
            client.join()
        for client in clients:
            client.ready()
        for client in clients:
            client.reset()
        clients[0].answer()
        keys.revoke("sensors")
        started = time.monotonic()
        outcome = broker.outcome()
        assert time.monotonic() - started < REVOKED_WITHIN_S
        assert outcome.culprit == "sensors"
        assert "it was cut off: it is not authorized any more" in outcome.error
        for client in clients:
            client.close()


def test_a_key_authorized_while_the_broker_runs_is_let_in(tmp_path: Path, keys: Ring) -> None:
    with serving(plan("world"), tmp_path, access=keys.access()) as broker:
        own = keys.authorize("world", "world")
        eventually(lambda: broker.server._guard.access.name(own.pair.public), "the file was read", 1.0)  # type: ignore[union-attr]
        with Client(broker.endpoint, "world", credentials=own) as client:
            client.join()


def test_a_damaged_authorized_file_is_told_and_changes_nothing(tmp_path: Path, keys: Ring) -> None:
    own = keys.authorize("world", "world")
    with serving(plan("world"), tmp_path, access=keys.access()) as broker:
        damaged = tmp_path / "damaged"
        damaged.write_text("[[key")
        damaged.replace(keys.directory / k.AUTHORIZED)  # at once: a file cut to nothing is one without keys
        eventually(lambda: "goes on holding" in broker.witness.texts(), "the user reads it", 1.0)
        with Client(broker.endpoint, "world", credentials=own) as client:
            client.join()


def test_a_broker_without_a_key_of_its_own_says_how_to_make_one(tmp_path: Path) -> None:
    with pytest.raises(SetupError, match="caviar keys new broker --directory"):
        Access(tmp_path)


def test_the_services_of_a_launcher_may_take_their_own_places_alone(keys: Ring) -> None:
    local = pair().public
    access = Access(keys.directory, local, {"world": "world"})
    assert access.refusal(local, "world", "world", ("anything",)) == ""
    assert "not as agent" in access.refusal(local, "world", "agent")
    assert "is not for 'guest'" in access.refusal(local, "guest", "agent")
    assert Access(keys.directory).refusal("", "world", "world") != ""  # no local key is not an empty key


@pytest.mark.parametrize("mechanism", [b"NULL", b"PLAIN", b"CURVE"])
def test_the_handshake_refuses_whatever_is_no_authorized_key(keys: Ring, mechanism: bytes) -> None:
    request = [
        b"1.0",
        b"7",
        b"caviar",
        b"10.0.0.1",
        b"",
        mechanism,
        b"\1" * (32 if mechanism == b"CURVE" else 3),
    ]
    reply, why = answer(keys.access(), request)
    assert reply[:3] == [b"1.0", b"7", b"400"]
    assert reply[4:] == [b"", b""]
    assert why
    for length in range(7):
        reply, why = answer(keys.access(), request[:length])
        assert reply[2] == b"400"
        assert why


# --- addresses -------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("endpoint", "local"),
    [
        ("tcp://127.0.0.1:0", True),
        ("tcp://127.8.9.10:5570", True),
        ("tcp://[::1]:5570", True),
        ("tcp://[::ffff:127.0.0.1]:5570", True),
        ("tcp://localhost:5570", True),
        ("tcp://lo:5570", True),
        ("ipc:///tmp/socket", True),
        ("inproc://name", True),
        ("tcp://0.0.0.0:5570", False),
        ("tcp://*:5570", False),
        ("tcp://[::]:5570", False),
        ("tcp://10.1.2.3:5570", False),
        ("tcp://[fe80::1%eth0]:5570", False),
        ("tcp://[::ffff:10.1.2.3]:5570", False),
        ("tcp://eth0:5570", False),
        ("tcp://no-such-host.invalid:5570", False),
        ("tcp://:5570", False),
        ("udp://127.0.0.1:5570", False),
        ("nonsense", False),
    ],
)
def test_only_addresses_of_this_machine_are_local(
    monkeypatch: pytest.MonkeyPatch, endpoint: str, local: bool
) -> None:
    real = socket.getaddrinfo

    def without_network(host: str, *rest: object, **more: object) -> object:
        if host in ("eth0", "no-such-host.invalid"):
            raise socket.gaierror
        return real(host, *rest, **more)  # type: ignore[arg-type]

    monkeypatch.setattr(socket, "getaddrinfo", without_network)
    assert is_local(endpoint) is local


def test_a_name_is_local_only_if_all_its_addresses_are(monkeypatch: pytest.MonkeyPatch) -> None:
    found = [(socket.AF_INET, 1, 6, "", ("127.0.0.1", 0)), (socket.AF_INET, 1, 6, "", ("10.0.0.9", 0))]
    monkeypatch.setattr(socket, "getaddrinfo", lambda *_, **__: found)
    assert not is_local("tcp://both:1")
    monkeypatch.setattr(socket, "getaddrinfo", lambda *_, **__: found[:1])
    assert is_local("tcp://one:1")


@pytest.mark.parametrize("endpoint", ["tcp://0.0.0.0:0", "tcp://*:0", "tcp://[::]:0"])
def test_an_address_open_to_others_is_refused_without_keys_and_taken_with_them(
    keys: Ring, endpoint: str
) -> None:
    with pytest.raises(CaviarError, match="--keys keys"):
        Router(endpoint, 1500 * MS)
    port = Router(endpoint, 1500 * MS, keys.access())
    port.close()


@pytest.mark.parametrize(
    ("endpoint", "words"),
    [
        ("tcp://127.0.0.1", "has no port; write it as tcp://127.0.0.1:PORT"),
        ("tcp://[::1]", "has no port"),
        ("tcp://127.0.0.1:99999", "has the port '99999'; .* with a port from 0 .* to 65535"),
        ("tcp://127.0.0.1:http", "has the port 'http'"),
        ("tcp://127.0.0.1:-1", "has the port '-1'"),
        ("127.0.0.1:5570", "is no address to listen at; write it as tcp://127.0.0.1:5570"),
    ],
)
def test_an_address_without_a_port_that_there_is_is_refused(endpoint: str, words: str) -> None:
    """Of 99999 libzmq listened at 34463, and said nothing of it."""
    with pytest.raises(RunError, match=words):
        check_bind(endpoint, keys=False)
    with pytest.raises(RunError, match=words):
        check_bind(endpoint, keys=True)


def test_a_service_connects_over_ipv6(tmp_path: Path) -> None:
    with (
        serving(plan("world"), tmp_path, endpoint="tcp://[::1]:0") as broker,
        Client(broker.endpoint, "world") as client,
    ):
        client.join()


FAILURES = zmq.EVENT_HANDSHAKE_FAILED_NO_DETAIL, zmq.EVENT_HANDSHAKE_FAILED_PROTOCOL


@pytest.mark.parametrize(
    ("key", "expected"),
    [
        ("authorized", (zmq.EVENT_HANDSHAKE_SUCCEEDED,)),
        ("unknown", (zmq.EVENT_HANDSHAKE_FAILED_AUTH,)),
        ("none", FAILURES),
        ("of another broker", FAILURES),
    ],
)
def test_a_socket_monitor_shows_what_the_specification_says(
    tmp_path: Path, keys: Ring, key: str, expected: tuple[int, ...]
) -> None:
    """SPEC.md, section Transport: the event that ends the handshake."""
    right = keys.authorize("world", "world")
    shown = {
        "authorized": right,
        "unknown": keys.of(pair()),
        "none": None,
        "of another broker": k.Credentials(right.pair, pair().public),
    }[key]
    with (
        serving(plan("world", "sensors"), tmp_path, access=keys.access()) as broker,
        zmq.Context() as context,
        context.socket(zmq.DEALER) as socket,
        socket.get_monitor_socket() as monitor,
    ):
        socket.linger = 0
        if shown is not None:
            shown.apply_to(socket)
        socket.connect(broker.endpoint)
        events = []
        last = expected[0] if key == "authorized" else zmq.EVENT_DISCONNECTED
        while not events or events[-1] != last:
            assert monitor.poll(PATIENCE_S * 1000), events
            events.append(recv_monitor_message(monitor)["event"])
        handshake = [event for event in events if event in (*FAILURES, *expected)]
        assert handshake[0] in expected
        socket.disable_monitor()
