"""How fast the LIDAR service is, in ratio to a bare intersection of the same rays.

Run as ``python tests/bench/bench_lidar.py [--scene NAME] [--objects N] [--frames N]``. The scene is
one that comes with sionna-rt; cars drive through it, and one carries a LIDAR of 64×1,800 rays. The
bare loop intersects rays that are already in Dr.Jit's memory, and fetches distance and face.
"""

# ruff: noqa: T201 - a command that prints what it measured

from __future__ import annotations

import argparse
import time
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from caviar_protocol.codec import encode_payload
from caviar_protocol.messages import GrantInput, Status
from caviar_protocol.space.coordinates import quaternion_from_euler
from caviar_protocol.topics import LidarDevice, Scene
from caviar_services.sensors.base import active_variant
from caviar_services.sensors.lidar import LidarSensors, LidarSettings, ray_directions
from caviar_services.service import Frame, FrameInput, Preparation, RunInfo
from caviar_services.world.assets import object_assets
from caviar_space.scenery import scenery_assets


def traffic(frame: int, count: int) -> Scene:
    """Two lanes of cars that drive against each other; the one in the middle carries the LIDAR."""
    names = tuple(f"car{index:03}" for index in range(count))
    index = np.arange(count)
    carrier = names[count // 2]
    return Scene(
        names=names,
        classes=("car",) * count,
        assets=("objects/car.ply",) * count,
        position=np.stack(
            [
                9.0 * (index - count // 2) + 0.3 * frame * (-1.0) ** index,
                3.0 * (-1.0) ** index,
                np.full(count, 0.8),
            ],
            axis=1,
        ),
        orientation=np.array(
            [quaternion_from_euler(np.pi * (i % 2) + 0.02 * np.sin(frame + i)) for i in index]
        ),
        velocity=np.zeros((count, 3)),
        dimensions=np.tile([4.4, 1.8, 1.5], (count, 1)),
        devices=(LidarDevice(name=f"{carrier}/lidar", parent=carrier, position=(0.0, 0.0, 1.2)),),
    )


def step(service: LidarSensors, frame: int, scene: Scene) -> tuple[float, int, int]:
    """Time [s] of a step and of encoding its product, hits, and bytes of the product."""
    provenance = GrantInput(topic="scene", source="world", status=Status.FRESH, frame=frame)
    granted = Frame(episode=0, number=frame, t_ns=0, inputs=(FrameInput(provenance, payload=scene),))
    started = time.perf_counter()
    product = service.step(granted).products["lidar"]
    header, body = encode_payload(product)
    taken = time.perf_counter() - started
    return taken, len(product.scans[0].ray), len(header) + len(body)  # type: ignore[attr-defined]


def bare(service: LidarSensors, repeats: int) -> float:
    """Median time [s] to intersect the rays of one LIDAR with scenery and bodies."""
    import drjit as dr

    device = LidarDevice(name="bare")
    rays = ray_directions(device.beams, device.azimuth_steps, device.elevation_min, device.elevation_max)
    origin = np.repeat([[0.0], [3.0], [2.8]], rays.shape[1], axis=1)
    reach = np.full(rays.shape[1], device.max_range)
    times = []
    with active_variant(service.variant) as mi:
        columns = [mi.Float(np.ascontiguousarray(row, dtype=np.float32)) for row in (*origin, *rays, reach)]
        dr.eval(columns)
        ray = mi.Ray3f(mi.Point3f(*columns[:3]), mi.Vector3f(*columns[3:6]))
        ray.maxt = columns[6]
        assert service.traced is not None
        parts = [part for part in (service.traced._scenery, service.traced._moving) if part]
        for _ in range(repeats):
            started = time.perf_counter()
            for part in parts:
                hit = part.scene.ray_intersect_preliminary(ray, coherent=True)
                dr.eval(hit.t, hit.prim_index)
                hit.t.numpy()
                hit.prim_index.numpy()
            times.append(time.perf_counter() - started)
    return float(np.median(times))


def asset_files(scene: str, folder: Path) -> dict[str, Path]:
    """Files of a scene of sionna-rt and of a car, by asset name; what is made goes below a folder."""
    assets = {}
    for name, content in {**scenery_assets(f"sionna:{scene}"), **object_assets(["car"])}.items():
        assets[name] = content if isinstance(content, Path) else folder / name
        if isinstance(content, bytes):
            assets[name].parent.mkdir(exist_ok=True)
            assets[name].write_bytes(content)
    return assets


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scene", default="simple_street_canyon", help="name of a scene of sionna-rt")
    parser.add_argument("--objects", type=int, default=15)
    parser.add_argument("--frames", type=int, default=100)
    told = parser.parse_args()
    with TemporaryDirectory() as folder:
        assets = asset_files(told.scene, Path(folder))
        service = LidarSensors(LidarSettings(bodies_per_asset=told.objects), RunInfo(name="lidar"))
        prepared = service.prepare(Preparation(demand={"lidar": frozenset()}, assets=assets))
        print(prepared.notes[0])
        for frame in range(5):
            step(service, frame, traffic(frame, told.objects))
        results = [step(service, frame, traffic(frame, told.objects)) for frame in range(told.frames)]
        times = np.array([taken for taken, _, _ in results])
        floor = bare(service, told.frames)
    rays, median = 64 * 1800, float(np.median(times))
    print(
        f"{told.scene}, {told.objects} cars, {rays} rays, {results[-1][1]} hits, {results[-1][2]} B a frame"
    )
    print(f"frame    {1e3 * median:8.2f} ms median, {1e3 * np.percentile(times, 99):.2f} ms p99")
    print(f"rays     {rays / median:8.2e} a second")
    print(f"bare     {1e3 * floor:8.2f} ms median; ratio {median / floor:.2f}")


if __name__ == "__main__":
    main()
