"""One world for radio and light: LIDAR, depth images and the channel's line of sight agree.

A base station, a camera and a LIDAR share one place above a street canyon with moving traffic.
Whether the straight way to a receiver is free is said by three programs: the channel's path tracer,
depth images, and LIDAR ranges.

- *Aimed*: one camera and one LIDAR look exactly at each receiver, so that the ray in their middle is
  the straight way itself. There the three must agree in every case. Tolerance 5 mm, for float32
  coordinates of 100 m and for where a ray's origin is rounded to.
- *Wide*: one image and one LIDAR turn of the whole street. A pixel's ray misses the receiver by up to
  half a pixel, so a pixel is judged where its neighbours and it say the same; at silhouettes they do
  not. What is left out is counted and must be the smaller part.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from camera_world import prepared as cameras
from camera_world import products, projected
from lidar_world import observed
from lidar_world import prepared as lidars

from caviar_labs.stability.lab import measure, sionna
from caviar_protocol.arrays import BoolArray, Float64Array
from caviar_protocol.space.coordinates import quaternion_from_euler
from caviar_protocol.topics import (
    AntennaDevice,
    CameraDevice,
    Channel,
    Depth,
    DepthImage,
    Lidar,
    LidarDevice,
    LidarScan,
    Scene,
)
from caviar_services.sensors.camera import CameraSettings
from caviar_services.sensors.lidar import LidarSettings
from caviar_services.world.assets import object_assets
from caviar_space.scenery import scenery_assets

pytestmark = pytest.mark.channel

FRAMES = 24
EYE = (0.0, -8.3, 4.0)
"""On the southern façade, so low that buses hide cars behind them."""
TOLERANCE = 5e-3
"""[m]"""
WIDE = CameraDevice(
    name="wide",
    position=EYE,
    orientation=quaternion_from_euler(np.pi / 2, 0.15),
    width=1600,
    height=400,
    field_of_view=2.75,
)
TURNING = LidarDevice(
    name="turning", position=EYE, beams=48, azimuth_steps=1440, elevation_min=-0.5, elevation_max=0.1
)


def street(frame: int) -> Scene:
    """Two lanes: buses and a lorry in the near one, cars with receivers in the far one."""
    t = 0.1 * frame
    rows = [
        ("bus.0", "bus", (-14.0 + 8.0 * t, -2.5, 1.55), (12.0, 2.5, 3.1), 0.0),
        ("bus.1", "bus", (22.0 + 7.0 * t, -2.2, 1.55), (11.0, 2.5, 3.1), 0.05),
        ("truck.0", "truck", (-48.0 + 9.0 * t, -2.4, 1.7), (8.0, 2.4, 3.4), -0.03),
        *(
            (f"car.{i}", "car", (x - 9.0 * t, 3.1, 0.75), (4.5, 1.8, 1.5), np.pi - 0.04 * i)
            for i, x in enumerate((-26.0, -3.0, 11.0, 24.0, 41.0))
        ),
    ]
    rows.sort()
    antennas = [
        AntennaDevice(name=f"{name}/rx", parent=name, role="rx", position=(0.2, 0.1, 0.75 + 0.25))
        for name, kind, *_ in rows
        if kind == "car"
    ]
    eyes = [AntennaDevice(name="bs", role="tx", position=EYE), WIDE, TURNING]
    bare = Scene(
        names=tuple(row[0] for row in rows),
        classes=tuple(row[1] for row in rows),
        assets=tuple(f"objects/{row[1]}.ply" for row in rows),
        position=np.array([row[2] for row in rows]),
        orientation=np.array([quaternion_from_euler(row[4]) for row in rows]),
        velocity=np.zeros((len(rows), 3)),
        dimensions=np.array([row[3] for row in rows]),
    )
    aimed = [device for antenna in antennas for device in aimed_at(antenna.name, position_of(bare, antenna))]
    devices = sorted([*antennas, *eyes, *aimed], key=lambda device: device.name)
    return Scene(
        **{name: getattr(bare, name) for name in bare.__struct_fields__} | {"devices": tuple(devices)}
    )


def position_of(scene: Scene, antenna: AntennaDevice) -> Float64Array:
    """World position [m] of an antenna on an object that stands upright."""
    index = scene.names.index(antenna.parent)
    w, _, _, z = scene.orientation[index]
    yaw = 2 * np.arctan2(z, w)
    x, y, up = antenna.position
    place: Float64Array = scene.position[index] + [
        x * np.cos(yaw) - y * np.sin(yaw),
        x * np.sin(yaw) + y * np.cos(yaw),
        up,
    ]
    return place


def aimed_at(name: str, place: Float64Array) -> tuple[CameraDevice, LidarDevice]:
    """A camera and a LIDAR at `EYE` whose axis goes through a point."""
    x, y, z = place - EYE
    turn = quaternion_from_euler(np.arctan2(y, x), -np.arctan2(z, np.hypot(x, y)))
    return (
        CameraDevice(
            name=f"camera to {name}", position=EYE, orientation=turn, width=5, height=5, field_of_view=0.02
        ),
        LidarDevice(
            name=f"lidar to {name}",
            position=EYE,
            orientation=turn,
            beams=1,
            azimuth_steps=4,
            elevation_min=0.0,
            elevation_max=0.0,
            max_range=500.0,
        ),
    )


@dataclass(frozen=True, eq=False)
class Seen:
    """What the three say of one frame."""

    scene: Scene
    channel: Channel
    depth: dict[str, DepthImage]
    lidar: Lidar
    places: dict[str, Float64Array]

    @property
    def scans(self) -> dict[str, LidarScan]:
        return {scan.sensor: scan for scan in self.lidar.scans}

    @property
    def los(self) -> dict[str, bool]:
        """The channel's line of sight by receiver."""
        return dict(zip(self.channel.rx, self.channel.los.ravel().tolist(), strict=True))


@pytest.fixture(scope="module")
def frames(tmp_path_factory: pytest.TempPathFactory) -> list[Seen]:
    """The same scenes through all three services."""
    folder = tmp_path_factory.mktemp("assets")
    assets = {}
    content = {**scenery_assets("sionna:simple_street_canyon"), **object_assets(["bus", "car", "truck"])}
    for name, file in content.items():
        assets[name] = file if isinstance(file, Path) else folder / name
        if isinstance(file, bytes):
            assets[name].parent.mkdir(exist_ok=True)
            assets[name].write_bytes(file)
    model = sionna(28e9, assets, samples=1000, max_depth=1, pool={"bus": 2, "car": 5, "truck": 1}, bodies=0)
    camera = cameras(assets, CameraSettings(bodies_per_asset=5), {"depth": frozenset()})
    lidar = lidars(assets, LidarSettings(bodies_per_asset=5))
    found = []
    for number in range(FRAMES):
        scene = street(number)
        depth = products(camera, scene, number)["depth"]
        assert isinstance(depth, Depth)
        receivers = [d for d in scene.devices if isinstance(d, AntennaDevice) and d.role == "rx"]
        found.append(
            Seen(
                scene,
                measure(model, scene),
                {image.sensor: image for image in depth.images},
                observed(lidar, scene, number),
                {antenna.name: position_of(scene, antenna) for antenna in receivers},
            )
        )
    return found


def test_both_states_occur(frames: list[Seen]) -> None:
    """Otherwise the others would show little; some receiver also changes from one to the other."""
    states = np.array([list(seen.los.values()) for seen in frames])
    assert states.shape == (FRAMES, 5)
    assert 20 < states.sum() < states.size - 20
    assert (states != states[0]).any()


def test_aimed_depth_and_range_equal_the_channels_line_of_sight(frames: list[Seen]) -> None:
    """In every frame, for every receiver, without exception."""
    for number, seen in enumerate(frames):
        for name, los in seen.los.items():
            distance = float(np.linalg.norm(seen.places[name] - EYE))
            depth = float(seen.depth[f"camera to {name}"].depth[2, 2])
            ahead = seen.scans[f"lidar to {name}"]
            ranges = ahead.range[ahead.ray == 0]
            reach = float(ranges[0]) if len(ranges) else np.inf
            free = depth == 0.0 or depth >= distance - TOLERANCE
            assert free == los, (number, name, depth, distance)
            assert (reach >= distance - TOLERANCE) == los, (number, name, reach, distance)
            if np.isfinite(reach):
                assert reach == pytest.approx(depth, abs=TOLERANCE)


def neighbourhood(image: DepthImage, column: float, row: float) -> Float64Array:
    """Depths [m] of the 3 × 3 pixels around a point; infinite where nothing is hit."""
    height, width = image.depth.shape
    i, j = int(row), int(column)
    around = image.depth[max(i - 1, 0) : i + 2, max(j - 1, 0) : j + 2].astype(np.float64).ravel()
    assert 0 <= i < height
    assert 0 <= j < width
    return np.where(around > 0, around, np.inf)


FORWARD = np.array([0.0, np.cos(0.15), -np.sin(0.15)])
UP = np.array([0.0, np.sin(0.15), np.cos(0.15)])


def test_a_wide_depth_image_agrees_where_it_is_unambiguous(frames: list[Seen]) -> None:
    """A receiver is hidden in its pixel, and in those around it, if and only if it has no line of sight."""
    judged = {True: 0, False: 0}
    for seen in frames:
        for name, los in seen.los.items():
            (place,) = projected(WIDE, FORWARD, UP, np.array(EYE), seen.places[name][None])
            free = neighbourhood(seen.depth["wide"], place[0], place[1]) >= place[2] - TOLERANCE
            assert free.size == 9, "in the image, not at its border"
            if free.all() or not free.any():
                assert bool(free.all()) == los, (name, place)
                judged[los] += 1
    assert min(judged.values()) > 20
    assert sum(judged.values()) > 0.75 * FRAMES * 5


def test_a_turning_lidar_and_a_wide_depth_image_see_the_same_surfaces(frames: list[Seen]) -> None:
    """Each LIDAR point, projected, lies between the depths of its pixel's neighbourhood.

    Left out are points whose neighbours lie more than half a metre apart: silhouettes, and surfaces that
    are seen at a grazing angle.
    """
    for seen in frames:
        points = seen.scans["turning"].points_world.astype(np.float64)
        pixel = projected(WIDE, FORWARD, UP, np.array(EYE), points)
        inside: BoolArray = (
            (pixel[:, 2] > 0.5)
            & (pixel[:, 0] > 1)
            & (pixel[:, 0] < WIDE.width - 1)
            & (pixel[:, 1] > 1)
            & (pixel[:, 1] < WIDE.height - 1)
        )
        column, row = pixel[inside, :2].astype(int).T
        depth = seen.depth["wide"].depth
        around = np.stack([depth[row + dy, column + dx] for dy in (-1, 0, 1) for dx in (-1, 0, 1)])
        low, high = around.min(axis=0), around.max(axis=0)
        smooth = (low > 0) & (high - low < 0.5)
        assert inside.sum() > 5000
        assert smooth.mean() > 0.8
        off = np.maximum(low - pixel[inside, 2], pixel[inside, 2] - high)[smooth]
        assert np.mean(off > TOLERANCE) < 0.005, "what begins to show between two pixels' centres"
        # A ray that meets the edge of two triangles may slip through between them, one in 10,000.
        assert np.mean(off > 0.2) < 1e-4
