"""What datasets cost: time and space of a scene for each preset, and how many workers pay.

    python tests/bench/bench_datasets.py [--presets s008 …] [--seconds 60] [--markdown FILE]

Episodes of each preset are played by one worker, as ``caviar dataset generate`` does, for about
``--seconds``; the worker's processor time counts. What the command itself does for each episode is measured
apart, by the clock: the Dask scheduler's part by tasks that do nothing, and the rows of the catalogue. With
these times, in their spread, 1 to 10,000 workers are simulated: workers play, the command serves one episode
after the other, and the disk takes so many bytes a second.
"""

# ruff: noqa: T201 - a command that prints what it measured

from __future__ import annotations

import argparse
import heapq
import os
import random
import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import fmean
from typing import Any

from caviar_clients.datasets.catalogue import Catalogue
from caviar_clients.datasets.cluster import Episodes
from caviar_clients.datasets.directory import DatasetDirectory, writing_dataset
from caviar_clients.datasets.episode import EpisodeTask
from caviar_clients.datasets.generate import SharedTraffic
from caviar_clients.datasets.plan import PRESETS, apply_preset, plan_dataset
from caviar_clients.datasets.rows import EpisodeRows
from caviar_clients.session.prepared import prepare

WORKERS = (1, 10, 100, 1000, 10_000)
TASKS_OF_A_WORKER = 30
"""Episodes that each simulated worker plays: enough for a steady state."""


@dataclass(frozen=True)
class Cost:
    """Measured costs of a preset."""

    preset: str
    scenes: int
    """Of an episode."""
    cpu_s: tuple[float, ...]
    """Processor time of each episode, at a worker: what others do on the machine counts little."""
    wall_s: float
    """Of a scene."""
    bytes: float
    """Of a scene."""
    services_s: dict[str, float]
    """Of a scene, by service."""
    catalogue_s: float
    """Of an episode, in the command."""

    @property
    def scene_s(self) -> float:
        return fmean(self.cpu_s) / self.scenes

    @property
    def greatest(self) -> str:
        """What takes most of a scene's time, and its share."""
        parts = {**self.services_s, "set-up of the episode": self.wall_s - sum(self.services_s.values())}
        name = max(parts, key=lambda part: parts[part])
        return f"{name}, {parts[name] / self.wall_s:.0%}"


def measure(name: str, seconds: float, out: Path) -> Cost:
    """Play episodes of a preset at one worker."""
    preset = PRESETS[name]
    scenario = apply_preset(preset, prepare(preset.scenario).scenario)
    plan = plan_dataset(scenario, episodes=preset.episodes)
    directory = DatasetDirectory(out / name)
    traffic = SharedTraffic(plan.scenario)
    many = min(preset.episodes, 60)
    traffic.save(many)
    results = list[tuple[EpisodeRows, dict[str, Any]]]()
    catalogue_s = list[float]()
    with writing_dataset(directory), Episodes(1) as episodes:
        catalogue = Catalogue(directory.catalogue, writable=True)
        ends = time.monotonic() + 3600.0

        def tasks() -> Iterator[EpisodeTask]:
            for number in range(many):
                if number > 2 and time.monotonic() > ends:
                    return
                yield EpisodeTask(
                    plan.scenario, number, str(directory.path), cached=traffic.states_of(number)
                )

        for result in episodes.play(tasks()):
            if result.rows is None:
                raise SystemExit(f"{name}, episode {result.episode}: {result.error}")
            results.append((result.rows, result.measured))
            if len(results) == 1:  # it loads and compiles
                ends = time.monotonic() + seconds
            began = time.perf_counter()
            catalogue.add(result.rows, result.measured)
            catalogue_s.append(time.perf_counter() - began)
        catalogue.close()
    warm = results[1:] or results
    played = len(warm) * preset.scenes
    services: dict[str, float] = {}
    for _, measured in warm:
        for service, taken in measured["services_s"].items():
            services[service] = services.get(service, 0.0) + taken / played
    return Cost(
        preset=name,
        scenes=preset.scenes,
        cpu_s=tuple(measured["cpu_s"] for _, measured in warm),
        wall_s=sum(measured["wall_s"] for _, measured in warm) / played,
        bytes=sum(rows.episode[4] for rows, _ in warm) / played,
        services_s=services,
        catalogue_s=fmean(catalogue_s[1:] or catalogue_s),
    )


def dispatch_s(tasks: int = 500) -> float:
    """Time of the command and the scheduler for a task that does nothing [s]."""
    with Episodes(1) as episodes:
        client = episodes._connected
        client.gather(client.map(_same, range(10), pure=False))
        began = time.perf_counter()
        client.gather([client.submit(_same, number, pure=False) for number in range(tasks)])
        return (time.perf_counter() - began) / tasks


def _same(number: int) -> int:
    return number


def disk_bytes_per_s(folder: Path, size: int = 256 << 20) -> float:
    """What the disk takes, in files that are synced [B/s]."""
    block = os.urandom(1 << 20)
    began = time.perf_counter()
    with tempfile.NamedTemporaryFile(dir=folder) as file:
        for _ in range(size >> 20):
            file.write(block)
        file.flush()
        os.fsync(file.fileno())
    return size / (time.perf_counter() - began)


def simulate(cost: Cost, workers: int, serve_s: float, disk: float) -> float:
    """Scenes a second of so many workers.

    A worker plays an episode, writes it, and waits until the command has served its result and sent the next;
    disk and command serve one after the other, in the order in which workers come.
    """
    draw = random.Random(workers)
    write_s = cost.bytes * cost.scenes / disk
    ready = [(draw.choice(cost.cpu_s) * draw.random(), worker) for worker in range(workers)]
    heapq.heapify(ready)
    disk_free = command_free = 0.0
    ends = list[float]()
    for _ in range(workers * TASKS_OF_A_WORKER):
        now, worker = heapq.heappop(ready)
        disk_free = max(disk_free, now) + write_s
        command_free = max(command_free, disk_free) + serve_s
        ends.append(command_free)
        heapq.heappush(ready, (command_free + draw.choice(cost.cpu_s), worker))
    # The first third fills the queues, the last one empties them.
    first, last = len(ends) // 3, 2 * len(ends) // 3
    return (last - first) * cost.scenes / (ends[last] - ends[first])


def bottleneck(cost: Cost, workers: int, serve_s: float, disk: float) -> str:
    """What bounds so many workers."""
    rates = {
        "workers": workers / fmean(cost.cpu_s),
        "command": 1.0 / serve_s,
        "disk": disk / (cost.bytes * cost.scenes),
    }
    return min(rates, key=lambda name: rates[name])


def tables(costs: Sequence[Cost], dispatch: float, disk: float) -> str:
    """Both tables, as Markdown."""
    lines = [
        "## Cost of scenes",
        "",
        "| preset | processor s a scene | kB a scene | 1e6 scenes | 1e9 scenes | most of the time |",
        "| --- | ---: | ---: | ---: | ---: | --- |",
    ]
    for cost in costs:
        million = cost.scene_s * 1e6 / 3600, cost.bytes * 1e6 / 1e12
        totals = " | ".join(
            f"{million[0] * more:,.0f} core-hours, {million[1] * more:,.2f} TB" for more in (1, 1000)
        )
        lines.append(
            f"| `{cost.preset}` | {cost.scene_s:.3f} | {cost.bytes / 1e3:.0f} | {totals} | {cost.greatest} |"
        )
    heads = " | ".join(f"{workers:,} worker{'s' * (workers > 1)}" for workers in WORKERS)
    lines += [
        "",
        "## Scenes a second",
        "",
        f"| preset | {heads} | command, ms an episode |",
        "| --- |" + " ---: |" * (len(WORKERS) + 1),
    ]
    for cost in costs:
        serve_s = dispatch + cost.catalogue_s
        cells = " | ".join(
            f"{simulate(cost, workers, serve_s, disk):,.1f} ({bottleneck(cost, workers, serve_s, disk)})"
            for workers in WORKERS
        )
        lines.append(f"| `{cost.preset}` | {cells} | {serve_s * 1e3:.1f} |")
    lines += ["", f"A disk that takes {disk / 1e6:.0f} MB/s; the scheduler {dispatch * 1e3:.2f} ms a task."]
    return "\n".join(lines) + "\n"


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--presets", nargs="+", choices=list(PRESETS), default=list(PRESETS))
    parser.add_argument("--seconds", type=float, default=60.0, help="of each preset, about")
    parser.add_argument("--markdown", type=Path)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        dispatch, disk = dispatch_s(), disk_bytes_per_s(Path(folder))
        costs = []
        for name in options.presets:
            costs.append(measure(name, options.seconds, Path(folder)))
            cost = costs[-1]
            print(
                f"{name}: {cost.scene_s:.3f} s, {cost.bytes / 1e3:.0f} kB a scene, {cost.greatest}",
                flush=True,
            )
    text = tables(costs, dispatch, disk)
    print(text)
    if options.markdown:
        options.markdown.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
