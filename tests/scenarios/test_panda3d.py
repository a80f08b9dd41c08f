"""Scenario ``panda3d``, a whole run: rays meet the walls that the engine shows."""

from __future__ import annotations

import importlib.util

import numpy as np
import pytest
from scenarios_support import SCENARIOS, Finished, run

from caviar_protocol.recording import Recording
from caviar_protocol.topics import Camera, Channel, Depth, Lidar, Scene

ABSENT = [name for name in ("panda3d", "sionna", "mitsuba") if importlib.util.find_spec(name) is None]

pytestmark = [
    pytest.mark.slow,
    pytest.mark.channel,
    pytest.mark.skipif(bool(ABSENT), reason=f"needs {', '.join(ABSENT)}"),
]

CHANGES = [
    ("frames = 100", "frames = 3"),
    ('"file:panda3d/town.egg"', f'"{SCENARIOS / "panda3d" / "town.egg"}"'),
    ('"lidar", "camera"', '"lidar", "camera", "depth"'),
    ("samples = 100_000", "samples = 2_000"),
    ("size_px = [480, 320]", "size_px = [120, 80]"),
    ("azimuth_steps = 900", "azimuth_steps = 90"),
]
"""To the scenario that ships, for a short run with small pictures."""


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Finished:
    """The run, in one process."""
    text = (SCENARIOS / "panda3d.toml").read_text()
    for before, after in CHANGES:
        assert before in text
        text = text.replace(before, after)
    folder = tmp_path_factory.mktemp("panda3d")
    (folder / "short.toml").write_text(text)
    done = run(folder / "short.toml", folder / "runs", "--embedded", timeout=240)
    assert done.status == 0, done.output
    return done


def test_the_engine_and_ray_tracing_see_sky_in_the_same_pixels(finished: Finished) -> None:
    """But for pixels with an edge in them, in which the two sample at other points."""
    recording = Recording(finished.directory)
    assert len(recording) == 3
    for frame in recording.frames():
        pictures = frame.payloads("camera", Camera)
        assert set(pictures) == {"engine", "camera"}
        (depth,) = frame.payloads("depth", Depth).values()
        for drawn, traced, far in zip(
            pictures["engine"].images, pictures["camera"].images, depth.images, strict=True
        ):
            assert drawn.sensor == traced.sensor == far.sensor
            assert (drawn.position, drawn.orientation) == (traced.position, traced.orientation)
            assert drawn.intrinsics == traced.intrinsics
            # Where the renderer rounds a channel the other way, it is off by one.
            sky = (np.abs(drawn.rgb.astype(int) - (184, 209, 237)) <= 1).all(axis=2)
            assert 0.005 < sky.mean() < 0.9
            assert (sky == (far.depth == 0)).mean() > 0.98


def test_rays_of_channel_and_lidar_meet_the_model(finished: Finished) -> None:
    """Names of what they hit are those of the model's nodes."""
    for frame in Recording(finished.directory).frames():
        (channel,) = frame.payloads("channel", Channel).values()
        assert {"bank", "office", "market", "hall", "tower", "flats"} & set(channel.object_names)
        assert channel.los.any()
        (lidar,) = frame.payloads("lidar", Lidar).values()
        assert {"road", "bank"} <= set(lidar.object_names)


def test_the_pilot_flies_the_uav_in_the_engine(finished: Finished) -> None:
    """From the first command on, which acts in the second frame, with 5 m/s²."""
    scenes = [frame.scene() for frame in Recording(finished.directory).frames()]
    speeds = [
        np.linalg.norm(scene.velocity[scene.names.index("uav")])
        for scene in scenes
        if isinstance(scene, Scene)
    ]
    np.testing.assert_allclose(speeds, [0.0, 0.5, 1.0], atol=1e-3)
