"""How fast the camera service is: pictures, and depth with segmentation, of 640×480 pixels.

Run as ``python tests/bench/bench_camera.py [--scene NAME] [--objects N] [--frames N] [--picture FILE]``.
The scene is one that comes with sionna-rt; cars drive through a street of it, and the camera stands
above the street.
"""

# ruff: noqa: T201 - a command that prints what it measured

from __future__ import annotations

import argparse
import time
from collections.abc import Mapping
from pathlib import Path
from tempfile import TemporaryDirectory

import msgspec
import numpy as np
from bench_lidar import asset_files, traffic

from caviar_protocol.codec import encode_payload
from caviar_protocol.messages import GrantInput, Status
from caviar_protocol.space.coordinates import Pose, compose, quaternion_from_euler
from caviar_protocol.space.scene import object_pose
from caviar_protocol.topics import Camera, CameraDevice, Scene
from caviar_services.sensors.camera import CameraSensors, CameraSettings
from caviar_services.service import Frame, FrameInput, Preparation, RunInfo, StepResult

DEMANDS: dict[str, dict[str, frozenset[str]]] = {
    "RGB": {"camera": frozenset()},
    "depth + segmentation": {"depth": frozenset(), "segmentation": frozenset()},
    "with normals, materials": {"depth": frozenset({"normals"}), "segmentation": frozenset({"materials"})},
    "all": {
        "camera": frozenset(),
        "depth": frozenset({"normals"}),
        "segmentation": frozenset({"materials"}),
    },
}


CENTRE, YAW = (-110.0, -70.0), -0.375
"""Of the traffic, in Munich: a street between two blocks, and the square that it leads to."""


def street(frame: int, count: int, place: Pose) -> Scene:
    """The traffic of the LIDAR's benchmark in a street, below a fixed camera."""
    moved = traffic(frame, count)
    turn = Pose((*CENTRE, 0.0), quaternion_from_euler(YAW))
    poses = [compose(turn, object_pose(moved, index)) for index in range(count)]
    camera = CameraDevice(name="camera", position=place.position, orientation=place.orientation)
    return msgspec.structs.replace(
        moved,
        position=np.array([pose.position for pose in poses]),
        orientation=np.array([pose.orientation for pose in poses]),
        devices=(camera,),
    )


def step(service: CameraSensors, frame: int, scene: Scene) -> tuple[float, int, StepResult]:
    """Time [s] of a step and of encoding its products, their bytes, and the result."""
    provenance = GrantInput(topic="scene", source="world", status=Status.FRESH, frame=frame)
    granted = Frame(episode=0, number=frame, t_ns=0, inputs=(FrameInput(provenance, payload=scene),))
    started = time.perf_counter()
    result = service.step(granted)
    parts = [part for payload in result.products.values() for part in encode_payload(payload)]
    return time.perf_counter() - started, sum(map(len, parts)), result


def measured(assets: Mapping[str, Path], told: argparse.Namespace, what: str) -> StepResult:
    """Print how long frames with this demand take; the result of the last one."""
    service = CameraSensors(CameraSettings(bodies_per_asset=told.objects), RunInfo(name="camera"))
    started = time.perf_counter()
    service.prepare(Preparation(demand=DEMANDS[what], assets=assets))
    ready = time.perf_counter() - started
    place = Pose(tuple(told.position), quaternion_from_euler(*np.radians(told.heading)))
    for frame in range(3):
        step(service, frame, street(frame, told.objects, place))
    results = [step(service, frame, street(frame, told.objects, place)) for frame in range(told.frames)]
    times = 1e3 * np.array([taken for taken, _, _ in results])
    print(
        f"{what:24} {np.median(times):7.1f} ms median, {np.percentile(times, 99):.1f} ms p99, "
        f"{results[-1][1]} B a frame, ready after {ready:.1f} s"
    )
    service.close()
    return results[-1][2]


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scene", default="munich", help="name of a scene of sionna-rt")
    parser.add_argument("--objects", type=int, default=36)
    parser.add_argument("--frames", type=int, default=30)
    parser.add_argument("--position", type=float, nargs=3, default=(-62.0, -84.0, 9.0), help="[m]")
    parser.add_argument("--heading", type=float, nargs=2, default=(160.0, 12.0), help="yaw, pitch [°]")
    parser.add_argument("--picture", type=Path, help="PNG of the last frame")
    told = parser.parse_args()
    with TemporaryDirectory() as folder:
        assets = asset_files(told.scene, Path(folder))
        print(f"{told.scene}, {told.objects} cars, 640×480")
        last = [measured(assets, told, what) for what in DEMANDS]
    if told.picture:
        from matplotlib.image import imsave

        camera = last[0].products["camera"]
        assert isinstance(camera, Camera)
        imsave(told.picture, camera.images[0].rgb)


if __name__ == "__main__":
    main()
