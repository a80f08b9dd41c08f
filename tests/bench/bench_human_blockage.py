"""What a person in the way takes: as a traced body of skin, and as a screen of TR 38.901's blockage model B.

    python tests/bench/bench_human_blockage.py [--markdown FILE]

A person of 0.3 m × 0.5 m × 1.72 m faces a link of 20 m between antennas at 1.5 m, in its middle, and steps
aside. For each offset and carrier: the loss against free space of the sum of all paths, with a body whose
edges diffract or do not, and with a screen. There is no ground.
"""

# ruff: noqa: T201 - what it measures is printed

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from caviar_labs.stability.lab import (
    Model,
    Thing,
    antenna,
    free_space,
    measure,
    scene,
    sionna,
    total,
)
from caviar_protocol.spec import table

FREQUENCIES = (28e9, 60e9)
SIZE = (0.3, 0.5, 1.72)
TX, RX = (0.0, 0.0, 1.5), (20.0, 0.0, 1.5)
OFFSETS = (0.0, 0.1, 0.2, 0.3, 0.5, 1.0)


def models() -> dict[str, Model]:
    """The channels that are compared, by name."""
    body: dict[str, Any] = {
        "object_materials": {"pedestrian": "skin"},
        "candidates": "launched",
        "bodies": 1,
        "max_depth": 1,
    }
    return {
        "body": sionna(FREQUENCIES, **body),
        "body, edges diffract": sionna(FREQUENCIES, **body, diffraction=True),
        "screen": sionna(
            FREQUENCIES, without_body=["pedestrian"], human_blockage={}, candidates="launched", max_depth=0
        ),
    }


def loss_db(model: Model, offset: float) -> list[float | None]:
    """Against free space on each carrier [dB]; None where there is no path."""
    ends = [antenna("t", "tx", TX), antenna("r", "rx", RX)]
    person = Thing("person", (10.0, offset, SIZE[2] / 2), size=SIZE)
    made = msgspec.structs.replace(scene(ends, [person]), classes=("pedestrian",))
    seen, free = measure(model, made), measure(free_space(*FREQUENCIES), scene(ends))
    found: list[float | None] = []
    for carrier in range(len(FREQUENCIES)):
        ratio = abs(total(seen, carrier)) / abs(total(free, carrier)) if seen.a.shape[1] else 0.0
        found.append(-20 * float(np.log10(ratio)) if ratio else None)
    return found


def cell(loss: float | None) -> str:
    """A loss as the table shows it."""
    # + 0.0: what is but rounding is no negative zero.
    return "no path" if loss is None else f"{round(loss, 1) + 0.0:.1f} dB".replace("-", "−")


def main() -> None:
    """Measure, print, and write the table where asked to."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--markdown", type=Path, help="write the table of the documentation there")
    args = parser.parse_args()
    compared = models()
    losses = {(name, at): loss_db(model, at) for name, model in compared.items() for at in OFFSETS}
    head = ["aside by", *(f"{name}, {f / 1e9:g} GHz" for f in FREQUENCIES for name in compared)]
    rows = [
        [f"{at:g} m", *(cell(losses[name, at][c]) for c in range(len(FREQUENCIES)) for name in compared)]
        for at in OFFSETS
    ]
    text = table(head, rows)
    print(text)
    if args.markdown:
        args.markdown.write_text(text + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
