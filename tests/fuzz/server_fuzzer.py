"""Feeds a broker that is in the middle of a run what is wrong, from many connections; run as a script.

    python server_fuzzer.py [--inputs 100000] [--seed 6] [--connections 40] [--frames FRAMES]

Two services play a run over real sockets. Between their frames, unknown connections send
mutated messages, in parts that fit or do not, out of turn, come and go, and speak no ZMTP at all; the
services themselves repeat, guess and garble what has no place where it stands. Prints a JSON report: the
digests of the run with and without all that, which must be equal, what was handled, how much the broker
grew. A service that sends what is not in the protocol ends the run with its name, which other tests
show; strangers who know name, epoch and attempt of a service are a matter of keys.
"""

from __future__ import annotations

import argparse
import json
import resource
import socket
import subprocess
import sys
import time
from contextlib import closing
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import zmq
from decoder_fuzzer import PROGRESS_S, Mutator, seeds

from caviar_broker.core import events as ev
from caviar_broker.core.plan import SECOND, RunPlan, ServicePlan
from caviar_broker.journal import JournalFile
from caviar_broker.security.limits import PeerLimits
from caviar_broker.server import BrokerServer
from caviar_broker.statistics import Statistics
from caviar_protocol import messages as m
from caviar_protocol.assets import AssetStore
from caviar_protocol.codec import decode_message, encode_message
from caviar_protocol.digest import payload_digest

WORLD, EYES = "fuzzed-world", "fuzzed-eyes"
"""Names that no vector has."""
CHUNK = 500
"""Inputs between two frames, so that little waits to be read: memory that grows shows."""
DRAINED_MS = 500
"""[ms] of silence after which everything that was sent counts as handled: all of it is answered."""
PATIENCE_MS = 30_000


class Watcher:
    """Observer that keeps numbers only."""

    def __init__(self) -> None:
        self.notices = 0

    def notice(self, notice: ev.Notice) -> None:
        """Counted: there must not be one for each input."""
        self.notices += 1

    def frame(self, frame: ev.FrameFinished, statistics: Statistics) -> None:
        """Known by the statistics."""


class CountingServer(BrokerServer):
    """A broker that counts what reaches it."""

    handled = 0

    def _handle(self, route: bytes, parts: list[zmq.Frame]) -> None:
        self.handled += 1
        super()._handle(route, parts)


def serve(inputs: int, seed: int, connections: int, frames: int) -> dict[str, Any]:
    """One run with so many inputs beside it: its report. Whatever the broker raises is raised."""
    plan = RunPlan(
        run="fuzz",
        services=(
            ServicePlan(name=WORLD, role="world", budget_ns=SECOND),
            ServicePlan(name=EYES, role="sensors", budget_ns=SECOND),
        ),
        frames=frames,
        sampling_period_ns=SECOND,
        record=("lidar",),
    )
    watcher, began = Watcher(), time.monotonic()
    with TemporaryDirectory() as folder, closing(JournalFile(Path(folder) / "journal", 1)) as journal:
        store = AssetStore(Path(folder) / "assets")
        # Bounds that no connection comes to, so that every input reaches what has to stand it.
        far = PeerLimits(stranger_messages=10**9, strangers=4096, stranger_bytes=1 << 40, burst=1e9, rate=1e9)
        server = CountingServer(plan, "tcp://127.0.0.1:0", journal, watcher, store, peer_limits=far)
        before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        numbers = [str(value) for value in (inputs, seed, connections, frames)]
        driver = subprocess.Popen([sys.executable, __file__, "--drive", server.endpoint, *numbers])
        try:
            outcome = server.run()
            status = driver.wait(60)
        finally:
            driver.kill()
            driver.wait()
    assert not outcome.error, outcome.error
    assert status == 0, f"the driver ended with {status}"
    return {
        "digest": outcome.digest,
        "frames": server.statistics.frames,
        "handled": server.handled,
        "notices": watcher.notices,
        "grown_kib": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before,
        "seconds": time.monotonic() - began,
    }


class Player:
    """A service that does its part, and sends noise beside it."""

    def __init__(self, context: zmq.Context[zmq.Socket[bytes]], endpoint: str, hello: m.Hello) -> None:
        self.socket = context.socket(zmq.DEALER)
        self.socket.connect(endpoint)
        self.socket.send(encode_message(hello))
        self.output = hello.outputs[0]
        welcome = self.expect(m.Welcome)
        self.who = {"epoch": welcome.epoch, "attempt": welcome.attempt}

    def expect(self, kind: type[Any]) -> Any:
        """The next message of a kind; answers to noise are passed over."""
        while True:
            assert self.socket.poll(PATIENCE_MS), f"{self.output}: no {kind.__name__} came"
            message = decode_message(self.socket.recv_multipart()[0])
            if isinstance(message, kind):
                return message
            assert isinstance(message, m.Stale | m.Error | m.EpisodeEnd), (
                f"{message} came in place of {kind.__name__}"
            )

    def answer(self, frame: int) -> None:
        """Take the grant of a frame, and answer with a product that tells the frame."""
        grant = self.expect(m.Grant)
        assert grant.frame == frame, f"frame {grant.frame} was granted, not {frame}"
        self.done(self.who, frame, f"{self.output} of {frame}".encode() * 20)

    def done(self, who: dict[str, int], frame: int, body: bytes) -> None:
        """An answer, true or not."""
        product = m.ProductHeader(topic=self.output, digest=payload_digest(b"\x80", body))
        done = m.Done(**who, episode=0, frame=frame, products=(product,))
        self.socket.send_multipart([encode_message(done), b"\x80", body])

    def noise(self, mutator: Mutator, frame: int) -> None:
        """What is in the protocol, and has no place here."""
        other = {key: value + 1 + mutator.draw(3) for key, value in self.who.items()}
        match mutator.draw(5):
            case 0:
                self.done(other, frame, b"of another incarnation")
            case 1:
                self.done(self.who, frame + 1 + mutator.draw(1000), b"of a frame that was not granted")
            case 2:
                self.done(self.who, mutator.draw(frame) if frame else 7, b"of a frame that is over")
            case 3:
                self.socket.send(encode_message(m.ResetDone(**self.who, episode=mutator.draw(9))))
            case _:
                self.socket.send(encode_message(m.Heartbeat(sequence=1, phase="on the wrong connection")))


class Strangers:
    """Unknown connections."""

    def __init__(
        self, context: zmq.Context[zmq.Socket[bytes]], endpoint: str, count: int, mutator: Mutator
    ) -> None:
        self._context, self._endpoint, self._mutator = context, endpoint, mutator
        self._sockets = [self._connected() for _ in range(count)]
        self.answers = 0

    def _connected(self) -> zmq.Socket[bytes]:
        found = self._context.socket(zmq.DEALER)
        found.linger = 0
        found.sndtimeo = PATIENCE_MS
        found.connect(self._endpoint)
        return found

    def send(self) -> None:
        """One input."""
        draw = self._mutator.draw
        which = draw(len(self._sockets))
        if draw(1000) == 0:  # gone with whatever was not sent yet, and another in its place
            self._sockets[which].close()
            self._sockets[which] = self._connected()
        if draw(2000) == 0:
            self._not_even_zmtp()
        _, header, body = self._mutator.input()
        parts = [header, *([body] if body else []), *([header] * (draw(70) if draw(50) == 0 else 0))]
        self._sockets[which].send_multipart(parts)
        self.drain(self._sockets[which])

    def drain(self, one: zmq.Socket[bytes]) -> None:
        """Read what came back."""
        while one.getsockopt(zmq.EVENTS) & zmq.POLLIN:
            one.recv_multipart()
            self.answers += 1

    def drain_all(self) -> None:
        """Read until nothing comes any more."""
        poller = zmq.Poller()
        for one in self._sockets:
            poller.register(one, zmq.POLLIN)
        while ready := poller.poll(DRAINED_MS):
            for one, _ in ready:
                self.drain(one)

    def close(self) -> None:
        """All of them go."""
        for one in self._sockets:
            one.close()

    def _not_even_zmtp(self) -> None:
        host, port = self._endpoint.removeprefix("tcp://").split(":")
        with socket.create_connection((host, int(port)), 5.0) as raw:
            raw.sendall(self._mutator.mutated(b"\xff\0\0\0\0\0\0\0\x01\x7f\x03\0NULL" + bytes(48)))


def drive(endpoint: str, inputs: int, seed: int, connections: int, frames: int) -> None:
    """Play the services, and feed the inputs between their frames."""
    mutator = Mutator(seed, seeds())
    version = m.PROTOCOL_VERSION
    hellos = (
        m.Hello(version=version, name=WORLD, role="world", outputs=("scene",)),
        m.Hello(
            version=version, name=EYES, role="sensors", inputs=(m.Input(topic="scene"),), outputs=("lidar",)
        ),
    )
    with zmq.Context() as context:
        context.max_sockets = 4096
        strangers = Strangers(context, endpoint, connections if inputs else 0, mutator)
        players = [Player(context, endpoint, hello) for hello in hellos]
        for player in players:
            player.expect(m.Prepare)
            player.socket.send(encode_message(m.Ready(**player.who)))
        for player in players:
            reset = player.expect(m.Reset)
            player.socket.send(encode_message(m.ResetDone(**player.who, episode=reset.episode)))
        began = told = time.monotonic()
        for frame in range(frames):
            for _ in range(inputs // frames):
                strangers.send()
                if mutator.draw(50) == 0:
                    players[mutator.draw(2)].noise(mutator, frame)
            if inputs and frame == frames - 1:
                strangers.drain_all()
            for player in players:
                player.answer(frame)
            now = time.monotonic()
            if inputs and now - told > PROGRESS_S:
                told, left = now, (now - began) / (frame + 1) * (frames - frame - 1)
                sys.stderr.write(f"frame {frame + 1} of {frames}, {left:.0f} s left\n")
        for player in players:
            player.expect(m.Shutdown)
            player.socket.send(encode_message(m.Bye(**player.who)))
            player.socket.close()
        strangers.close()


def main() -> int:
    """What the command line says; 0 where the run was the same."""
    if sys.argv[1:2] == ["--drive"]:
        drive(sys.argv[2], *map(int, sys.argv[3:]))
        return 0
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--inputs", type=int, default=100_000)
    parser.add_argument("--seed", type=int, default=6)
    parser.add_argument("--connections", type=int, default=40)
    parser.add_argument(
        "--frames", type=int, default=0, help=f"of the run; by default one for {CHUNK} inputs"
    )
    arguments = parser.parse_args()
    frames = arguments.frames or max(20, arguments.inputs // CHUNK)
    undisturbed = serve(0, arguments.seed, 0, frames)
    report = serve(arguments.inputs, arguments.seed, arguments.connections, frames)
    report |= {"inputs": arguments.inputs, "undisturbed": undisturbed["digest"]}
    sys.stdout.write(json.dumps(report) + "\n")
    return int(report["digest"] != report["undisturbed"])


if __name__ == "__main__":
    sys.exit(main())
