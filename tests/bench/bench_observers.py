"""Frames a second of a scenario with and without observers, in alternating pairs of runs.

    python tests/bench/bench_observers.py [street-canyon] [--observers 3] [--pairs 5] [--frames N]
        [--period S] [--json FILE]

Each observer is a process of its own that gets every product of the newest frame, once in ``--period`` at
most (0.04 s, as pages do; 0: as often as it can), and decodes none. Prints for each pair of runs the frames a
second and the processor time of a frame, in all processes of the run and none of the observers, which says
more on a busy machine; then the ratios, and whether the digests are equal. The exit status is 1 where they
are not.
"""

from __future__ import annotations

import argparse
import json
import os
import socket
import statistics
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any


def free_port() -> int:
    """A port that nothing listens on."""
    with socket.socket() as found:
        found.bind(("127.0.0.1", 0))
        return int(found.getsockname()[1])


def watch(endpoint: str, name: str, period_s: float) -> None:
    """Observe until the run is over, and print how many frames and bytes came."""
    from caviar_protocol.observer import Observer

    frames = size = 0
    with Observer(endpoint, name, timeout_s=120.0, period_s=period_s) as observer:
        for observation in observer:
            frames += bool(observation.products)
            size += sum(product.body.nbytes for product in observation.products.values())
    sys.stdout.write(json.dumps({"frames": frames, "bytes": size}))


def played(arguments: argparse.Namespace, observers: int, folder: Path) -> dict[str, Any]:
    """Summary of one run, and what each of its observers saw."""
    endpoint = f"tcp://127.0.0.1:{free_port()}"
    own = [sys.executable, __file__, "--watch", endpoint, "--period", str(arguments.period), "--name"]
    looking = [
        subprocess.Popen([*own, f"observer {n}"], stdout=subprocess.PIPE, text=True) for n in range(observers)
    ]
    command = [str(Path(sys.executable).with_name("caviar")), "run", arguments.scenario, "--bind", endpoint]
    command += ["--out", str(folder), "--json", str(folder / "summary.json")]
    command += ["--frames", str(arguments.frames)] if arguments.frames else []
    with subprocess.Popen(command, stdout=subprocess.DEVNULL) as process:
        _, status, used = os.wait4(process.pid, 0)
        process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode:
        raise SystemExit(f"{' '.join(command)} ended with status {process.returncode}")
    seen = [json.loads(observer.communicate()[0]) for observer in looking]
    summary = json.loads((folder / "summary.json").read_text())
    cpu_ms = 1e3 * (used.ru_utime + used.ru_stime) / summary["frames"]
    return {"fps": summary["frames_per_second"], "cpu_ms": cpu_ms, "digest": summary["digest"], "seen": seen}


def main() -> int:
    """Measure; the exit status."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("scenario", nargs="?", default="street-canyon")
    parser.add_argument("--observers", type=int, default=3)
    parser.add_argument("--pairs", type=int, default=5)
    parser.add_argument("--frames", type=int, default=0, help="instead of the scenario's")
    parser.add_argument("--period", type=float, default=0.04, help="[s] from one observation to the next")
    parser.add_argument("--json", type=Path)
    parser.add_argument("--watch", help=argparse.SUPPRESS)
    parser.add_argument("--name", help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.watch:
        watch(arguments.watch, arguments.name, arguments.period)
        return 0
    pairs, digests = [], set()
    for number in range(arguments.pairs):
        # Another order each time: what warms up or slows down in the meantime falls on both.
        pair = {}
        for observers in (0, arguments.observers) if number % 2 == 0 else (arguments.observers, 0):
            with tempfile.TemporaryDirectory() as folder:
                pair[observers] = played(arguments, observers, Path(folder))
            digests.add(pair[observers]["digest"])
        alone, observed = pair[0], pair[arguments.observers]
        pairs.append((observed["fps"] / alone["fps"], observed["cpu_ms"] / alone["cpu_ms"]))
        seen = ", ".join(f"{s['frames']} frames, {s['bytes'] / 1e6:.1f} MB" for s in observed["seen"])
        figures = [f"{run['fps']:7.1f} frames/s, {run['cpu_ms']:6.2f} ms" for run in (alone, observed)]
        sys.stdout.write(f"{figures[0]};{figures[1]}; {pairs[-1][0]:.3f}, {pairs[-1][1]:.3f}; {seen}\n")
        sys.stdout.flush()
    speed, cpu = (statistics.median(ratios) for ratios in zip(*pairs, strict=True))
    text = f"{arguments.scenario}, {arguments.observers} observers: median {speed:.3f} of the frames a second"
    text += f", {cpu:.3f} of the processor time; digests {'equal' if len(digests) == 1 else 'DIFFER'}"
    sys.stdout.write(f"{text}\n")
    if arguments.json:
        arguments.json.write_text(json.dumps({"ratios": pairs, "digests": sorted(digests)}))
    return 0 if len(digests) == 1 else 1


if __name__ == "__main__":
    sys.exit(main())
