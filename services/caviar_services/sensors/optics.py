"""Pinhole cameras: where a pixel looks."""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np

from caviar_protocol.arrays import Float64Array
from caviar_protocol.errors import PayloadError
from caviar_protocol.topics import CameraDevice, Intrinsics


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
