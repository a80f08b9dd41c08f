"""Processor time of the channel among many bodies, and bodies of many faces, to that of a common street.

    python tests/bench/bench_crowd.py [--frames N] [--markdown FILE]

A station and ten receivers in the street canyon, with 18 cars that move in every frame; then 100 cars and 200
people, with people as bodies and without one; then a car of 10,000 faces, as it is and with `object_faces`.
Cases take turns frame by frame, in one process. Errors of `object_faces` are against the car as it is.
"""

# ruff: noqa: T201 - what it measures is printed

from __future__ import annotations

import argparse
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import msgspec
import numpy as np
from bench_detail import compared, taken, traced

from caviar_protocol.spec import table
from caviar_protocol.topics import AntennaArray, AntennaDevice, Carrier, Scene
from caviar_services.channel.sionna.model import SionnaChannel
from caviar_services.channel.sionna.settings import SionnaSettings
from caviar_services.service import Preparation, RunInfo
from caviar_space.meshes import Mesh, ply
from caviar_space.scenery import scenery_assets

RECEIVERS = 10
FEW, CARS, PEOPLE = 18, 100, 200
ROUND = "objects/round.ply"


@dataclass(frozen=True)
class Case:
    """What stands in the street, and how it is traced."""

    cars: int
    people: int = 0
    mesh: str = ""
    """Of the first car."""
    settings: dict[str, Any] = field(default_factory=dict)


CASES = {
    f"{FEW} cars": Case(FEW),
    f"{CARS} cars, {PEOPLE} people": Case(CARS, PEOPLE),
    "people without a body": Case(CARS, PEOPLE, settings={"without_body": ["pedestrian"]}),
    f"{FEW} cars, one of 10,000 faces": Case(FEW, mesh=ROUND),
    "`object_faces = 500`": Case(FEW, mesh=ROUND, settings={"object_faces": 500}),
}


def round_mesh(steps: int = 72) -> Mesh:
    """A rounded box, Σ|x|⁸ = const, of 2·steps·(steps − 1) faces, within −½ … ½."""
    turn, tilt = np.meshgrid(np.arange(steps) * 2 * np.pi / steps, np.linspace(0, np.pi, steps + 1))
    points = np.stack([np.sin(tilt) * np.cos(turn), np.sin(tilt) * np.sin(turn), np.cos(tilt)], -1) / 2
    at = np.arange(points.shape[0] * steps).reshape(points.shape[0], steps)
    a, b, c, d = at[:-1], np.roll(at, -1, 1)[:-1], np.roll(at, -1, 1)[1:], at[1:]
    faces = np.concatenate(
        [np.stack([a, d, c], -1)[:-1].reshape(-1, 3), np.stack([a, c, b], -1)[1:].reshape(-1, 3)]
    )
    points = points.reshape(-1, 3)
    points /= np.linalg.norm(points, ord=8, axis=1, keepdims=True)
    return Mesh(points / np.ptp(points, axis=0), faces.astype(np.int32))


def scene(case: Case, frame: int) -> Scene:
    """The street in a frame: cars on two lanes, people on both sides, all of them moving."""
    draws = np.random.default_rng(5)
    count = case.cars + case.people
    x, side = draws.uniform(-55.0, 55.0, count), draws.choice([-1.0, 1.0], count)
    is_car = np.arange(count) < case.cars
    x[0], side[0] = -10.0, 1.0  # the car of many faces, beside receivers
    y = side * np.where(is_car, draws.uniform(1.5, 5.0, count), draws.uniform(7.0, 8.5, count))
    dimensions = np.where(is_car[:, None], [4.5, 1.8, 1.5], [0.5, 0.5, 1.75])
    velocity = np.zeros((count, 3))
    velocity[:, 0] = side * np.where(is_car, 10.0, 1.4)
    position = np.stack([x, y, dimensions[:, 2] / 2], -1) + 0.1 * frame * velocity
    station = AntennaDevice(name="bs", role="tx", position=(-40.0, 8.0, 6.0), array=AntennaArray(columns=16))
    receivers = [
        AntennaDevice(
            name=f"rx{i}", role="rx", position=(8.0 * i - 30.0, 0.0, 2.0), array=AntennaArray(columns=2)
        )
        for i in range(RECEIVERS)
    ]
    return Scene(
        names=tuple(f"object{i:03d}" for i in range(count)),
        classes=tuple("car" if car else "pedestrian" for car in is_car),
        assets=(case.mesh, *[""] * (count - 1)),
        position=position,
        orientation=np.tile([1.0, 0.0, 0.0, 0.0], (count, 1)),
        velocity=velocity,
        dimensions=dimensions,
        devices=(station, *receivers),
    )


def prepared(case: Case, folder: Path) -> SionnaChannel:
    """The channel of a case, ready for its frames."""
    assets = {
        name: file
        for name, file in scenery_assets("sionna:simple_street_canyon").items()
        if isinstance(file, Path)
    }
    assets[ROUND] = folder / "round.ply"
    settings = {
        "candidates": "enumerated",
        "refraction": False,
        "bodies": 0,
        "pool": {"box": case.cars + case.people, "round": 1},
        "object_materials": {"pedestrian": "skin"},
        **case.settings,
    }
    run = RunInfo(name="channel", seed=1, carriers=(Carrier(name="c", frequency_hz=28e9),))
    model = SionnaChannel(msgspec.convert(settings, SionnaSettings), run)
    for note in model.prepare(Preparation(demand={"channel": frozenset({"h"})}, assets=assets)).notes:
        print(note)
    return model


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--frames", type=int, default=20)
    parser.add_argument("--markdown", type=Path, help="where the figures go as a table")
    options = parser.parse_args()
    with TemporaryDirectory() as folder:
        (Path(folder) / "round.ply").write_bytes(ply(round_mesh()))
        models = {name: prepared(case, Path(folder)) for name, case in CASES.items()}
    times: dict[str, list[float]] = {name: [] for name in CASES}
    for frame in range(-3, options.frames):
        for name, case in CASES.items():
            busy = taken(models[name], scene(case, frame))[1]
            times[name] += [busy] if frame >= 0 else []  # the first frames compile
        print(f"frame {frame + 1} of {options.frames}", flush=True)
    middle = {name: float(np.median(values)) for name, values in times.items()}
    first, (*_, whole, few) = next(iter(middle.values())), CASES
    errors = [
        compared(*(traced(models[name], scene(CASES[name], frame)) for name in (whole, few)))
        for frame in range(options.frames)
    ]
    rows = [[name, f"{value:.0f}", f"{value / first:.1f}"] for name, value in middle.items()]
    text = table(("in the street", "CPU ms", "ratio"), rows)
    print(text)
    nmse, gain = (max(error[key] for error in errors) for key in ("nmse_db", "path_gain_error_db_worst"))
    print(
        f"object_faces, at worst in {options.frames} frames: NMSE of H {nmse:.1f} dB, gain {gain:.2f} dB off"
    )
    if options.markdown:
        options.markdown.write_text(text + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
