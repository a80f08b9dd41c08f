"""The map and the LIDAR picture: what is where in them."""

from __future__ import annotations

import math

import msgspec
import numpy as np
import pytest
from recording_builders import channel, frame_of, grid_only, lidar, link, record, scene

from caviar_clients.cli.plot import beam_amplitude, plot_run
from caviar_clients.plots.map import (
    RECEIVER,
    WITHOUT_LOS,
    WITHOUT_PATH,
    MapData,
    chosen_beam,
    draw_antennas,
    draw_map,
    draw_objects,
    receiver_mark,
    served_object,
    view_of,
)
from caviar_clients.plots.rays import rays
from caviar_clients.plots.sensors import draw_scan, range_image
from caviar_clients.plots.style import Labels, common_prefix
from caviar_protocol.space.antenna_arrays import beam_towards, pointing_directions
from caviar_protocol.space.scene import device_pose
from caviar_protocol.topics import AntennaArray, AntennaDevice, LidarDevice, LidarScan

pytestmark = pytest.mark.slow

pytest.importorskip("matplotlib")
Image = pytest.importorskip("PIL.Image")

USER = ("bs", "car.1/rx", "c0")


def a_map(**changes) -> MapData:
    given = {
        "scene": scene(2),
        "channel": channel(2),
        "link": link(2),
        "footprints": None,
        "beam_gain": beam_amplitude,
        "user": USER,
        "title": "sample",
    }
    return MapData(**(given | changes))


def test_a_receiver_shows_whether_it_has_line_of_sight_or_no_path_at_all():
    assert receiver_mark(None, "car.0/rx") is RECEIVER
    assert receiver_mark(link(1), "stranger/rx") is RECEIVER
    assert receiver_mark(link(1), "car.0/rx") is RECEIVER
    assert receiver_mark(link(0), "car.0/rx") is WITHOUT_LOS  # the sample is NLOS in frames 0, 5, …
    assert receiver_mark(link(1, without_path=(0,)), "car.0/rx") is WITHOUT_PATH


@pytest.mark.parametrize(
    ("n", "without", "labels"), [(1, (), []), (1, (0,), ["receiver, no path"]), (0, (), ["receiver, NLOS"])]
)
def test_the_legend_of_a_map_says_so(n, without, labels):
    from matplotlib.figure import Figure

    axes = Figure().subplots()
    draw_antennas(axes, a_map(link=link(n, without_path=without)))
    shown = axes.get_legend_handles_labels()[1]
    assert [label for label in shown if "," in label] == labels


def test_rays_run_from_transmitter_over_their_points_to_the_receiver():
    data = a_map()
    found = rays(data.scene, data.channel)
    lines, gains = found.lines, found.gains
    assert not len(found.tick_gains)
    assert len(lines) == 4  # two cars with two paths each, the third has none
    receiver = next(d for d in data.scene.devices if d.name == "car.1/rx")
    end = device_pose(data.scene, receiver).position
    direct, bounced = (line for line in lines if np.allclose(line[-1], end))
    assert direct.shape == (2, 3)
    assert bounced.shape == (3, 3)
    assert bounced[1, 1] == pytest.approx(30.0)
    for line in (direct, bounced):
        np.testing.assert_allclose(line[0][:2], [0.0, 20.0])
    strongest = 20 * math.log10(1e-3 / np.linalg.norm(np.array(end[:2]) - [0, 20]))
    assert gains.max() == pytest.approx(strongest, abs=2.0)


@pytest.mark.parametrize("pattern", ["iso", "tr38901"])
@pytest.mark.parametrize(("rows", "columns"), [(1, 16), (4, 8)])
def test_the_gain_of_a_beam_is_greatest_where_the_beam_points(pattern, rows, columns):
    array = AntennaArray(rows=rows, columns=columns, pattern=pattern)
    towards = np.array([math.cos(0.3), math.sin(0.3), 0.0])
    beam = int(beam_towards(array, towards))
    (pointing, *_) = pointing_directions(array, beam)
    level = math.hypot(pointing[0], pointing[1])
    azimuth = np.linspace(-np.pi / 2, np.pi / 2, 1801)
    around = np.stack([level * np.cos(azimuth), level * np.sin(azimuth), np.full(1801, pointing[2])], axis=-1)
    gain = beam_amplitude(array, beam, around)
    found = azimuth[np.argmax(gain)]
    # The element pattern pulls the greatest gain a little towards boresight.
    assert found == pytest.approx(
        math.atan2(pointing[1], pointing[0]), abs=0.01 if pattern == "iso" else 0.03
    )


def test_the_lobe_stands_at_the_array_and_points_to_the_user():
    data = a_map()
    receiver = next(d for d in data.scene.devices if d.name == "car.1/rx")
    target = np.array(device_pose(data.scene, receiver).position) - [0.0, 20.0, 15.0]
    # In the axes of the base station, which is turned by −90°: x' = −y, y' = x.
    local = np.array([-target[1], target[0], target[2]]) / np.linalg.norm(target)
    chosen = int(beam_towards(AntennaArray(columns=16), local))
    links = link(2)
    links.tx_beam[:] = chosen
    beam = chosen_beam(a_map(link=links))
    assert beam is not None
    assert beam.label == f"beam {chosen} of bs on c0, chosen for car.1/rx"
    reach = beam.outline - [0.0, 20.0]
    in_front = reach[reach[:, 1] < 0]
    tip = in_front[np.argmax(np.linalg.norm(in_front, axis=1))]
    between = math.atan2(tip[1], tip[0]) - math.atan2(target[1], target[0])
    assert abs(between) < math.radians(7.2)  # half the spacing of 16 beams, and some


@pytest.mark.parametrize(
    "changes", [{"link": None}, {"user": None}, {"user": ("bs", "gone/rx", "c0")}, {"beam_gain": None}]
)
def test_without_a_chosen_beam_there_is_no_lobe(changes):
    assert chosen_beam(a_map(**changes)) is None


def test_the_view_holds_everything_and_is_never_tiny():
    data = a_map()
    (left, right), (bottom, top) = view_of(data, None)
    x, y = data.scene.position[:, 0], data.scene.position[:, 1]
    assert left < x.min()
    assert x.max() < right
    assert bottom < y.min()
    assert top > 30.0  # the wall that reflects
    single = a_map(scene=scene(0, cars=1), channel=None)
    (left, right), (bottom, top) = view_of(single, None)
    assert right - left >= 40.0
    assert top - bottom >= 40.0


def test_a_ray_that_strays_far_does_not_shrink_the_picture():
    far = channel(2)
    points = far.points.copy()
    points[1, 0] = [900.0, 30.0, 0.0]
    (left, right), _ = view_of(a_map(channel=msgspec.structs.replace(far, points=points)), None)
    assert right - left < 100.0


def test_names_lose_what_all_have_in_common():
    assert common_prefix(["vehicle.east.1", "vehicle.east.2"]) == "vehicle.east."
    assert common_prefix(["vehicle.east.1", "vehicle.west.1"]) == "vehicle."
    assert common_prefix(["car", "uav"]) == ""
    assert common_prefix(["world.car"]) == ""


def test_of_many_objects_the_one_that_the_beam_is_for_stands_out_and_is_named_first():
    """Forty cars in one spot leave room for some names only, and that one's comes last in the alphabet."""
    from matplotlib.figure import Figure

    crowd = scene(2)
    names = tuple(f"car.{i:02}" for i in range(40))
    place = np.tile(crowd.position[:1], (40, 1)) + np.arange(40)[:, None] * [0.3, 0.0, 0.0]
    many = {
        "names": names,
        "classes": crowd.classes[:1] * 40,
        "assets": crowd.assets[:1] * 40,
        "position": place,
        "orientation": np.tile(crowd.orientation[:1], (40, 1)),
        "velocity": np.tile(crowd.velocity[:1], (40, 1)),
        "dimensions": np.tile(crowd.dimensions[:1], (40, 1)),
        "devices": tuple(AntennaDevice(name=f"{name}/rx", parent=name, role="rx") for name in names),
    }
    data = a_map(scene=msgspec.structs.replace(crowd, **many), user=("bs", "car.39/rx", "c0"))
    assert served_object(data) == "car.39"
    assert served_object(a_map(user=None)) == ""
    axes = Figure().subplots()
    axes.set_xlim(place[0, 0] - 20, place[0, 0] + 30)
    axes.set_ylim(place[0, 1] - 20, place[0, 1] + 20)
    draw_objects(axes, data, Labels(marked=served_object(data)))
    shown = {text.get_text(): text.get_fontweight() for text in axes.texts}
    assert shown["39"] == "bold"
    assert len(shown) < 40
    assert [name for name, weight in shown.items() if weight == "bold"] == ["39"]


def test_the_range_image_has_ahead_in_the_middle_and_left_on_the_left():
    device = LidarDevice(name="l", beams=2, azimuth_steps=8)
    # Ray 2 of the upper beam looks 90° to the left, ray 0 of the lower one ahead, ray 6 right.
    ray = np.array([0, 6, 8 + 2], np.int32)
    scan = LidarScan(
        sensor="l",
        position=(0, 0, 0),
        orientation=(1, 0, 0, 0),
        ray=ray,
        points=np.zeros((3, 3), np.float32),
        points_world=np.zeros((3, 3), np.float32),
        range=np.array([1, 2, 3], np.float32),
        object=np.zeros(3, np.int32),
    )
    image = range_image(scan, device)
    assert image.shape == (2, 8)
    # Columns: 180, 135, 90, 45, 0, −45, −90, −135 degrees.
    assert image[0, 4] == 1.0
    assert image[0, 6] == 2.0
    assert image[1, 2] == 3.0
    assert np.isnan(image).sum() == 13


def colours(file) -> set[tuple[int, ...]]:
    with Image.open(file) as picture:
        assert picture.format == "PNG"
        pixels = np.asarray(picture.convert("RGB")).astype(np.int64)
    found = np.unique((pixels[..., 0] << 16) + (pixels[..., 1] << 8) + pixels[..., 2]).tolist()
    return {(c >> 16, c >> 8 & 255, c & 255) for c in found}


@pytest.mark.parametrize(
    "changes", [{}, {"channel": None}, {"link": None}, {"scene": scene(0, cars=1), "channel": None}]
)
def test_the_map_is_drawn_whatever_is_missing(tmp_path, changes):
    file = tmp_path / "map.png"
    draw_map(a_map(**changes), file)
    assert (0xE6, 0x9F, 0x00) in colours(file)  # objects with a device


@pytest.mark.parametrize("with_scene", [True, False])
def test_the_scan_is_drawn_with_and_without_a_scene(tmp_path, with_scene):
    payload = lidar(1)
    file = tmp_path / "lidar.png"
    draw_scan(payload.scans[0], payload, scene(1) if with_scene else None, "sample", file)
    assert ((0xE6, 0x9F, 0x00) in colours(file)) is with_scene  # hits on a moving object


def test_a_scan_without_hits_is_drawn(tmp_path):
    empty = LidarScan(
        sensor="car.0/top",
        position=(0, 0, 1),
        orientation=(1, 0, 0, 0),
        ray=np.zeros(0, np.int32),
        points=np.zeros((0, 3), np.float32),
        points_world=np.zeros((0, 3), np.float32),
        range=np.zeros(0, np.float32),
        object=np.zeros(0, np.int32),
    )
    draw_scan(empty, lidar(0), scene(0), "empty", tmp_path / "lidar.png")
    assert (tmp_path / "lidar.png").stat().st_size > 1000


def test_a_recording_of_grids_alone_has_a_picture_of_the_grid(tmp_path):
    run = record(tmp_path / "run", [frame_of(0, scene=scene(0), lidar=grid_only())])
    (file,) = (file for file in plot_run(run) if file.stem == "lidar")
    found = colours(file)
    assert {(0x44, 0x01, 0x54), (0xFD, 0xE7, 0x25), (0xE6, 0x9F, 0x00)} <= found  # both heights, the antenna


def test_a_name_stays_on_the_side_where_it_was_and_is_never_cut():
    from matplotlib.figure import Figure

    axes = Figure().subplots()
    axes.set(xlim=(-35.0, 35.0), ylim=(-20.0, 40.0))
    labels = Labels(width=400.0, prefix="car.", marked="car.1")
    draw_objects(axes, a_map(scene=scene(0)), labels)
    assert {text.get_text() for text in axes.texts} == {"0", "1", "2"}
    (marked,) = (text for text in axes.texts if text.get_fontweight() == "bold")
    assert marked.get_text() == "1"
    labels.sides["car.0"] = 1  # below, where it had no need to be
    for text in list(axes.texts):
        text.remove()
    draw_objects(axes, a_map(scene=scene(1)), labels)
    heights = {text.get_text(): text.get_position()[1] for text in axes.texts}
    assert heights["0"] < 0.0 < heights["2"]
    axes.set_xlim(-29.0, 41.0)  # cuts the first car
    for text in list(axes.texts):
        text.remove()
    draw_objects(axes, a_map(scene=scene(0)), Labels(width=400.0, prefix=""))
    assert {text.get_text() for text in axes.texts} >= {"car.1", "car.2"}
    assert all(text.get_position()[0] >= -29.0 for text in axes.texts)
