"""Processor time of each process of a run, a frame: where the time of a frame goes, on a busy machine too.

    python tests/bench/bench_processes.py street-canyon [--frames N] [--markdown FILE]

Starts `caviar run` and reads what the kernel counted for each thread (``/proc/PID/task/TID/schedstat``), from
the 30th frame on, when kernels are compiled and caches are warm. The growing recording shows how far the
run is. On two cores no run is faster than half of the sum allows, nor than its busiest thread.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
import time
from collections import Counter, defaultdict
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

WARM_UP = 30
"""Frames that do not count."""
LAST = 3
"""Frames at the end that do not count: processes end in them."""
PERIOD_S = 0.05


class Sample(NamedTuple):
    """What was counted at an instant."""

    instant_s: float
    recorded: int
    """Bytes of the recording."""
    used_ns: Counter[tuple[str, int]]
    """Processor time by process and thread."""


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


def sampled(pid: int, folder: Path) -> Sample:
    """Threads that end in the meantime are left out."""
    used: Counter[tuple[str, int]] = Counter()
    for process in list(descendants(pid)):
        try:
            name = name_of(process)
            for task in Path(f"/proc/{process}/task").iterdir():
                used[name, int(task.name)] = int((task / "schedstat").read_text().split()[0])
        except OSError:
            continue
    recorded = sum(file.stat().st_size for file in folder.rglob("recording-*.mcap"))
    return Sample(time.monotonic(), recorded, used)


def measured(scenario: str, frames: int, folder: Path) -> tuple[dict[str, float], float, float, int, str]:
    """By process, ms a frame; ms of the busiest thread; frames/s; frames that count; and the digest."""
    command = [str(Path(sys.executable).with_name("caviar")), "run", scenario, "--frames", str(frames)]
    command += ["--out", str(folder), "--json", str(folder / "summary.json")]
    run = subprocess.Popen(command, stdout=subprocess.DEVNULL)
    samples = []
    while run.poll() is None:
        samples.append(sampled(run.pid, folder))
        time.sleep(PERIOD_S)
    if run.returncode:
        raise SystemExit(run.returncode)
    whole = samples[-1].recorded
    first = next(s for s in samples if s.recorded >= whole * WARM_UP / frames)
    last = next(s for s in samples if s.recorded >= whole * (frames - LAST) / frames)
    count = (last.recorded - first.recorded) / whole * frames
    by_thread = {key: (ns - first.used_ns[key]) / 1e6 / count for key, ns in last.used_ns.items()}
    by_process: defaultdict[str, float] = defaultdict(float)
    for (name, _), ms in by_thread.items():
        by_process[name] += ms
    digest = json.loads((folder / "summary.json").read_text())["digest"]
    rate = count / (last.instant_s - first.instant_s)
    return dict(by_process), max(by_thread.values()), rate, round(count), digest


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("scenario", nargs="?", default="street-canyon")
    parser.add_argument("--frames", type=int, default=150)
    parser.add_argument("--markdown", type=Path)
    arguments = parser.parse_args()
    if arguments.frames < WARM_UP + 2 * LAST:
        parser.error(f"--frames {arguments.frames} leaves nothing after the first {WARM_UP} frames")
    with tempfile.TemporaryDirectory() as folder:
        by_process, busiest, rate, count, digest = measured(
            arguments.scenario, arguments.frames, Path(folder)
        )
    rows = [(name, f"{ms:.1f}") for name, ms in sorted(by_process.items(), key=lambda item: -item[1])]
    rows += [("all", f"{sum(by_process.values()):.1f}"), ("busiest thread", f"{busiest:.1f}")]
    title = f"`{arguments.scenario}`, {count} frames"
    table = [f"| {title} | processor time of a frame, ms |", "| --- | ---: |"]
    table += [f"| {name} | {value} |" for name, value in rows]
    sys.stdout.write("\n".join(table) + f"\n{rate:.1f} frames/s; digest {digest}\n")
    if arguments.markdown:
        arguments.markdown.write_text("## Processes\n\n" + "\n".join(table) + "\n")


if __name__ == "__main__":
    main()
