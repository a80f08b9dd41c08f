"""Exports per second and core, and their memory, over a dataset of any size.

    .venv/bin/python tests/bench/bench_formats.py --scenes 2000 [--out FILE.md]

Scenes have ten receivers of 8 elements, a transmitter of 64, and 15 paths each. Each format is a process of
its own, whose largest resident memory is that of its export.
"""

# ruff: noqa: T201 - what it measures is printed

from __future__ import annotations

import argparse
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from caviar_clients.datasets.reader import Dataset
from caviar_formats.base import export_users, find_format, markdown_table
from caviar_formats.imports import ImportedScene, Paths, Source, import_dataset
from caviar_protocol.scenario import Carrier
from caviar_protocol.topics import AntennaArray, AntennaDevice

SCENES_OF_EPISODE, RECEIVERS, PATHS = 50, 10, 15
FORMATS = ("npz", "parquet", "sionna", "huggingface", "deepmimo", "ns3-qd")


def scenes(count: int) -> Iterator[ImportedScene]:
    """Scenes of random paths."""
    draw = np.random.default_rng(1)
    names = [f"rx{number}" for number in range(RECEIVERS)]
    bs = AntennaDevice(name="bs", role="tx", position=(0.0, 0.0, 5.0), array=AntennaArray(columns=64))
    for number in range(count):
        devices = [
            AntennaDevice(
                name=name, role="rx", position=tuple(draw.uniform(1, 50, 3)), array=AntennaArray(columns=8)
            )
            for name in names
        ]
        paths = [
            Paths(
                tx="bs", rx=name, los=True, a=draw.normal(size=(1, PATHS)).astype(np.complex128) * 1e-6,
                tau=draw.uniform(3e-7, 9e-7, PATHS), aod=draw.uniform(0, 3, (PATHS, 2)),
                aoa=draw.uniform(0, 3, (PATHS, 2)), points=draw.uniform(0, 9, (PATHS, 3, 3)),
                interactions=np.ones((PATHS, 3), np.uint8),
            )
            for name in names
        ]  # fmt: skip
        episode, scene = divmod(number, SCENES_OF_EPISODE)
        yield ImportedScene(episode=episode, scene=scene, devices=(bs, *devices), paths=paths)


def measure(folder: Path, name: str) -> None:
    """Export, and print scenes a second and the largest memory [MiB]."""
    data = Dataset(folder / "data")
    began, cpu = time.perf_counter(), time.process_time()
    export_users(data.users(), find_format(name), folder / name)
    wall, used = time.perf_counter() - began, time.process_time() - cpu
    count = len(data.table("scenes"))
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    print(f"{count / used:.0f} {count / wall:.0f} {peak:.0f}")


def main() -> None:
    """Make the dataset, and measure each format."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scenes", type=int, default=2000)
    parser.add_argument("--out", type=Path)
    parser.add_argument("--measure", nargs=2, help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.measure:
        measure(Path(given.measure[0]), given.measure[1])
        return
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        source = Source(
            path=Path(folder) / "bench", scenes=scenes(given.scenes), scenes_of_episode=SCENES_OF_EPISODE,
            carriers=(Carrier(name="mm", frequency_hz=60e9),),
        )  # fmt: skip
        import_dataset(source, Path(folder) / "data")
        for name in FORMATS:
            command = [sys.executable, __file__, "--measure", folder, name]
            done = subprocess.run(command, capture_output=True, text=True, check=True)
            rows.append((name, *done.stdout.split()))
    text = markdown_table(("format", "scenes/s of a core", "scenes/s", "largest memory [MiB]"), rows)
    print(text)
    if given.out:
        given.out.write_text(text + "\n")


if __name__ == "__main__":
    main()
