"""Depth, objects and normals of cameras against boxes, for which they follow from the slab method.

Tolerance: 0.1 mm of depth on pixels that look at no edge closer than 2 mm; float32 rounds coordinates
of 100 m to 8 µm.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from camera_world import EMPTY, prepared, products, projected, seen
from lidar_world import Body, scene_of, slab_ranges

from caviar_protocol.arrays import Float64Array
from caviar_protocol.errors import PayloadError
from caviar_protocol.space.coordinates import Pose, compose, quaternion_from_euler, rotation_matrix
from caviar_protocol.topics import CameraDevice
from caviar_services.sensors.camera import CameraSensors, CameraSettings
from caviar_space.meshes import box, ply

pytestmark = pytest.mark.channel

TOLERANCE = 1e-4
"""[m]"""
MARGIN = 2e-3
"""[m]"""


@pytest.fixture(scope="module")
def service() -> CameraSensors:
    """A camera service without scenery."""
    return prepared(settings=CameraSettings(bodies_per_asset=64))


def rays_by_angles(device: CameraDevice) -> Float64Array:
    """Unit vectors through pixel centres in device axes, row by row, Shape ``[H·W, 3]``."""
    half = np.tan(device.field_of_view / 2)
    x, y = np.meshgrid(np.arange(device.width) + 0.5, np.arange(device.height) + 0.5)
    left = (1 - 2 * x / device.width) * half
    up = (1 - 2 * y / device.height) * half * device.height / device.width
    rays = np.stack([np.ones_like(left), left, up], axis=2).reshape(-1, 3)
    unit: Float64Array = rays / np.linalg.norm(rays, axis=1, keepdims=True)
    return unit


def random_bodies(rng: np.random.Generator, count: int) -> dict[str, Body]:
    """Turned boxes of unequal edges all around, none nearer than 4 m."""
    bodies = {}
    for index in range(count):
        distance, bearing = rng.uniform(12, 40), rng.uniform(0, 2 * np.pi)
        bodies[f"box{index:02}"] = Body(
            position=(distance * np.cos(bearing), distance * np.sin(bearing), rng.uniform(-8, 8)),
            dimensions=(rng.uniform(2, 9), rng.uniform(1, 6), rng.uniform(1, 8)),
            orientation=quaternion_from_euler(*rng.uniform(-np.pi, np.pi, 3) * (1, 0.4, 0.4)),
        )
    return bodies


@pytest.mark.parametrize("away", [(5e5, 5e6, 100.0), (1e7, 1e7 / 3, 0.0)])
def test_images_are_the_same_far_from_the_origin(service: CameraSensors, away: tuple[float, ...]) -> None:
    near, far = (
        seen(
            service,
            scene_of(
                {
                    name: replace(body, position=tuple(np.add(body.position, origin)))
                    for name, body in random_bodies(np.random.default_rng(3), 24).items()
                },
                CameraDevice(name="eye", position=origin, width=96, height=64, field_of_view=1.4),
            ),
        )
        for origin in ((0.0, 0.0, 0.0), away)
    )
    assert (near[1].images[0].depth > 0).mean() > 0.05
    assert np.abs(near[1].images[0].depth - far[1].images[0].depth).max() < 1e-3
    assert np.array_equal(near[2].images[0].object, far[2].images[0].object)
    colours = np.abs(near[0].images[0].rgb.astype(int) - far[0].images[0].rgb)
    assert (colours <= 2).mean() > 0.999


@pytest.mark.parametrize("seed", range(5))
def test_depth_and_objects_equal_the_slab_method(service: CameraSensors, seed: int) -> None:
    """A camera of odd size on a tilted carrier; what is judged is nearly all of the image."""
    rng = np.random.default_rng(seed)
    bodies = random_bodies(rng, 40)
    carrier = Body((0.2, -0.3, 0.1), (0.3, 0.2, 0.1), quaternion_from_euler(rng.uniform(-3, 3), 0.2, -0.3))
    mount = Pose((0.9, 0.1, -0.2), quaternion_from_euler(*rng.uniform(-0.4, 0.4, 3)))
    device = CameraDevice(
        name="carrier/camera",
        parent="carrier",
        position=mount.position,
        orientation=mount.orientation,
        width=131,
        height=77,
        field_of_view=float(rng.uniform(0.7, 2.0)),
    )
    _, depth, segmentation = seen(service, scene_of({**bodies, "carrier": carrier}, device))
    image, ids = depth.images[0], segmentation.images[0]
    eye = compose(Pose(carrier.position, carrier.orientation), mount)
    assert image.position == eye.position
    rays = rays_by_angles(device)
    exact, small, large = (
        slab_ranges([*bodies.values(), carrier], eye, rays, grown) for grown in (0.0, -MARGIN, MARGIN)
    )
    nearest, names = exact.argmin(axis=0), [*bodies, "carrier"]
    ranges = exact.min(axis=0)
    found = np.isfinite(ranges)
    with np.errstate(invalid="ignore"):
        clear = np.abs(small.min(axis=0) - large.min(axis=0)) < 20 * MARGIN
    clear |= ~np.isfinite(large.min(axis=0))
    clear &= (small.argmin(axis=0) == large.argmin(axis=0)) | ~found
    assert clear.mean() > 0.95
    assert 0.05 < found.mean() < 0.95
    expected = np.where(found, ranges * rays[:, 0], 0.0)
    np.testing.assert_allclose(image.depth.ravel()[clear], expected[clear], rtol=0, atol=TOLERANCE)
    told = np.array([*segmentation.object_names, ""])[ids.object.ravel()]
    np.testing.assert_array_equal(told[clear], np.where(found, np.array(names)[nearest], "")[clear])


@pytest.mark.parametrize("seed", range(3))
def test_normals_are_those_of_the_face_that_is_hit(service: CameraSensors, seed: int) -> None:
    """From the point that depth tells: on a box's surface, one coordinate is half an edge."""
    rng = np.random.default_rng(100 + seed)
    bodies = random_bodies(rng, 40)
    device = CameraDevice(
        name="camera", orientation=quaternion_from_euler(0.4, 0.1, 0.2), width=97, height=61
    )
    _, depth, segmentation = seen(service, scene_of(bodies, device))
    image, ids = depth.images[0], segmentation.images[0].object.ravel()
    assert image.normals is not None
    rays = rays_by_angles(device)
    points = rays / rays[:, :1] * image.depth.reshape(-1, 1) @ rotation_matrix(device.orientation).T
    judged = 0
    for number, name in enumerate(segmentation.object_names):
        body, mine = bodies[name], ids == number
        turn = rotation_matrix(body.orientation)
        share = (points[mine] - body.position) @ turn / (np.array(body.dimensions) / 2)
        axis = np.abs(share).argmax(axis=1)
        inner = np.sort(np.abs(share), axis=1)[:, 1] < 0.999
        outward = turn[:, axis].T * np.sign(np.take_along_axis(share, axis[:, None], 1))
        normals = image.normals.reshape(-1, 3)[mine]
        np.testing.assert_allclose(normals[inner], outward[inner], atol=1e-5)
        judged += int(inner.sum())
    assert judged > 0.9 * (ids >= 0).sum() > 500


def test_small_objects_are_where_the_pinhole_formula_puts_them(service: CameraSensors) -> None:
    """Centres of small cubes on their pixels: half a pixel in the mean, so pixel centres are at +½."""
    rng = np.random.default_rng(7)
    eye, yaw, pitch = np.array([3.0, -2.0, 5.0]), 2.1, 0.35
    device = CameraDevice(
        name="camera",
        position=tuple(eye.tolist()),
        orientation=quaternion_from_euler(yaw, pitch),
        width=640,
        height=360,
        field_of_view=1.1,
    )
    forward = np.array([np.cos(pitch) * np.cos(yaw), np.cos(pitch) * np.sin(yaw), -np.sin(pitch)])
    level = np.array([-np.sin(yaw), np.cos(yaw), 0.0])
    up = np.cross(forward, level)
    places = eye + np.array(
        [
            d * (forward + across * level + height * up)
            for d, across, height in zip(
                rng.uniform(8, 40, 40), rng.uniform(-0.55, 0.55, 40), rng.uniform(-0.3, 0.3, 40), strict=True
            )
        ]
    )
    bodies = {
        f"cube{i:02}": Body(tuple(place.tolist()), (0.3,) * 3, quaternion_from_euler(*rng.uniform(-1, 1, 3)))
        for i, place in enumerate(places)
    }
    _, depth, segmentation = seen(service, scene_of(bodies, device))
    ids, pixel = segmentation.images[0].object, projected(device, forward, up, eye, places)
    offsets = []
    for i, name in enumerate(bodies):
        if name not in segmentation.object_names:
            continue
        rows, columns = np.nonzero(ids == segmentation.object_names.index(name))
        middle = np.array([columns.mean() + 0.5, rows.mean() + 0.5])
        near = depth.images[0].depth[rows, columns].min()
        if near < pixel[i, 2] - 0.6 or len(rows) < 4:
            continue  # another cube stands in front of it, or it is too small to have a middle
        offsets.append(middle - pixel[i, :2])
        assert pixel[i, 2] - 0.27 < near < pixel[i, 2]
    assert len(offsets) > 25
    assert np.abs(np.median(offsets, axis=0)).max() < 0.15
    assert np.abs(np.mean(offsets, axis=0)).max() < 0.3


def test_an_empty_scene_is_all_sky(service: CameraSensors) -> None:
    """0 m, −1, no normal and no name; and the picture is the sky's, the same along each row."""
    device = CameraDevice(name="camera", width=33, height=21)
    picture, depth, segmentation = seen(service, scene_of({}, device))
    image, ids = depth.images[0], segmentation.images[0]
    assert image.normals is not None
    assert ids.material is not None
    assert not image.depth.any()
    assert not image.normals.any()
    assert (ids.object == -1).all()
    assert (ids.material == -1).all()
    assert segmentation.object_names == segmentation.material_names == ()
    rgb = picture.images[0].rgb.astype(int)
    assert (rgb[..., 2] > rgb[..., 0]).all(), "blue"
    assert (np.abs(rgb - rgb[:, ::-1]) <= 1).all(), "the same to the left and to the right"
    assert rgb[0].sum() < rgb[-1].sum(), "lighter towards the horizon"


@pytest.mark.parametrize(("width", "height"), [(1, 1), (1, 3), (2, 1)])
@pytest.mark.parametrize("bodies", [0, 1])
def test_images_of_a_few_pixels_and_scenes_without_a_triangle(width: int, height: int, bodies: int) -> None:
    """Without scenery, and with room for no body or for one."""
    things = {"box": Body((5, 0, 0), (2, 4, 4))} if bodies else {}
    few = prepared(settings=CameraSettings(bodies_per_asset=bodies))
    device = CameraDevice(name="camera", width=width, height=height, field_of_view=0.2)
    picture, depth, segmentation = seen(few, scene_of(things, device))
    assert picture.images[0].rgb.shape == (height, width, 3)
    np.testing.assert_allclose(depth.images[0].depth, np.full((height, width), 4.0 * bodies), atol=1e-5)
    np.testing.assert_array_equal(segmentation.images[0].object, np.full((height, width), bodies - 1))


def test_without_cameras_the_products_have_no_images(service: CameraSensors) -> None:
    picture, depth, segmentation = seen(service, EMPTY)
    assert picture.images == depth.images == segmentation.images == ()


def test_from_within_a_box_its_inner_sides_are_seen(service: CameraSensors) -> None:
    """Everywhere, at the depth of the wall ahead; normals point inwards, to the camera."""
    device = CameraDevice(name="camera", position=(1.0, 0.0, 0.0), width=40, height=30, field_of_view=0.9)
    room = Body((0.0, 0.0, 0.0), (9.0, 30.0, 30.0))
    picture, depth, segmentation = seen(service, scene_of({"room": room}, device))
    image = depth.images[0]
    np.testing.assert_allclose(image.depth, 3.5, atol=1e-5)
    assert image.normals is not None
    np.testing.assert_allclose(
        image.normals, np.broadcast_to([-1.0, 0.0, 0.0], image.normals.shape), atol=1e-6
    )
    assert segmentation.object_names == ("room",)
    assert (segmentation.images[0].object == 0).all()
    assert (picture.images[0].rgb > 0).all(), "dim, not black"


def test_a_camera_within_its_carrier_is_refused(service: CameraSensors) -> None:
    """As a LIDAR is: it would see nothing else."""
    device = CameraDevice(name="cab/camera", parent="cab", position=(0.5, 0.0, 0.0))
    with pytest.raises(PayloadError, match=r"'cab/camera'.*'cab'"):
        products(service, scene_of({"cab": Body((0, 0, 1), (4, 2, 2))}, device))


def test_a_field_of_view_without_an_image_plane_is_refused(service: CameraSensors) -> None:
    with pytest.raises(PayloadError, match=r"'camera'.*180°.*for example 90°"):
        products(service, scene_of({}, CameraDevice(name="camera", field_of_view=np.pi)))


def test_scenery_and_objects_are_named_with_their_materials(tmp_path: Path) -> None:
    """Shapes by their name in the description, objects by theirs; only what is in sight."""
    files = {
        "scenery/yard.xml": b'<scene><bsdf type="itu-radio-material" id="stone">'
        b'<string name="type" value="marble"/></bsdf><bsdf type="diffuse" id="moss"/>'
        + b"".join(
            b'<shape type="ply" id="mesh-%b"><string name="filename" value="%b.ply"/>%b</shape>' % row
            for row in (
                (b"ground", b"ground", b'<ref id="moss" name="bsdf"/>'),
                (b"wall", b"wall", b'<ref id="stone" name="bsdf"/>'),
                (b"behind", b"behind", b""),
            )
        )
        + b"</scene>",
        "scenery/ground.ply": ply(box((-90, 90), (-90, 90), (-1, 0))),
        "scenery/wall.ply": ply(box((30, 31), (-90, 90), (0, 20))),
        "scenery/behind.ply": ply(box((-31, -30), (-90, 90), (0, 20))),
    }
    for name, content in files.items():
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_bytes(content)
    assets = {name: tmp_path / name for name in files}
    device = CameraDevice(name="camera", position=(0, 0, 3), width=64, height=48)
    service = prepared(assets, CameraSettings(bodies_per_asset=2, body_material="wood"))
    _, depth, segmentation = seen(service, scene_of({"car.1": Body((15, 2, 1), (4, 2, 2))}, device))
    assert segmentation.object_names == ("car.1", "ground", "wall")
    assert segmentation.material_names == ("marble", "moss", "wood")
    ids = segmentation.images[0]
    assert ids.material is not None
    pairs = {(int(o), int(m)) for o, m in zip(ids.object.ravel(), ids.material.ravel(), strict=True)}
    assert pairs == {(0, 2), (1, 1), (2, 0), (-1, -1)}
    wall = ids.object == 2
    np.testing.assert_allclose(depth.images[0].depth[wall], 30.0, atol=1e-5)
