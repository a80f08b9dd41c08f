"""How often the errors hold that the channel `adaptive` states, rung by rung.

    python tests/bench/bench_stated_errors.py [--scene street-canyon|munich] [--seeds N] [--frames N]
        [--rungs 1e4,d2,...] [--every N] [--streams FILE] [--out FILE]

Every seed is traffic of its own, and begins with nothing known. Each frame is computed on every rung and on
the reference, `d3`: all reflections up to the third, enumerated. Errors are the NMSE of H of each receiver.
Every ``--every``-th frame the estimators learn them, as in a run with ``calibrate_every``; in all frames what
they state is held against what was measured. Errors below −60 dB count as −60 dB.

With ``--streams`` the errors are kept in a file, and a second call tries the estimator on those.
"""

# ruff: noqa: T201 - a command that prints what it measured

from __future__ import annotations

import argparse
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import bench_follow
import bench_ladder
import msgspec
import numpy as np
from bench_enumerated import Case, munich
from numpy.typing import NDArray

from caviar_protocol.space.scene import antennas
from caviar_protocol.topics import Scene
from caviar_services.channel.adaptive.calibration import ErrorBound, errors_db, scores_db
from caviar_services.channel.sionna.model import SionnaChannel
from caviar_services.channel.sionna.scene import shared_scenes
from caviar_services.channel.sionna.settings import SionnaSettings
from caviar_services.service import Frame, Preparation

RUNGS: dict[str, dict[str, Any]] = {
    "1e3": {"candidates": "launched", "samples": 1_000},
    "1e4": {"candidates": "launched", "samples": 10_000},
    "1e5": {"candidates": "launched", "samples": 100_000},
    "d1": {"candidates": "enumerated", "max_depth": 1},
    "d2": {"candidates": "enumerated", "max_depth": 2},
}
REFERENCE: dict[str, Any] = {"candidates": "enumerated", "max_depth": 3}

ROW = np.dtype(
    [
        ("seed", "<i4"),
        ("frame", "<i4"),
        ("rung", "<U16"),
        ("receiver", "<U64"),
        ("error", "<f8"),
        ("score", "<f8"),
    ]
)
"""A receiver of a frame on a rung; error and score [dB] are those of `calibration`."""

Rows = NDArray[Any]


def canyon(seed: int, frames: int) -> tuple[Scene, ...]:
    """Traffic of the scenario street-canyon with another seed."""
    return bench_ladder.world(0, frames, 10, seed=seed).scenes


def munich_street(seed: int, frames: int) -> tuple[Scene, ...]:
    """36 cars in a street of Munich, each 0.4 to 1.4 m further from frame to frame."""
    rng = np.random.default_rng(seed)
    first = bench_follow.traffic(0, 36)
    rotation = np.array([_yaw(quaternion) for quaternion in first.orientation])
    along = np.stack([np.cos(rotation), np.sin(rotation), np.zeros(36)], axis=1)
    across = np.stack([-along[:, 1], along[:, 0], along[:, 2]], axis=1)
    speed = rng.uniform(0.4, 1.4, 36)
    begin = rng.uniform(-4, 4, 36)[:, None] * along + rng.normal(0, 0.3, 36)[:, None] * across
    return tuple(
        msgspec.structs.replace(first, position=first.position + begin + frame * speed[:, None] * along)
        for frame in range(frames)
    )


def _yaw(quaternion: Sequence[float]) -> float:
    w, x, y, z = quaternion
    return float(np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z)))


def canyon_case() -> Case:
    made = bench_ladder.world(0, 1, 10)
    return Case(made.run, made.preparation, {"pool": made.settings["pool"]}, made.scenes)


SCENES = {"street-canyon": (canyon_case, canyon), "munich": (lambda: munich(1), munich_street)}


def measured(scene: str, rungs: Sequence[str], seeds: Sequence[int], frames: int) -> Iterator[Rows]:
    """What each frame of each seed shows, one after another."""
    make_case, make_scenes = SCENES[scene]
    case = make_case()
    models = {}
    with shared_scenes():
        for name in (*rungs, "reference"):
            settings = {"max_depth": 3, **case.settings, **RUNGS.get(name, REFERENCE)}
            model = SionnaChannel(msgspec.convert(settings, SionnaSettings), case.run)
            demand = {"channel": frozenset({"h"})}
            model.prepare(Preparation(demand=demand, assets=case.preparation.assets))
            model.with_split = True
            models[name] = model
    for seed in seeds:
        for number, at in enumerate(make_scenes(seed, frames)):
            yield np.array(list(_rows(models, seed, number, at)), ROW)


def _rows(
    models: dict[str, SionnaChannel], seed: int, number: int, scene: Scene
) -> Iterator[tuple[Any, ...]]:
    frame = Frame(episode=0, number=number, t_ns=0)
    ends = antennas(scene, "tx"), antennas(scene, "rx")
    made = {name: model.model(frame, scene, *ends) for name, model in models.items()}
    true = made.pop("reference").channel
    for name, modelled in made.items():
        errors, scores = errors_db(modelled.channel, true), scores_db(modelled)
        for receiver, error, score in zip(true.rx, errors.tolist(), scores.tolist(), strict=True):
            if np.isfinite(error):
                yield (seed, number, name, receiver, error, score)


def collected(arguments: argparse.Namespace) -> Rows:
    """The rows of all frames, with progress and time left on the screen."""
    rungs = arguments.rungs.split(",")
    seeds = range(arguments.first_seed, arguments.first_seed + arguments.seeds)
    total, found, began = arguments.seeds * arguments.frames, [], 0.0
    for count, rows in enumerate(measured(arguments.scene, rungs, seeds, arguments.frames)):
        began = began or time.monotonic()
        found.append(rows)
        if count and count % 10 == 0:
            left = (time.monotonic() - began) / count * (total - count - 1)
            print(f"frame {count + 1} of {total}, {left / 60:.1f} min left", flush=True)
    every = np.concatenate(found)
    if arguments.streams:
        np.save(arguments.streams, every)
    return every


@dataclass
class Coverage:
    """How often the bounds of a rung held, over all seeds."""

    within: list[bool]
    beginning: list[bool]
    """In the first ten frames."""
    excess: list[float]
    """Bounds less errors [dB]."""
    longest: int = 0
    """Longest run of frames in which a receiver's bound did not hold."""

    def described(self) -> list[str]:
        low, high = wilson(sum(self.within), len(self.within))
        return [
            f"{np.mean(self.within):.3f}",
            f"{low:.3f}–{high:.3f}",
            f"{np.mean(self.beginning):.3f}",
            str(self.longest),
            f"{np.mean(self.excess):.1f}",
            f"{np.median(self.excess):.1f}",
        ]


def wilson(successes: int, count: int) -> tuple[float, float]:
    """95 % interval of a binomial share (E. B. Wilson, "Probable inference, the law of succession, and
    statistical inference", JASA 22, 1927)."""
    z, share = 1.96, successes / count
    middle = (share + z * z / (2 * count)) / (1 + z * z / count)
    half = z / (1 + z * z / count) * np.sqrt(share * (1 - share) / count + z * z / (4 * count * count))
    return float(middle - half), float(middle + half)


def judged(rows: Rows, every: int) -> Coverage:
    """What the estimator states of one rung, held against what was measured."""
    found = Coverage([], [], [])
    for seed in np.unique(rows["seed"]):
        bound, misses = ErrorBound(), dict[str, int]()
        of_seed = rows[rows["seed"] == seed]
        for number in np.unique(of_seed["frame"]).tolist():
            now = of_seed[of_seed["frame"] == number]
            pairs, errors, scores = now["receiver"].tolist(), now["error"], now["score"]
            stated = bound.bounds_db(number, pairs, scores)
            within = errors <= stated
            found.within += within.tolist()
            found.excess += (stated - errors).tolist()
            found.beginning += within.tolist() if number < 10 else []
            misses = {
                name: 0 if held else misses.get(name, 0) + 1 for name, held in zip(pairs, within, strict=True)
            }
            found.longest = max(found.longest, *misses.values())
            if number % every == 0:
                bound.check(number, pairs, scores, errors)
    return found


HEAD = (
    "rung",
    "pairs",
    "median NMSE dB",
    "held",
    "95 % interval",
    "first ten frames",
    "longest run of misses",
    "excess dB, mean",
    "median",
)


def table(rows: Rows, every: int) -> str:
    """A line for each rung."""
    lines = ["| " + " | ".join(HEAD) + " |", "| --- |" + " ---: |" * (len(HEAD) - 1)]
    for name in dict.fromkeys(rows["rung"].tolist()):
        of_rung = rows[rows["rung"] == name]
        cells = [f"{len(of_rung):,}", f"{np.median(of_rung['error']):.1f}".replace("-", "−")]
        lines.append("| " + " | ".join([f"`{name}`", *cells, *judged(of_rung, every).described()]) + " |")
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--scene", choices=sorted(SCENES), default="street-canyon")
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--first-seed", type=int, default=1)
    parser.add_argument("--frames", type=int, default=60, help="of each seed")
    parser.add_argument("--rungs", default="d1,d2", help=f"of {', '.join(RUNGS)}")
    parser.add_argument("--every", type=int, default=10, help="frames from one check to the next")
    parser.add_argument("--streams", type=Path, help="file of errors (.npy); read if it is there")
    parser.add_argument("--out", type=Path, help="Markdown file for the table")
    arguments = parser.parse_args()
    rows = (
        np.load(arguments.streams)
        if arguments.streams and arguments.streams.exists()
        else collected(arguments)
    )
    text = table(rows, arguments.every)
    print(text)
    if arguments.out:
        arguments.out.write_text(text + "\n")


if __name__ == "__main__":
    main()
