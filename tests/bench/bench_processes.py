"""Processor time of each process of a run, a frame: where the time of a frame goes, on a busy machine too.

    python tests/bench/bench_processes.py street-canyon [--frames N] [--markdown FILE]

Starts `caviar run` and reads what the kernel counted for each thread (``schedstat`` and ``stat`` in
``/proc/PID/task/TID``), from the 30th frame on, when kernels are compiled and caches are warm. The broker
notes when each frame was finished (``latency.npz``), which says how many frames lie between two samples. On
two cores no run is faster than half of the sum allows, nor than its busiest thread. Time in the kernel is
mostly that of sockets and files: what another way of the bytes between processes could save at most.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from collections import Counter, defaultdict
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np

WARM_UP = 30
"""Frames that do not count."""
LAST = 3
"""Frames at the end that do not count: processes end in them."""
PERIOD_S = 0.05
TICK_NS = 1_000_000_000 // os.sysconf("SC_CLK_TCK")
FEWEST_SAMPLES = 10
"""Samples that a measurement needs: a process ends, or is counted, up to a period beside a frame."""


class TooShortError(Exception):
    """A run ended before enough was sampled."""


class Sample(NamedTuple):
    """What was counted at an instant."""

    instant_ns: int
    """Of the monotonic clock, as the broker's."""
    used_ns: Counter[tuple[str, int]]
    """Processor time by process and thread."""
    kernel_ns: Counter[tuple[str, int]]
    """What of it was spent in the kernel."""


def descendants(pid: int) -> Iterator[int]:
    """A process and all that it started."""
    yield pid
    for tasks in Path(f"/proc/{pid}/task").glob("*/children"):
        try:
            children = tasks.read_text().split()
        except OSError:
            continue
        for child in children:
            yield from descendants(int(child))


def name_of(pid: int) -> str:
    """The service that a process is, broker, or launcher."""
    words = Path(f"/proc/{pid}/cmdline").read_text().split("\0")
    if "caviar_services" in words:
        return words[words.index("caviar_services") + 1]
    return "broker" if "caviar_broker" in words else "launcher"


def sampled(pid: int) -> Sample:
    """Threads that end in the meantime are left out."""
    used: Counter[tuple[str, int]] = Counter()
    kernel: Counter[tuple[str, int]] = Counter()
    instant_ns = time.monotonic_ns()
    for process in list(descendants(pid)):
        try:
            name = name_of(process)
            for task in Path(f"/proc/{process}/task").iterdir():
                # Numbers begin after the name of the program, which is in brackets: the 15th is stime.
                ticks = int((task / "stat").read_text().rpartition(")")[2].split()[12])
                used[name, int(task.name)] = int((task / "schedstat").read_text().split()[0])
                kernel[name, int(task.name)] = ticks * TICK_NS
        except OSError:
            continue
    return Sample(instant_ns, used, kernel)


class Measured(NamedTuple):
    """Times of a frame [ms]."""

    by_process: dict[str, float]
    kernel: dict[str, float]
    """What of it was spent in the kernel, by process."""
    busiest: float
    """Of the busiest thread."""
    rate: float
    """[frames/s]"""
    frames: int
    digest: str


def measured(scenario: str, frames: int, folder: Path) -> Measured:
    """Measure a run of a scenario, whose files go below a folder."""
    command = [str(Path(sys.executable).with_name("caviar")), "run", scenario, "--frames", str(frames)]
    command += ["--out", str(folder), "--json", str(folder / "summary.json")]
    run = subprocess.Popen(command, stdout=subprocess.DEVNULL)
    samples = []
    while run.poll() is None:
        samples.append(sampled(run.pid))
        time.sleep(PERIOD_S)
    if run.returncode:
        raise SystemExit(run.returncode)
    (latencies,) = folder.glob("*/latency.npz")
    with np.load(latencies) as arrays:
        finished_ns = arrays["finished_ns"]
    counted = [s for s in samples if finished_ns[WARM_UP] <= s.instant_ns <= finished_ns[-LAST]]
    if len(counted) < FEWEST_SAMPLES:
        raise TooShortError(f"{frames} frames of {scenario} last for {len(counted)} samples of {PERIOD_S} s")
    first, last = counted[0], counted[-1]
    # Within a frame by proportion: a frame of a heavy scenario is longer than the time between samples.
    done = np.interp([first.instant_ns, last.instant_ns], finished_ns, np.arange(len(finished_ns)))
    count = float(done[1] - done[0])
    by_thread = {key: (ns - first.used_ns[key]) / 1e6 / count for key, ns in last.used_ns.items()}
    by_process: defaultdict[str, float] = defaultdict(float)
    kernel: defaultdict[str, float] = defaultdict(float)
    for (name, thread), ms in by_thread.items():
        by_process[name] += ms
        kernel[name] += (last.kernel_ns[name, thread] - first.kernel_ns[name, thread]) / 1e6 / count
    digest = json.loads((folder / "summary.json").read_text())["digest"]
    rate = count / (last.instant_ns - first.instant_ns) * 1e9
    return Measured(by_process, kernel, max(by_thread.values()), rate, round(count), digest)


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("scenario", nargs="?", default="street-canyon")
    parser.add_argument("--frames", type=int, help="default: 150, or ten times as many where these are short")
    parser.add_argument("--markdown", type=Path)
    arguments = parser.parse_args()
    frames = 150 if arguments.frames is None else arguments.frames
    if frames < WARM_UP + 2 * LAST:
        parser.error(f"--frames {frames} leaves nothing after the first {WARM_UP} frames")
    while True:
        with tempfile.TemporaryDirectory() as folder:
            try:
                found = measured(arguments.scenario, frames, Path(folder))
                break
            except TooShortError as error:
                if arguments.frames is not None:
                    parser.error(f"{error}; give more --frames")
                frames *= 10
    table = [
        f"| `{arguments.scenario}`, {found.frames} frames | processor time of a frame, ms | in the kernel |",
        "| --- | ---: | ---: |",
    ]
    for name, ms in sorted(found.by_process.items(), key=lambda item: -item[1]):
        table.append(f"| {name} | {ms:.1f} | {found.kernel[name]:.1f} |")
    totals = (sum(times.values()) for times in (found.by_process, found.kernel))
    table.append(f"| all | {' | '.join(f'{total:.1f}' for total in totals)} |")
    table.append(f"| busiest thread | {found.busiest:.1f} | |")
    sys.stdout.write("\n".join(table) + f"\n{found.rate:.1f} frames/s; digest {found.digest}\n")
    if arguments.markdown:
        arguments.markdown.write_text("## Processes\n\n" + "\n".join(table) + "\n")


if __name__ == "__main__":
    main()
