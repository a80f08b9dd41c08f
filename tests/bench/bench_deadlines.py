"""How long after a deadline the broker decides, where services are late in every frame.

    python tests/bench/bench_deadlines.py [--frames 500] [--budget-ms 10] [--busy] [--json FILE]

A world is on time; two sensors, one of policy hold, one of drop, answer half a budget too late, always, so
that deadlines of every kind pass: of those that work, and of those that could not be granted the next frame.
``--busy`` keeps as many processes computing as there are cores. Promised (99 of 100): 2 ms on an idle
machine, 5 ms on a busy one; the bare timer of the same minutes is printed beside, which no program can beat.
"""

# ruff: noqa: T201 - a command that prints what it measured

from __future__ import annotations

import argparse
import json
import os
import select
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import zmq

from caviar_broker.core import events as ev
from caviar_broker.core.plan import SECOND, RunPlan, ServicePlan
from caviar_broker.event_loop import raise_priority
from caviar_broker.journal import JournalFile
from caviar_broker.launch import tune_garbage_collector
from caviar_broker.server import BrokerServer
from caviar_broker.statistics import Statistics
from caviar_protocol import messages as m
from caviar_protocol.assets import AssetStore
from caviar_protocol.codec import decode_message, encode_message
from caviar_protocol.digest import payload_digest
from caviar_protocol.messages import Policy

MS = 1_000_000
SENSORS: dict[str, tuple[Policy, str]] = {"holding": ("hold", "lidar"), "dropping": ("drop", "camera")}
BURN = "import time\nuntil = time.monotonic() + {}\nwhile time.monotonic() < until: pass"


def client(name: str, delay_s: float, endpoint: str) -> None:
    """A service that takes so long for every frame."""
    topic = SENSORS[name][1] if name in SENSORS else "scene"
    header, body = b"\x80", bytes(100)
    products = (m.ProductHeader(topic=topic, digest=payload_digest(header, body)),)
    role: m.Role = "sensors" if name in SENSORS else "world"
    inputs = (m.Input(topic="scene"),) if name in SENSORS else ()
    with zmq.Context() as context, context.socket(zmq.DEALER) as socket:
        socket.connect(endpoint)
        version = m.PROTOCOL_VERSION
        socket.send(
            encode_message(m.Hello(version=version, name=name, role=role, inputs=inputs, outputs=(topic,)))
        )
        who: dict[str, Any] = {}
        while True:
            message = decode_message(socket.recv_multipart()[0])
            match message:
                case m.Welcome():
                    who = {"epoch": message.epoch, "attempt": message.attempt}
                case m.Prepare():
                    socket.send(encode_message(m.Ready(**who)))
                case m.Reset():
                    socket.send(encode_message(m.ResetDone(episode=message.episode, **who)))
                case m.Grant():
                    time.sleep(delay_s)
                    at: dict[str, Any] = {"episode": message.episode, "frame": message.frame}
                    socket.send_multipart(
                        [encode_message(m.Done(products=products, **at, **who)), header, body]
                    )
                case m.Shutdown():
                    socket.send(encode_message(m.Bye(**who)))
                    return


class _Silent:
    def notice(self, notice: ev.Notice) -> None:
        """There are many, on purpose."""

    def frame(self, frame: ev.FrameFinished, statistics: Statistics) -> None:
        """Measured by the statistics."""


def measure(frames: int, budget_ms: float) -> np.ndarray:
    """Lateness of every decision [ms]."""
    budget = round(budget_ms * MS)
    plan = RunPlan(
        run="deadlines",
        services=(
            ServicePlan(name="world", role="world", budget_ns=SECOND),
            *(
                ServicePlan(name=name, role="sensors", budget_ns=budget, policy=policy)
                for name, (policy, _) in SENSORS.items()
            ),
        ),
        frames=frames,
        sampling_period_ns=budget,
        record=tuple(topic for _, topic in SENSORS.values()),
    )
    with TemporaryDirectory() as folder, closing(JournalFile(Path(folder) / "journal", 1)) as journal:
        server = BrokerServer(plan, "tcp://127.0.0.1:0", journal, _Silent(), AssetStore(Path(folder) / "a"))
        tune_garbage_collector()
        started = [
            subprocess.Popen([sys.executable, __file__, "--client", name, str(delay), server.endpoint])
            for name, delay in {"world": 0.0, **dict.fromkeys(SENSORS, 1.5e-3 * budget_ms)}.items()
        ]
        try:
            outcome = server.run()
        finally:
            for process in started:
                process.kill()
                process.wait()
        server.statistics.save(Path(folder) / "latency.npz")
        with np.load(Path(folder) / "latency.npz") as saved:
            lateness: np.ndarray = saved["decision_lateness_ns"] / MS
    if outcome.error:
        raise SystemExit(outcome.error)
    return lateness


def bare_timer(budget_ms: float, count: int) -> np.ndarray:
    """Lateness of waking from a wait of the same length [ms]."""
    found = []
    for _ in range(count):
        due = time.monotonic_ns() + round(budget_ms * MS)
        select.select((), (), (), budget_ms / 1e3)
        found.append((time.monotonic_ns() - due) / MS)
    return np.asarray(found)


@contextmanager
def burners(count: int, seconds: float) -> Iterator[None]:
    """That many processes that compute, for so long at most."""
    started = [subprocess.Popen([sys.executable, "-c", BURN.format(seconds)]) for _ in range(count)]
    try:
        yield
    finally:
        for process in started:
            process.kill()
            process.wait()


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--frames", type=int, default=500)
    parser.add_argument("--budget-ms", type=float, default=10.0)
    parser.add_argument("--busy", action="store_true", help="with both cores busy")
    parser.add_argument("--raise_priority", action="store_true", help="scheduled as the broker of a run is")
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    scheduling = raise_priority() if arguments.prefer else "as it is"
    print(f"load of the machine before: {os.getloadavg()[0]:.1f}; scheduling: {scheduling}")
    count = (os.cpu_count() or 1) if arguments.busy else 0
    kinds: dict[str, Callable[[], np.ndarray]] = {
        "decision": lambda: measure(arguments.frames, arguments.budget_ms),
        "bare timer": lambda: bare_timer(arguments.budget_ms, arguments.frames),
    }
    figures = {}
    with burners(count, 120.0):
        for kind, measured in kinds.items():
            late = measured()
            p50, p99 = np.percentile(late, (50, 99))
            figures[kind] = {"count": len(late), "p50_ms": p50, "p99_ms": p99, "max_ms": late.max()}
            print(f"{kind:11} n {len(late)}: p50 {p50:.3f}, p99 {p99:.3f}, worst {late.max():.3f} ms late")
    if arguments.json:
        arguments.json.write_text(json.dumps({"busy": arguments.busy, **figures}, indent=2) + "\n")


if __name__ == "__main__":
    if sys.argv[1:2] == ["--client"]:
        client(sys.argv[2], float(sys.argv[3]), sys.argv[4])
    else:
        main()
