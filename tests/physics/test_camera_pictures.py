"""Pictures: light where the sun shines, shadow where geometry puts it, smooth edges, the same bytes."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from camera_world import prepared, products, projected, seen
from lidar_world import Body, scene_of

from caviar_protocol.arrays import UInt8Array
from caviar_protocol.codec import encode_payload
from caviar_protocol.errors import ScenarioError
from caviar_protocol.space.coordinates import quaternion_from_euler
from caviar_protocol.topics import CameraDevice, Scene
from caviar_services.sensors.camera import CameraSensors, CameraSettings
from caviar_space.meshes import box, ply

pytestmark = pytest.mark.channel

BLOCK = Body((0.0, 0.0, 5.0), (4.0, 4.0, 10.0))
ABOVE = CameraDevice(
    name="camera",
    position=(0.0, 0.0, 60.0),
    orientation=quaternion_from_euler(0.0, np.pi / 2),
    width=200,
    height=200,
    field_of_view=1.0,
)
"""Looks down; +x is up in its image, +y left."""


@pytest.fixture(scope="module")
def plain(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Assets: a wide concrete plain at z = 0."""
    folder = tmp_path_factory.mktemp("plain")
    files = {
        "scenery/plain.xml": b'<scene><bsdf type="itu-radio-material" id="c"><string name="type" '
        b'value="concrete"/></bsdf><shape type="ply" id="mesh-plain"><string name="filename" '
        b'value="plain.ply"/><ref id="c" name="bsdf"/></shape></scene>',
        "scenery/plain.ply": ply(box((-500, 500), (-500, 500), (-1, 0))),
    }
    for name, content in files.items():
        (folder / name).parent.mkdir(exist_ok=True)
        (folder / name).write_bytes(content)
    return {name: folder / name for name in files}


@pytest.fixture(scope="module")
def service(plain: dict[str, Path]) -> CameraSensors:
    """The sun stands in the east, 45° high."""
    sun = CameraSettings(bodies_per_asset=8, sun_azimuth_deg=0.0, sun_elevation_deg=45.0)
    return prepared(plain, sun, {"camera": frozenset()})


def picture(service: CameraSensors, scene: Scene) -> UInt8Array:
    rgb: UInt8Array = products(service, scene)["camera"].images[0].rgb  # type: ignore[attr-defined]
    return rgb


def brightness_at(rgb: UInt8Array, *points: tuple[float, float, float]) -> list[float]:
    """Mean of the channels at world points, as `ABOVE` sees them."""
    axes = (np.array([0.0, 0.0, -1.0]), np.array([1.0, 0.0, 0.0]), np.array(ABOVE.position))
    pixels = projected(ABOVE, *axes, np.array(points))
    return [float(rgb[int(y), int(x)].mean()) for x, y, _ in pixels]


def test_a_shadow_falls_where_the_sun_puts_it(service: CameraSensors) -> None:
    """10 m high and 45°: from the western foot of the block to 10 m west of its eastern edge's."""
    rgb = picture(service, scene_of({"block": BLOCK}, ABOVE))
    west, beyond, north, east = brightness_at(rgb, (-9.0, 0, 0), (-13.5, 0, 0), (-7, 4.0, 0), (9.0, 0, 0))
    assert west < 0.8 * beyond
    assert beyond == pytest.approx(east, rel=0.06)
    assert north == pytest.approx(east, rel=0.06)


def test_without_sun_there_is_no_shadow_but_dimmer_corners(plain: dict[str, Path]) -> None:
    """Below the horizon it lights nothing; the sky does, less where a wall hides half of it."""
    night = CameraSettings(bodies_per_asset=8, sun_elevation_deg=-30.0)
    rgb = picture(prepared(plain, night, {"camera": frozenset()}), scene_of({"block": BLOCK}, ABOVE))
    west, east, foot, open_field = brightness_at(rgb, (-9, 0, 0), (9, 0, 0), (2.6, 0, 0), (18.0, 0, 0))
    assert west == pytest.approx(east, rel=0.02)
    assert foot < 0.97 * open_field


def test_the_same_scene_gives_the_same_bytes(plain: dict[str, Path], service: CameraSensors) -> None:
    """Whatever came before, and whatever else is asked for; so digests do not depend on it."""
    scene = scene_of({"block": BLOCK}, ABOVE)
    first = products(service, scene)["camera"]
    for n in range(3):
        products(service, scene_of({"a": Body((n, 8, 1), (2, 2, 2)), "block": BLOCK}, ABOVE))
    service.release_memory()
    assert encode_payload(products(service, scene)["camera"]) == encode_payload(first)
    more = CameraSettings(bodies_per_asset=8, sun_azimuth_deg=0.0, sun_elevation_deg=45.0)
    assert encode_payload(seen(prepared(plain, more), scene)[0]) == encode_payload(first)


def test_another_camera_changes_nothing_in_a_picture(service: CameraSensors) -> None:
    other = CameraDevice(name="aside", position=(9, 9, 9), width=31, height=17)
    alone = picture(service, scene_of({"block": BLOCK}, ABOVE))
    both = products(service, scene_of({"block": BLOCK}, ABOVE, other))["camera"]
    aside, above = both.images  # type: ignore[attr-defined]
    assert aside.rgb.shape == (17, 31, 3)
    np.testing.assert_array_equal(above.rgb, alone)


def test_slanted_edges_are_smooth(service: CameraSensors) -> None:
    """Against the sky, pixels on an edge are mixed: neither of the block's colour nor of the sky's."""
    device = CameraDevice(name="camera", position=(0, 0, 8), width=160, height=120)
    turned = Body((12, 0, 8), (1, 30, 4), quaternion_from_euler(0.0, 0.0, 0.2))
    sky, both = (picture(service, scene_of(bodies, device)).astype(int) for bodies in ({}, {"beam": turned}))
    change = np.abs(both - sky).sum(axis=2)[:56, 60:100]
    full = np.median(change[54])
    mixed = (change > 0.15 * full) & (change < 0.85 * full)
    assert full > 60
    assert 0.5 < mixed.sum(axis=0).mean() < 2, "of the beam's upper edge, in each column"


def test_classes_have_colours_of_their_own_and_can_be_given_others(plain: dict[str, Path]) -> None:
    scene = scene_of({"block": BLOCK}, ABOVE)
    blue = CameraSettings(bodies_per_asset=8, colours={"car": (0.05, 0.1, 0.9), "concrete": (0.1, 0.5, 0.1)})
    default = picture(prepared(plain, demand={"camera": frozenset()}), scene).astype(int)
    changed = picture(prepared(plain, blue, {"camera": frozenset()}), scene).astype(int)
    roof, ground = (100, 100), (20, 20)
    assert default[roof][0] > default[roof][2] + 40, "a car is red"
    assert np.ptp(default[ground]) < 40, "concrete is grey"
    assert changed[roof][2] > changed[roof][0] + 40
    assert changed[ground][1] > changed[ground][0] + 40


def test_a_colour_out_of_range_is_refused() -> None:
    with pytest.raises(ScenarioError, match=r"camera\.settings\.colours\.marble.*255.*0.*1"):
        prepared(settings=CameraSettings(colours={"marble": (255, 250, 240)}))
