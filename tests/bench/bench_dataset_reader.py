"""How quickly a dataset is read: scenes and megabytes a second, of one process.

    python tests/bench/bench_dataset_reader.py DATASET [--names channel.h lidar.grid x_m] [--episodes N]

Users are read in batches of 256 in a seeded order, as a training does. Bytes are those of the arrays as they
are delivered. A first pass over the same episodes, not counted, has the files in the page cache: what is
measured is the reader, and a disk that is slower bounds it.
"""

# ruff: noqa: T201 - a command that prints what it measured

from __future__ import annotations

import argparse
import time

import caviar
from caviar_clients.datasets.reader import Dataset

BATCH = 256


def read(data: Dataset, names: list[str], shuffle: int | None) -> tuple[float, int]:
    """Time [s] and bytes of one pass."""
    users = data.users()
    began, size = time.perf_counter(), 0
    for batch in users.batches(BATCH, names, shuffle=shuffle):
        size += sum(batch[name].nbytes for name in names)
    return time.perf_counter() - began, size


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("dataset")
    parser.add_argument("--names", nargs="+", default=["channel.h", "x_m", "y_m", "tx_beam"])
    parser.add_argument("--episodes", type=int, default=200)
    parser.add_argument("--rounds", type=int, default=3)
    options = parser.parse_args()
    data = caviar.dataset(options.dataset)
    data = data.select(data.episodes[: options.episodes])
    scenes = sum(1 for _ in data.scenes())
    read(data, options.names, None)
    for shuffle in (None, 1):
        taken, size = min(read(data, options.names, shuffle) for _ in range(options.rounds))
        order = "in order" if shuffle is None else "shuffled"
        rates = f"{scenes / taken:,.0f} scenes/s, {size / taken / 1e6:,.0f} MB/s"
        print(f"{', '.join(options.names)}, {order}: {rates}")


if __name__ == "__main__":
    main()
