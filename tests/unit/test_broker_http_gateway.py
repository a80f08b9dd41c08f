"""The WebSocket gateway: a peer without ZeroMQ is a full one, and harms only itself."""

from __future__ import annotations

import asyncio
import hashlib
import json
import socket
import struct
import threading
from pathlib import Path

import pytest
import zmq
import zmq.asyncio
from broker_harness import MS, PAIR, PATIENCE_S, eventually, plan, playing, serving
from http_harness import Peer, Site, site
from starlette.datastructures import Headers
from starlette.websockets import WebSocketDisconnect
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect
from websockets.typing import Subprotocol

from caviar_broker.http.auth import Tokens
from caviar_broker.http.gateway import Gateway
from caviar_protocol import messages as m
from caviar_protocol.codec import decode_message, encode_message, join_parts, split_frame
from caviar_protocol.codec.messages import MAX_FRAME

pytestmark = pytest.mark.slow

LIMITS = {"heartbeat": 50 * MS, "liveness": 300 * MS}
SECRET = "a-token-of-the-world"  # noqa: S105
AGENT = hashlib.sha256(SECRET.encode()).hexdigest()
TOKENS = f'[[token]]\nname = "world"\nrole = "world"\nsha256 = "{AGENT}"\n'


def closed(peer: Peer) -> tuple[int, str]:
    """Code and reason with which a WebSocket is closed, whatever comes before."""
    with pytest.raises(ConnectionClosed) as ended:  # noqa: PT012  # it may come after any of them
        while True:
            peer.socket.recv(timeout=PATIENCE_S)
    assert ended.value.rcvd is not None
    return ended.value.rcvd.code, ended.value.rcvd.reason


def test_a_world_over_a_websocket_and_sensors_over_zeromq_make_a_run(tmp_path: Path) -> None:
    """The digest is that of the same bytes over ZeroMQ alone."""
    with site(tmp_path) as http, Peer(http.url, "world") as world:
        assert world.socket.subprotocol == "caviar.v1"
        sensors_thread = threading.Thread(target=play_sensors, args=(http,), daemon=True)
        sensors_thread.start()
        world.join()
        world.begin()
        world.reset()
        for frame in range(3):
            grant = world.expect(m.Grant)
            assert grant.frame == frame
            world.done(grant, "scene", bytes(range(frame, 200)) * 1000)
        world.expect(m.EpisodeEnd)
        world.expect(m.Shutdown)
        world.send(m.Bye(**world.ids))
        sensors_thread.join(PATIENCE_S)
        outcome = http.broker.outcome()
        assert outcome.error == ""
    folder = tmp_path / "again"
    folder.mkdir()
    with serving(plan(*PAIR), folder) as plain, playing(plain.endpoint, *PAIR) as (direct, sensors):
        for frame in range(3):
            direct.done(direct.expect(m.Grant), ("scene", b"\x80", bytes(range(frame, 200)) * 1000))
            sensors.answer()
        for client in (direct, sensors):
            client.expect(m.EpisodeEnd)
            client.bye()
        assert plain.outcome().digest == outcome.digest


def play_sensors(http: Site) -> None:
    with playing(http.broker.endpoint, "sensors") as (sensors,):
        for frame in range(3):
            sensors.answer()
            assert sensors.parts[1] == bytes(range(frame, 200)) * 1000
        sensors.expect(m.EpisodeEnd)
        sensors.bye()


def refused_after_accept(peer: Peer, why: str) -> None:
    """REFUSE, which every page and engine can read, and then the end."""
    refusal = peer.expect(m.Refuse)
    assert refusal.code == "unauthorized"
    assert why in refusal.message
    code, reason = closed(peer)
    assert code == 1008
    assert reason == refusal.message.encode()[:123].decode()


def test_a_closing_handshake_counts_as_bye(tmp_path: Path) -> None:
    with site(tmp_path, limits=LIMITS) as http, playing_world(http) as world:
        world.expect(m.Grant)
        world.socket.close()
        outcome = http.broker.outcome(PATIENCE_S)
        assert outcome.culprit == "world"
        assert "it left: it closed its WebSocket (code 1000)" in outcome.error


def test_a_reason_of_the_peers_own_letters_fits_into_a_close_frame(tmp_path: Path) -> None:
    with site(tmp_path) as http, Peer(http.url, "world") as world:
        world.join()
        world.send(m.Hello(version=(1, 0), name="ä" * 120, role="sensors"))
        assert closed(world) == (
            1008,
            ("it said that it is '" + "ä" * 120).encode()[:123].decode(errors="ignore"),
        )


def test_heartbeats_over_a_second_websocket_count(tmp_path: Path) -> None:
    with site(tmp_path, limits=LIMITS) as http, Peer(http.url, "world") as world:
        world.join()
        with world.attach() as pulse:
            pulse.send(join_parts([encode_message(m.Heartbeat(sequence=5, progress=3, phase="meshes"))]))
            frame = pulse.recv(timeout=PATIENCE_S)
            assert isinstance(frame, bytes)
            assert decode_message(split_frame(frame)[0]) == m.HeartbeatAck(sequence=5)
            (entry,) = [s for s in http.get("/status").json["services"] if s["name"] == "world"]
            assert (entry["phase"], entry["progress"]) == ("meshes", 3)


def test_a_peer_whose_websockets_are_gone_is_noticed_and_blamed(tmp_path: Path) -> None:
    with site(tmp_path, limits=LIMITS) as http, playing_world(http) as world:
        world.expect(m.Grant)
        for stream in (world.socket, world.pulse):
            stream.socket.shutdown(socket.SHUT_RDWR)  # as the kernel does for a process that is killed
        outcome = http.broker.outcome(2.0)
        assert outcome.culprit == "world"
        assert "world 'world' died" in outcome.error
        assert "frame 0" in outcome.error


class playing_world:  # noqa: N801  # a context manager
    """A world over WebSockets with heartbeats, and sensors over ZeroMQ, up to the first grant."""

    def __init__(self, http: Site, token: str = "") -> None:
        self._http, self._token = http, token

    def __enter__(self) -> Peer:
        world = self._world = Peer(self._http.url, "world", token=self._token)
        world.join()
        world.pulse = world.attach()
        self._sensors = playing(self._http.broker.endpoint, "sensors")
        joined = threading.Thread(target=self._sensors.__enter__, daemon=True)
        joined.start()
        world.begin()
        world.reset()
        joined.join(PATIENCE_S)
        return world

    def __exit__(self, *_: object) -> None:
        self._sensors.__exit__(None, None, None)
        self._world.pulse.close()
        self._world.socket.close()


def test_a_process_id_told_over_a_websocket_is_not_watched(tmp_path: Path) -> None:
    """It would be one of another machine, or of a page's browser."""
    from caviar_protocol.host import host_identity

    with (
        site(tmp_path) as http,
        Peer(http.url, "world", pid=2**22 + 1, host=host_identity(), implementation="page") as world,
    ):
        world.join()
        hello = http.broker.server.clock.member("world").hello  # type: ignore[union-attr]
        assert (hello.pid, hello.host, hello.implementation) == (0, "", "page")


# --- wrong frames -----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("frame", "code", "told"),
    [
        (b"", 1007, "begins with the number of its parts"),
        (struct.pack(">II", 1, 1) + b"x", 1007, "big-endian"),
        (struct.pack("<II", 1, 9) + b"x", 1007, "its lengths add up to"),
        (join_parts([b"\xc1"]), 1007, "not in the protocol"),
        (join_parts([encode_message(m.Heartbeat(sequence=1))]), 1008, "before HELLO or ATTACH"),
        ("text", 1003, "one binary frame"),
    ],
)
def test_one_who_begins_with_something_else_is_cut_off_and_told_why(
    tmp_path: Path, frame: bytes | str, code: int, told: str
) -> None:
    with site(tmp_path) as http, Peer(http.url, "world") as stranger:
        stranger.socket.send(frame)
        found, reason = closed(stranger)
        assert found == code
        assert told in reason
        eventually(lambda: "has not said who it is was cut off" in http.broker.witness.texts(), "it is said")
        assert http.get("/status").json["state"] == "joining"


def test_garbage_of_a_member_ends_the_run_and_names_it_as_over_zeromq(tmp_path: Path) -> None:
    with site(tmp_path) as http, Peer(http.url, "world") as world:
        world.join()
        world.socket.send(join_parts([b"\xc1\xc1"]))
        outcome = http.broker.outcome()
        assert outcome.culprit == "world"
        assert "not in the protocol" in outcome.error


def test_a_broken_frame_of_a_member_cuts_it_off_and_names_it(tmp_path: Path) -> None:
    with site(tmp_path, limits=LIMITS) as http, playing_world(http) as world:
        world.expect(m.Grant)
        world.socket.send(b"\x01")
        assert world.expect(m.Error).code == "malformed"
        assert closed(world)[0] == 1007
        eventually(lambda: "of 'world' was cut off" in http.broker.witness.texts("world"), "it is named")


def test_a_message_that_is_too_large_is_refused_as_soon_as_it_is_announced(tmp_path: Path) -> None:
    with site(tmp_path, limits=LIMITS) as http, Peer(http.url, "world") as world:
        world.join()
        world.socket.socket.sendall(b"\x82\xff" + (MAX_FRAME + 1).to_bytes(8, "big") + bytes(4))
        assert closed(world)[0] == 1009
        told = f"it sent a message of more than {MAX_FRAME} B"
        eventually(lambda: told in http.broker.witness.texts("world"), "it is named")


def test_a_connection_is_that_of_one_service(tmp_path: Path) -> None:
    with site(tmp_path) as http, Peer(http.url, "world") as world:
        world.join()
        world.send(m.Hello(version=(1, 0), name="sensors", role="sensors"))
        assert closed(world) == (1008, "it said that it is 'sensors', on the connection of 'world'")


def test_one_who_does_not_read_is_cut_off_and_named(monkeypatch: pytest.MonkeyPatch) -> None:
    """A WebSocket that takes what it is sent never; its connection to the broker is closed."""
    monkeypatch.setattr("caviar_broker.http.gateway.SLOW_S", 0.1)
    told: list[tuple[str, str]] = []

    async def tell(service: str, text: str, _: str) -> None:
        told.append((service, text))

    async def serve() -> MuteSocket:
        mute = MuteSocket()
        with zmq.asyncio.Context() as context, context.socket(zmq.ROUTER) as router:
            router.linger = 0
            port = router.bind_to_random_port("tcp://127.0.0.1")
            gateway = Gateway(f"tcp://127.0.0.1:{port}", Tokens(None), tell)
            serving_it = asyncio.create_task(gateway.serve(mute))  # type: ignore[arg-type]
            route, _ = await router.recv_multipart()
            await router.send_multipart([route, encode_message(m.HeartbeatAck(sequence=0))])
            async with asyncio.timeout(PATIENCE_S):
                await serving_it
            assert gateway.connections == 0
            gateway.close()
        return mute

    assert asyncio.run(serve()).closed == (1008, "it has not read for 0.1 s")
    assert told == [("sensors", "the WebSocket of 'sensors' was cut off: it has not read for 0.1 s")]


def test_what_a_peer_sent_before_it_closed_is_delivered_where_it_takes_nothing_any_more() -> None:
    """A message to it fails before its BYE, which is there, is read."""

    async def tell(*_: str) -> None:
        return

    async def serve() -> m.Message:
        with zmq.asyncio.Context() as context, context.socket(zmq.ROUTER) as router:
            router.linger = 0
            port = router.bind_to_random_port("tcp://127.0.0.1")
            gateway = Gateway(f"tcp://127.0.0.1:{port}", Tokens(None), tell)
            serving_it = asyncio.create_task(gateway.serve(LeavingSocket()))  # type: ignore[arg-type]
            async with asyncio.timeout(PATIENCE_S):
                route, _ = await router.recv_multipart()
                await router.send_multipart([route, encode_message(m.HeartbeatAck(sequence=0))])
                _, last = await router.recv_multipart()
                await serving_it
            gateway.close()
            return decode_message(last)

    assert asyncio.run(serve()) == m.Bye(epoch=1, attempt=1)


class MuteSocket:
    """A WebSocket that says HELLO and reads nothing."""

    def __init__(self) -> None:
        hello = m.Hello(version=(1, 0), name="sensors", role="sensors")
        self._frames = [join_parts([encode_message(hello)])]
        self.scope: dict[str, object] = {}
        self.headers = Headers({"host": "127.0.0.1"})
        self.closed: tuple[int, str] | None = None

    async def accept(self, _: object) -> None:
        return

    async def receive(self) -> dict[str, object]:
        if not self._frames:
            await asyncio.Event().wait()
        return {"type": "websocket.receive", "bytes": self._frames.pop()}

    async def send_bytes(self, _: bytes) -> None:
        await asyncio.Event().wait()

    async def close(self, code: int, reason: str) -> None:
        self.closed = code, reason


class LeavingSocket(MuteSocket):
    """A WebSocket whose BYE is read only after something could not be sent to it."""

    def __init__(self) -> None:
        super().__init__()
        self._frames.insert(0, join_parts([encode_message(m.Bye(epoch=1, attempt=1))]))
        self._failed = asyncio.Event()

    async def receive(self) -> dict[str, object]:
        if len(self._frames) < 2:
            await self._failed.wait()
            for _ in range(10):  # turns of the loop, in which the failure is seen first
                await asyncio.sleep(0)
        if not self._frames:
            return {"type": "websocket.disconnect", "code": 1000}
        return await super().receive()

    async def send_bytes(self, _: bytes) -> None:
        self._failed.set()
        raise WebSocketDisconnect(1006)


# --- who comes in -----------------------------------------------------------------------------------------


def test_with_tokens_a_service_takes_part_as_what_its_token_says(tmp_path: Path) -> None:
    with site(tmp_path, tokens=TOKENS) as http:
        for token, why in (("", "there is no token"), (SECRET[1:], "not, or no longer, known")):
            with Peer(http.url, "world", token=token) as stranger:
                refused_after_accept(stranger, why)
        with Peer(http.url, "sensors", token=SECRET) as other:
            other.send(other.hello)
            refused = other.expect(m.Refuse)
            assert (refused.code, "not of sensors 'sensors'" in refused.message) == ("unauthorized", True)
            assert closed(other)[0] == 1008
        with Peer(http.url, "world", role="sensors", token=SECRET) as other:
            other.send(other.hello)
            assert other.expect(m.Refuse).code == "unauthorized"
        with Peer(http.url, "world", token=SECRET) as world:
            world.join()
            with world.attach():
                pass
        log = (tmp_path / "journal.msgpack").read_bytes() + json.dumps(http.broker.witness.texts()).encode()
        assert SECRET.encode() not in log


def test_a_browser_shows_its_token_as_a_subprotocol_and_gets_ours_back(tmp_path: Path) -> None:
    with site(tmp_path, tokens=TOKENS) as http:
        wanted = [Subprotocol("bearer." + SECRET), Subprotocol("caviar.v1")]
        with connect(http.url, subprotocols=wanted) as page:
            assert page.subprotocol == "caviar.v1"


def test_a_revoked_token_ends_the_connection_that_came_in_with_it(tmp_path: Path) -> None:
    with site(tmp_path, tokens=TOKENS) as http, Peer(http.url, "world", token=SECRET) as world:
        world.join()
        (tmp_path / "tokens.toml").write_text("")
        assert closed(world) == (1008, "its token was revoked")


def test_without_tokens_no_page_of_another_machine_gets_a_websocket(tmp_path: Path) -> None:
    with site(tmp_path) as http:
        with Peer(http.url, "world", origin="https://evil.example") as page:
            refused_after_accept(page, "without tokens no page of another machine is served")
        shown = [notice.text for notice in http.broker.witness.notices if notice.kind == "refused"]
        assert any("from 127.0.0.1 was refused: without tokens no page" in text for text in shown)
        with connect(http.url, origin="http://localhost:8000"):
            pass
