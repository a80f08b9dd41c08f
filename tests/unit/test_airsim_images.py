"""Pictures as AirSim answers them: PNG, bytes in its order, depth along the axis and along the ray."""

from __future__ import annotations

import math
import struct
import zlib
from typing import Any

import numpy as np
import pytest

from caviar_bridges.airsim.images import colour_of, image_response, png
from caviar_bridges.airsim.rpc import CallError
from caviar_bridges.airsim.wire import NedFrame
from caviar_protocol.arrays import UInt8Array
from caviar_protocol.topics import (
    Camera,
    CameraImage,
    Depth,
    DepthImage,
    Intrinsics,
    Segmentation,
    SegmentationImage,
)

OPTICS = Intrinsics(fx=2.0, fy=4.0, cx=2.0, cy=1.5)
WHERE: dict[str, Any] = {
    "sensor": "uav/front",
    "intrinsics": OPTICS,
    "position": (1.0, 2.0, 3.0),
    "orientation": (1.0, 0.0, 0.0, 0.0),
}
RGB = np.random.default_rng(3).integers(0, 256, (3, 4, 3)).astype(np.uint8)
DEPTH = np.array([[0.0, 10.0, 20.0, 30.0], [1.0, 50.0, 100.0, 200.0], [5.0, 5.0, 5.0, 5.0]], np.float32)
OBJECT = np.array([[-1, 0, 0, 1], [1, 1, 0, -1], [0, 1, 0, 1]], np.int32)
PRODUCTS = {
    "camera": (Camera(images=(CameraImage(**WHERE, rgb=RGB),)),),
    "depth": (Depth(images=(DepthImage(**WHERE, depth=DEPTH),)),),
    "segmentation": (
        Segmentation(object_names=("road", "car.1"), images=(SegmentationImage(**WHERE, object=OBJECT),)),
    ),
}


def made(kind: int, as_float: bool = False, compress: bool = True) -> dict[str, Any]:
    return image_response(PRODUCTS, "uav/front", kind, as_float, compress, NedFrame((0.0, 0.0, 0.0)).pose)


def decoded(data: bytes) -> UInt8Array:
    """A PNG of 8-bit colour without filters, read by its specification, checksums and all."""
    assert data[:8] == b"\x89PNG\r\n\x1a\n"
    chunks, place = {}, 8
    while place < len(data):
        length, kind = struct.unpack_from(">I4s", data, place)
        content = data[place + 8 : place + 8 + length]
        (check,) = struct.unpack_from(">I", data, place + 8 + length)
        assert check == zlib.crc32(kind + content)
        chunks[kind] = content
        place += 12 + length
    assert list(chunks) == [b"IHDR", b"IDAT", b"IEND"]
    width, height, depth, colour, *rest = struct.unpack(">IIBBBBB", chunks[b"IHDR"])
    assert (depth, colour, rest) == (8, 2, [0, 0, 0])
    rows = np.frombuffer(zlib.decompress(chunks[b"IDAT"]), np.uint8).reshape(height, 1 + 3 * width)
    assert not rows[:, 0].any()
    return rows[:, 1:].reshape(height, width, 3)


def test_a_png_has_the_picture() -> None:
    assert np.array_equal(decoded(png(RGB)), RGB)
    found = made(0)
    assert np.array_equal(decoded(found["image_data_uint8"]), RGB)
    assert (found["width"], found["height"], found["image_data_float"]) == (4, 3, [])


def test_bytes_are_blue_green_red_as_airsim_sends_them() -> None:
    data = made(0, compress=False)["image_data_uint8"]
    assert np.array_equal(np.frombuffer(data, np.uint8).reshape(3, 4, 3)[..., ::-1], RGB)


def test_planar_depth_is_along_the_axis_and_far_where_nothing_is_hit() -> None:
    found = made(1, as_float=True)
    assert found["image_data_float"][:4] == [65504.0, 10.0, 20.0, 30.0]
    assert (found["image_data_uint8"], found["pixels_as_float"], found["compress"]) == (b"", True, False)


def test_perspective_depth_is_the_length_of_the_ray() -> None:
    found = np.reshape(made(2, as_float=True)["image_data_float"], (3, 4))
    # Pixel (row 2, column 3): its centre is 1.5 px right and 1 px below the axis, at focal lengths 2 and 4.
    assert found[2, 3] == pytest.approx(5.0 * math.sqrt(1 + (1.5 / 2) ** 2 + (1 / 4) ** 2), rel=1e-6)
    assert found[0, 0] == 65504.0


def test_depth_that_is_shown_is_white_at_a_hundred_metres() -> None:
    numbers = np.reshape(made(3, as_float=True)["image_data_float"], (3, 4))
    assert numbers[1].tolist() == pytest.approx([0.01, 0.5, 1.0, 1.0])
    grey = decoded(made(3)["image_data_uint8"])
    assert grey[1, :, 0].tolist() == [2, 127, 255, 255]
    assert (grey[..., 0] == grey[..., 2]).all()
    assert (grey[0, 0] == 255).all()


def test_a_segmentation_has_a_colour_for_each_object_and_black_for_the_sky() -> None:
    found = decoded(made(5)["image_data_uint8"])
    assert tuple(found[0, 1]) == colour_of("road") != colour_of("car.1") == tuple(found[0, 3])
    assert tuple(found[0, 0]) == (0, 0, 0)
    assert made(5, as_float=True)["image_data_float"][:4] == [-1.0, 0.0, 0.0, 1.0]


def test_a_picture_says_where_it_was_taken() -> None:
    assert made(0)["camera_position"] == {"x_val": 2.0, "y_val": 1.0, "z_val": -3.0}


@pytest.mark.parametrize(
    ("products", "device", "kind", "words"),
    [
        (
            PRODUCTS,
            "uav/front",
            7,
            "image_type is 7, which is not offered; choose one of Scene (0), DepthPla",
        ),
        ({}, "uav/front", 0, "there is no product 'camera' in this frame; Scene (0) needs a service"),
        (PRODUCTS, "uav/back", 5, "camera 'uav/back' took no picture 'segmentation' in this frame"),
    ],
)
def test_a_picture_that_there_is_not_is_refused_with_the_reason(
    products: Any, device: str, kind: int, words: str
) -> None:
    with pytest.raises(CallError) as error:
        image_response(products, device, kind, False, True, NedFrame((0.0, 0.0, 0.0)).pose)
    assert words in str(error.value)
