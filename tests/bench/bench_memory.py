"""Whether a long run leaks: memory of broker and services over the frames of the real command.

    python tests/bench/bench_memory.py [--scenario smoke] [--frames 10000]
                                       [--service NAME ...] [--limit KB]

Runs ``caviar run`` and samples the resident memory (``VmRSS`` of /proc/PID/status) of the broker and
of services. Frames are recognised by the instants at which the broker finished them (``latency.npz`` of the
run). A line is fitted to the last 80 % of the frames; its slope is printed in KB a frame. Within a frame
the ray tracer takes and frees a hundred megabytes, and a sample meets any moment of it: so the line goes
through the medians of 40 equal spans of frames. With ``--limit`` the status is 1 where one of them is
steeper. Also printed: bytes a frame of the journal.
"""

from __future__ import annotations

import argparse
import re
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

SAMPLE_S = 0.1
TAIL = 0.8
"""Share of the frames that the line is fitted to."""
SPANS = 40
"""Of equal length, each of which gives the line one point."""


@dataclass
class Growth:
    """Memory of one process over the frames of a run."""

    name: str
    instants: list[int] = field(default_factory=list)
    """Of the monotonic clock [ns]."""
    kilobytes: list[int] = field(default_factory=list)

    def slope(self, finished_ns: NDArray[np.int64]) -> float:
        """KB a frame over the last `TAIL` of the frames, by least squares through medians."""
        total = len(finished_ns)
        frames = np.searchsorted(finished_ns, np.array(self.instants))
        span = np.floor((frames / total - (1 - TAIL)) / TAIL * SPANS)
        kilobytes = np.array(self.kilobytes)
        points = np.array(
            [
                (np.median(frames[span == s]), np.median(kilobytes[span == s]))
                for s in range(SPANS)
                if (span == s).any()
            ]
        )
        if len(points) < SPANS // 2:
            raise SystemExit(f"{self.name}: too few samples; run more frames")
        return float(np.polyfit(points[:, 0], points[:, 1], 1)[0])


@dataclass
class Measured:
    """What a run took."""

    growth: list[Growth]
    finished_ns: NDArray[np.int64]
    journal_bytes: int

    def slopes(self) -> dict[str, float]:
        """KB a frame of every process."""
        return {growth.name: growth.slope(self.finished_ns) for growth in self.growth}


def measure(scenario: Path, frames: int, names: list[str], out: Path) -> Measured:
    """Run the command in an empty folder, and watch its processes."""
    command = [sys.executable, "-m", "caviar_clients", "run", str(scenario), "--frames", str(frames)]
    found = {name: Growth(name) for name in ["broker", *names]}
    with subprocess.Popen([*command, "--out", str(out)], stdout=subprocess.DEVNULL) as run:
        while run.poll() is None:
            _sample(run.pid, found)
            try:
                run.wait(SAMPLE_S)
            except subprocess.TimeoutExpired:
                continue
    if run.returncode:
        raise SystemExit(f"the run failed with status {run.returncode}")
    (directory,) = out.glob("*/")
    with np.load(directory / "latency.npz") as figures:
        finished_ns = figures["finished_ns"]
    return Measured(list(found.values()), finished_ns, (directory / "journal.msgpack").stat().st_size)


def _sample(launcher: int, found: dict[str, Growth]) -> None:
    """Note the memory of every process."""
    for pid, command in _children(launcher):
        words = command.split("\0")
        if "caviar_broker" in words:
            name = "broker"
        elif "caviar_services" in words:
            name = words[words.index("caviar_services") + 1]
        else:
            continue
        kilobytes = _resident(pid)
        if name in found and kilobytes:
            found[name].instants.append(time.monotonic_ns())
            found[name].kilobytes.append(kilobytes)


def _children(launcher: int) -> list[tuple[int, str]]:
    found = []
    for folder in Path("/proc").iterdir():
        if folder.name.isdigit():
            try:
                parent = int((folder / "stat").read_text().rpartition(")")[2].split()[1])
                command = (folder / "cmdline").read_text()
            except OSError:
                continue
            if parent == launcher:
                found.append((int(folder.name), command))
    return found


def _resident(pid: int) -> int:
    """Resident memory [KB]; 0 where the process is gone."""
    try:
        status = Path(f"/proc/{pid}/status").read_text()
    except OSError:
        return 0
    match = re.search(r"VmRSS:\s+(\d+) kB", status)
    return int(match[1]) if match else 0


def main() -> int:
    """Measure and print; the exit status."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--scenario", type=Path, default=Path("smoke"))
    parser.add_argument("--frames", type=int, default=10_000)
    parser.add_argument("--service", nargs="*", default=["channel"], help="services to watch")
    parser.add_argument("--limit", type=float, help="greatest slope [KB a frame]")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as out:
        measured = measure(arguments.scenario, arguments.frames, arguments.service, Path(out))
    slopes = measured.slopes()
    for growth in measured.growth:
        kilobytes = growth.kilobytes
        span = f"{kilobytes[0]} → {kilobytes[-1]} KB, {len(kilobytes)} samples"
        sys.stdout.write(f"{growth.name:10} {slopes[growth.name]:+.4f} KB a frame ({span})\n")
    sys.stdout.write(f"journal    {measured.journal_bytes / arguments.frames:.0f} B a frame\n")
    return int(arguments.limit is not None and max(slopes.values()) > arguments.limit)


if __name__ == "__main__":
    sys.exit(main())
