"""Noise in scans and pictures: of the size that was set, consistent, and the same again."""

from __future__ import annotations

from collections.abc import Sequence
from math import sqrt

import camera_world
import numpy as np
import pytest
from lidar_world import Body, observed, prepared, scene_of

from caviar_protocol.codec import encode_payload
from caviar_protocol.space.coordinates import quaternion_from_euler
from caviar_protocol.topics import CameraDevice, LidarDevice, LidarScan
from caviar_services.sensors.camera import CameraSettings
from caviar_services.sensors.lidar import GridSettings, LidarSensors, LidarSettings, quantised

pytestmark = pytest.mark.channel

STD, DROPOUT = 0.03, 0.05
GRID = GridSettings(minimum_m=(-35, -25, -12), maximum_m=(35, 25, 12), cell_m=(1, 1, 1), min_height_m=-20)
ROOM = {"room": Body((3.0, -2.0, 1.0), (60.0, 40.0, 20.0))}
TOP = LidarDevice(
    name="top", position=(1.0, 2.0, 0.5), orientation=quaternion_from_euler(0.4, 0.1, -0.2),
    beams=64, azimuth_steps=1800, elevation_min=-1.2, elevation_max=1.2, max_range=100.0,
)  # fmt: skip


def lidar(*, std: float = STD, dropout: float = DROPOUT, noisy: bool = True) -> LidarSensors:
    noise = {"use": "gaussian", "range_std_m": std, "dropout": dropout}
    settings = LidarSettings(bodies_per_asset=8, grid=GRID, noise=noise if noisy else None)
    return prepared(settings=settings, parts=frozenset({"grid"}))


@pytest.fixture(scope="module")
def scans() -> Sequence[LidarScan]:
    """A room without and with noise, 115,200 rays each."""
    scene = scene_of(ROOM, TOP)
    return [observed(service, scene, 3, seed=7).scans[0] for service in (lidar(noisy=False), lidar())]


def test_errors_of_ranges_have_the_deviation_that_was_set(scans: Sequence[LidarScan]) -> None:
    """Over 1e5 returns, within five standard errors; lost returns too."""
    clean, noisy = scans
    assert len(clean.ray) == TOP.beams * TOP.azimuth_steps
    errors = noisy.range.astype(np.float64) - clean.range[noisy.ray]
    count = len(errors)
    assert count > 1e5
    assert errors.mean() == pytest.approx(0.0, abs=5 * STD / sqrt(count))
    assert errors.std() == pytest.approx(STD, rel=5 / sqrt(2 * count))
    lost = 1 - count / len(clean.ray)
    assert lost == pytest.approx(DROPOUT, abs=5 * sqrt(DROPOUT * (1 - DROPOUT) / len(clean.ray)))


def test_points_and_grid_are_those_of_the_noisy_ranges(scans: Sequence[LidarScan]) -> None:
    clean, noisy = scans
    directions = clean.points[noisy.ray] / clean.range[noisy.ray, None]
    np.testing.assert_allclose(noisy.points, directions * noisy.range[:, None], atol=2e-5)
    assert noisy.points_world is not None
    without = LidarScan(**{f: getattr(noisy, f) for f in noisy.__struct_fields__} | {"points_world": None})
    np.testing.assert_allclose(noisy.points_world, without.in_world(), atol=2e-5)
    assert noisy.grid is not None
    wanted = np.zeros(GRID.shape, np.int8)
    wanted[tuple(quantised(noisy.points_world.astype(np.float64), GRID).T)] = 1
    # A point within float32 of an edge may be in either cell.
    assert (wanted != noisy.grid.occupancy).sum() <= 2
    assert clean.grid is not None
    assert (clean.grid.occupancy != noisy.grid.occupancy).any()


def test_the_same_seed_gives_the_same_bytes_in_any_order_and_beside_other_sensors() -> None:
    small = LidarDevice(name="small", position=(0, 0, 0), beams=4, azimuth_steps=90)
    alone, both = scene_of(ROOM, small), scene_of(ROOM, LidarDevice(name="early", beams=3), small)
    first, second = lidar(), lidar()
    forwards = [observed(first, alone, number, seed=7) for number in range(3)]
    backwards = [observed(second, alone, number, seed=7) for number in (2, 1, 0)]
    assert [encode_payload(each) for each in forwards] == [encode_payload(each) for each in backwards[::-1]]
    beside = observed(second, both, 1, seed=7).scans[1]
    assert beside.range.tobytes() == forwards[1].scans[0].range.tobytes()
    for other in (forwards[0], observed(second, alone, 1, seed=8)):
        assert other.scans[0].range.tobytes() != forwards[1].scans[0].range.tobytes()


def test_ranges_beyond_those_of_the_device_are_lost_and_none_may_be_left() -> None:
    """Noise of a kilometre: half of the ranges are negative, and most others too long."""
    scan = observed(lidar(std=1000.0, dropout=0.0), scene_of(ROOM, TOP)).scans[0]
    assert 0 < len(scan.ray) < 0.1 * TOP.beams * TOP.azimuth_steps
    assert scan.range.min() >= TOP.min_range
    assert scan.range.max() <= TOP.max_range
    nothing = observed(lidar(dropout=1.0), scene_of(ROOM, TOP)).scans[0]
    assert len(nothing.ray) == len(nothing.points) == 0


def test_pictures_have_noise_that_is_clipped_and_depth_has_none() -> None:
    eye = CameraDevice(name="eye", position=(0, 0, 0), width=200, height=200)
    scene = scene_of(ROOM, eye)
    settings = CameraSettings(bodies_per_asset=8, noise={"use": "gaussian", "std_counts": 4.0})
    clean = camera_world.seen(camera_world.prepared(), scene)
    noisy, again = (camera_world.seen(camera_world.prepared(settings=settings), scene) for _ in range(2))
    before, after = (each[0].images[0].rgb.astype(np.int64) for each in (clean, noisy))
    inside = (before > 30) & (before < 225)
    errors = (after - before)[inside]
    assert errors.size > 1e5
    # Rounding to whole counts adds a twelfth.
    assert errors.std() == pytest.approx(sqrt(4.0**2 + 1 / 12), rel=5 / sqrt(2 * errors.size))
    assert errors.mean() == pytest.approx(0.0, abs=5 * 4.0 / sqrt(errors.size))
    assert encode_payload(noisy[0]) == encode_payload(again[0])
    assert encode_payload(noisy[1]) == encode_payload(clean[1])
    assert encode_payload(noisy[2]) == encode_payload(clean[2])
