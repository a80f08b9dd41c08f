"""What mesh detail costs and saves: the ray-traced channel in Munich at several levels.

    python tests/bench/bench_detail.py [--json FILE] [--markdown FILE]

Each level traces the same receivers, around one transmitter above the streets, among cars that move in
every frame; errors are against full detail, in the first frame. NMSE of H is that of all receivers together,
path gains are sums of powers. Each level has a process of its own, so that none meets what another left
in memory; levels take turns, so that what else the machine does slows all of them. Processor time is that of
all threads; −300 dB stands for equal matrices.
"""

# ruff: noqa: T201 - what it measures is printed

from __future__ import annotations

import argparse
import json
import multiprocessing
import re
import time
from collections.abc import Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from caviar_protocol.arrays import BoolArray, Complex128Array, Float64Array
from caviar_protocol.messages import GrantInput, Status
from caviar_protocol.topics import AntennaArray, AntennaDevice, Carrier, Channel, Scene
from caviar_services.channel.sionna.model import SionnaChannel
from caviar_services.channel.sionna.settings import SionnaSettings
from caviar_services.service import Frame, FrameInput, Preparation, RunInfo
from caviar_space.scenery import scenery_assets

STATION = (8.5, 21.0, 27.0)
"""Position of the transmitter [m]."""

SPREAD_M = 70.0
"""Receivers are drawn this far around the station in x and y."""

LEVELS: dict[str, dict[str, Any]] = {
    "full": {"smallest_m": 1e-9},
    "near": {"centre_m": [8.5, 21.0], "radius_m": 250.0},
    "planar": {"tolerance_m": 0.001},
    "decimated": {"tolerance_m": 0.5},
    "near, decimated": {"centre_m": [8.5, 21.0], "radius_m": 250.0, "tolerance_m": 0.5},
    "coarse": {"centre_m": [8.5, 21.0], "radius_m": 150.0, "smallest_m": 25.0, "tolerance_m": 2.0},
}
EQUAL_DB = -299.0
"""[dB] of equal matrices, and less."""


@dataclass(frozen=True, kw_only=True)
class Task:
    """What a process is to do."""

    detail: dict[str, Any]
    settings: dict[str, Any]
    places: Float64Array
    """Of the receivers [m], Shape ``[R, 3]``."""
    cars: int
    frames: int


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """What came of it."""

    prepare_s: float
    effect: str
    times_ms: list[tuple[float, float]]
    """Wall and processor time of frames."""
    channel: Channel
    """Of the first frame."""


def prepared(detail: dict[str, Any], **settings: Any) -> tuple[SionnaChannel, float, tuple[str, ...]]:
    """A model, how long it took to get ready [s], and its notes."""
    assets = {name: file for name, file in scenery_assets("sionna:munich").items() if isinstance(file, Path)}
    run = RunInfo(name="channel", seed=1, carriers=(Carrier(name="c", frequency_hz=28e9),))
    model = SionnaChannel(msgspec.convert({"detail": detail, **settings}, SionnaSettings), run)
    begin = time.perf_counter()
    notes = model.prepare(Preparation(demand={"channel": frozenset({"h"})}, assets=assets)).notes
    return model, time.perf_counter() - begin, notes


def scene(places: Float64Array, cars: int, frame: int = 0) -> Scene:
    """The station, with 8×8 elements, receivers of 4, and cars that go 1 m east in each frame."""
    station = AntennaDevice(name="t", role="tx", position=STATION, array=AntennaArray(rows=8, columns=8))
    receivers = [
        AntennaDevice(name=f"r{i:03d}", role="rx", position=(x, y, z), array=AntennaArray(columns=4))
        for i, (x, y, z) in enumerate(places.tolist())
    ]
    where = np.random.default_rng(9).uniform(-SPREAD_M, SPREAD_M, (cars, 3)) + STATION
    where[:, 2] = 0.75
    return Scene(
        names=tuple(f"car{i:03d}" for i in range(cars)),
        classes=("car",) * cars,
        assets=("",) * cars,
        position=where + np.array([float(frame), 0.0, 0.0]),
        orientation=np.tile([1.0, 0.0, 0.0, 0.0], (cars, 1)),
        velocity=np.tile([10.0, 0.0, 0.0], (cars, 1)),
        dimensions=np.tile([4.5, 1.8, 1.5], (cars, 1)),
        devices=tuple(sorted([station, *receivers], key=lambda device: device.name)),
    )


def traced(model: SionnaChannel, at: Scene) -> Channel:
    source = FrameInput(GrantInput(topic="scene", source="world", status=Status.FRESH), payload=at)
    product = model.step(Frame(episode=0, number=0, t_ns=0, inputs=(source,))).products["channel"]
    assert isinstance(product, Channel)
    return product


def done(task: Task) -> Outcome:
    """Trace one frame, then time some more."""
    model, ready, notes = prepared(task.detail, **{"bodies": task.cars, **task.settings})
    return Outcome(
        prepare_s=ready,
        effect=next((note for note in notes if note.startswith("mesh detail")), "everything"),
        channel=traced(model, scene(task.places, task.cars)),
        times_ms=[taken(model, scene(task.places, task.cars, frame)) for frame in range(task.frames)],
    )


def medians(rounds: list[Outcome]) -> list[float]:
    """Of wall and processor time over all rounds [ms]."""
    times: list[float] = np.median(
        [times for outcome in rounds for times in outcome.times_ms], axis=0
    ).tolist()
    return times


def alone(task: Task) -> Outcome:
    """The same in a process of its own."""
    with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as pool:
        return pool.submit(done, task).result()


def taken(model: SionnaChannel, at: Scene) -> tuple[float, float]:
    """Wall and processor time of a frame [ms]."""
    begin, busy = time.perf_counter(), time.process_time()
    traced(model, at)
    return (time.perf_counter() - begin) * 1e3, (time.process_time() - busy) * 1e3


def gains(channel: Channel) -> Float64Array:
    """Path gain of each receiver, Shape ``[R]``."""
    power = np.concatenate([[0.0], np.cumsum(np.abs(channel.a[0]) ** 2)])
    return np.diff(power[channel.offsets])


def matrices(channel: Channel) -> Complex128Array:
    """H of all receivers, Shape ``[R, 4, 64]``."""
    return np.array([matrix.h for matrix in channel.h])


def compared(reference: Channel, channel: Channel) -> dict[str, float]:
    """Errors of one product against another of the same receivers."""
    h, expected = matrices(channel), matrices(reference)
    found: BoolArray = gains(channel) > 0
    error = 10 * np.log10(gains(channel)[found] / gains(reference)[found])
    of_each = (np.abs(h - expected) ** 2).sum((1, 2)) / (np.abs(expected) ** 2).sum((1, 2))
    total = (np.abs(h - expected) ** 2).sum() / (np.abs(expected) ** 2).sum()
    return {
        "nmse_db": float(10 * np.log10(max(total, 1e-30))),
        "nmse_worst_db": float(10 * np.log10(max(of_each.max(), 1e-30))),
        "path_gain_error_db_median": float(np.median(np.abs(error))),
        "path_gain_error_db_worst": float(np.abs(error).max()),
        "receivers_lost": float((~found).sum()),
        "los_agreement": float((channel.los == reference.los).mean()),
    }


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--receivers", type=int, default=10)
    parser.add_argument("--cars", type=int, default=36)
    parser.add_argument("--frames", type=int, default=20, help="in each round")
    parser.add_argument("--rounds", type=int, default=2)
    parser.add_argument("--settings", type=json.loads, default={}, help="JSON, as in a scenario")
    parser.add_argument("--json", type=Path, help="write the rows here")
    parser.add_argument("--markdown", type=Path, help="where the figures go as a table")
    options = parser.parse_args()

    rng = np.random.default_rng(3)
    places = rng.uniform((-SPREAD_M, -SPREAD_M, 1.5), (SPREAD_M, SPREAD_M, 2.0), (20 * options.receivers, 3))
    places[:, :2] += STATION[:2]
    common = {"settings": options.settings, "cars": options.cars}
    whole = alone(Task(detail=LEVELS["full"], places=places, frames=0, **common)).channel
    places = places[gains(whole) > 0][: options.receivers]  # within buildings nothing is received
    outcomes: dict[str, list[Outcome]] = {name: [] for name in LEVELS}
    for _ in range(options.rounds):
        for name, detail in LEVELS.items():
            task = Task(detail=detail, places=places, frames=options.frames, **common)
            outcomes[name].append(alone(task))
    reference = outcomes["full"][0].channel
    rows = [
        {
            "level": name,
            "detail": LEVELS[name],
            "effect": rounds[0].effect,
            "prepare_s": min(outcome.prepare_s for outcome in rounds),
            **dict(zip(("frame_ms_median", "cpu_ms_median"), medians(rounds), strict=True)),
            "paths": len(rounds[0].channel.tau),
            **compared(reference, rounds[0].channel),
        }
        for name, rounds in outcomes.items()
    ]
    for row in rows:
        print(json.dumps(row, ensure_ascii=False))
    if options.json:
        options.json.write_text(json.dumps(rows, indent=2, ensure_ascii=False) + "\n", "utf-8")
    if options.markdown:
        options.markdown.write_text(as_markdown(rows), "utf-8")


def as_markdown(rows: Sequence[Mapping[str, Any]]) -> str:
    """A table with a line for each level of `LEVELS`."""
    lines = [
        "| detail | what is left | CPU ms | NMSE of H | path gain, worst |",
        "| --- | --- | ---: | ---: | ---: |",
    ]
    for row in rows:
        errors = ["–", "–"]
        if row["level"] != "full":
            is_equal = row["nmse_db"] <= EQUAL_DB
            errors = [
                "equal" if is_equal else f"{row['nmse_db']:.1f} dB",
                f"{row['path_gain_error_db_worst']:.1f} dB",
            ]
        cells = [
            row["level"],
            row["effect"].removeprefix("mesh detail: ").split(";")[0],
            f"{row['cpu_ms_median']:.0f}",
            *errors,
        ]
        lines.append(f"| {' | '.join(cells)} |")
    return re.sub(r"(?<![\w-])-(?=\d)", "−", "\n".join(lines)) + "\n"


if __name__ == "__main__":
    main()
