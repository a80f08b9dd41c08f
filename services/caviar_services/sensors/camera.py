"""Pinhole cameras: topics ``camera``, ``depth`` and ``segmentation``."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Annotated, Any, ClassVar

import msgspec
import numpy as np

from caviar_protocol.arrays import (
    Float32Array,
    Float64Array,
    Int32Array,
    Int64Array,
    Payload,
    UInt8Array,
    quantity,
)
from caviar_protocol.errors import PayloadError, ScenarioError
from caviar_protocol.scenario.conversion import Place
from caviar_protocol.space.coordinates import rotation_matrix
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
from caviar_services.drjit_setup import aligned_columns
from caviar_services.sensors.base import (
    NO_HIT,
    Sensors,
    SensorSettings,
    TracedScene,
    sensor_poses,
    visible_names,
)
from caviar_services.sensors.noise import SensorNoise, measured, noise_model
from caviar_services.sensors.shading import Colour, Painter, View, object_colour, shape_colour
from caviar_services.service import Preparation, Prepared


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
    noise: dict[str, Any] | None = None
    """Errors of the pictures of topic ``camera``: ``{ use = "gaussian", std_counts = 2.0 }``, or another
    model of `caviar_services.sensors.noise` or of a plug-in; absent: none. Depth and segmentation have
    none."""


@dataclass(frozen=True, eq=False)
class Hits:
    """Hits of the rays of a view, Shape ``[H·W]`` each."""

    distance: Float32Array
    """[m]; infinite where nothing is hit."""
    owner: Int32Array
    """What is hit (`TracedScene`); `NO_HIT` for nothing."""
    face: Int64Array
    """Which triangle is hit; 0 where nothing is."""


class CameraSensors(Sensors[CameraSettings]):
    """All cameras of the scene: topics ``camera``, ``depth`` and ``segmentation``.

    What is not in demand is not computed: neither a topic, nor part ``normals`` of ``depth``, nor part
    ``materials`` of ``segmentation`` (clause 5). Normals point to the camera's side of a surface. As
    for a LIDAR, every object of the scene is solid, the camera's own carrier too.

    Args:
        settings: Materials and colours of what is seen, the sun, and how many bodies there may be.
        run: What the service knows about the run.

    Example:
        >>> from caviar_services.service import RunInfo
        >>> CameraSensors(CameraSettings(sun_elevation_deg=30.0), RunInfo(name="camera")).outputs
        ('camera', 'depth', 'segmentation')
    """

    _noise: SensorNoise | None = None
    outputs: ClassVar[tuple[str, ...]] = ("camera", "depth", "segmentation")
    uses_scenery: ClassVar[bool] = True
    Settings: ClassVar[type[msgspec.Struct]] = CameraSettings

    @classmethod
    def check_settings(cls, settings: CameraSettings, place: Place) -> None:
        """See `Service.check_settings`."""
        noise_model("camera", settings.noise, place.at("noise"))

    def prepare(self, preparation: Preparation) -> Prepared:
        """See `Sensors.prepare`; `ScenarioError` where a colour is none."""
        for name, colour in self.settings.colours.items():
            if not all(0 <= value <= 1 for value in colour):
                raise ScenarioError(
                    f"colour {list(colour)} of {name!r} is not sRGB; give red, green and blue from 0 to 1",
                    key=f"services.{self.run.name}.settings.colours.{name}",
                )
        self._noise = noise_model("camera", self.settings.noise, Place("settings.noise"))
        self._demand = preparation.demand  # before `super`, whose warm-up observes
        return super().prepare(preparation)

    def example_devices(self) -> tuple[Device, ...]:
        """One small camera at the origin."""
        return (CameraDevice(name="warm-up", width=8, height=6),)

    def observe(self, mi: Any, traced: TracedScene, scene: Scene) -> dict[str, Payload]:
        """One image of each camera on each topic that is in demand."""
        views = [
            View(device, intrinsics(device), pose)
            for device, pose in sensor_poses(traced, scene, CameraDevice)
        ]
        products: dict[str, Payload] = {}
        if "camera" in self._demand:
            products["camera"] = self._pictures(mi, traced, scene, views)
        # Both come of the same rays, one a pixel; pictures have more, and shadows.
        if self._demand.keys() & {"depth", "segmentation"}:
            hits = [first_hits(mi, traced, view) for view in views]
            if "depth" in self._demand:
                products["depth"] = self._depth(traced, views, hits)
            if "segmentation" in self._demand:
                products["segmentation"] = self._segmentation(traced, views, hits)
        return products

    def _pictures(self, mi: Any, traced: TracedScene, scene: Scene, views: list[View]) -> Camera:
        azimuth = math.radians(self.settings.sun_azimuth_deg)
        elevation = math.radians(self.settings.sun_elevation_deg)
        sun = np.array(
            [
                math.cos(elevation) * math.cos(azimuth),
                math.cos(elevation) * math.sin(azimuth),
                math.sin(elevation),
            ]
        )
        # One painter for all cameras of a frame: normals and colours of all faces are uploaded once.
        painter = Painter(mi, traced, self._albedo(traced, scene), sun)
        return Camera(
            images=tuple(
                CameraImage(**view.fields, rgb=self._taken(view, painter.paint(view))) for view in views
            )
        )

    def _taken(self, view: View, rgb: UInt8Array) -> UInt8Array:
        """The picture as the camera takes it, Shape ``[H, W, 3]``."""
        if self._noise is None:
            return rgb
        random = self.frame.generator(f"noise/{view.device.name}")
        counts = measured(self._noise, rgb.astype(np.float32), random)
        if not np.isfinite(counts).all():
            raise PayloadError(f"{type(self._noise).__name__}.apply made counts that are no number")
        return np.clip(np.rint(counts), 0, 255).astype(np.uint8)

    def _albedo(self, traced: TracedScene, scene: Scene) -> Float64Array:
        """Linear sRGB of each owner, Shape ``[owners, 3]``."""
        albedo = np.zeros((len(traced.owner_names), 3))
        albedo[: len(self.shapes)] = self._shape_colours
        for name, kind in zip(scene.names, scene.classes, strict=True):
            albedo[traced.object_owner[name]] = object_colour(kind, name, self.settings.colours)
        return albedo

    @cached_property
    def _shape_colours(self) -> Float64Array:
        # Once: scenery keeps its colours, and Munich has 2,367 shapes.
        colours = [shape_colour(shape, self.settings.colours) for shape in self.shapes]
        return np.array(colours).reshape(-1, 3)

    def _depth(self, traced: TracedScene, views: list[View], hits: list[Hits]) -> Depth:
        of_face = traced.face_normals() if "normals" in self._demand["depth"] else None
        return Depth(
            images=tuple(
                DepthImage(
                    **view.fields,
                    depth=view.image(_depths(view, hit)),
                    normals=None if of_face is None else view.image(_normals(view, hit, of_face)),
                )
                for view, hit in zip(views, hits, strict=True)
            )
        )

    def _segmentation(self, traced: TracedScene, views: list[View], hits: list[Hits]) -> Segmentation:
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
                    **view.fields,
                    object=view.image(index[owner]),
                    material=None if material is None else view.image(material[owner]),
                )
                for view, owner in zip(views, owners, strict=True)
            ),
        )


def first_hits(mi: Any, traced: TracedScene, view: View) -> Hits:
    """Find what the rays through the centres of pixels hit.

    Args:
        mi: Mitsuba, with the variant that is active.
        traced: The scene for rays.
        view: The camera.
    """
    import drjit as dr

    world = ray_directions(view)
    origin = np.repeat((np.array(view.pose.position) - traced.centre)[:, None], world.shape[1], axis=1)
    # Every value is an array, never a Python number: a number becomes part of the kernel, and
    # each new one makes a kernel to compile.
    columns = [mi.Float(column) for column in aligned_columns(np.vstack([origin, world]))]
    distances, faces = traced.intersect(mi, mi.Ray3f(mi.Point3f(*columns[:3]), mi.Vector3f(*columns[3:])))
    dr.eval(distances, faces)
    distance = distances.numpy()
    found = np.isfinite(distance)
    # A ray that hits nothing has no face; 0 stands in, so that the tables can be read.
    face = np.where(found, faces.numpy(), 0).astype(np.int64)
    if not len(traced.face_owner):
        return Hits(distance, np.full(len(distance), NO_HIT, dtype=np.int32), face)
    return Hits(distance, np.where(found, traced.face_owner[face], np.int32(NO_HIT)), face)


def _pixel_rays(view: View) -> Float64Array:
    return pixel_rays(view.device.width, view.device.height, view.optics)


def ray_directions(view: View) -> Float64Array:
    """Unit vectors of a view's rays in world axes, Shape ``[3, H·W]``."""
    local = _pixel_rays(view)
    # Written out instead of a matrix product, whose rounding may depend on the BLAS and its threads.
    return np.stack(
        [
            row[0] * local[0] + row[1] * local[1] + row[2] * local[2]
            for row in rotation_matrix(view.pose.orientation)
        ]
    )


def _depths(view: View, hits: Hits) -> Float32Array:
    """Distances along the optical axis [m], Shape ``[H·W]``; 0 where nothing is hit."""
    found = hits.owner != NO_HIT
    depth = np.zeros(len(found), dtype=np.float32)
    # In float64 up to the assignment, so that the only rounding is that of the product.
    np.multiply(hits.distance, _pixel_rays(view)[0], out=depth, where=found, casting="same_kind")
    return depth


def _normals(view: View, hits: Hits, of_face: Float32Array) -> Float32Array:
    """Unit normals in world axes, Shape ``[H·W, 3]``; 0 where nothing is hit."""
    found = hits.owner != NO_HIT
    normals = np.zeros((len(found), 3), dtype=np.float32)
    normals[found] = of_face[hits.face[found]]
    # Meshes of scenery are often open sheets, of which either side may be seen.
    away = np.einsum("ij,ji->i", normals, ray_directions(view)) > 0
    normals[away] *= -1
    return normals


def intrinsics(device: CameraDevice) -> Intrinsics:
    """Pinhole of a camera: square pixels, the principal point in the middle of the image.

    Half of the width is seen under half of the field of view: ``fx = width / 2 / tan(fov / 2)``.

    Args:
        device: The camera; its field of view [rad] is horizontal.

    Returns:
        Focal lengths and principal point [px].

    Raises:
        PayloadError: The image has no pixels, or no plane can hold the field of view.

    Example:
        >>> optics = intrinsics(CameraDevice(name="roof", width=640, height=480, field_of_view=math.pi / 2))
        >>> round(optics.fx, 6), optics.cy
        (320.0, 240.0)
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

    The first component is the cosine of the angle to the optical axis, so depth is a ray's length times it.

    Args:
        width: Width of the image [px].
        height: Height of the image [px].
        optics: Focal lengths and principal point [px].

    Returns:
        Shape ``[3, height·width]``, row by row from the top, read-only: calls with equal arguments share it.

    Example:
        >>> pixel_rays(1, 1, Intrinsics(fx=1.0, fy=1.0, cx=0.5, cy=0.5)).ravel().tolist()
        [1.0, -0.0, -0.0]
    """
    right = (np.arange(width) + 0.5 - optics.cx) / optics.fx
    down = ((np.arange(height) + 0.5 - optics.cy) / optics.fy)[:, None]
    forward = 1 / np.sqrt(1 + right**2 + down**2)
    rays = np.stack([forward.ravel(), (-right * forward).ravel(), (-down * forward).ravel()])
    rays.flags.writeable = False
    return rays
