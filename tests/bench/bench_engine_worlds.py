"""Frames/s of whole runs with the reference worlds of the client libraries, and the latencies of the worlds.

Run as ``python tests/bench/bench_engine_worlds.py [--frames 300] [--rounds 3] [--markdown FILE]``. Each world
plays in one and the same scenario, that of the library for JavaScript: channel `free-space`, LIDAR, link,
agent and recorder, each a process of its own. What a library needs and this machine lacks leaves its row out,
with a word. The rounds take turns, and of each figure the median counts.
"""

# ruff: noqa: T201 - a command that prints what it measured

from __future__ import annotations

import argparse
import json
import shutil
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from tempfile import TemporaryDirectory

from caviar_broker.control.socket import ask
from caviar_protocol.errors import RunError
from caviar_protocol.spec import table

CLIENTS = Path(__file__).resolve().parents[2] / "clients"
SCENARIO = CLIENTS / "js" / "world.toml"
JOIN_S = 60.0
"""Until the run says where it is served."""
Start = Callable[[str, str], list[str]]
"""Command of a world, of the address for ZeroMQ and that for WebSocket."""


def worlds(folder: Path) -> Iterator[tuple[str, Start]]:
    """Worlds that can be started here, by language."""
    yield "Python", lambda zeromq, _: [sys.executable, str(CLIENTS / "python" / "world.py"), zeromq, "world"]
    if compiler := found("g++"):
        program = str(folder / "world")
        source = [str(CLIENTS / "cpp" / "world.cpp"), "-o", program, "-lzmq"]
        subprocess.run([compiler, "-std=c++17", "-O2", *source], check=True)
        yield "C++", lambda zeromq, _: [program, zeromq, "world"]
    if node := found("node"):
        yield "JavaScript, Node", lambda _, web: [node, str(CLIENTS / "js" / "world.mjs"), web, "world"]
    if (compiler := found("mcs")) and (mono := found("mono")):
        library = str(folder / "World.exe")
        sources = [str(CLIENTS / "csharp" / name) for name in ("World.cs", "Caviar.cs")]
        subprocess.run([compiler, f"-out:{library}", *sources], check=True)
        yield "C#, Mono", lambda _, web: [mono, library, web, "world"]
    if godot := found("godot3-server"):
        script = [godot, "--path", str(CLIENTS / "godot"), "-s", "world.gd"]
        yield "Godot 3.2", lambda _, web: [*script, web, "world"]


def found(program: str) -> str | None:
    """Path of a program; says so where there is none."""
    path = shutil.which(program)
    if path is None:
        print(f"{program} is not installed: its world is left out")
    return path


def played(start: Start, frames: int) -> tuple[float, float, float]:
    """Frames/s of a run, and median and 99 % of the world's latency [ms]."""
    with TemporaryDirectory() as folder:
        out = Path(folder)
        command = [sys.executable, "-m", "caviar_clients", "run", str(SCENARIO), "--frames", str(frames)]
        addresses = ["--http", "127.0.0.1:0", "--bind", "tcp://127.0.0.1:0", "--out", folder]
        with quiet([*command, *addresses]) as run:
            try:
                world = quiet(start(*served(out, run)))
                try:
                    status = run.wait(600)
                finally:
                    world.kill()
                    world.wait()
            finally:
                run.kill()
        if status:
            raise SystemExit(f"a run ended with status {status}")
        summary = json.loads(next(out.glob("*/summary.json")).read_text())
        of = summary["services"]["world"]
        return summary["frames_per_second"], of["p50_ms"], of["p99_ms"]


def quiet(command: list[str]) -> subprocess.Popen[bytes]:
    """A process without output."""
    return subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)


def served(out: Path, run: subprocess.Popen[bytes]) -> tuple[str, str]:
    """Addresses of a run that has begun, for ZeroMQ and WebSocket."""
    until = time.monotonic() + JOIN_S
    while time.monotonic() < until and run.poll() is None:
        for directory in out.glob("*/"):
            try:
                status = ask(directory, do="status")["status"]
            except RunError:
                break
            if status.get("http"):
                return status["endpoint"], status["http"].replace("http:", "ws:") + "/ws"
        time.sleep(0.05)
    raise SystemExit("a run did not say where it is served")


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--frames", type=int, default=300)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--markdown", type=Path, help="write the table of the documentation there")
    args = parser.parse_args()
    with TemporaryDirectory() as folder:
        starts = dict(worlds(Path(folder)))
        times: dict[str, list[tuple[float, float, float]]] = {name: [] for name in starts}
        for _ in range(args.rounds):
            for name, start in starts.items():
                times[name].append(played(start, args.frames))
                print(f"{name}: {times[name][-1][0]:.0f} frames/s", flush=True)
    rows = [
        (name, f"{speed:.0f}", f"{median:.1f}", f"{slow:.1f}")
        for name, measured in times.items()
        for speed, median, slow in [tuple(map(statistics.median, zip(*measured, strict=True)))]
    ]
    text = table(("world in", "frames/s of the run", "world, median ms", "world, 99 % ms"), rows)
    print(text)
    if args.markdown:
        args.markdown.write_text(text + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
