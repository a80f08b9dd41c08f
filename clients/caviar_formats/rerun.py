"""Format ``rerun``: recordings of Rerun."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from caviar_clients.datasets.user_rows import Users
from caviar_clients.plots.style import SKY, VERMILION
from caviar_formats.viewers import (
    FRAMES,
    LOBE_M,
    TICK_M,
    Moment,
    Viewer,
    camera_pose,
    lobe,
    picture,
    rgb,
    series_text,
)
from caviar_protocol.space.coordinates import Pose
from caviar_space.meshes import Mesh, joined, placed
from caviar_view.world import World


class Rerun(Viewer):
    """Recordings of Rerun."""

    packages = ("rerun",)
    extra = "rerun"

    def write_episode(self, place: Path, world: World, moments: Iterator[Moment]) -> None:
        import rerun as rr

        name = f"{place.parent.name.removesuffix('.part')} {place.name}"
        # By size alone: by default what is logged in 0.2 s is a chunk, each of two kilobytes for a number.
        batches = rr.ChunkBatcherConfig(flush_tick=3600.0)
        stream = rr.RecordingStream(
            "caviar", recording_id=name, send_properties=False, batcher_config=batches
        )
        stream.save(place.with_suffix(".rrd"))
        stream.log("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        for group in world.groups:
            stream.log(
                ["world", "scenery", f"{group.kind} of {group.material}"],
                _rerun_mesh(group.mesh, rgb(group.color)),
                static=True,
            )
        for now in moments:
            stream.set_time("time", duration=np.timedelta64(now.t_ns, "ns"))
            boxes = rr.Boxes3D(
                centers=[pose.position for _, _, pose, _ in now.objects],
                quaternions=[_rerun_turned(pose) for _, _, pose, _ in now.objects],
                sizes=[size for *_, size in now.objects],
                labels=[name for name, *_ in now.objects],
                colors=[rgb(SKY)] * len(now.objects),
            )
            stream.log("world/objects", boxes)
            strips, colors = [points for points, _, _ in now.rays], [color for *_, color in now.rays]
            stream.log("world/rays", rr.LineStrips3D(strips, colors=colors, radii=0.08))
            lobes = [
                Mesh(placed(lobe(device.array, beam), np.ones(3), pose), lobe(device.array, beam).faces)
                for device, pose, beam in now.beams
            ]
            stream.log("world/beams", _rerun_mesh(joined(lobes), [*rgb(VERMILION), 0.4]))
            for scan in now.scans:
                pose = Pose(scan.position, scan.orientation)
                points = np.array(scan.points)  # a copy: Rerun ends the process where memory is not aligned
                stream.log(["world", "lidar", scan.sensor], _rerun_pose(pose), rr.Points3D(points))
            for image in now.images:
                topic, _, pixels = picture(image)
                optics, (height, width) = image.intrinsics, pixels.shape[:2]
                # Pixel centres are at +½ there, too.
                pinhole = rr.Pinhole(
                    focal_length=(optics.fx, optics.fy),
                    principal_point=(optics.cx, optics.cy),
                    resolution=(width, height),
                )
                camera = ["world", "camera", image.sensor]
                stream.log(camera, _rerun_pose(camera_pose(image)), pinhole)
                shown = rr.DepthImage(pixels, meter=1.0) if topic == "depth" else rr.Image(pixels)
                stream.log([*camera, topic], shown)
            for user, values in now.users.items():
                for name, value in values.items():
                    stream.log(["users", *user.split("/"), name], rr.Scalars(value))
        stream.disconnect()

    def readme(self, users: Users) -> str:
        return f"""# {users.dataset.name} for Rerun

`episode-N.rrd`: an episode, with simulated times on the timeline `time`. {FRAMES}

- `world/scenery`: meshes by material.
- `world/objects`: boxes, with names.
- `world/rays`: paths on the first carrier that their pair uses, yellow for the strongest. One whose route is
  not known has a tick of {TICK_M:g} m at either end.
- `world/beams`: amplitudes of the chosen beams without side lobes, {LOBE_M:g} m at the most.
- `world/lidar/SENSOR`: points. `world/camera/CAMERA`: `image`, and `depth` [m].
- `users/RX/TX/CARRIER/NAME`: for plots, without what is not finite,
{series_text()}
"""


def _rerun_turned(pose: Pose) -> list[float]:
    w, *xyz = pose.orientation
    return [*xyz, w]


def _rerun_pose(pose: Pose) -> Any:
    import rerun as rr

    return rr.Transform3D(translation=pose.position, quaternion=_rerun_turned(pose))


def _rerun_mesh(mesh: Mesh, color: list[float]) -> Any:
    import rerun as rr

    return rr.Mesh3D(vertex_positions=mesh.vertices, triangle_indices=mesh.faces, albedo_factor=color)
