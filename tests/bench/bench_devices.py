"""The ray tracer on a GPU beside the cores of the same machine: times of frames, and how far results differ.

    python tests/bench/bench_devices.py [--frames N] [--rounds N] [--markdown FILE]

Needs a CUDA device. Each device computes the same frames in a process of its own, and the two take turns; of
each, the round with the lower median counts. Channels are of the street canyon with 15 or 60 moving cars, 10
receivers with 8 antennas and a base station with 64; the LIDAR has 64 × 1800 rays among 15 cars, the camera
640 × 480 pixels among 36 cars in Munich. Of channels the NMSE of all H together is given, and how many paths
one device has and the other has not; of sensors, how many rays or pixels differ by more than 1 mm or 2 of
255 levels.
"""

# ruff: noqa: T201 - what it measures is printed

from __future__ import annotations

import argparse
import os
import re
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import bench_camera
import bench_channel
import bench_lidar
import msgspec
import numpy as np

from caviar_protocol.arrays import Float64Array
from caviar_protocol.messages import GrantInput, Status
from caviar_protocol.space.coordinates import Pose, quaternion_from_euler
from caviar_protocol.topics import Camera, Carrier, Channel, Lidar
from caviar_services.channel.sionna.model import SionnaChannel
from caviar_services.channel.sionna.settings import SionnaSettings
from caviar_services.drjit_setup import cuda_devices
from caviar_services.sensors.camera import CameraSensors, CameraSettings
from caviar_services.sensors.lidar import LidarSensors, LidarSettings
from caviar_services.service import Frame, FrameInput, Preparation, RunInfo

LAUNCHED = {"candidates": "launched"}
CHANNELS: dict[str, tuple[int, dict[str, Any]]] = {
    "enumerated": (15, {}),
    "enumerated, 60 cars": (60, {"bodies": 64}),
    "spherical waves": (15, {"rung": "spherical"}),
    "100,000 rays": (15, LAUNCHED),
    "1,000,000 rays": (15, {**LAUNCHED, "samples": 1_000_000}),
    "10,000,000 rays": (15, {**LAUNCHED, "samples": 10_000_000}),
    "refraction, diffraction": (15, {"refraction": True, "diffraction": True}),
}
"""Number of cars and settings of the channel, by what is computed."""
SENSORS = ("LIDAR", "camera")
EQUAL = 1e-30
"""NMSE of equal matrices, and less."""

Arrays = dict[str, np.ndarray[Any, Any]]


def channel_frames(cars: int, settings: Mapping[str, Any], frames: int) -> Iterator[tuple[float, Arrays]]:
    """Time [s] and arrays of each frame of the street canyon."""
    run = RunInfo(name="channel", seed=1, carriers=(Carrier(name="c", frequency_hz=28e9),))
    at_once = {"receivers_at_once": bench_channel.RECEIVERS, **settings}
    model = SionnaChannel(msgspec.convert(at_once, SionnaSettings), run)
    model.prepare(Preparation(demand={"channel": frozenset({"h"})}, assets=bench_channel.canyon()))
    traffic = bench_channel.Traffic(cars)
    for number in range(frames):
        provenance = GrantInput(topic="scene", source="world", status=Status.FRESH)
        scene = FrameInput(provenance, payload=traffic.scene(number))
        frame = Frame(episode=0, number=number, t_ns=number * 100_000_000, inputs=(scene,))
        begin = time.perf_counter()
        channel = model.step(frame).products["channel"]
        taken = time.perf_counter() - begin
        assert isinstance(channel, Channel)
        h = np.concatenate([matrix.h.ravel() for matrix in channel.h])
        yield taken, {"h": h, "id": channel.id, "offsets": channel.offsets}
    model.close()


def sensor_frames(kind: str, frames: int) -> Iterator[tuple[float, Arrays]]:
    """Time [s] and arrays of each frame of a sensor."""
    scene, cars = ("simple_street_canyon", 15) if kind == "LIDAR" else ("munich", 36)
    with TemporaryDirectory() as folder:
        assets = bench_lidar.asset_files(scene, Path(folder))
        service: Any
        if kind == "LIDAR":
            service = LidarSensors(LidarSettings(bodies_per_asset=cars), RunInfo(name="lidar"))
        else:
            service = CameraSensors(CameraSettings(bodies_per_asset=cars), RunInfo(name="camera"))
        topic = kind.lower()
        service.prepare(Preparation(demand={topic: frozenset()}, assets=assets))
        place = Pose((-62.0, -84.0, 9.0), quaternion_from_euler(*np.radians([160.0, 12.0])))
        for number in range(frames):
            at = (
                bench_lidar.traffic(number, cars)
                if kind == "LIDAR"
                else bench_camera.street(number, cars, place)
            )
            provenance = GrantInput(topic="scene", source="world", status=Status.FRESH, frame=number)
            frame = Frame(episode=0, number=number, t_ns=0, inputs=(FrameInput(provenance, payload=at),))
            begin = time.perf_counter()
            product = service.step(frame).products[topic]
            taken = time.perf_counter() - begin
            if isinstance(product, Lidar):
                ranges = np.full(64 * 1800, np.inf)
                ranges[product.scans[0].ray] = product.scans[0].range
                yield taken, {"range": ranges}
            else:
                assert isinstance(product, Camera)
                yield taken, {"rgb": product.images[0].rgb}
        service.close()


def compute(file: Path, names: Sequence[str], frames: int) -> None:
    """Compute all frames on this process's device, and write times and arrays."""
    found: Arrays = {}
    for name in names:
        several = sensor_frames(name, frames) if name in SENSORS else channel_frames(*CHANNELS[name], frames)
        times = []
        for number, (taken, arrays) in enumerate(several):
            times.append(taken)
            found |= {f"{name}/{number}/{key}": values for key, values in arrays.items()}
        # The first frame compiles, or loads what was compiled.
        found[f"{name}/times"] = np.array(times[1:])
        print(f"  {name}: {1e3 * np.median(times[1:]):.1f} ms", flush=True)
    np.savez(file, **found)  # type: ignore[arg-type]


def medians(rounds: Sequence[Mapping[str, Float64Array]], name: str) -> float:
    """Median time of a frame [ms] of the quickest round."""
    return min(1e3 * float(np.median(found[f"{name}/times"])) for found in rounds)


def difference(ours: Arrays, theirs: Arrays, name: str, frames: int) -> str:
    """How the frames of two devices differ, in words."""

    def pairs(key: str) -> list[tuple[Any, Any]]:
        return [(ours[f"{name}/{n}/{key}"], theirs[f"{name}/{n}/{key}"]) for n in range(frames)]

    if name == "LIDAR":
        # Where neither ray hits anything, infinity less infinity is no number, and no difference.
        with np.errstate(invalid="ignore"):
            differing = sum(int((np.abs(a - b) > 1e-3).sum()) for a, b in pairs("range"))
        return f"{differing} of {frames * 64 * 1800:,} rays"
    if name == "camera":
        differing = sum(int((np.abs(a.astype(int) - b).max(axis=2) > 2).sum()) for a, b in pairs("rgb"))
        return f"{differing} of {frames * 640 * 480:,} pixels"
    error = sum(np.sum(np.abs(a - b) ** 2) for a, b in pairs("h"))
    nmse = 10 * np.log10(max(error / sum(np.sum(np.abs(b) ** 2) for _, b in pairs("h")), EQUAL))
    ids = [[set(_numbered(found, f"{name}/{n}")) for n in range(frames)] for found in (ours, theirs)]
    missed = sum(len(a ^ b) for a, b in zip(*ids, strict=True))
    return f"{nmse:.1f} dB; {missed} of {sum(map(len, ids[1])):,} paths"


def _numbered(found: Arrays, frame: str) -> Iterator[tuple[int, int]]:
    """Pair and id of each path of a frame."""
    offsets = found[f"{frame}/offsets"]
    pair = np.repeat(np.arange(len(offsets) - 1), np.diff(offsets)).tolist()
    yield from zip(pair, found[f"{frame}/id"].tolist(), strict=True)


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--frames", type=int, default=20)
    parser.add_argument("--rounds", type=int, default=2)
    parser.add_argument("--of", nargs="+", choices=[*CHANNELS, *SENSORS], default=[*CHANNELS, *SENSORS])
    parser.add_argument("--markdown", type=Path, help="where the figures go as a table")
    parser.add_argument("--compute", type=Path, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.compute:
        compute(options.compute, options.of, options.frames)
        return
    if options.frames < 2:
        parser.error(
            f"--frames {options.frames}: give 2 at least, since the first one compiles and does not count"
        )
    if not cuda_devices():
        raise SystemExit(
            "no CUDA device answers (nvidia-smi shows whether the driver has one): there is nothing to "
            "compare with"
        )
    rounds: dict[str, list[Arrays]] = {"cpu": [], "gpu": []}
    with TemporaryDirectory() as folder:
        for number in range(options.rounds):
            for device, results in rounds.items():
                print(f"round {number + 1} of {options.rounds}, {device}")
                file = Path(folder) / f"{device}.npz"
                hidden = {"CUDA_VISIBLE_DEVICES": ""} if device == "cpu" else {}
                own = [sys.executable, __file__, "--frames", str(options.frames), "--of", *options.of]
                subprocess.run([*own, "--compute", file], env=os.environ | hidden, check=True)
                with np.load(file) as found:
                    results.append(dict(found))
    lines = [
        "| what is computed | CPU ms | GPU ms | CPU ÷ GPU | difference |",
        "| --- | ---: | ---: | ---: | --- |",
    ]
    for name in options.of:
        cpu, gpu = (medians(rounds[device], name) for device in ("cpu", "gpu"))
        differing = difference(rounds["gpu"][0], rounds["cpu"][0], name, options.frames)
        lines.append(f"| {name} | {cpu:.1f} | {gpu:.1f} | {cpu / gpu:.2f} | {differing} |")
    table = re.sub(r"(?<![\w-])-(?=\d)", "−", "\n".join(lines)) + "\n"
    print(table)
    if options.markdown:
        options.markdown.write_text(table, "utf-8")


if __name__ == "__main__":
    main()
