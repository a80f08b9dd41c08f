"""Pictures as AirSim answers them, of the products of cameras: PNG, raw bytes, or a number for each pixel."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Callable, Mapping, Sequence

import numpy as np

from caviar_bridges.airsim.rpc import CallError
from caviar_bridges.airsim.wire import Map
from caviar_protocol.arrays import Float32Array, UInt8Array
from caviar_protocol.space.coordinates import Pose
from caviar_protocol.topics import Camera, CameraImage, Depth, DepthImage, Segmentation, SegmentationImage

SCENE, DEPTH_PLANAR, DEPTH_PERSPECTIVE, DEPTH_VIS, SEGMENTATION = 0, 1, 2, 3, 5
OFFERED = {
    SCENE: "Scene (0)",
    DEPTH_PLANAR: "DepthPlanar (1)",
    DEPTH_PERSPECTIVE: "DepthPerspective (2)",
    DEPTH_VIS: "DepthVis (3)",
    SEGMENTATION: "Segmentation (5)",
}
TOPIC_OF = {
    SCENE: "camera",
    DEPTH_PLANAR: "depth",
    DEPTH_PERSPECTIVE: "depth",
    DEPTH_VIS: "depth",
    SEGMENTATION: "segmentation",
}
"""The product that a kind of picture is made of."""
NO_HIT_M = 65_504.0
"""[m] where nothing is hit: the greatest number of half precision, as of AirSim's depth buffer."""
WHITE_M = 100.0
"""[m] at which a depth picture is white."""

Products = Mapping[str, Sequence[Camera | Depth | Segmentation]]
"""Payloads of a frame, by topic."""
Image = CameraImage | DepthImage | SegmentationImage


def png(rgb: UInt8Array) -> bytes:
    """Encode a picture as PNG.

    Args:
        rgb: Red, green and blue, top row first, Shape ``[H, W, 3]``.

    Example:
        >>> png(np.zeros((2, 3, 3), np.uint8))[:4]
        b'\\x89PNG'
    """
    height, width, _ = rgb.shape
    rows = np.zeros((height, 1 + 3 * width), np.uint8)  # a row begins with its filter: 0 for none
    rows[:, 1:] = rgb.reshape(height, 3 * width)
    header = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    # The fastest level: a frame of the run waits meanwhile, where the client steps it.
    chunks = ((b"IHDR", header), (b"IDAT", zlib.compress(rows.tobytes(), 1)), (b"IEND", b""))
    return b"\x89PNG\r\n\x1a\n" + b"".join(_chunk(kind, data) for kind, data in chunks)


def _chunk(kind: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


def colour_of(name: str) -> tuple[int, int, int]:
    """Colour of an object in a segmentation: the same in every frame and run, and never black.

    Example:
        >>> colour_of("car.1") == colour_of("car.1") != colour_of("car.2")
        True
    """
    digest = zlib.crc32(name.encode())
    return digest & 255, digest >> 8 & 255, digest >> 16 & 255 | 1


def image_response(
    products: Products,
    device: str,
    kind: int,
    as_float: bool,
    compress: bool,
    pose_of: Callable[[Pose], Map],
) -> Map:
    """Make AirSim's ``ImageResponse``, but for the name that the client used and the time.

    Args:
        products: Of the frame.
        device: Name of the camera.
        kind: AirSim's ``ImageType``.
        as_float: Whether a number for each pixel is asked for.
        compress: Whether bytes are a PNG; else they are blue, green and red of each pixel, as AirSim sends
            them.
        pose_of: Makes AirSim's ``Pose`` of one in ENU.

    Raises:
        CallError: The frame has no such picture, or the kind is none that is offered.
    """
    image, names = _image(products, device, kind)
    numbers = list[float]()
    data = b""
    if as_float:
        numbers = _numbers(image, kind).reshape(-1).tolist()
    else:
        rgb = _rgb(image, kind, names)
        data = png(rgb) if compress else np.ascontiguousarray(rgb[..., ::-1]).tobytes()
    height, width = _size(image)
    pose = pose_of(Pose(image.position, image.orientation))
    return {
        "image_data_uint8": data,
        "image_data_float": numbers,
        "camera_position": pose["position"],
        "camera_orientation": pose["orientation"],
        "message": "",
        "pixels_as_float": as_float,
        "compress": compress and not as_float,
        "width": width,
        "height": height,
        "image_type": kind,
    }


def _image(products: Products, device: str, kind: int) -> tuple[Image, tuple[str, ...]]:
    """The picture of a camera, and the names that a segmentation points into."""
    if kind not in OFFERED:
        offered = ", ".join(OFFERED.values())
        raise CallError(f"image_type is {kind!r:.80}, which is not offered; choose one of {offered}")
    topic = TOPIC_OF[kind]
    found = products.get(topic, ())
    if not found:
        raise CallError(
            f"there is no product {topic!r} in this frame; {OFFERED[kind]} needs a service of the run with "
            "role 'sensors' and use 'camera'"
        )
    for payload in found:
        names = payload.object_names if isinstance(payload, Segmentation) else ()
        for image in payload.images:
            if image.sensor == device:
                return image, names
    raise CallError(f"camera {device!r} took no picture {topic!r} in this frame")


def _size(image: Image) -> tuple[int, int]:
    """Height and width [px]."""
    match image:
        case CameraImage():
            height, width, _ = image.rgb.shape
        case DepthImage():
            height, width = image.depth.shape
        case SegmentationImage():
            height, width = image.object.shape
    return height, width


def _depth(image: DepthImage, kind: int) -> Float32Array:
    """[m], along the axis or the ray of each pixel, Shape ``[H, W]``."""
    depth = image.depth
    if kind == DEPTH_PERSPECTIVE:
        height, width = depth.shape
        optics = image.intrinsics
        x = (np.arange(width) + 0.5 - optics.cx) / optics.fx
        y = (np.arange(height) + 0.5 - optics.cy) / optics.fy
        depth = depth * np.sqrt(1.0 + x[None, :] ** 2 + y[:, None] ** 2).astype(np.float32)
    return np.where(image.depth > 0.0, depth, np.float32(NO_HIT_M)).astype(np.float32)


def _numbers(image: Image, kind: int) -> Float32Array:
    """A number for each pixel, or three of a picture in colour."""
    match image:
        case CameraImage():
            return image.rgb.astype(np.float32)
        case DepthImage() if kind == DEPTH_VIS:
            shade: Float32Array = np.clip(_depth(image, kind) / WHITE_M, 0.0, 1.0).astype(np.float32)
            return shade
        case DepthImage():
            return _depth(image, kind)
        case SegmentationImage():
            return image.object.astype(np.float32)


def _rgb(image: Image, kind: int, names: Sequence[str]) -> UInt8Array:
    """Shape ``[H, W, 3]``."""
    match image:
        case CameraImage():
            return image.rgb
        case DepthImage():
            grey = np.clip(_depth(image, kind) * (255.0 / WHITE_M), 0.0, 255.0).astype(np.uint8)
            return np.repeat(grey[..., None], 3, axis=2)
        case SegmentationImage():
            # Row −1 is the last one: black, where nothing is hit.
            palette = np.array([*(colour_of(name) for name in names), (0, 0, 0)], np.uint8)
            coloured: UInt8Array = palette[image.object]
            return coloured
