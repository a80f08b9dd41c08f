"""A broker that a test plays by hand, and a service in a process of its own beside it."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeVar

import pytest
import zmq
from forked import Forked

from caviar_protocol import messages as m
from caviar_protocol.codec import check_parts, decode_message, encode_message
from caviar_protocol.digest import payload_digest

HERE = Path(__file__).parent
MS = 1_000_000
PATIENCE_S = 15.0
M = TypeVar("M", bound=m.Message)
IDS: dict[str, int] = {"epoch": 4, "attempt": 2}


class Broker:
    """A broker played by hand, for one service. Heartbeats are answered while it waits for something."""

    def __init__(self, port: int = 0) -> None:
        self.context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
        self.socket = self.context.socket(zmq.ROUTER)
        self.socket.linger = 0
        self.socket.bind(f"tcp://127.0.0.1:{port}")
        self.endpoint = self.socket.getsockopt_string(zmq.LAST_ENDPOINT)
        self.route = b""
        self.pulse = b""
        self.answering = True
        self.beats: list[m.Heartbeat] = []
        self.parts: list[bytes] = []

    def close(self) -> None:
        self.socket.close()
        self.context.term()

    def send(self, message: m.Message, *parts: bytes) -> None:
        self.socket.send_multipart([self.route, encode_message(message), *parts])

    def receive(self, within_s: float = PATIENCE_S) -> m.Message:
        until = time.monotonic() + within_s
        while True:
            left = until - time.monotonic()
            assert left > 0, f"nothing came within {within_s} s"
            if not self.socket.poll(left * 1000):
                continue
            route, *parts = self.socket.recv_multipart()
            message = decode_message(parts[0])
            check_parts(message, parts)
            if isinstance(message, m.Attach | m.Heartbeat):
                self._beat(route, message)
                continue
            self.route, self.parts = route, parts[1:]
            return message

    def _beat(self, route: bytes, message: m.Attach | m.Heartbeat) -> None:
        self.pulse = route
        sequence = 0
        if isinstance(message, m.Heartbeat):
            self.beats.append(message)
            sequence = message.sequence
        if self.answering:
            ack = encode_message(m.HeartbeatAck(sequence=sequence))
            self.socket.send_multipart([route, ack])

    def expect(self, cls: type[M], within_s: float = PATIENCE_S) -> M:
        message = self.receive(within_s)
        assert isinstance(message, cls), f"expected {cls.__name__}, got {message}"
        return message

    def until(self, condition: Callable[[], object], within_s: float = PATIENCE_S) -> None:
        """Answer heartbeats until a condition holds; nothing else may come."""
        until = time.monotonic() + within_s
        while not condition():
            assert time.monotonic() < until
            if self.socket.poll(20):
                route, header = self.socket.recv_multipart()
                message = decode_message(header)
                assert isinstance(message, m.Attach | m.Heartbeat), message
                self._beat(route, message)

    # --- the ordinary course -------------------------------------------------------------------------

    def welcome(self, **values: Any) -> m.Hello:
        hello = self.expect(m.Hello)
        told = {"heartbeat_ns": 50 * MS, "liveness_ns": 10_000 * MS, "run": "test", "seed": 9} | values
        self.send(m.Welcome(version=m.PROTOCOL_VERSION, **IDS, **told))
        return hello

    def prepare(self, assets: tuple[m.Asset, ...] = ()) -> None:
        demand = (m.Demand(topic="lidar"), m.Demand(topic="scene"))
        self.send(m.Prepare(**IDS, demand=demand, assets=assets))

    def start(self, **values: Any) -> None:
        """Up to the first grant."""
        self.welcome(**values)
        self.prepare()
        self.expect(m.Ready)
        self.reset()

    def reset(self, episode: int = 0) -> None:
        self.send(m.Reset(**IDS, episode=episode, seed=9, t0_ns=0))
        assert self.expect(m.ResetDone) == m.ResetDone(**IDS, episode=episode)

    def grant(self, frame: int, *, episode: int = 0, **ids: int) -> None:
        header, body = b"\x80", b""
        entry = m.GrantInput(
            topic="scene",
            source="world",
            status=m.Status.FRESH,
            frame=frame,
            digest=payload_digest(header, body),
        )
        grant = m.Grant(**(IDS | ids), episode=episode, frame=frame, t_ns=frame, inputs=(entry,))
        self.send(grant, header, body)

    def shutdown(self, reason: str = "enough") -> None:
        self.send(m.Shutdown(reason=reason))
        assert self.expect(m.Bye).reason == reason


@pytest.fixture(name="broker")
def played_broker() -> Iterator[Broker]:
    played = Broker()
    yield played
    played.close()


@contextmanager
def service(
    endpoint: str, use: str = "sensors:Sensors", *arguments: str, cache: Path | None = None
) -> Iterator[subprocess.Popen[str]]:
    """A service in a process of its own: ``role:Class`` of `runner_services`."""
    role, _, name = use.partition(":")
    command = [sys.executable, "-m", "caviar_services", "sick", "--broker", endpoint, *arguments]
    command += ["--use", f"{role}:runner_services:{name}"]
    paths = [str(HERE), *filter(None, [os.environ.get("PYTHONPATH")])]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(paths)}
    if cache is not None:
        environment["XDG_CACHE_HOME"] = str(cache)
    process = Forked(
        command,
        ("caviar_services.runner",),
        env=environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    with process:
        try:
            yield process
        finally:
            process.kill()


def ends(process: subprocess.Popen[str], status: int, within_s: float = PATIENCE_S) -> str:
    """What the process says until it ends, with that status, in time."""
    output, errors = process.communicate(timeout=within_s)
    assert process.returncode == status, errors
    return output + errors


def hears(process: subprocess.Popen[str], word: str) -> None:
    assert process.stdout is not None
    assert process.stdout.readline() == f"{word}\n"
