"""Enumerated candidates beside launched ones: how near both come to all paths there are, and their times.

    python tests/bench/bench_enumerated.py [--frequency HZ] [--frames N] [--rays N] [--launches N]
        [--scene street-canyon|uav|munich|crowd|static-canyon|static-munich]
        [--own-rays N] [--own-launches N] [--json FILE]

The reference is the union of ``--launches`` launches of ``--rays`` rays by Sionna RT's own solver and of
``--own-launches`` of ``--own-rays`` by this project (`path_reference`). Each path that the reference lacks,
and each that a channel lacks, is held against every triangle of the scene in float64 (`path_check`): it is
``real``, ``wrong``, or at a ``border``, none by less than 1 mm. ``missing_real_db`` is the strongest real
path that the reference has and a channel has not, relative to all paths of its receiver; ``extra_real``
counts real paths that the reference has not. The figures that begin with ``all`` are against real paths
alone: those of the reference, and those that it lacks; those that begin with ``common`` are over the paths
that both have, so that fields are compared and not what was found. A real path of more than 1 % of a
receiver's power that one of two neighbouring frames lacks ``blinks``.

The two ways take turns frame by frame, and of each frame the shortest time counts. With rays a frame takes a
minute, and Sionna RT's launches some GB for each million of rays.
"""

# ruff: noqa: T201 - a command that prints what it measured

from __future__ import annotations

import argparse
import json
import math
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import bench_follow
import msgspec
import numpy as np
from bench_ladder import world
from path_check import PathCheck
from path_figures import Seen, blinking, compared, described
from path_reference import OwnLaunches, Sionna, paths_of, united
from path_reference import Path as Ray

from caviar_protocol.messages import GrantInput, Status
from caviar_protocol.scenario import DeviceSpec
from caviar_protocol.space.scene import antennas, device_pose
from caviar_protocol.topics import Carrier, Channel, Scene
from caviar_services.channel.sionna.model import SionnaChannel
from caviar_services.channel.sionna.settings import SionnaSettings
from caviar_services.service import Frame, FrameInput, Preparation, RunInfo
from caviar_services.world.assets import object_assets
from caviar_space.scenery import scenery_assets

FREQUENCY_HZ = 28e9

LAUNCHED = 100_000
"""Rays of the launches that enumeration stands beside."""


@dataclass(frozen=True)
class Case:
    """Scenes of moving traffic, and the preparation that a channel service gets before them."""

    run: RunInfo
    preparation: Preparation
    settings: dict[str, Any]
    scenes: tuple[Scene, ...]


def street_canyon(frames: int) -> Case:
    """Frames of the scenario, three frames apart."""
    made = world(5, 3 * frames, 10)
    kept = {"max_depth": 3, "pool": made.settings["pool"]}
    return Case(made.run, made.preparation, kept, made.scenes[::3])


def crowd(frames: int) -> Case:
    """The street canyon with 32 vehicles on two lanes, 30 of which carry receivers."""
    made = world(5, 1, 10)
    scenes = tuple(_crowded(made.scenes[0], frame) for frame in range(frames))
    return Case(made.run, made.preparation, {"max_depth": 3, "bodies": 40}, scenes)


def uav(frames: int) -> Case:
    """The street canyon, its base station on a UAV that flies along above the street."""
    made = world(5, frames, 10)
    kept = {"max_depth": 3, "pool": made.settings["pool"]}
    scenes = tuple(_flown(scene, number) for number, scene in enumerate(made.scenes))
    return Case(replace(made.run, devices=()), made.preparation, kept, scenes)


def _flown(scene: Scene, frame: int) -> Scene:
    place = (-40.0 + 1.0 * frame, 3.0 * math.sin(0.1 * frame), 18.0 + 0.05 * frame)
    devices = tuple(
        msgspec.structs.replace(device, position=place, parent="")
        if device in antennas(scene, "tx")
        else device
        for device in scene.devices
    )
    return msgspec.structs.replace(scene, devices=devices)


def _crowded(scene: Scene, frame: int) -> Scene:
    count, rng = 32, np.random.default_rng(frame)
    lane = np.arange(count) % 2
    of_lane = [next(i for i, name in enumerate(scene.names) if way in name) for way in ("east", "west")]
    kinds = [scene.assets.index(f"objects/{mesh}.ply") for mesh in ("car", "car", "truck", "car")]
    kind = np.array([kinds[i // 2 % len(kinds)] for i in range(count)])
    position = scene.position[kind].copy()
    position[:, 0] = (np.arange(count) // 2 - 7.5) * 11.25 + rng.uniform(0, 3, count) + np.where(lane, -1, 1)
    position[:, 1] = scene.position[of_lane, 1][lane] + rng.normal(0, 0.2, count)
    names = tuple(f"vehicle-{number:02d}" for number in range(count))
    height = scene.dimensions[kind, 2] / 2 + 0.1
    model = antennas(scene, "rx")[0]
    receivers = tuple(
        msgspec.structs.replace(
            model, name=f"{name}/rx", parent=name, position=(0.0, 0.0, float(height[number]))
        )
        for number, name in enumerate(names[:30])
    )
    return Scene(
        names=names,
        classes=tuple(scene.classes[i] for i in kind),
        assets=tuple(scene.assets[i] for i in kind),
        position=position,
        orientation=scene.orientation[of_lane][lane],
        velocity=np.zeros((count, 3)),
        dimensions=scene.dimensions[kind],
        devices=(*antennas(scene, "tx"), *receivers),
    )


def static_canyon(frames: int) -> Case:
    """The street canyon without a body, its receivers where the vehicles carry them."""
    return _emptied(street_canyon(frames))


def static_munich(frames: int) -> Case:
    """The same of Munich."""
    return _emptied(munich(frames))


def _emptied(case: Case) -> Case:
    nothing: dict[str, Any] = {"bodies": 0} if "bodies" in case.settings else {"pool": {}}
    nothing["outside_itu_range"] = "nearest"  # brick, at 60 GHz
    return replace(case, settings=case.settings | nothing, scenes=tuple(map(_without_bodies, case.scenes)))


def _without_bodies(scene: Scene) -> Scene:
    devices = []
    for device in (*antennas(scene, "tx"), *antennas(scene, "rx")):
        pose = device_pose(scene, device)
        devices.append(
            msgspec.structs.replace(
                device, parent="", position=tuple(pose.position), orientation=tuple(pose.orientation)
            )
        )
    return Scene(
        names=(),
        classes=(),
        assets=(),
        position=np.zeros((0, 3)),
        orientation=np.zeros((0, 4)),
        velocity=np.zeros((0, 3)),
        dimensions=np.zeros((0, 3)),
        devices=tuple(devices),
    )


def munich(frames: int) -> Case:
    """A street of Munich with 36 cars, ten of which carry receivers."""
    folder = Path("runs") / "bench-munich"
    assets = {}
    for name, content in {**scenery_assets("sionna:munich"), **object_assets(["car"])}.items():
        if isinstance(content, bytes):
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            (folder / name).write_bytes(content)
            content = folder / name
        assets[name] = content
    station = DeviceSpec(name="bs", kind="antenna", role="tx", position_m=bench_follow.STATION)
    carrier = Carrier(name="mmwave", frequency_hz=FREQUENCY_HZ)
    run = RunInfo(name="channel", seed=1, carriers=(carrier,), devices=(station,))
    scenes = tuple(bench_follow.traffic(10 * frame, 36) for frame in range(frames))
    return Case(run, Preparation(demand={}, assets=assets), {"max_depth": 3, "bodies": 36}, scenes)


CASES = {
    "street-canyon": street_canyon,
    "uav": uav,
    "munich": munich,
    "crowd": crowd,
    "static-canyon": static_canyon,
    "static-munich": static_munich,
}


class Model:
    """A channel, and what its frames took."""

    def __init__(self, case: Case, **settings: Any) -> None:
        own = msgspec.convert({**case.settings, **settings}, SionnaSettings)
        self.channel = SionnaChannel(own, case.run)
        demand = {"channel": frozenset({"h"})}
        began = time.perf_counter()
        self.channel.prepare(Preparation(demand=demand, assets=case.preparation.assets))
        self.prepared_s = time.perf_counter() - began
        self.ms: list[float] = []

    def __call__(self, number: int, scene: Scene) -> Channel:
        provenance = GrantInput(topic="scene", source="world", status=Status.FRESH, frame=number)
        inputs = (FrameInput(provenance, payload=scene),)
        began = time.perf_counter()
        frame = Frame(episode=0, number=number, t_ns=0, previous=number - 1, inputs=inputs)
        product = self.channel.step(frame).products["channel"]
        self.ms.append(1e3 * (time.perf_counter() - began))
        assert isinstance(product, Channel)
        return product


class Reference:
    """What is there, for all that launches find."""

    def __init__(self, case: Case, model: Model, args: argparse.Namespace) -> None:
        self._model, self._depth = model, case.settings["max_depth"]
        self._sionna = Sionna(model.channel, args.rays, args.launches, self._depth)
        self._own: Model | None = None
        if args.own_launches:
            self._own = Model(case, candidates="launched", samples=args.own_rays)
            self._launches = OwnLaunches(self._own.channel, args.own_launches)

    def __call__(self, number: int, scene: Scene) -> tuple[list[list[Ray]], PathCheck]:
        """Paths of each receiver, and what judges others in this scene, which the model has just seen."""
        check = PathCheck(self._model.channel._scene)
        found = self._sionna(scene)
        if self._own is not None:
            more = self._launches(lambda at: self._own(number, at), scene)
            found = [united(known, new) for known, new in zip(found, more, strict=True)]
        return found, check


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--scene", choices=sorted(CASES), nargs="+", default=["street-canyon"])
    parser.add_argument("--frames", type=int, default=20)
    parser.add_argument("--frequency", type=float, help="of the carrier [Hz], if not the scene's own")
    parser.add_argument(
        "--rays", type=int, default=10_000_000, help="of Sionna RT's launches; 0: times alone"
    )
    parser.add_argument("--launches", type=int, default=4, help="of Sionna RT's")
    parser.add_argument("--own-rays", type=int, default=2_000_000, help="of this project's launches")
    parser.add_argument("--own-launches", type=int, default=4, help="of this project's; 0: Sionna RT alone")
    parser.add_argument(
        "--repeat", type=int, default=3, help="times that the frames are timed; 0: not at all"
    )
    parser.add_argument("--json", type=Path)
    parser.add_argument("--markdown", type=Path, help="write the table of the documentation there")
    args = parser.parse_args()
    figures = {name: measured(at_frequency(CASES[name](args.frames), args), args) for name in args.scene}
    if args.json:
        args.json.write_text(json.dumps(figures, indent=1))
    if args.markdown:
        args.markdown.write_text(markdown(figures))


def at_frequency(case: Case, args: argparse.Namespace) -> Case:
    """The case with the carrier that was asked for."""
    if args.frequency is None:
        return case
    carriers = tuple(
        msgspec.structs.replace(carrier, frequency_hz=args.frequency) for carrier in case.run.carriers
    )
    return replace(case, run=replace(case.run, carriers=carriers))


def measured(case: Case, args: argparse.Namespace) -> dict[str, dict[str, float]]:
    """Figures of both ways, printed."""
    models = {
        "enumerated": Model(case, candidates="enumerated"),
        "launched": Model(case, candidates="launched", samples=LAUNCHED),
    }
    for _ in range(args.repeat):
        for number, scene in enumerate(case.scenes):
            for model in models.values():
                model(number, scene)
    figures = {name: timed(model, args.repeat) for name, model in models.items()}
    if args.rays:
        for name, found in accuracy(case, models, args).items():
            figures[name] |= found
    for name, of in figures.items():
        print(f"{name}: " + ", ".join(f"{key} {value:.4g}" for key, value in of.items()))
    if args.repeat:
        ratio = figures["enumerated"]["least_ms"] / figures["launched"]["least_ms"]
        print(f"time of enumerated candidates to that of {LAUNCHED} launched rays: {ratio:.2f}")
    return figures


def markdown(figures: dict[str, dict[str, dict[str, float]]]) -> str:
    """The table for the documentation."""
    columns = (
        "scene | candidates | receivers | time of a frame, as a multiple | NMSE of H, mean dB | median | "
    )
    columns += "within −20 dB | best beams | gain, median dB | strongest missing path dB"
    rows = []
    for scene, of in figures.items():
        for name, f in of.items():
            ratio = f["least_ms"] / of["launched"]["least_ms"] if "least_ms" in f else math.nan
            missing = f["missing_real_db"]
            cells = [
                scene,
                name if name != "launched" else f"launched, {LAUNCHED:,} rays",
                f"{f['receivers']:.0f}",
                f"{ratio:.2f}",
                f"{f['all_nmse_db']:.1f}",
                f"{f['all_median_db']:.1f}",
                f"{100 * f['all_within_20_db']:.1f} %",
                f"{100 * f['all_best_beams']:.1f} %",
                f"{f['all_gain_error_db']:.4f}",
                "none" if missing <= -200 else f"{missing:.1f}",
            ]
            rows.append(" | ".join(cells).replace("-", "−").replace("street−canyon", "street-canyon"))
    lines = [columns, " | ".join(["---"] * 10), *rows]
    return "".join(f"| {line} |\n" for line in lines)


def timed(model: Model, repeat: int) -> dict[str, float]:
    """Times of a model whose frames were played so many times."""
    if not repeat:
        return {"prepared_s": model.prepared_s}
    least = np.array(model.ms).reshape(repeat, -1).min(0)
    return {
        "prepared_s": model.prepared_s,
        "least_ms": float(np.median(least)),
        "p50_ms": float(np.median(model.ms)),
        "p95_ms": float(np.quantile(model.ms, 0.95)),
    }


def accuracy(case: Case, models: dict[str, Model], args: argparse.Namespace) -> dict[str, dict[str, float]]:
    """Figures of models against the reference, over all frames."""
    reference = Reference(case, models["enumerated"], args)
    rows: dict[str, list[dict[str, float]]] = {name: [] for name in models}
    before: dict[str, Seen] = {}
    blinks = dict.fromkeys(models, 0)
    for number, scene in enumerate(case.scenes):
        products = {name: model(number, scene) for name, model in models.items()}
        known, check = reference(number, scene)
        for name, product in products.items():
            notes: list[str] = []
            paths = paths_of(product, scene)
            rows[name] += compared(paths, known, check, notes)
            seen = Seen(scene, paths, check, models[name].channel._names)
            if name in before:
                pieces = models[name].channel._scene
                blinks[name] += blinking(pieces, before[name], seen, notes)
                blinks[name] += blinking(pieces, seen, before[name], notes)
            before[name] = seen
            if name == "enumerated":
                print(f"frame {number}: {described(rows[name])}", *notes, sep="\n  ", flush=True)
    return {name: described(rows[name]) | {"blinks": float(blinks[name])} for name in models}


if __name__ == "__main__":
    main()
