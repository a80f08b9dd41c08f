"""What diffuse scattering costs in the street canyon, and how far two seeds are apart with it.

    python tests/bench/bench_diffuse.py --samples 10000 30000 --paths 500 0 [--json FILE] [--markdown FILE]

Takes scenes of ``street-canyon``, every material with the scattering coefficient that
the trade of speed for accuracy takes (0.4), and steps by turns a channel without diffuse paths and two with
them, which differ in the seed of their launch alone. For each number of rays: median times of a scene, H
included; the median over the scenes of their ratio, and the ratio of processor times, which what else the
machine does changes less; 95 % of users differ by less in path gain; and the share of users whose best pair
of DFT beams is the same. ``other rays`` compares with a launch of 7 % more rays besides another seed: their
directions are all others.
"""

# ruff: noqa: T201 - what it measures is printed

from __future__ import annotations

import argparse
import itertools
import json
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from caviar_clients.session.scenes import Scenes
from caviar_labs.tradeoff.errors import Key, UserChannel, differences, error_fields
from caviar_labs.tradeoff.ladder import Setting
from caviar_labs.tradeoff.scenes import scenes_of
from caviar_labs.tradeoff.worker import Rung

SCENARIO = Path(__file__).parents[2] / "deploy" / "caviar_scenarios" / "street-canyon.toml"
WITHOUT, ONE, OTHER, RAYS = "without", "seed 1", "seed 2", "other rays"


def rungs(scenes: Scenes, samples: int, paths: int, depth: int) -> dict[str, Rung]:
    """The channels that are compared, by name."""
    plain = {"samples": 100_000, "max_depth": depth, "refraction": False, "diffraction": False}
    rough: dict[str, Any] = {"scattering": True, "max_paths": 2_000_000}
    if paths:
        rough["scattering_paths"] = paths
    settings: dict[str, dict[str, Any]] = {
        WITHOUT: {**plain, "scattering": False},
        ONE: {**plain, **rough, "scattering_samples": samples, "launch_seed": 1},
        OTHER: {**plain, **rough, "scattering_samples": samples, "launch_seed": 2},
        RAYS: {**plain, **rough, "scattering_samples": round(samples * 1.07), "launch_seed": 2},
    }
    return {
        name: Rung(
            Setting(label=name, use="sionna-rt", settings=own, scattering="scattering_samples" in own),
            scenes,
            None,
        )
        for name, own in settings.items()
    }


def measured(scenes: Scenes, samples: int, wanted: int, depth: int) -> dict[str, Any]:
    """A row of the table."""
    compared = rungs(scenes, samples, wanted, depth)
    times: dict[str, list[float]] = {name: [] for name in compared}
    processor: dict[str, list[float]] = {name: [] for name in compared}
    users: dict[str, dict[Key, UserChannel]] = {name: {} for name in compared}
    paths = []
    for instant in scenes.instants:
        for name, rung in compared.items():  # in turn: what else the machine does slows all
            begin = time.process_time()
            sample = rung.sample(instant)
            processor[name].append(time.process_time() - begin)
            times[name].append(sample.time_ms)
            users[name].update(sample.users)
            paths += [sample.paths] if name == ONE else []
    for rung in compared.values():
        rung.close()
    return {
        "samples": samples,
        "scattering_paths": wanted,
        "paths": float(np.mean(paths)),
        "without_ms": float(np.median(times[WITHOUT])),
        "with_ms": float(np.median(times[ONE])),
        "factor": float(np.median(np.divide(times[ONE], times[WITHOUT]))),
        "processor_factor": float(np.median(processor[ONE]) / np.median(processor[WITHOUT])),
        "seeds": agreement(users[ONE], users[OTHER]),
        "other_rays": agreement(users[ONE], users[RAYS]),
    }


def agreement(one: Mapping[Key, UserChannel], other: Mapping[Key, UserChannel]) -> dict[str, Any]:
    """How far two channels are apart, over all users that have paths."""
    fields = error_fields(differences(other, one))
    kept = ("users", "path_gain_error_db_p95", "path_gain_bias_db", "beam_top1", "nmse_db")
    return {name: fields[name] for name in kept}


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--samples", type=int, nargs="+", default=[10_000])
    parser.add_argument(
        "--paths", type=int, nargs="+", default=[500], help="of a receiver (scattering_paths); 0: all"
    )
    parser.add_argument("--depth", type=int, default=3, help="interactions of a path at most")
    parser.add_argument("--scenes", type=int, default=25, help="with ten users each")
    parser.add_argument("--json", type=Path, help="write the rows here")
    parser.add_argument("--markdown", type=Path, help="where the figures go as a table")
    options = parser.parse_args(arguments)
    scenes = scenes_of(SCENARIO, options.scenes)
    rows = []
    for samples, paths in itertools.product(options.samples, options.paths):
        rows.append(measured(scenes, samples, paths, options.depth))
        print(json.dumps(rows[-1], ensure_ascii=False), flush=True)
    if options.json:
        options.json.write_text(json.dumps(rows, indent=2, ensure_ascii=False) + "\n", "utf-8")
    if options.markdown:
        options.markdown.write_text(as_markdown(rows, options.depth, options.scenes), "utf-8")


def as_markdown(rows: Sequence[Mapping[str, Any]], depth: int, scenes: int) -> str:
    """A table with a column for each number of paths of a receiver, `rows` being those of `measured`."""
    samples = " and ".join(f"{n:,}" for n in sorted({row["samples"] for row in rows}))
    title = (
        f"street canyon, S = 0.4, 1e5 rays and {samples} for diffuse paths, depth {depth}, {scenes} scenes"
    )
    columns = [
        f"`scattering_paths = {row['scattering_paths']}`" if row["scattering_paths"] else "absent"
        for row in rows
    ]
    lines: dict[str, list[str]] = {
        "paths of a scene": [f"{row['paths']:,.0f}" for row in rows],
        "time of a scene, H included, as a multiple of that without scattering": [
            f"{row['factor']:.1f}" for row in rows
        ],
        "processor time, likewise": [f"{row['processor_factor']:.1f}" for row in rows],
    }
    for label, key in (("two seeds", "seeds"), ("other rays", "other_rays")):
        lines[f"{label}: 95 % of users differ in path gain by less than"] = [
            f"{row[key]['path_gain_error_db_p95']:.2f} dB" for row in rows
        ]
        lines[f"{label}: users with the same best pair of beams"] = [
            f"{100 * row[key]['beam_top1']:.1f} %" for row in rows
        ]
    head = [f"| {title} | {' | '.join(columns)} |", "| --- |" + " ---: |" * len(rows)]
    return "\n".join([*head, *(f"| {name} | {' | '.join(cells)} |" for name, cells in lines.items())]) + "\n"


if __name__ == "__main__":
    main()
