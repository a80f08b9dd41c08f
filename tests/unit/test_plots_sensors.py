"""Pictures of what a camera saw."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from recording_builders import frame_of, record, scene

from caviar_clients.cli.plot import plot_run
from caviar_clients.plots.sensors import CameraView, draw_view, largest, object_colours
from caviar_protocol.errors import RecordingError
from caviar_protocol.topics import (
    Camera,
    CameraImage,
    Depth,
    DepthImage,
    Intrinsics,
    Segmentation,
    SegmentationImage,
)

pytestmark = pytest.mark.slow

pytest.importorskip("matplotlib")

RNG = np.random.default_rng(5)
VIEW = CameraView(
    sensor="pole",
    rgb=RNG.integers(0, 256, (30, 40, 3)).astype(np.uint8),
    depth=np.linspace(0, 90, 1200, dtype=np.float32).reshape(30, 40),
    objects=(np.arange(1200, dtype=np.int32).reshape(30, 40) // 300) - 1,
    object_names=("bus", "car", "wall"),
    normals=np.tile(np.array([0, 0, 1], dtype=np.float32), (30, 40, 1)),
    materials=np.zeros((30, 40), dtype=np.int32),
    material_names=("metal",),
    moving=frozenset({"car", "bus"}),
)


def test_each_image_gets_a_picture_and_all_get_one(tmp_path: Path) -> None:
    files = draw_view(VIEW, "frame 3", tmp_path)
    kinds = ["", "-rgb", "-depth", "-normals", "-segmentation", "-materials"]
    assert [file.name for file in files] == [f"camera{kind}.png" for kind in kinds]
    assert all(file.stat().st_size > 500 for file in files)


def test_the_rgb_picture_has_the_pixels_of_the_image(tmp_path: Path) -> None:
    from matplotlib.image import imread

    draw_view(VIEW, "frame 3", tmp_path)
    read = imread(tmp_path / "camera-rgb.png")[..., :3]
    np.testing.assert_array_equal(np.round(255 * read).astype(np.uint8), VIEW.rgb)


def test_what_is_not_there_is_not_drawn(tmp_path: Path) -> None:
    lone = replace(VIEW, rgb=None, normals=None, objects=None, materials=None)
    assert [file.name for file in draw_view(lone, "", tmp_path)] == ["camera.png", "camera-depth.png"]


def test_an_image_of_sky_alone_is_drawn(tmp_path: Path) -> None:
    sky = CameraView(
        sensor="up",
        depth=np.zeros((6, 8), dtype=np.float32),
        objects=np.full((6, 8), -1, dtype=np.int32),
        normals=np.zeros((6, 8, 3), dtype=np.float32),
    )
    assert len(draw_view(sky, "", tmp_path)) == 4


def test_another_depth_gives_another_picture(tmp_path: Path) -> None:
    """The scale is logarithmic, so other ratios show."""
    assert VIEW.depth is not None
    draw_view(VIEW, "", tmp_path / "a")
    draw_view(replace(VIEW, depth=VIEW.depth**2), "", tmp_path / "b")
    a, b = (tmp_path / name / "camera-depth.png" for name in "ab")
    assert a.read_bytes() != b.read_bytes()


def test_moving_objects_have_strong_colours_that_differ_and_scenery_pale_ones() -> None:
    names = tuple(f"car.{i:02}" for i in range(30)) + tuple(f"wall.{i:02}" for i in range(30))
    colours = object_colours(names, frozenset(names[:30]))
    spread = colours.max(axis=1) - colours.min(axis=1)
    assert spread[:30].min() > 1.5 * spread[30:].max()
    apart = np.abs(colours[:30, None] - colours[None, :30]).sum(axis=2)
    assert apart[~np.eye(30, dtype=bool)].min() > 0.03


def test_the_legend_names_the_largest_and_leaves_room_for_scenery() -> None:
    names = (*(f"car.{i:02}" for i in range(40)), "road", "wall")
    ids = np.concatenate([np.repeat(np.arange(42), np.arange(42) + 1), np.full(99, -1)]).astype(np.int32)
    chosen = [names[i] for i in largest(ids, names, frozenset(names[:40]))]
    assert chosen[:3] == ["car.39", "car.38", "car.37"]
    assert chosen[-2:] == ["wall", "road"]
    assert len(chosen) == 16
    assert [names[i] for i in largest(ids[:1], names, frozenset())] == ["car.00"]


def recorded(folder: Path) -> Path:
    """Two frames with a fixed camera and one on a car."""
    made = []
    for n in range(2):
        optics = {
            "intrinsics": Intrinsics(fx=4.0, fy=4.0, cx=4.0, cy=3.0),
            "orientation": (1.0, 0.0, 0.0, 0.0),
        }
        sensors = [{**optics, "sensor": name, "position": (0.0, 0.0, 3.0)} for name in ("car.0/eye", "pole")]
        rgb = [np.full((6, 8, 3), 40 * i + n, dtype="|u1") for i in range(2)]
        depth = np.full((6, 8), 5.0 + n, dtype="<f4")
        ids = np.zeros((6, 8), dtype="<i4")
        payloads = {
            "scene": scene(n),
            "camera": Camera(
                images=tuple(CameraImage(**s, rgb=c) for s, c in zip(sensors, rgb, strict=True))
            ),
            "depth": Depth(images=tuple(DepthImage(**s, depth=depth) for s in sensors)),
            "segmentation": Segmentation(
                object_names=("road",), images=tuple(SegmentationImage(**s, object=ids) for s in sensors)
            ),
        }
        made.append(frame_of(n, **payloads))
    return record(folder, made)


def test_plot_draws_the_fixed_camera_of_a_recording_or_the_one_asked_for(tmp_path: Path) -> None:
    from matplotlib.image import imread

    run = recorded(tmp_path / "run")
    names = ["map", "camera", "camera-rgb", "camera-depth", "camera-segmentation"]
    assert [file.stem for file in plot_run(run, frame=1)] == names
    assert round(255 * float(imread(run / "camera-rgb.png")[0, 0, 0])) == 41
    fixed = (run / "camera-rgb.png").read_bytes()
    files = plot_run(run, frame=0, camera="car.0/eye")
    assert [file.stem for file in files[1:3]] == ["camera-car.0-eye", "camera-car.0-eye-rgb"]
    assert round(255 * float(imread(files[2])[0, 0, 0])) == 0
    assert (run / "camera-rgb.png").read_bytes() == fixed


def test_a_camera_that_is_not_there_is_refused_with_those_that_are(tmp_path: Path) -> None:
    run = recorded(tmp_path / "run")
    with pytest.raises(RecordingError, match=r"'pol'.*'pole'"):
        plot_run(run, tmp_path, camera="pol")
    with pytest.raises(RecordingError, match=r"frame 0.*'x'.*car\.0/eye, pole"):
        plot_run(run, tmp_path, frame=0, camera="x")
