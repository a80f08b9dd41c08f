"""Pinhole cameras: topics ``camera``, ``depth`` and ``segmentation``."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Annotated, Any, ClassVar

import msgspec
import numpy as np

from caviar_protocol.arrays import Float32Array, Float64Array, Payload, quantity
from caviar_protocol.errors import PayloadError, ScenarioError
from caviar_protocol.space.coordinates import Pose
from caviar_protocol.topics import (
    Camera,
    CameraDevice,
    CameraImage,
    Depth,
    DepthImage,
    Intrinsics,
    Scene,
    Segmentation,
    SegmentationImage,
)
from caviar_protocol.topics.scene import Device
from caviar_services.sensors.base import Sensors, SensorSettings, pose_outside, turned
from caviar_services.sensors.shading import Colour, Painter, View, object_colour, shape_colour
from caviar_services.sensors.traced_scene import NO_HIT, Hits, TracedScene, visible_names
from caviar_services.service import Preparation, Prepared

FAR = float(np.finfo(np.float32).max)
"""[m]; a camera sees however far."""


class CameraSettings(SensorSettings, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Settings of the camera service."""

    body_material: str = "metal"
    """Material of moving objects in a segmentation; that of the channel model."""
    colours: dict[str, Colour] = msgspec.field(default_factory=dict)
    """sRGB, 0…1, by name of a material or class: ``colours = { marble = [0.9, 0.8, 0.7] }``."""
    sun_azimuth_deg: Annotated[
        float, quantity("°", "where the sun stands, counter-clockwise from +x")
    ] = -55.0
    sun_elevation_deg: Annotated[float, quantity("°", "of the sun above the horizon", ge=-90, le=90)] = 45.0


@dataclass(frozen=True, eq=False)
class _Look:
    """One camera at one instant."""

    device: CameraDevice
    optics: Intrinsics
    pose: Pose

    @property
    def rays(self) -> Float64Array:
        """Unit vectors through the pixels' centres in device axes, Shape ``[3, H·W]``."""
        return pixel_rays(self.device.width, self.device.height, self.optics)

    @property
    def fields(self) -> dict[str, Any]:
        """What every image says of its camera."""
        return {
            "sensor": self.device.name,
            "intrinsics": self.optics,
            "position": self.pose.position,
            "orientation": self.pose.orientation,
        }

    def image(self, pixels: Any) -> Any:
        """Values by pixel, Shape ``[H·W, …]``, as an image."""
        return pixels.reshape(self.device.height, self.device.width, *pixels.shape[1:])


class CameraSensors(Sensors[CameraSettings]):
    """All cameras of the scene: topics ``camera``, ``depth`` and ``segmentation``.

    What is not in demand is not computed: neither a topic, nor part ``normals`` of ``depth``, nor part
    ``materials`` of ``segmentation`` (clause 5). Normals point to the camera's side of a surface. As
    for a LIDAR, every object of the scene is solid, the camera's own carrier too.
    """

    outputs: ClassVar[tuple[str, ...]] = ("camera", "depth", "segmentation")
    uses_scenery: ClassVar[bool] = True
    Settings: ClassVar[type[msgspec.Struct]] = CameraSettings

    def prepare(self, preparation: Preparation) -> Prepared:
        """See `Sensors.prepare`; `ScenarioError` where a colour is none."""
        for name, colour in self.settings.colours.items():
            if not all(0 <= value <= 1 for value in colour):
                raise ScenarioError(
                    f"colour {list(colour)} of {name!r} is not sRGB; give red, green and blue from 0 to 1",
                    key=f"services.{self.run.name}.settings.colours.{name}",
                )
        self._demand = preparation.demand
        return super().prepare(preparation)

    def example_devices(self) -> tuple[Device, ...]:
        """One small camera at the origin."""
        return (CameraDevice(name="warm-up", width=8, height=6),)

    def observe(self, mi: Any, traced: TracedScene, scene: Scene) -> dict[str, Payload]:
        """One image of each camera on each topic that is in demand."""
        devices = sorted(
            (d for d in scene.devices if isinstance(d, CameraDevice)), key=lambda device: device.name
        )
        looks = [_Look(device, intrinsics(device), pose_outside(traced, scene, device)) for device in devices]
        products: dict[str, Payload] = {}
        if "camera" in self._demand:
            products["camera"] = self._pictures(mi, traced, scene, looks)
        if self._demand.keys() & {"depth", "segmentation"}:
            hits = [_traced(mi, traced, look) for look in looks]
            if "depth" in self._demand:
                products["depth"] = self._depth(traced, looks, hits)
            if "segmentation" in self._demand:
                products["segmentation"] = self._segmentation(traced, looks, hits)
        return products

    def _pictures(self, mi: Any, traced: TracedScene, scene: Scene, looks: list[_Look]) -> Camera:
        azimuth = math.radians(self.settings.sun_azimuth_deg)
        elevation = math.radians(self.settings.sun_elevation_deg)
        sun = np.array(
            [
                math.cos(elevation) * math.cos(azimuth),
                math.cos(elevation) * math.sin(azimuth),
                math.sin(elevation),
            ]
        )
        painter = Painter(mi, traced, self._albedo(traced, scene), sun)
        return Camera(
            images=tuple(
                CameraImage(
                    **look.fields,
                    rgb=painter.paint(View(look.device.width, look.device.height, look.optics, look.pose)),
                )
                for look in looks
            )
        )

    def _albedo(self, traced: TracedScene, scene: Scene) -> Float64Array:
        """Linear sRGB of each owner, Shape ``[owners, 3]``."""
        albedo = np.zeros((len(traced.owner_names), 3))
        albedo[: len(self.shapes)] = self._shape_colours
        for name, kind in zip(scene.names, scene.classes, strict=True):
            albedo[traced.object_owner[name]] = object_colour(kind, name, self.settings.colours)
        return albedo

    @cached_property
    def _shape_colours(self) -> Float64Array:
        colours = [shape_colour(shape, self.settings.colours) for shape in self.shapes]
        return np.array(colours).reshape(-1, 3)

    def _depth(self, traced: TracedScene, looks: list[_Look], hits: list[Hits]) -> Depth:
        of_face = traced.face_normals() if "normals" in self._demand["depth"] else None
        return Depth(
            images=tuple(
                DepthImage(
                    **look.fields,
                    depth=look.image(_depths(look, hit)),
                    normals=None if of_face is None else look.image(_normals(look, hit, of_face)),
                )
                for look, hit in zip(looks, hits, strict=True)
            )
        )

    def _segmentation(self, traced: TracedScene, looks: list[_Look], hits: list[Hits]) -> Segmentation:
        owners = [hit.owner for hit in hits]
        of_owner = list(traced.owner_names)
        names, index = visible_names(of_owner, owners)
        materials: tuple[str, ...] = ()
        material = None
        if "materials" in self._demand["segmentation"]:
            of_owner = [shape.itu_material or shape.material or "unknown" for shape in self.shapes]
            of_owner += [self.settings.body_material] * (len(traced.owner_names) - len(self.shapes))
            materials, material = visible_names(of_owner, owners)
        return Segmentation(
            object_names=names,
            material_names=materials,
            images=tuple(
                SegmentationImage(
                    **look.fields,
                    object=look.image(index[owner]),
                    material=None if material is None else look.image(material[owner]),
                )
                for look, owner in zip(looks, owners, strict=True)
            ),
        )


def _traced(mi: Any, traced: TracedScene, look: _Look) -> Hits:
    world = turned(look.pose, look.rays)
    origin = np.repeat(np.array(look.pose.position)[:, None], world.shape[1], axis=1)
    return traced.trace(mi, origin, world, np.full(world.shape[1], FAR))


def _depths(look: _Look, hits: Hits) -> Float32Array:
    found = hits.owner != NO_HIT
    depth = np.zeros(len(found), dtype=np.float32)
    np.multiply(hits.distance, look.rays[0], out=depth, where=found, casting="same_kind")
    return depth


def _normals(look: _Look, hits: Hits, of_face: Float32Array) -> Float32Array:
    found = hits.owner != NO_HIT
    normals = np.zeros((len(found), 3), dtype=np.float32)
    normals[found] = of_face[hits.face[found]]
    away = np.einsum("ij,ji->i", normals, turned(look.pose, look.rays)) > 0
    normals[away] *= -1
    return normals


def intrinsics(device: CameraDevice) -> Intrinsics:
    """Square pixels, the principal point in the middle of the image.

    Half of the width is seen under half of the field of view: ``fx = width / 2 / tan(fov / 2)``.
    Raises `PayloadError` for an image without pixels, and for a field of view that no plane can hold.
    """
    if min(device.width, device.height) < 1:
        raise PayloadError(
            f"camera {device.name!r} has {device.width} × {device.height} pixels; give it at least 1 × 1"
        )
    if not 0 < device.field_of_view < math.pi:
        raise PayloadError(
            f"camera {device.name!r} has a field of view of {math.degrees(device.field_of_view):g}°; "
            "a pinhole camera sees more than 0° and less than 180°, for example 90°"
        )
    focal = device.width / 2 / math.tan(device.field_of_view / 2)
    return Intrinsics(fx=focal, fy=focal, cx=device.width / 2, cy=device.height / 2)


@lru_cache(maxsize=8)
def pixel_rays(width: int, height: int, optics: Intrinsics) -> Float64Array:
    """Unit vectors through the pixel centres in device axes (x forward, y left, z up).

    Shape ``[3, height·width]``, row by row from the top. The first row is the cosine of the angle to
    the optical axis, so depth is a ray's length times it.
    """
    right = (np.arange(width) + 0.5 - optics.cx) / optics.fx
    down = ((np.arange(height) + 0.5 - optics.cy) / optics.fy)[:, None]
    forward = 1 / np.sqrt(1 + right**2 + down**2)
    rays = np.stack([forward.ravel(), (-right * forward).ravel(), (-down * forward).ravel()])
    rays.flags.writeable = False
    return rays
