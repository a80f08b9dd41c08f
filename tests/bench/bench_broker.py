"""What a frame costs in the broker, beside a bare loop that forwards the same bytes, HELICS and mosaik.

    python tests/bench/bench_broker.py [--services 2 4 8 32] [--payload 100] [--frames 2000] [--curve]
                                       [--json FILE]

One hub and N - 1 others, each a process of its own. In every frame the hub takes what each of the others
made in it, and each of them takes what the hub made in the frame before. The kinds of loop take turns, round
by round, so that a machine's moods fall on all of them; ratios are medians of the ratios within each round.

- *bare*: a ROUTER loop that knows nothing but this pattern, and DEALER clients that send bytes back;
- *broker*: `caviar bench broker`: frame clock, deadlines, journal, latency record, clients of the protocol;
- *helics*, *mosaik*: where they are installed (``pip install helics mosaik``);
- *helics-lagged*: the hub too takes what was made in the frame before, which is less: nobody waits for it.

With ``--curve`` the bare loop and the broker are encrypted; the others know no encryption, and are left out.
"""

# ruff: noqa: T201 - a command that prints what it measured

from __future__ import annotations

import argparse
import importlib.util
import json
import re
import statistics
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import zmq

from caviar_broker.bench.client import deliveries
from caviar_broker.bench.run import WARM_UP

HEADER = bytes(60)
"""Stands for what the broker tells with each product."""
# Plain integers, and no multipart calls: pyzmq's flags are enumerations, which cost more than a small send.
MORE = int(zmq.SNDMORE)
COPIED = 1 << 16
"""[B] from which a payload is sent without a copy."""
PEERS_LEAST = 100
"""Frames of HELICS and mosaik, which take longer, at least."""

PLAIN = {"helics": "helics", "helics-lagged": "helics", "mosaik": "mosaik"}
"""Kinds that know no encryption, and what has to be installed for each."""

Seconds = Callable[[int, int, int, bool], float]
"""``kind(services, payload, frames, curve)``: seconds that a frame takes."""


def bare(services: int, payload: int, frames: int, curve: bool) -> float:
    """A loop that knows nothing but the pattern, in a process of its own."""
    command = [sys.executable, __file__, "--bare", *map(str, (services, payload, frames, int(curve)))]
    done = subprocess.run(command, stdout=subprocess.PIPE, timeout=600, check=True)
    return float(done.stdout)


def bare_loop(services: int, payload: int, frames: int, curve: bool) -> float:
    """The process of `bare`: seconds that a frame takes."""
    context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
    socket = context.socket(zmq.ROUTER)
    public_key = ""
    if curve:
        public, private = zmq.curve_keypair()
        socket.curve_server, socket.curve_secretkey, public_key = True, private, public.decode()
    socket.bind("tcp://127.0.0.1:0")
    command = [sys.executable, __file__, "--echo", str(payload), socket.getsockopt_string(zmq.LAST_ENDPOINT)]
    started = [subprocess.Popen([*command, str(number), public_key]) for number in range(services)]
    try:
        routes = {}
        while len(routes) < services:
            route, name = socket.recv_multipart()
            routes[int(name)] = route
        hub, leaves = routes[0], [routes[number] for number in range(1, services)]
        back: list[Any] = [b"\x80", bytes(payload)]
        began = 0.0
        for frame in range(frames + WARM_UP):
            if frame == WARM_UP:
                began = time.perf_counter()
            for leaf in leaves:
                forward(socket, leaf, back)
            taken: list[Any] = []
            for _ in leaves:
                taken += received(socket)
            forward(socket, hub, taken)
            back = received(socket)
        elapsed = time.perf_counter() - began
        for route in routes.values():
            socket.send_multipart([route, b""])
        for process in started:
            process.wait(10)
    finally:
        for process in started:
            process.kill()
            process.wait()
        socket.close(0)
        context.term()
    return elapsed / frames


def echo(payload: int, endpoint: str, name: str, public_key: str) -> None:
    """A client of the bare loop; with a public key of the loop's, encrypted."""
    with zmq.Context() as context, context.socket(zmq.DEALER) as socket:
        if public_key:
            socket.curve_publickey, socket.curve_secretkey = zmq.curve_keypair()
            socket.curve_serverkey = public_key.encode()
        socket.connect(endpoint)
        socket.send(name.encode())
        body = bytes(payload)
        while True:
            first = part = socket.recv(0, False)
            while part.more:
                part = socket.recv(0, False)
            if not len(first):
                return
            socket.send(HEADER, MORE)
            socket.send(b"\x80", MORE)
            socket.send(body, 0, payload < COPIED)


def forward(socket: zmq.Socket[bytes], route: bytes, parts: list[Any]) -> None:
    """Parts as they came, to a routing id."""
    socket.send(route, MORE)
    socket.send(HEADER, MORE)
    for part in parts[:-1]:
        socket.send(part, MORE, False)
    socket.send(parts[-1], 0, False)


def received(socket: zmq.Socket[bytes]) -> list[Any]:
    """What the next client sent, behind its header."""
    socket.recv()
    socket.recv()
    parts = [socket.recv(0, False)]
    while parts[-1].more:
        parts.append(socket.recv(0, False))
    return parts


def broker(services: int, payload: int, frames: int, curve: bool) -> float:
    """The broker, by its own command: in a process of its own, like the bare loop."""
    with TemporaryDirectory() as folder:
        figures = Path(folder) / "figures.json"
        options = {"services": services, "payload": payload, "frames": frames, "json": figures}
        words = [word for name, value in options.items() for word in (f"--{name}", str(value))]
        command = [sys.executable, "-m", "caviar_clients", "bench", "broker", *words, *["--curve"] * curve]
        subprocess.run(command, stdout=subprocess.DEVNULL, timeout=600, check=True)
        mean: float = json.loads(figures.read_text())["us_per_frame"]["mean"]
    return mean / 1e6


def peer(name: str, *variant: str) -> Seconds:
    """Another co-simulation, in a process of its own."""

    def seconds(services: int, payload: int, frames: int, curve: bool) -> float:
        assert not curve, f"{name} knows no encryption"
        script = Path(__file__).with_name(f"peer_{name}.py")
        numbers = services, payload, max(PEERS_LEAST, frames // 4)
        command = [sys.executable, str(script), *map(str, numbers), *variant]
        done = subprocess.run(
            command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, timeout=600, check=True
        )
        found = re.search(rb"seconds a frame: ([-+.e0-9]+)", done.stdout)
        assert found, f"{script.name} told no time: {done.stdout[-500:]!r}"
        return float(found[1])

    return seconds


KINDS: dict[str, Seconds] = {
    "bare": bare,
    "broker": broker,
    "helics": peer("helics"),
    "helics-lagged": peer("helics", "lagged"),
    "mosaik": peer("mosaik"),
}


def report(services: int, payload: int, rows: dict[str, list[float]], curve: bool) -> list[dict[str, Any]]:
    """Print and return a line for each kind of loop."""
    lines = []
    delivered = deliveries("hub", services) * payload
    for kind, seconds in rows.items():
        to_bare = [mine / bare for mine, bare in zip(seconds, rows["bare"], strict=True)]
        line = {
            "services": services,
            "payload": payload,
            "kind": kind,
            "curve": curve,
            "us_per_frame": statistics.median(seconds) * 1e6,
            "bytes_per_second": delivered / statistics.median(seconds),
            "time_to_bare": statistics.median(to_bare),
            "time_to_bare_range": [min(to_bare), max(to_bare)],
        }
        lines.append(line)
        low, high = line["time_to_bare_range"]
        print(
            f"N = {services:3} {payload:8} B {' curve' * curve} {kind:13}{line['us_per_frame']:9.0f} µs "
            f"a frame {line['time_to_bare']:7.2f} × bare ({low:.2f} to {high:.2f}) "
            f"{line['bytes_per_second'] / 1e6:9.3g} MB/s",
            flush=True,
        )
    return lines


def main() -> None:
    """What the command line says."""
    if sys.argv[1:2] == ["--echo"]:
        echo(int(sys.argv[2]), *sys.argv[3:])
        return
    if sys.argv[1:2] == ["--bare"]:
        services, payload, frames, curve = map(int, sys.argv[2:])
        print(bare_loop(services, payload, frames, bool(curve)))
        return
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--services", type=int, nargs="+", default=[2, 4, 8, 32], help="N")
    parser.add_argument("--payload", type=int, nargs="+", default=[100], help="bytes of every product")
    parser.add_argument("--frames", type=int, default=2000)
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--kinds", nargs="+", choices=list(KINDS), default=list(KINDS))
    parser.add_argument("--curve", action="store_true", help="encrypted; without helics and mosaik")
    parser.add_argument("--json", type=Path)
    told = parser.parse_args()
    kinds = ["bare", *(k for k in told.kinds if k != "bare" and not (told.curve and k in PLAIN))]
    for kind in [k for k in kinds if k in PLAIN and importlib.util.find_spec(PLAIN[k]) is None]:
        print(f"{kind} is left out: pip install {PLAIN[kind]}")
        kinds.remove(kind)
    lines = []
    for payload in told.payload:
        for services in told.services:
            rows: dict[str, list[float]] = {kind: [] for kind in kinds}
            for _ in range(told.rounds):
                for kind in kinds:
                    rows[kind].append(KINDS[kind](services, payload, told.frames, told.curve))
            lines += report(services, payload, rows, told.curve)
    if told.json:
        told.json.write_text(json.dumps(lines, indent=2) + "\n")


if __name__ == "__main__":
    main()
