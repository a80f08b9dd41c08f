"""Enumerated candidates beside launched ones: how near both come to Sionna RT, and the time that they take.

    python tests/bench/bench_enumerated.py [--scene street-canyon|munich|crowd] [--frames N] [--rays N]
        [--launches N] [--json FILE]

The reference is Sionna RT's own path solver with ``--rays`` rays from the transmitter, ``--launches`` times,
and the paths that any of these finds: one launch misses some. Its rays point the same way whatever its
seed, so each launch has some more than the one before. Lengths are those of images in float64, since Sionna's
own delays are off by 10⁻⁵ m. The two ways take turns frame by frame, and of each frame the shortest time
counts; with rays a frame takes a minute.

Sionna RT takes planes for one whose rounded normals and offsets agree, and so lacks paths by way of one of
two panels of a roof that hardly differ. ``missing_db`` is the strongest path that the reference has and a
channel has not, relative to all paths of its receiver; ``extra`` counts paths that the reference has not,
and the figures that begin with ``same`` are of receivers without one.
"""

# ruff: noqa: T201 - a command that prints what it measured

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import bench_follow
import msgspec
import numpy as np
from bench_ladder import world

from caviar_protocol.arrays import Complex128Array, Float64Array
from caviar_protocol.coordinates import SPEED_OF_LIGHT, Pose, rotation_matrix
from caviar_protocol.messages import GrantInput, Status
from caviar_protocol.scenario import DeviceSpec
from caviar_protocol.scene import antennas, device_pose
from caviar_protocol.topics import Carrier, Channel, Scene
from caviar_services.channel.sionna_rt import SionnaChannel
from caviar_services.channel.sionna_settings import SionnaSettings
from caviar_services.service import Frame, FrameInput, Preparation, RunInfo
from caviar_services.world.assets import object_assets, scenery_assets

FREQUENCY_HZ = 28e9
SAME_LENGTH = 1e-4
"""[m]; paths of one receiver whose lengths are nearer are one."""

LAUNCHED = 100_000
"""Rays of the launches that enumeration stands beside."""


@dataclass(frozen=True)
class Case:
    """Scenes of moving traffic, and what a channel service is told before them."""

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


CASES = {"street-canyon": street_canyon, "munich": munich, "crowd": crowd}


Reference = tuple[Complex128Array, Float64Array]
"""H of a receiver, and length [m] and power of each of its paths, Shape ``[P, 2]``."""


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


class Sionna:
    """Sionna RT's own path solver in the scene of a model."""

    def __init__(self, model: Model, rays: int, launches: int) -> None:
        import sionna.rt as rt

        self._scene = model.channel._scene
        self._traced = self._scene._scene
        self._rays, self._launches = rays, launches
        self._solver = rt.PathSolver()

    def __call__(self, scene: Scene) -> list[Reference]:
        """H of each receiver, and length [m] and power of each of its paths."""
        import sionna.rt as rt

        (transmitter,), receivers = antennas(scene, "tx"), antennas(scene, "rx")
        traced = self._traced
        for name in (*traced.transmitters, *traced.receivers):
            traced.remove(name)
        traced.tx_array, traced.rx_array = (
            rt.PlanarArray(
                num_rows=device.array.rows,
                num_cols=device.array.columns,
                vertical_spacing=0.5,
                horizontal_spacing=0.5,
                pattern=device.array.pattern,
                polarization="V",
            )
            for device in (transmitter, receivers[0])
        )
        ends = [self._end(scene, device) for device in (transmitter, *receivers)]
        traced.add(rt.Transmitter("tx", position=ends[0][0].tolist(), orientation=ends[0][1]))
        for number, (position, orientation) in enumerate(ends[1:]):
            traced.add(rt.Receiver(f"rx{number:02d}", position=position.tolist(), orientation=orientation))
        found: list[dict[bytes, tuple[float, Complex128Array]]] = [{} for _ in receivers]
        for launch in range(self._launches):
            rays = self._rays + launch * self._rays // 50
            paths = self._solver(
                traced,
                max_depth=3,
                samples_per_src=rays,
                max_num_paths_per_src=2_000_000,
                synthetic_array=True,
                refraction=False,
            )
            self._collect(paths, [end[0] for end in ends], found)
        empty = np.zeros((receivers[0].array.size, transmitter.array.size), np.complex128)
        return [
            (
                sum((h for _, h in of.values()), empty),
                np.array([(length, (np.abs(h) ** 2).sum()) for length, h in of.values()]).reshape(-1, 2),
            )
            for of in found
        ]

    def _end(self, scene: Scene, device: Any) -> tuple[Float64Array, list[float]]:
        """Position [m], relative to the scene's centre, and orientation [rad] of an antenna."""
        pose: Pose = device_pose(scene, device)
        turn = rotation_matrix(pose.orientation)
        yaw, pitch = np.arctan2(turn[1, 0], turn[0, 0]), -np.arcsin(turn[2, 0])
        roll = np.arctan2(turn[2, 1], turn[2, 2])
        return np.array(pose.position) - self._scene.centre, [float(yaw), float(pitch), float(roll)]

    def _collect(
        self,
        paths: Any,
        ends: Sequence[Float64Array],
        found: list[dict[bytes, tuple[float, Complex128Array]]],
    ) -> None:
        a = paths.a[0].numpy() + 1j * paths.a[1].numpy()  # [rx, rx_ant, tx, tx_ant, path]
        kinds = paths.interactions.numpy()[:, :, 0]
        shapes, primitives = (
            column.numpy()[:, :, 0].astype(np.int64) for column in (paths.objects, paths.primitives)
        )
        valid = paths.valid.numpy()[:, 0]
        scene = self._scene
        for receiver, known in enumerate(found):
            rows = np.flatnonzero(valid[receiver])
            used = kinds[:, receiver, rows].T != 0
            triangles = scene.triangle_numbers(shapes[:, receiver, rows].T, primitives[:, receiver, rows].T)
            planes = np.where(used, scene.plane_of[triangles], -1)
            image = np.broadcast_to(ends[0], (len(rows), 3))
            for d in range(used.shape[1]):
                normal, origin = (column[planes[:, d]] for column in (self._normals, self._origins))
                height = ((image - origin) * normal).sum(1, keepdims=True)
                image = np.where(used[:, d, None], image - 2 * height * normal, image)
            length = np.sqrt(((ends[1 + receiver] - image) ** 2).sum(1))
            phase = np.exp(-2j * np.pi * (length * FREQUENCY_HZ / SPEED_OF_LIGHT % 1.0))
            for row, key, long, turn in zip(rows, planes, length.tolist(), phase, strict=True):
                known.setdefault(key.tobytes(), (long, a[receiver, :, 0, :, row] * turn))

    @property
    def _normals(self) -> Float64Array:
        return self._scene.plane_table.normal

    @property
    def _origins(self) -> Float64Array:
        return self._scene.plane_table.origin


def compared(found: Channel, reference: list[Reference]) -> list[list[float]]:
    """Of each receiver that the reference reaches: ‖H − H_ref‖²/‖H_ref‖², error of the gain [dB], whether the
    best beam pair of DFT codebooks is that of the reference, part of the strongest missing path in all power,
    and how many paths the reference has not."""
    rows = []
    for rx, (matrix, (wanted, paths)) in enumerate(zip(found.h, reference, strict=True)):
        power = float((np.abs(wanted) ** 2).sum())
        if not power:
            continue
        error = float((np.abs(matrix.h - wanted) ** 2).sum()) / power
        gain = 10 * np.log10(max(float((np.abs(matrix.h) ** 2).sum()), 1e-300) / power)
        best = [int(np.abs(np.fft.fft2(h)).argmax()) for h in (matrix.h, wanted)]
        lengths = found.tau[found.offsets[rx] : found.offsets[rx + 1]] * SPEED_OF_LIGHT
        same = np.abs(lengths[:, None] - paths[:, 0]) < SAME_LENGTH
        missing = max(paths[~same.any(0), 1].max(initial=0.0) / power, 1e-12)
        extra = int((~same.any(1)).sum())
        rows.append([error, abs(gain), float(best[0] == best[1]), missing, extra])
    return rows


def described(rows: list[list[float]]) -> dict[str, float]:
    """Figures of many receivers."""
    error, gain, beam, missing, extra = np.array(rows).T
    same = error[extra == 0]
    return {
        "nmse_db": float(10 * np.log10(error.mean())),
        "median_db": float(10 * np.log10(np.median(error))),
        "worst_db": float(10 * np.log10(error.max())),
        "within_20_db": float((error < 0.01).mean()),
        "gain_error_db": float(np.median(gain)),
        "best_beams": float(beam.mean()),
        "missing_db": float(10 * np.log10(missing.max())),
        "extra": float(extra.sum()),
        "receivers": len(error),
        "same": len(same),
        "same_nmse_db": float(10 * np.log10(same.mean())) if len(same) else 0.0,
        "same_worst_db": float(10 * np.log10(same.max())) if len(same) else 0.0,
    }


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--scene", choices=sorted(CASES), default="street-canyon")
    parser.add_argument("--frames", type=int, default=20)
    parser.add_argument("--rays", type=int, default=10_000_000, help="of the reference; 0: times alone")
    parser.add_argument("--launches", type=int, default=4)
    parser.add_argument("--repeat", type=int, default=3, help="times that the frames are timed")
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    case = CASES[args.scene](args.frames)
    models = {
        "enumerated": Model(case, candidates="enumerated"),
        "launched": Model(case, candidates="launched", samples=LAUNCHED),
    }
    figures: dict[str, dict[str, float]] = {name: {} for name in models}
    for _ in range(args.repeat):
        for number, scene in enumerate(case.scenes):
            for model in models.values():
                model(number, scene)
    for name, model in models.items():
        least = np.array(model.ms).reshape(args.repeat, -1).min(0)
        figures[name] = {
            "prepared_s": model.prepared_s,
            "least_ms": float(np.median(least)),
            "p50_ms": float(np.median(model.ms)),
            "p95_ms": float(np.quantile(model.ms, 0.95)),
        }
    if args.rays:
        sionna = Sionna(models["enumerated"], args.rays, args.launches)
        rows: dict[str, list[list[float]]] = {name: [] for name in models}
        for number, scene in enumerate(case.scenes):
            products = {name: model(number, scene) for name, model in models.items()}
            models["enumerated"].channel._activate()
            reference = sionna(scene)
            for name, product in products.items():
                rows[name] += compared(product, reference)
            print(f"frame {number}: {described(rows['enumerated'])}", flush=True)
        for name in models:
            figures[name] |= described(rows[name])
    for name, of in figures.items():
        print(f"{name}: " + ", ".join(f"{key} {value:.4g}" for key, value in of.items()))
    ratio = figures["enumerated"]["least_ms"] / figures["launched"]["least_ms"]
    print(f"time of enumerated candidates to that of {LAUNCHED} launched rays: {ratio:.2f}")
    if args.json:
        args.json.write_text(json.dumps(figures, indent=1))


if __name__ == "__main__":
    main()
