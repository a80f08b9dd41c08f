"""Time and memory of the ray-traced channel: Sionna's street canyon with moving cars.

    python tests/bench/bench_channel.py --frames 1000 --cars 15

Prints wall and processor time of a frame, kernels compiled after the warm-up, and the slope of the
resident memory over the last 80 % of the frames.
"""

# ruff: noqa: T201 - what it measures is printed

from __future__ import annotations

import argparse
import hashlib
import importlib.util
import json
import time
from pathlib import Path

import msgspec
import numpy as np
import psutil

from caviar_protocol.codec import encode_payload
from caviar_protocol.digest import payload_digest
from caviar_protocol.host import install_command
from caviar_protocol.messages import GrantInput, Status
from caviar_protocol.space.coordinates import quaternion_from_euler
from caviar_protocol.topics import AntennaArray, AntennaDevice, Carrier, Scene
from caviar_services.channel.sionna.model import SionnaChannel
from caviar_services.channel.sionna.settings import SionnaSettings
from caviar_services.service import Frame, FrameInput, Preparation, RunInfo

RECEIVERS = 10


def canyon() -> dict[str, Path]:
    """The bundled street canyon as assets."""
    spec = importlib.util.find_spec("sionna")
    if spec is None or spec.origin is None:
        raise SystemExit(f"sionna-rt is not installed; run: {install_command('channel')}")
    folder = Path(spec.origin).parent / "rt" / "scenes" / "simple_street_canyon"
    xml = next(folder.glob("*.xml"))
    meshes = {f"scenery/meshes/{file.name}": file for file in (folder / "meshes").glob("*.ply")}
    return {f"scenery/{xml.name}": xml, **meshes}


class Traffic:
    """Cars on two lanes; some leave for a while and come back."""

    def __init__(self, cars: int) -> None:
        rng = np.random.default_rng(0)
        self._start = rng.uniform(-60, 60, cars)
        self._lane = rng.integers(0, 2, cars)
        self._speed = np.where(self._lane, -1.0, 1.0) * rng.uniform(8, 14, cars)

    def scene(self, frame: int) -> Scene:
        """The scene at 0.1 s a frame."""
        x = (self._start + self._speed * frame * 0.1 + 75) % 150 - 75
        here = np.flatnonzero(np.abs(x) < 70)
        names = tuple(f"car.{i:02d}" for i in here)
        station = AntennaDevice(
            name="bs", role="tx", position=(-30.0, 9.0, 8.0), array=AntennaArray(rows=8, columns=8)
        )
        roofs = tuple(
            AntennaDevice(
                name=f"{name}/rx",
                role="rx",
                parent=name,
                position=(0.0, 0.0, 0.9),
                array=AntennaArray(columns=8),
            )
            for name in names[:RECEIVERS]
        )
        zero = np.zeros(len(here))
        return Scene(
            names=names,
            classes=("car",) * len(here),
            assets=("",) * len(here),
            position=np.stack([x[here], np.where(self._lane[here], 2.0, -2.0), zero + 0.8], axis=1),
            orientation=np.array([quaternion_from_euler(np.pi * lane) for lane in self._lane[here]]),
            velocity=np.stack([self._speed[here], zero, zero], axis=1),
            dimensions=np.tile([4.5, 1.8, 1.6], (len(here), 1)),
            devices=(station, *roofs),
        )


def compiled() -> int:
    """Kernels compiled since the last call, by this process."""
    import drjit as dr

    history = dr.kernel_history([dr.KernelType.JIT])
    dr.kernel_history_clear()
    return sum(not entry["cache_hit"] for entry in history)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--frames", type=int, default=200)
    parser.add_argument("--cars", type=int, default=15)
    parser.add_argument("--settings", type=json.loads, default={}, help="JSON, as in a scenario")
    options = parser.parse_args()

    settings = msgspec.convert({"receivers_at_once": RECEIVERS, **options.settings}, SionnaSettings)
    run = RunInfo(name="channel", seed=1, carriers=(Carrier(name="c", frequency_hz=28e9),))
    model = SionnaChannel(settings, run)
    begin = time.perf_counter()
    prepared = model.prepare(Preparation(demand={"channel": frozenset({"h"})}, assets=canyon()))
    print(f"prepared in {time.perf_counter() - begin:.1f} s: {'; '.join(prepared.notes)}")

    traffic, process = Traffic(options.cars), psutil.Process()
    import drjit as dr

    dr.set_flag(dr.JitFlag.KernelHistory, True)
    wall, cpu, memory, kernels = np.zeros((4, options.frames))
    chain = hashlib.sha256()
    for number in range(options.frames):
        source = FrameInput(
            GrantInput(topic="scene", source="world", status=Status.FRESH), payload=traffic.scene(number)
        )
        frame = Frame(episode=0, number=number, t_ns=number * 100_000_000, inputs=(source,))
        begin, busy = time.perf_counter(), time.process_time()
        result = model.step(frame)
        wall[number] = time.perf_counter() - begin
        cpu[number] = time.process_time() - busy
        kernels[number] = compiled()
        memory[number] = process.memory_info().rss
        chain.update(payload_digest(*encode_payload(result.products["channel"])).encode())
    late = np.arange(options.frames // 5, options.frames)
    slope = np.polyfit(late, memory[late], 1)[0] / 1024
    p50, p99 = np.percentile(wall * 1e3, [50, 99])
    print(f"frame 0: {wall[0] * 1e3:.0f} ms; p50 {p50:.0f} ms, p99 {p99:.0f} ms")
    print(f"processor time p50 {np.median(cpu) * 1e3:.0f} ms")
    print(f"kernels compiled after the warm-up: {kernels.sum():.0f}")
    print(f"memory {memory[-1] / 2**20:.0f} MiB, slope over the last 80 %: {slope:.3f} KB a frame")
    print(f"digest of all frames: {chain.hexdigest()[:16]}")


if __name__ == "__main__":
    main()
