"""What a frame costs in the broker, beside a bare loop that forwards the same bytes, HELICS and mosaik.

    python tests/bench/bench_broker.py [--services 2 4 8 32] [--payload 100] [--frames 2000] [--curve]
                                       [--transport tcp ipc] [--json FILE] [--markdown FILE]

One hub and N - 1 others, each a process of its own. In every frame the hub takes what each of the others
made in it, and each of them takes what the hub made in the frame before. The kinds of loop take turns, round
by round, so that a machine's moods fall on all of them; ratios are medians of the ratios within each round.

- *bare*: a ROUTER loop that knows nothing but this pattern, and DEALER clients that send bytes back;
- *broker*: `caviar measure bench broker`: frame clock, deadlines, journal, latency record, clients of the
  protocol;
- *helics*, *mosaik*: where they are installed (``pip install helics mosaik``);
- *helics-lagged*: the hub too takes what was made in the frame before, which is less: none waits for it.

With ``--curve`` the bare loop and the broker are encrypted; with ``--transport ipc`` both use a socket
file, as the services of `caviar run` do. The others know neither, and are left out.
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

from caviar_labs.broker_bench import WARM_UP, deliveries, measure

HEADER = bytes(60)
"""Stands for what the broker tells with each product."""
# Plain integers, and no multipart calls: pyzmq's flags are enumerations, which cost more than a small send.
MORE = int(zmq.SNDMORE)
COPIED = 1 << 16
"""[B] from which a payload is sent without a copy."""
PEERS_LEAST = 100
"""Frames of HELICS and mosaik, which take longer, at least."""

PLAIN = {"helics": "helics", "helics-lagged": "helics", "mosaik": "mosaik"}
"""Kinds that know TCP without encryption alone, and what has to be installed for each."""
Seconds = Callable[[int, int, int, str], float]
"""``kind(services, payload, frames, wire)``: seconds of a frame over ``tcp``, ``ipc`` (a socket file) or
``curve`` (TCP with encryption)."""


def bare(services: int, payload: int, frames: int, wire: str) -> float:
    """A loop that knows nothing but the pattern, in a process of its own."""
    command = [sys.executable, __file__, "--bare", *map(str, (services, payload, frames)), wire]
    done = subprocess.run(command, stdout=subprocess.PIPE, timeout=600, check=True)
    return float(done.stdout)


def bare_loop(services: int, payload: int, frames: int, wire: str, folder: Path) -> float:
    """The process of `bare`: seconds that a frame takes."""
    context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
    socket = context.socket(zmq.ROUTER)
    public_key = ""
    if wire == "curve":
        public, private = zmq.curve_keypair()
        socket.curve_server, socket.curve_secretkey, public_key = True, private, public.decode()
    socket.bind(f"ipc://{folder}/bare" if wire == "ipc" else "tcp://127.0.0.1:0")
    command = [sys.executable, __file__, "--echo", str(payload), socket.getsockopt_string(zmq.LAST_ENDPOINT)]
    started = [subprocess.Popen([*command, str(number), public_key]) for number in range(services)]
    try:
        routes: dict[int, bytes] = {}
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
    """What the next client sent, after its header."""
    socket.recv()
    socket.recv()
    parts = [socket.recv(0, False)]
    while parts[-1].more:
        parts.append(socket.recv(0, False))
    return parts


def broker(services: int, payload: int, frames: int, wire: str) -> float:
    """The broker of `caviar measure bench broker`, in a process of its own, like the bare loop."""
    command = [sys.executable, __file__, "--broker", *map(str, (services, payload, frames)), wire]
    done = subprocess.run(command, stdout=subprocess.PIPE, timeout=600, check=True)
    return float(done.stdout)


def peer(name: str, *variant: str) -> Seconds:
    """Another co-simulation, in a process of its own."""

    def seconds(services: int, payload: int, frames: int, wire: str) -> float:
        assert wire == "tcp", f"{name} knows TCP alone"
        script = Path(__file__).with_name(f"peer_{name}.py")
        numbers = services, payload, max(PEERS_LEAST, frames // 4)
        command = [sys.executable, str(script), *map(str, numbers), *variant]
        done = subprocess.run(
            command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, timeout=600, check=True
        )
        found = re.search(rb"seconds a frame: ([-+.e0-9]+)", done.stdout)
        assert found, f"{script.name} printed no time: {done.stdout[-500:]!r}"
        return float(found[1])

    return seconds


KINDS: dict[str, Seconds] = {
    "bare": bare,
    "broker": broker,
    "helics": peer("helics"),
    "helics-lagged": peer("helics", "lagged"),
    "mosaik": peer("mosaik"),
}


def report(services: int, payload: int, rows: dict[str, list[float]], wire: str) -> list[dict[str, Any]]:
    """Print and return a line for each kind of loop."""
    lines = []
    delivered = deliveries("hub", services) * payload
    for kind, seconds in rows.items():
        to_bare = [mine / bare for mine, bare in zip(seconds, rows["bare"], strict=True)]
        low, high = min(to_bare), max(to_bare)
        ratio, took = statistics.median(to_bare), statistics.median(seconds)
        line = {
            "services": services,
            "payload": payload,
            "kind": kind,
            "wire": wire,
            "curve": wire == "curve",
            "us_per_frame": took * 1e6,
            "bytes_per_second": delivered / took,
            "time_to_bare": ratio,
            "time_to_bare_range": [low, high],
        }
        lines.append(line)
        print(
            f"N = {services:3} {payload:8} B {wire:5} {kind:13}{took * 1e6:9.0f} µs "
            f"a frame {ratio:7.2f} × bare ({low:.2f} to {high:.2f}) "
            f"{delivered / took / 1e6:9.3g} MB/s",
            flush=True,
        )
    return lines


def main() -> None:
    """What the command line says."""
    if sys.argv[1:2] == ["--echo"]:
        echo(int(sys.argv[2]), *sys.argv[3:])
        return
    if sys.argv[1:2] in (["--bare"], ["--broker"]):
        services, payload, frames = map(int, sys.argv[2:5])
        wire = sys.argv[5]
        if sys.argv[1] == "--bare":
            with TemporaryDirectory() as folder:
                print(bare_loop(services, payload, frames, wire, Path(folder)))
        else:
            measured = measure("hub", services, payload, frames, curve=wire == "curve", ipc=wire == "ipc")
            print(measured.us_per_frame.mean / 1e6)
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
    parser.add_argument("--transport", nargs="+", choices=["tcp", "ipc"], default=["tcp"], help="one or both")
    parser.add_argument("--json", type=Path)
    parser.add_argument("--markdown", type=Path, help="write a table of bare loop and broker there")
    options = parser.parse_args()
    kinds = ["bare", *(kind for kind in options.kinds if kind != "bare")]
    for kind in [k for k in kinds if k in PLAIN and importlib.util.find_spec(PLAIN[k]) is None]:
        print(f"{kind} is left out: pip install {PLAIN[kind]}")
        kinds.remove(kind)
    lines = []
    for wire in ["curve"] if options.curve else options.transport:
        able = [kind for kind in kinds if wire == "tcp" or kind not in PLAIN]
        for payload in options.payload:
            for services in options.services:
                rows: dict[str, list[float]] = {kind: [] for kind in able}
                for _ in range(options.rounds):
                    for kind in able:
                        rows[kind].append(KINDS[kind](services, payload, options.frames, wire))
                lines += report(services, payload, rows, wire)
    if options.json:
        options.json.write_text(json.dumps(lines, indent=2) + "\n")
    if options.markdown:
        options.markdown.write_text(markdown(lines))


def markdown(lines: list[dict[str, Any]]) -> str:
    """A table of the bare loop and the broker for the documentation, from what ``--json`` has."""
    found = {(line["wire"], line["services"], line["payload"], line["kind"]): line for line in lines}
    rows = ["| transport | N | payload | bare loop | broker | to bare | of all rounds |"]
    rows.append("| --- | --- | ---: | ---: | ---: | ---: | ---: |")
    for (wire, services, payload, kind), line in found.items():
        if kind != "broker":
            continue
        bare = found[wire, services, payload, "bare"]["us_per_frame"]
        least, most = line["time_to_bare_range"]
        cells = [wire, f"{services}", f"{payload} B", f"{bare:.0f} µs", f"{line['us_per_frame']:.0f} µs"]
        cells += [f"{line['time_to_bare']:.2f}", f"{least:.2f} to {most:.2f}"]
        rows.append(f"| {' | '.join(cells)} |")
    return "\n".join(rows) + "\n"


if __name__ == "__main__":
    main()
