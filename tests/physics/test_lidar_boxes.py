"""LIDAR ranges, points and hit objects against boxes whose ranges follow from the slab method.

Tolerance: 0.1 mm on rays that hit a face at more than a grazing angle and pass no edge within 2 mm;
float32 rounds coordinates of 100 m to 8 µm.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np
import pytest
from lidar_world import Body, expected, observed, prepared, scene_of

from caviar_labs.stability.lab import Plate, write_scenery
from caviar_protocol.space.coordinates import Pose, compose, multiply, quaternion_from_euler, rotation_matrix
from caviar_protocol.topics import LidarDevice
from caviar_services.sensors.lidar import GridSettings, LidarSensors, LidarSettings
from caviar_space.meshes import box, ply

pytestmark = pytest.mark.channel

TOLERANCE = 1e-4
"""[m]"""


@pytest.fixture(scope="module")
def service() -> LidarSensors:
    """A LIDAR service without scenery."""
    return prepared(settings=LidarSettings(bodies_per_asset=32))


def random_bodies(rng: np.random.Generator, count: int) -> dict[str, Body]:
    """Turned boxes of unequal edges all around, none nearer than 4 m."""
    bodies = {}
    for index in range(count):
        distance, bearing = rng.uniform(12, 40), rng.uniform(0, 2 * np.pi)
        bodies[f"box{index}"] = Body(
            position=(distance * np.cos(bearing), distance * np.sin(bearing), rng.uniform(-6, 6)),
            dimensions=(rng.uniform(2, 9), rng.uniform(1, 6), rng.uniform(1, 8)),
            orientation=quaternion_from_euler(*rng.uniform(-np.pi, np.pi, 3) * (1, 0.4, 0.4)),
        )
    return bodies


def tilted_lidar(rng: np.random.Generator, parent: str = "") -> LidarDevice:
    return LidarDevice(
        name="lidar",
        parent=parent,
        position=tuple(rng.uniform(-2, 2, 3)),
        orientation=quaternion_from_euler(rng.uniform(-3, 3), *rng.uniform(-0.5, 0.5, 2)),
        beams=24,
        azimuth_steps=360,
        elevation_min=-0.5,
        elevation_max=0.3,
        max_range=200.0,
    )


@pytest.mark.parametrize("standing", [False, True])
@pytest.mark.parametrize("away", [(5e5, 5e6, 100.0), (1e7, 1e7 / 3, 0.0)])
def test_ranges_and_grid_are_the_same_far_from_the_origin(
    tmp_path: Path, away: tuple[float, float, float], standing: bool
) -> None:
    scans = []
    for number, origin in enumerate([(0.0, 0.0, 0.0), away]):
        assets, high = {}, tuple(o + 60.0 for o in origin)
        if standing:
            corners = np.array([[45, -40, -9], [45, 40, -9], [45, 40, 9], [45, -40, 9]]) + np.array(origin)
            folder = tmp_path / str(number)
            assets = write_scenery(folder, [Plate("wall", corners.tolist())])
        grid = GridSettings(
            minimum_m=tuple(o - 60.0 for o in origin), maximum_m=high, cells=(40, 40, 40), min_height_m=-1e3
        )
        service = prepared(assets, LidarSettings(bodies_per_asset=32, grid=grid), frozenset({"grid"}))
        bodies = {
            name: replace(body, position=tuple(np.add(body.position, origin)))
            for name, body in random_bodies(np.random.default_rng(3), 12).items()
        }
        lidar = tilted_lidar(np.random.default_rng(4))
        lidar = msgspec.structs.replace(lidar, position=tuple(np.add(lidar.position, origin)))
        scans.append(observed(service, scene_of(bodies, lidar)).scans[0])
    near, far = scans
    both, one, other = np.intersect1d(near.ray, far.ray, return_indices=True)
    assert len(near.ray) == len(far.ray) == len(both) > 500
    assert np.abs(near.range[one] - far.range[other]).max() < 1e-3
    assert near.grid is not None
    assert far.grid is not None
    assert np.array_equal(near.grid.occupancy, far.grid.occupancy)


@pytest.mark.parametrize("seed", range(6))
def test_ranges_and_hit_objects_equal_the_slab_method(service: LidarSensors, seed: int) -> None:
    rng = np.random.default_rng(seed)
    bodies = random_bodies(rng, 20)
    device = tilted_lidar(rng)
    lidar = observed(service, scene_of(bodies, device))
    (scan,) = lidar.scans
    wanted = expected(list(bodies.values()), Pose(device.position, device.orientation), device)
    assert wanted.clear.mean() > 0.97
    ranges = np.full(wanted.ranges.shape, np.inf)
    ranges[scan.ray] = scan.range
    hit = np.isfinite(wanted.ranges) & wanted.clear
    assert hit.sum() > 500
    assert np.array_equal(np.isfinite(ranges)[wanted.clear], hit[wanted.clear])
    assert np.abs(ranges[hit] - wanted.ranges[hit]).max() < TOLERANCE
    names = np.full(len(ranges), "", dtype=object)
    names[scan.ray] = np.array(lidar.object_names, dtype=object)[scan.object]
    assert names[hit].tolist() == [f"box{index}" for index in wanted.nearest[hit]]


@pytest.mark.parametrize("seed", range(3))
def test_points_lie_on_the_rays_and_on_the_boxes(service: LidarSensors, seed: int) -> None:
    """World points, brought into their box's axes, lie on its surface."""
    rng = np.random.default_rng(100 + seed)
    bodies = random_bodies(rng, 6)
    device = tilted_lidar(rng)
    lidar = observed(service, scene_of(bodies, device))
    (scan,) = lidar.scans
    np.testing.assert_allclose(np.linalg.norm(scan.points, axis=1), scan.range, rtol=1e-6)
    turned = scan.points.astype(np.float64) @ rotation_matrix(device.orientation).T
    np.testing.assert_allclose(turned + device.position, scan.points_world, atol=2e-5)
    for index, name in enumerate(lidar.object_names):
        body = bodies[name]
        points = scan.points_world[scan.object == index] - np.array(body.position)
        depth = np.abs(points @ rotation_matrix(body.orientation)) - np.array(body.dimensions) / 2
        assert np.abs(depth.max(axis=1)).max() < TOLERANCE


@pytest.mark.parametrize("seed", range(3))
def test_a_mounted_lidar_moves_and_turns_with_its_carrier(service: LidarSensors, seed: int) -> None:
    """Carrier with yaw, pitch and roll; the pose in the scan is that of carrier and mount."""
    rng = np.random.default_rng(200 + seed)
    bodies = random_bodies(rng, 6)
    carrier = Body((1.5, -0.5, 0.4), (4.0, 1.8, 1.5), quaternion_from_euler(*rng.uniform(-0.6, 0.6, 3)))
    device = LidarDevice(
        name="lidar",
        parent="carrier",
        position=(0.3, -0.2, 1.4),
        orientation=quaternion_from_euler(0.5, 0.1, -0.2),
        beams=16,
        azimuth_steps=300,
    )
    lidar = observed(service, scene_of(bodies | {"carrier": carrier}, device))
    (scan,) = lidar.scans
    pose = compose(Pose(carrier.position, carrier.orientation), Pose(device.position, device.orientation))
    assert scan.position == pytest.approx(pose.position)
    assert scan.orientation == pytest.approx(multiply(carrier.orientation, device.orientation))
    wanted = expected([*bodies.values(), carrier], pose, device)
    ranges = np.full(wanted.ranges.shape, np.inf)
    ranges[scan.ray] = scan.range
    hit = np.isfinite(wanted.ranges) & (wanted.ranges < 100) & wanted.clear
    assert (wanted.nearest[hit] == len(bodies)).any(), "no ray meets the carrier's own roof"
    assert np.abs(ranges[hit] - wanted.ranges[hit]).max() < TOLERANCE


@pytest.mark.parametrize(
    ("yaw", "step"), [(0.0, 0), (np.pi / 2, 270), (-0.5235987755982988, 30), (2.0943951023931953, 240)]
)
def test_what_is_in_the_east_is_seen_at_the_azimuth_that_the_carriers_yaw_leaves(
    service: LidarSensors, yaw: float, step: int
) -> None:
    """A carrier turned counter-clockwise sees what is in the east clockwise of its nose."""
    bodies = {
        "carrier": Body((0, 0, 0.75), (4, 2, 1.5), quaternion_from_euler(yaw)),
        "post": Body((20, 0, 2), (0.2, 0.2, 4)),
    }
    device = LidarDevice(
        name="lidar",
        parent="carrier",
        position=(0, 0, 1.25),
        beams=1,
        azimuth_steps=360,
        elevation_min=0,
        elevation_max=0,
    )
    (scan,) = observed(service, scene_of(bodies, device)).scans
    assert scan.ray.tolist() == [step]
    assert scan.range[0] == pytest.approx(19.9, abs=1e-4)
    np.testing.assert_allclose(scan.points_world[0], [19.9, 0, 2], atol=1e-4)
    np.testing.assert_allclose(scan.points[0], [19.9 * np.cos(-yaw), 19.9 * np.sin(-yaw), 0], atol=1e-4)


def test_scenery_stands_where_its_transform_puts_it(tmp_path: Path) -> None:
    """A wall that is scaled, turned about z and moved, before a ground plate without transform."""
    (tmp_path / "scenery" / "meshes").mkdir(parents=True)
    for name, mesh in {
        "wall": box((-0.5, 0.5), (-0.5, 0.5), (-0.5, 0.5)),
        "ground": box((-80, 80), (-80, 80), (-1, 0)),
    }.items():
        (tmp_path / "scenery" / "meshes" / f"{name}.ply").write_bytes(ply(mesh))
    file = tmp_path / "scenery" / "yard.xml"
    file.write_text(
        '<scene version="2.1.0">'
        '<shape type="ply" id="mesh-wall"><string name="filename" value="meshes/wall.ply"/>'
        '<transform name="to_world"><scale x="12" y="0.5" z="6"/><rotate z="1" angle="40"/>'
        '<translate x="9" y="14" z="3"/></transform></shape>'
        '<shape type="ply" id="mesh-ground"><string name="filename" value="meshes/ground.ply"/></shape>'
        "</scene>"
    )
    service = prepared({"scenery/yard.xml": file})
    device = LidarDevice(
        name="lidar", position=(1.0, -2.0, 2.5), orientation=quaternion_from_euler(1.1, 0.2), beams=32
    )
    lidar = observed(service, scene_of({}, device))
    (scan,) = lidar.scans
    bodies = [
        Body((9, 14, 3), (12, 0.5, 6), quaternion_from_euler(np.radians(40))),
        Body((0, 0, -0.5), (160, 160, 1)),
    ]
    wanted = expected(bodies, Pose(device.position, device.orientation), device)
    ranges = np.full(wanted.ranges.shape, np.inf)
    ranges[scan.ray] = scan.range
    hit = (wanted.ranges < 60) & wanted.clear
    assert np.abs(ranges[hit] - wanted.ranges[hit]).max() < TOLERANCE
    assert lidar.object_names == ("ground", "wall")
    seen = np.full(len(ranges), -1)
    seen[scan.ray] = scan.object
    assert np.array_equal(seen[hit], 1 - wanted.nearest[hit])
    assert set(wanted.nearest[hit]) == {0, 1}
