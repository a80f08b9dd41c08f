"""The HTTP process of a broker, and WebSockets that play services through its gateway."""

from __future__ import annotations

import http.client
import json
import re
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

from broker_harness import MS, PAIR, PATIENCE_S, Serving, plan, serving
from forked import Forked
from websockets.sync.client import ClientConnection, connect
from websockets.typing import Origin, Subprotocol

from caviar_broker.control.socket import ask
from caviar_protocol import messages as m
from caviar_protocol.codec import decode_message, encode_message, join_parts, split_frame
from caviar_protocol.digest import payload_digest

M = TypeVar("M", bound=m.Message)
CAVIAR = Subprotocol("caviar.v1")
GATEWAY = ("caviar_broker.http.app", "caviar_broker.http.gateway", "caviar_broker.http.server")
"""What the process imports that serves HTTP."""
START_S = 60.0
"""[s] that the HTTP process may take to start: on a busy machine its libraries take long to load."""


@dataclass
class Page:
    """One HTTP answer."""

    status: int
    text: str
    headers: dict[str, str]

    @property
    def json(self) -> Any:
        return json.loads(self.text)


@dataclass
class Site:
    """A broker with its HTTP process."""

    broker: Serving
    process: subprocess.Popen[bytes]
    port: int
    directory: Path

    def ask(self, method: str, path: str, token: str = "", **headers: str) -> Page:
        connection = http.client.HTTPConnection("127.0.0.1", self.port, timeout=PATIENCE_S)
        try:
            shown = {"Authorization": f"Bearer {token}"} if token else {}
            connection.request(method, path, headers=shown | headers)
            answer = connection.getresponse()
            return Page(answer.status, answer.read().decode(), dict(answer.getheaders()))
        finally:
            connection.close()

    def get(self, path: str, token: str = "", **headers: str) -> Page:
        return self.ask("GET", path, token, **headers)

    def post(self, path: str, token: str = "", **headers: str) -> Page:
        return self.ask("POST", path, token, **headers)

    @property
    def url(self) -> str:
        return f"ws://127.0.0.1:{self.port}/ws"


@contextmanager
def site(
    tmp_path: Path,
    *services: str,
    tokens: str | None = None,
    limits: dict[str, int] | None = None,
    **run: Any,
) -> Iterator[Site]:
    """A broker with a desk, and the process beside it; ``tokens`` is the text of tokens.toml."""
    command = [sys.executable, "-m", "caviar_broker.http", str(tmp_path), "--http", "127.0.0.1:0"]
    if tokens is not None:
        (tmp_path / "tokens.toml").write_text(tokens)
        command += ["--keys", str(tmp_path)]
    # The HTTP process may take many seconds to start on a busy machine, and the run has to wait for it.
    waits = {"connect": int(START_S * 1000) * MS} | (limits or {})
    planned = plan(*(services or PAIR), limits=waits, **run)
    with serving(planned, tmp_path, desk=tmp_path) as broker:
        process = Forked(command, GATEWAY, stderr=subprocess.PIPE)
        try:
            yield Site(broker, process, port_of(tmp_path, process), tmp_path)
        finally:
            process.terminate()
            process.communicate(timeout=PATIENCE_S)


def port_of(directory: Path, process: subprocess.Popen[bytes]) -> int:
    until = time.monotonic() + START_S
    while True:
        served = ask(directory, do="status")["status"].get("http", "")
        if found := re.search(r":(\d+)$", served):
            return int(found[1])
        assert process.poll() is None, process.communicate()[1].decode()
        assert time.monotonic() < until, "HTTP is not served"


def opened(url: str, **options: Any) -> ClientConnection:
    """A WebSocket that is open; the test that opened it closes it."""
    return connect(url, **options).__enter__()


class Peer:
    """A service over a WebSocket."""

    def __init__(
        self, url: str, name: str, role: str = "", token: str = "", origin: str | None = None, **hello: Any
    ) -> None:
        role = role or name
        headers = {"Authorization": f"Bearer {token}"} if token else {}
        self.socket = opened(
            url,
            origin=Origin(origin) if origin else None,
            additional_headers=headers,
            max_size=None,
            compression=None,
            subprotocols=[Subprotocol("caviar.v1")],
        )
        inputs = {"sensors": (m.Input(topic="scene"),)}.get(role, ())
        outputs = {"world": ("scene",), "sensors": ("lidar",)}.get(role, ())
        declared = {"version": (1, 0), "name": name, "role": role, "inputs": inputs, "outputs": outputs}
        self.name, self.hello = name, m.Hello(**declared | hello)
        self.url, self.headers = url, headers
        self.ids: dict[str, int] = {}
        self.parts: list[bytes] = []
        self.pulse: ClientConnection

    def __enter__(self) -> Peer:
        return self

    def __exit__(self, *_: object) -> None:
        self.socket.close()

    def send(self, message: m.Message, *parts: bytes) -> None:
        self.socket.send(join_parts([encode_message(message), *parts]))

    def receive(self) -> m.Message:
        frame = self.socket.recv(timeout=PATIENCE_S)
        assert isinstance(frame, bytes)
        header, *parts = split_frame(frame)
        self.parts = [bytes(part) for part in parts]
        return decode_message(header)

    def expect(self, cls: type[M]) -> M:
        message = self.receive()
        assert isinstance(message, cls), f"expected {cls.__name__}, got {message}"
        return message

    def join(self) -> None:
        self.send(self.hello)
        welcome = self.expect(m.Welcome)
        self.ids = {"epoch": welcome.epoch, "attempt": welcome.attempt}

    def attach(self) -> ClientConnection:
        pulse = opened(self.url, additional_headers=self.headers, compression=None)
        pulse.send(join_parts([encode_message(m.Attach(**self.ids, name=self.name))]))
        frame = pulse.recv(timeout=PATIENCE_S)
        assert isinstance(frame, bytes)
        assert decode_message(split_frame(frame)[0]) == m.HeartbeatAck(sequence=0)
        return pulse

    def begin(self) -> None:
        self.expect(m.Prepare)
        self.send(m.Ready(**self.ids))

    def reset(self) -> None:
        episode = self.expect(m.Reset).episode
        self.send(m.ResetDone(**self.ids, episode=episode))

    def done(self, grant: m.Grant, topic: str, body: bytes) -> None:
        header = m.ProductHeader(topic=topic, digest=payload_digest(b"\x80", body))
        ids = self.ids | {"episode": grant.episode, "frame": grant.frame}
        self.send(m.Done(**ids, products=(header,)), b"\x80", body)
