"""Where pixels look: intrinsics and rays of a pinhole camera."""

from __future__ import annotations

import math

import numpy as np
import pytest

from caviar_protocol.errors import PayloadError
from caviar_protocol.topics import CameraDevice, Intrinsics
from caviar_services.sensors.camera import intrinsics, pixel_rays


def test_a_field_of_view_of_90_degrees_has_a_focal_length_of_half_the_width() -> None:
    device = CameraDevice(name="c", width=640, height=480, field_of_view=math.pi / 2)
    optics = intrinsics(device)
    assert (optics.fx, optics.fy, optics.cx, optics.cy) == pytest.approx((320.0, 320.0, 320.0, 240.0))


@pytest.mark.parametrize(("width", "height", "degrees"), [(7, 5, 33.0), (640, 480, 100.0), (1, 1, 170.0)])
def test_the_borders_of_the_image_are_those_of_the_field_of_view(
    width: int, height: int, degrees: float
) -> None:
    """A point at the half angle is projected to the border, by the formula that the product documents."""
    optics = intrinsics(
        CameraDevice(name="c", width=width, height=height, field_of_view=math.radians(degrees))
    )
    x = math.tan(math.radians(degrees / 2)) * 12.0
    assert optics.fx * x / 12.0 + optics.cx == pytest.approx(width)
    assert optics.fx * -x / 12.0 + optics.cx == pytest.approx(0.0, abs=1e-9)
    assert optics.fy == optics.fx


def test_rays_go_through_pixel_centres() -> None:
    """Projected again, in camera axes (x right, y down, z forward), each is at column + ½, row + ½."""
    optics = Intrinsics(fx=50.0, fy=40.0, cx=3.2, cy=1.9)
    forward, left, up = pixel_rays(6, 4, optics)
    rows, columns = np.divmod(np.arange(24), 6)
    np.testing.assert_allclose(50.0 * -left / forward + 3.2, columns + 0.5, atol=1e-12)
    np.testing.assert_allclose(40.0 * -up / forward + 1.9, rows + 0.5, atol=1e-12)
    np.testing.assert_allclose(forward**2 + left**2 + up**2, 1.0, atol=1e-15)


def test_the_first_row_is_up_and_the_first_column_left() -> None:
    forward, left, up = pixel_rays(5, 3, Intrinsics(fx=4.0, fy=4.0, cx=2.5, cy=1.5)).reshape(3, 3, 5)
    assert (up[0] > 0).all()
    assert (left[:, 0] > 0).all()
    assert (forward > 0).all()
    assert (forward[1, 2], left[1, 2], up[1, 2]) == (1.0, 0.0, 0.0)


@pytest.mark.parametrize("degrees", [0.0, -20.0, 180.0, 360.0, math.nan])
def test_a_field_of_view_that_no_plane_holds_is_refused(degrees: float) -> None:
    with pytest.raises(PayloadError, match=r"'roof'.*field of view.*less than 180°"):
        intrinsics(CameraDevice(name="roof", field_of_view=math.radians(degrees)))


def test_an_image_without_pixels_is_refused() -> None:
    with pytest.raises(PayloadError, match=r"'roof' has 0 × 480 pixels.*1 × 1"):
        intrinsics(CameraDevice(name="roof", width=0))
