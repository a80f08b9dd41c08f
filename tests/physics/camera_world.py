"""The camera service in small worlds, and the pinhole formula once more, by itself."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from lidar_world import scene_of

from caviar_protocol.arrays import Float64Array, Payload
from caviar_protocol.messages import GrantInput, Status
from caviar_protocol.topics import Camera, CameraDevice, Depth, Scene, Segmentation
from caviar_services.sensors.camera import CameraSensors, CameraSettings
from caviar_services.service import Frame, FrameInput, Preparation, RunInfo

ALL = {"camera": frozenset[str](), "depth": frozenset({"normals"}), "segmentation": frozenset({"materials"})}
"""Demand for all that cameras see."""

EMPTY = scene_of({})


def prepared(
    assets: Mapping[str, Path] | None = None,
    settings: CameraSettings | None = None,
    demand: Mapping[str, frozenset[str]] = ALL,
) -> CameraSensors:
    """A camera service that is ready for frame 0."""
    service = CameraSensors(settings or CameraSettings(bodies_per_asset=8), RunInfo(name="camera"))
    service.prepare(Preparation(demand=demand, assets=assets or {}))
    return service


def products(service: CameraSensors, scene: Scene, number: int = 0) -> Mapping[str, Payload]:
    """What the service makes of a scene, by topic."""
    provenance = GrantInput(topic="scene", source="world", status=Status.FRESH, frame=number)
    frame = Frame(episode=0, number=number, t_ns=0, inputs=(FrameInput(provenance, payload=scene),))
    return service.step(frame).products


def seen(service: CameraSensors, scene: Scene, number: int = 0) -> tuple[Camera, Depth, Segmentation]:
    """Picture, depth and segmentation of all cameras in a scene."""
    found = products(service, scene, number)
    camera, depth, segmentation = found["camera"], found["depth"], found["segmentation"]
    assert isinstance(camera, Camera)
    assert isinstance(depth, Depth)
    assert isinstance(segmentation, Segmentation)
    return camera, depth, segmentation


def projected(
    device: CameraDevice, forward: Float64Array, up: Float64Array, eye: Float64Array, points: Float64Array
) -> Float64Array:
    """Column, row [px] and depth [m] of world points, Shape ``[N, 3]`` to ``[N, 3]``.

    Written with angles: a point at angle α to the right of the axis is tan α / tan(fov / 2) half widths
    off the middle; vertical half a height is as many half widths as the image is high over wide.
    """
    right = np.cross(forward, up)
    way = points - eye
    depth = way @ forward
    half = np.tan(device.field_of_view / 2)
    across = (way @ right) / depth / half
    down = -(way @ up) / depth / half * device.width / device.height
    return np.stack([device.width * (1 + across) / 2, device.height * (1 + down) / 2, depth], axis=1)
