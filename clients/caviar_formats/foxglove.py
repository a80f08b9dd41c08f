"""Format ``foxglove``: MCAP with the schemas of Foxglove."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from caviar_clients.datasets.user_rows import Users
from caviar_clients.plots.style import SKY, VERMILION
from caviar_formats.viewers import (
    FRAMES,
    LOBE_M,
    ORIGIN,
    TICK_M,
    WORLD,
    Moment,
    Viewer,
    lobe,
    optical,
    picture,
    projections,
    rgb,
    series_text,
)
from caviar_protocol.arrays import Float64Array
from caviar_protocol.space.coordinates import Pose
from caviar_space.meshes import Mesh
from caviar_view.answers import SERIES
from caviar_view.world import World


class Foxglove(Viewer):
    """MCAP with the schemas of Foxglove, which Foxglove and Lichtblick open, and Rerun in part."""

    packages = ("foxglove",)

    def write_episode(self, place: Path, world: World, moments: Iterator[Moment]) -> None:
        import foxglove

        context = foxglove.Context()
        with foxglove.open_mcap(place.with_suffix(".mcap"), allow_overwrite=True, context=context):
            file = FoxgloveMessages(context)
            for number, now in enumerate(moments):
                file.stamp(now.t_ns)
                if not number:
                    file.scenery(world)
                file.add(now)

    def readme(self, users: Users) -> str:
        return f"""# {users.dataset.name} for Foxglove

`episode-N.mcap`: an episode, with simulated times. Messages have Foxglove's schemas in Protocol Buffers;
those of `/users` are JSON. {FRAMES}

- `/tf`: FrameTransforms of objects in the world, and of devices on their objects.
- `/scenery`: SceneUpdate of the first frame, triangles by material.
- `/objects`: SceneUpdate, a box for each object, with its class.
- `/rays`: SceneUpdate, a line for each path on the first carrier that its pair uses, yellow for the
  strongest; metadata has its gain [dB] there. A path whose route is not known has a tick of {TICK_M:g} m at
  either end.
- `/beams`: SceneUpdate when a beam changes: amplitudes of the chosen beams without side lobes, {LOBE_M:g} m
  at the most.
- `/lidar/SENSOR`: PointCloud in the axes of the sensor, with ranges [m] and the pose of the sensor.
- `/camera/SENSOR/image`, `depth`, `calibration`: RawImage of colours, RawImage of depths [m],
  CameraCalibration.
- `/users/RX/TX/CARRIER`: for plots, without what is not finite,
{series_text()}

`rerun mcap convert` draws transforms, points and pictures of these files.
"""


class FoxgloveMessages:
    """Messages of Foxglove to a file or a server: topics have channels from their first message on.

    Args:
        context: Of the SDK, which the file or the server is of.
    """

    def __init__(self, context: Any) -> None:
        import foxglove
        from foxglove import channels, messages

        self._channel, self._channels, self.fg = foxglove.Channel, channels, messages
        self._context, self._topics = context, dict[str, Any]()
        self._beams: list[tuple[str, int]] | None = None

    def stamp(self, t_ns: int) -> None:
        """Set the time of what follows [ns]."""
        self._t_ns, self._stamp = t_ns, self.fg.Timestamp(*divmod(t_ns, 10**9))

    def scenery(self, world: World) -> None:
        """Show the scenery, and with the next frame all beams again: a viewer that comes has seen nothing."""
        self._beams, entities = None, []
        for group in world.groups:
            about = {"triangles": len(group.mesh.faces), "of": group.of}
            surface = self._surface(group.mesh, rgb(group.color))
            entities.append(self._entity(f"{group.kind} of {group.material}", about, triangles=[surface]))
        self._update("/scenery", entities)

    def add(self, now: Moment) -> None:
        """Show a frame."""
        fg = self.fg
        transforms = [(WORLD, name, pose) for name, _, pose, _ in now.objects] + now.mounts
        self._log("/tf", fg.FrameTransforms(transforms=[self._transform(*each) for each in transforms]))
        boxes = []
        for name, kind, pose, size in now.objects:
            cube = fg.CubePrimitive(
                pose=self._pose(pose), size=self._vector(size), color=self._color(rgb(SKY))
            )
            boxes.append(self._entity(name, {"class": kind}, cubes=[cube]))
        self._update("/objects", boxes)
        lines = []
        for number, (points, gain, color) in enumerate(now.rays):
            line = fg.LinePrimitive(
                type=fg.LinePrimitiveLineType.LineStrip,
                pose=self._pose(ORIGIN),
                thickness=0.15,
                points=self._points(points),
                color=self._color(color),
            )
            lines.append(self._entity(f"path {number}", {"gain_db": f"{gain:.2f}"}, lines=[line]))
        self._update("/rays", lines)
        beams = [(device.name, beam) for device, _, beam in now.beams]
        if beams != self._beams:
            self._beams, lobes = beams, []
            for device, _, beam in now.beams:
                surface = self._surface(lobe(device.array, beam), rgb(VERMILION), 0.4)
                name = f"beam {beam} of {device.name}"
                lobes.append(
                    self._entity(name, {"beam": beam}, device.name, frame_locked=True, triangles=[surface])
                )
            self._update("/beams", lobes)
        for scan in now.scans:
            rows = np.concatenate([scan.points, scan.range[:, None]], axis=1).astype("<f4")
            kind = fg.PackedElementFieldNumericType.Float32
            fields = [
                fg.PackedElementField(name=name, offset=4 * at, type=kind)
                for at, name in enumerate(("x", "y", "z", "range"))
            ]
            cloud = fg.PointCloud(
                timestamp=self._stamp,
                frame_id=WORLD,
                pose=self._pose(Pose(scan.position, scan.orientation)),
                point_stride=16,
                fields=fields,
                data=rows.tobytes(),
            )
            self._log(f"/lidar/{scan.sensor}", cloud)
        lenses = dict[str, Any]()
        for image in now.images:
            topic, encoding, pixels = picture(image)
            height, width = pixels.shape[:2]
            shared: dict[str, Any] = {
                "timestamp": self._stamp,
                "frame_id": optical(image),
                "width": width,
                "height": height,
            }
            step = pixels.strides[0]
            raw = fg.RawImage(**shared, encoding=encoding, step=step, data=pixels.tobytes())
            self._log(f"/camera/{image.sensor}/{topic}", raw)
            k, p = projections(image)
            turned = [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]
            lenses[image.sensor] = fg.CameraCalibration(**shared, K=k, R=turned, P=p)
        for sensor, calibration in lenses.items():
            self._log(f"/camera/{sensor}/calibration", calibration)
        for user, values in now.users.items():
            self._log(f"/users/{user}", values)

    def _log(self, topic: str, message: Any) -> None:
        if topic not in self._topics and isinstance(message, dict):
            numbers = {name: {"type": "number"} for name in (*SERIES, "tx_beam", "rx_beam")}
            schema = {"type": "object", "title": "caviar.User", "properties": numbers}
            self._topics[topic] = self._channel(topic, schema=schema, context=self._context)
        elif topic not in self._topics:
            kind = getattr(self._channels, f"{type(message).__name__}Channel")
            self._topics[topic] = kind(topic, context=self._context)
        self._topics[topic].log(message, log_time=self._t_ns)

    def _update(self, topic: str, entities: list[Any]) -> None:
        # Each message has all of its topic, so that a jump in time shows what there is then.
        fg = self.fg
        gone = [fg.SceneEntityDeletion(timestamp=self._stamp, type=fg.SceneEntityDeletionType.All)]
        self._log(topic, fg.SceneUpdate(deletions=gone, entities=entities))

    def _entity(self, name: str, about: dict[str, Any], frame: str = WORLD, **parts: Any) -> Any:
        pairs = [self.fg.KeyValuePair(key=key, value=str(value)) for key, value in about.items()]
        return self.fg.SceneEntity(timestamp=self._stamp, frame_id=frame, id=name, metadata=pairs, **parts)

    def _surface(self, mesh: Mesh, color: list[float], alpha: float = 1.0) -> Any:
        return self.fg.TriangleListPrimitive(
            pose=self._pose(ORIGIN),
            points=self._points(mesh.vertices),
            color=self._color(color, alpha),
            indices=mesh.faces.ravel().tolist(),
        )

    def _transform(self, parent: str, name: str, pose: Pose) -> Any:
        return self.fg.FrameTransform(
            timestamp=self._stamp,
            parent_frame_id=parent,
            child_frame_id=name,
            translation=self._vector(pose.position),
            rotation=self._turned(pose),
        )

    def _pose(self, pose: Pose) -> Any:
        return self.fg.Pose(position=self._vector(pose.position), orientation=self._turned(pose))

    def _turned(self, pose: Pose) -> Any:
        w, x, y, z = pose.orientation
        return self.fg.Quaternion(x=x, y=y, z=z, w=w)

    def _vector(self, values: Sequence[float]) -> Any:
        x, y, z = values
        return self.fg.Vector3(x=x, y=y, z=z)

    def _points(self, points: Float64Array) -> list[Any]:
        return [self.fg.Point3(x=x, y=y, z=z) for x, y, z in points.tolist()]

    def _color(self, color: list[float], alpha: float = 1.0) -> Any:
        r, g, b = color
        return self.fg.Color(r=r, g=g, b=b, a=alpha)
