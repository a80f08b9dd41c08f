"""How soon the broker knows that a service is gone (clause 15), and says how.

    python tests/bench/bench_verdicts.py [--repeat 10]

Promised: 100 ms for a process of the same machine, of which the operating system tells; 1.5 s for one
elsewhere, of which only its connection tells (``timeouts.liveness_s``). One that is alive and makes no
progress is neither: it is blamed after ``timeouts.stall_s``.
"""

# ruff: noqa: T201 - a command that prints what it measured

from __future__ import annotations

import argparse
import os
import signal
import statistics
import subprocess
import sys
import time
from pathlib import Path
from tempfile import TemporaryDirectory

UNIT = Path(__file__).resolve().parents[1] / "unit"
sys.path.insert(0, str(UNIT))

from broker_harness import Client, eventually, plan, serving  # noqa: E402

CASES = [
    ("local", signal.SIGKILL, 0.1),
    ("local", signal.SIGSTOP, 0.1),
    ("remote", signal.SIGKILL, 1.5),
    ("remote", signal.SIGSTOP, 1.5),
]


def verdict(place: str, number: signal.Signals) -> tuple[float, str]:
    """Seconds from the signal until the broker knows, and what it says."""
    peer = [sys.executable, str(UNIT / "broker_peer.py")]
    with (
        TemporaryDirectory() as folder,
        serving(plan("world", "sensors"), Path(folder)) as broker,
        subprocess.Popen([*peer, broker.endpoint, place, "wait"], stdout=subprocess.PIPE) as process,
        Client(broker.endpoint, "sensors") as sensors,
    ):
        try:
            sensors.join()
            sensors.ready()
            sensors.reset()
            assert process.stdout is not None
            process.stdout.readline()  # it is granted a frame
            pulse = broker.server._watchdog._watched["world"]
            eventually(lambda: pulse.heard_at, "its heartbeat connection is known")
            began = time.monotonic()
            os.kill(process.pid, number)
            lost = broker.witness.notices
            eventually(lambda: any(n.kind == "lost" for n in lost), "the loss is known")
            return time.monotonic() - began, next(n.text for n in lost if n.kind == "lost")
        finally:
            process.kill()


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--repeat", type=int, default=10)
    repeat = parser.parse_args().repeat
    for place, number, promised in CASES:
        found = [verdict(place, number) for _ in range(repeat)]
        times = [seconds * 1e3 for seconds, _ in found]
        middle, worst = statistics.median(times), max(times)
        print(f"{number.name} {place}: median {middle:.1f}, worst {worst:.1f} of {promised * 1e3:.0f} ms")
        print(f"    {found[-1][1]}")


if __name__ == "__main__":
    main()
