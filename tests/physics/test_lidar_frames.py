"""A LIDAR from frame to frame: objects that move, come and go; limits; the same bits again."""

from __future__ import annotations

import gc
import hashlib
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from lidar_world import Body, observed, prepared, scene_of

from caviar_protocol.arrays import Float32Array
from caviar_protocol.codec import encode_payload
from caviar_protocol.errors import AssetError, PayloadError
from caviar_protocol.host import trim_memory
from caviar_protocol.space.coordinates import quaternion_from_euler
from caviar_protocol.topics import AntennaDevice, Lidar, LidarDevice
from caviar_services.sensors.lidar import GridSettings, LidarSensors, LidarSettings
from caviar_services.session import TRIM_EVERY
from caviar_space.meshes import box, car, ply

pytestmark = pytest.mark.channel

LEVEL = LidarDevice(
    name="lidar", position=(0, 0, 2), beams=5, azimuth_steps=720, elevation_min=-0.1, elevation_max=0.1
)


@pytest.fixture(scope="module")
def yard(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Assets: a ground plate and the mesh of a car."""
    folder = tmp_path_factory.mktemp("assets")
    files = {
        "scenery/yard.xml": b'<scene><shape type="ply" id="mesh-ground">'
        b'<string name="filename" value="ground.ply"/></shape></scene>',
        "scenery/ground.ply": ply(box((-90, 90), (-90, 90), (-1, 0))),
        "objects/car.ply": ply(car()),
    }
    for name, content in files.items():
        (folder / name).parent.mkdir(exist_ok=True)
        (folder / name).write_bytes(content)
    return {name: folder / name for name in files}


@pytest.fixture(scope="module")
def service(yard: dict[str, Path]) -> LidarSensors:
    return prepared(yard)


def points_on(lidar: Lidar, name: str, scan: int = 0) -> Float32Array:
    """World points of one scan on one object."""
    if name not in lidar.object_names:
        return np.zeros((0, 3), dtype=np.float32)
    chosen = lidar.scans[scan]
    return chosen.points_world[chosen.object == lidar.object_names.index(name)]


def a_car(x: float, y: float, yaw: float = 0.0) -> Body:
    return Body((x, y, 1.75), (4.4, 1.8, 3.5), quaternion_from_euler(yaw), "objects/car.ply")


def test_an_object_that_moves_moves_in_the_scan(service: LidarSensors) -> None:
    """Sideways by one ray's width at a time: the points follow it to within a ray's width."""
    for frame in range(5):
        y = -6.0 + 3.0 * frame
        seen = points_on(observed(service, scene_of({"box": Body((20, y, 2), (2, 2, 4))}, LEVEL)), "box")
        spacing = 19 * 2 * np.pi / LEVEL.azimuth_steps
        assert seen[:, 0].min() == pytest.approx(19, abs=1e-3)
        assert seen[:, 1].min() == pytest.approx(y - 1, abs=1.2 * spacing)
        assert seen[:, 1].max() == pytest.approx(y + 1, abs=1.2 * spacing)


def test_objects_that_come_and_go_keep_their_names(service: LidarSensors) -> None:
    """A body that was freed carries the newcomer's name, and nothing stays where its object was."""
    first = observed(service, scene_of({"a": a_car(15, 0), "b": a_car(0, 12)}, LEVEL))
    assert {"a", "b"} <= set(first.object_names)
    second = observed(service, scene_of({"b": a_car(0, 12), "c": a_car(-18, 0)}, LEVEL))
    assert "a" not in second.object_names
    assert points_on(second, "b").mean(axis=0)[1] == pytest.approx(11.2, abs=0.5)
    assert points_on(second, "c").mean(axis=0)[0] == pytest.approx(-16.0, abs=0.6)
    third = observed(service, scene_of({}, LEVEL))
    assert third.object_names == ("ground",)


def test_a_scan_depends_on_its_scene_alone(service: LidarSensors, yard: dict[str, Path]) -> None:
    """A service that saw other frames before and one that did not: equal to the last bit."""
    for frame in range(0, 30, 3):
        observed(service, scene_of(traffic(frame), turning(frame)))
    scene = scene_of(traffic(40), turning(40, beams=64, azimuth_steps=900))
    assert observed(service, scene) == observed(prepared(yard), scene)


def test_a_frame_without_a_lidar_has_no_scans(service: LidarSensors) -> None:
    assert observed(service, scene_of({"a": a_car(15, 0)})) == Lidar(object_names=(), scans=())


def test_a_lidar_that_sees_nothing_has_an_empty_scan() -> None:
    lidar = observed(prepared(), scene_of({}, LEVEL))
    assert lidar.object_names == ()
    assert lidar.scans[0].points.shape == (0, 3)


def test_hits_outside_the_range_are_dropped_and_hide_what_is_behind(service: LidarSensors) -> None:
    """Boxes at 5, 20 and 40 m: the nearest is too near, the farthest too far."""
    device = LidarDevice(
        name="lidar",
        position=(0, 0, 2),
        beams=1,
        azimuth_steps=4,
        elevation_min=0,
        elevation_max=0,
        min_range=5.5,
        max_range=39.0,
    )
    bodies = {
        "near": Body((6, 0, 2), (2, 2, 4)),
        "behind": Body((12, 0, 2), (2, 4, 4)),
        "kept": Body((0, 21, 2), (2, 2, 4)),
        "far": Body((-41, 0, 2), (2, 2, 4)),
    }
    lidar = observed(service, scene_of(bodies, device))
    assert lidar.object_names == ("kept",)
    assert lidar.scans[0].ray.tolist() == [1]
    assert lidar.scans[0].range.tolist() == pytest.approx([20.0], abs=1e-4)


def test_the_carrier_is_seen_by_its_own_lidar(service: LidarSensors) -> None:
    """From 0.5 m above the roof of a box, a ray 30° down meets it after 1 m."""
    bodies = {"me": Body((3, 4, 0.75), (4.4, 1.8, 1.5), quaternion_from_euler(0.7))}
    device = LidarDevice(
        name="lidar", parent="me", position=(0, 0, 1.25), beams=1, azimuth_steps=8, elevation_min=-np.pi / 6
    )
    lidar = observed(service, scene_of(bodies, device))
    (scan,) = lidar.scans
    own = scan.object == lidar.object_names.index("me")
    assert {0, 4} <= set(scan.ray[own].tolist())
    np.testing.assert_allclose(scan.range[own], 1.0, atol=1e-4)


@pytest.mark.parametrize("elevation_rad", [0.0, 0.01])
def test_a_lidar_on_the_roof_itself_is_accepted(service: LidarSensors, elevation_rad: float) -> None:
    """At no height above it, whichever way the height rounds."""
    if elevation_rad == 0 and service.variant.startswith("cuda"):
        pytest.skip("rays in the roof's own plane pass its edges in Embree, and hit them in OptiX")
    device = LidarDevice(
        name="lidar", parent="me", position=(0, 0, 1.75), elevation_min=elevation_rad, beams=2
    )
    lidar = observed(service, scene_of({"me": a_car(0, 0, 0.3)}, device))
    assert "me" not in lidar.object_names


def test_a_lidar_inside_its_carrier_is_refused(service: LidarSensors) -> None:
    device = LidarDevice(name="me/lidar", parent="me")
    with pytest.raises(PayloadError, match=r"'me/lidar'.*'me'"):
        observed(service, scene_of({"me": a_car(0, 0)}, device))


def test_an_object_with_the_name_of_scenery_is_refused(service: LidarSensors) -> None:
    with pytest.raises(PayloadError, match=r"'ground'.*prefix"):
        observed(service, scene_of({"ground": a_car(0, 0)}))


def test_more_objects_than_bodies_are_refused(service: LidarSensors) -> None:
    crowd = {f"car{index}": a_car(5 * index, 0) for index in range(9)}
    with pytest.raises(PayloadError, match=r"objects/car\.ply.*pool has 8"):
        observed(service, scene_of(crowd))


def test_a_missing_mesh_is_named(yard: dict[str, Path], tmp_path: Path) -> None:
    file = tmp_path / "yard.xml"
    file.write_bytes(yard["scenery/yard.xml"].read_bytes())
    with pytest.raises(AssetError, match=r"mesh-ground.*ground\.ply is missing"):
        prepared({"scenery/yard.xml": file})


def test_several_lidars_see_what_each_sees_alone(service: LidarSensors) -> None:
    """Of different sizes, sorted by name, to the last bit."""
    bodies = {"a": a_car(15, 0, 0.4), "b": a_car(2, -12, 1.0)}
    devices = [
        LEVEL,
        LidarDevice(name="b/lidar", parent="b", position=(0, 0, 2.2), beams=7, azimuth_steps=123),
        LidarDevice(name="fixed", position=(-5, 3, 6), beams=3, azimuth_steps=50),
    ]
    together = observed(service, scene_of(bodies, *devices))
    assert [scan.sensor for scan in together.scans] == ["b/lidar", "fixed", "lidar"]
    for scan in together.scans:
        alone = observed(service, scene_of(bodies, *(d for d in devices if d.name == scan.sensor)))
        assert np.array_equal(alone.scans[0].points_world, scan.points_world)
        assert [alone.object_names[i] for i in alone.scans[0].object] == [
            together.object_names[i] for i in scan.object
        ]


def test_the_grid_marks_what_the_scan_hit_and_the_antennas(yard: dict[str, Path]) -> None:
    """Every point above 0.2 m has its cell marked, and no other cell is; −1 and −2 stand on top."""
    grid = GridSettings(minimum_m=(-30, -30, 0), maximum_m=(30, 30, 6), cell_m=(1, 1.5, 0.5))
    service = prepared(yard, LidarSettings(bodies_per_asset=4, grid=grid), frozenset({"points", "grid"}))
    bodies = {"me": a_car(-4, 3, 0.5), "other": a_car(9, -6, 2.0)}
    devices = (
        AntennaDevice(name="bs", role="tx", position=(20.2, 10.4, 5.1)),
        AntennaDevice(name="me/ue", parent="me", role="rx", position=(0, 0, 1.9)),
        LidarDevice(name="me/lidar", parent="me", position=(0, 0, 2.4)),
    )
    (scan,) = observed(service, scene_of(bodies, *devices)).scans
    assert scan.grid is not None
    kept = scan.points_world[(scan.points_world[:, 2] > 0.2) & (scan.range < 100)].astype(np.float64)
    cells = np.clip(np.rint((kept - (-30, -30, 0)) / (1, 1.5, 0.5)), 0, (59, 39, 11)).astype(int)
    wanted = np.zeros((60, 40, 12), dtype=np.int8)
    wanted[tuple(cells.T)] = 1
    wanted[50, 27, 10] = -1
    wanted[26, 22, 7] = -2
    assert (wanted == 1).sum() > 20
    assert np.array_equal(scan.grid.occupancy, wanted)


def test_the_grid_comes_beside_the_points_and_only_where_it_is_asked_for(yard: dict[str, Path]) -> None:
    grid = GridSettings(minimum_m=(-30, -30, 0), maximum_m=(30, 30, 6), cells=(30, 30, 6))
    settings = LidarSettings(bodies_per_asset=4, grid=grid)
    scene = scene_of({"a": a_car(9, 2)}, LEVEL)
    (asked,) = observed(prepared(yard, settings, frozenset({"grid"})), scene).scans
    (plain,) = observed(prepared(yard, settings, frozenset()), scene).scans
    assert asked.grid is not None
    assert asked.grid.occupancy.any()
    assert plain.grid is None
    assert len(plain.range) > 0
    assert np.array_equal(asked.points, plain.points)


def test_between_the_scans_with_points_the_grid_says_the_same(yard: dict[str, Path]) -> None:
    grid = GridSettings(minimum_m=(-30, -30, 0), maximum_m=(30, 30, 6), cells=(30, 30, 6))
    whole = prepared(yard, LidarSettings(bodies_per_asset=4, grid=grid), frozenset({"grid"}))
    thin = prepared(yard, LidarSettings(bodies_per_asset=4, grid=grid, points_every=3), frozenset({"grid"}))
    for number in range(5):
        scene = scene_of({"a": a_car(9, 2 + number)}, LEVEL)
        lidar = observed(thin, scene, number)
        (scan,), (wanted,) = lidar.scans, observed(whole, scene, number).scans
        assert scan.grid == wanted.grid
        assert len(scan.ray) == len(scan.points) == len(scan.points_world) == len(scan.range)
        if number % 3 == 0:
            assert scan == wanted
            assert len(scan.object) == len(scan.ray) > 0
        else:
            assert len(scan.ray) == 0
            assert lidar.object_names == ()


def test_points_in_world_axes_follow_from_those_of_the_sensor(yard: dict[str, Path]) -> None:
    """Left out by a setting, they are computed; the grid, which is made of them, is the same."""
    grid = GridSettings(minimum_m=(-30, -30, 0), maximum_m=(30, 30, 6), cells=(30, 30, 6))
    settings = LidarSettings(bodies_per_asset=4, grid=grid)
    device = LidarDevice(
        name="lidar", position=(4, -3, 2), orientation=quaternion_from_euler(0.7, 0.2, -0.1), azimuth_steps=90
    )
    scene = scene_of({"a": a_car(9, 2)}, device)
    (whole,) = observed(prepared(yard, settings, frozenset({"grid"})), scene).scans
    alone = LidarSettings(bodies_per_asset=4, grid=grid, points_world=False)
    (scan,) = observed(prepared(yard, alone, frozenset({"grid"})), scene).scans
    assert scan.points_world is None
    assert whole.points_world is not None
    np.testing.assert_allclose(scan.in_world(), whole.points_world, atol=2e-5)
    assert np.array_equal(scan.points, whole.points)
    assert scan.grid == whole.grid


def test_the_ray_tracer_holds_the_bodies_of_the_frame_alone(yard: dict[str, Path]) -> None:
    """Embree rebuilds all triangles of the mesh in each frame, those of bodies that are not there too."""
    service = prepared(yard, LidarSettings(bodies_per_asset=64))
    for count in (3, 0, 5):
        observed(service, scene_of({f"car{i}": a_car(6 * i, 5) for i in range(count)}, LEVEL))
        assert service.traced is not None
        moving = len(service.traced.face_owner) - service.traced.scenery_faces
        assert moving == max(1, count * len(car().faces))


def traffic(frame: int) -> dict[str, Body]:
    """Cars that drive, turn, come and leave."""
    return {
        f"car{index}": a_car(4.0 * index - 10 + 0.13 * frame, 6.0 * (-1) ** index, 0.01 * frame + index)
        for index in range(frame // 7 % 3, 5 + frame // 11 % 3)
    }


def turning(frame: int, *, beams: int = 8, azimuth_steps: int = 90) -> LidarDevice:
    """A LIDAR on a car, on another one from time to time."""
    carrier = f"car{2 + frame // 10 % 2}"
    return LidarDevice(
        name=f"{carrier}/lidar",
        parent=carrier,
        position=(0, 0, 2.2),
        beams=beams,
        azimuth_steps=azimuth_steps,
    )


def test_moving_objects_and_sensors_compile_nothing(service: LidarSensors) -> None:
    """Poses, carriers and the number of sensors change; every kernel is found in the cache."""
    import drjit as dr

    observed(service, scene_of(traffic(0), turning(0)))
    dr.kernel_history_clear()
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        for frame in range(1, 40):
            devices = [turning(frame, beams=2 + frame % 5), LEVEL][: frame % 3]
            observed(service, scene_of(traffic(frame), *devices), frame)
    history = [entry for entry in dr.kernel_history() if "cache_hit" in entry]
    assert len(history) >= 26
    assert all(entry["cache_hit"] for entry in history)


def test_the_variant_of_a_neighbour_is_left_as_it_was(service: LidarSensors) -> None:
    """Another service in the same process uses another variant of Mitsuba."""
    import mitsuba as mi

    before = mi.variant()
    scene = scene_of({"a": a_car(15, 0, 0.4)}, LEVEL)
    alone = observed(service, scene)
    mi.set_variant("llvm_ad_rgb")
    try:
        assert observed(service, scene) == alone
        assert mi.variant() == "llvm_ad_rgb"
    finally:
        if before is not None:
            mi.set_variant(before)


def in_a_fresh_process(call: str, yard: dict[str, Path], *arguments: int) -> str:
    """What a function of this module returns there, for these assets and arguments."""
    files = {name: str(path) for name, path in yard.items()}
    code = (
        f"import sys; sys.path.insert(0, {str(Path(__file__).parent)!r}); from pathlib import Path; "
        f"import test_lidar_frames as frames; files = {files!r}; "
        f"print(frames.{call}({{name: Path(path) for name, path in files.items()}}, *{arguments!r}))"
    )
    told = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=120
    )
    return told.stdout.strip()


def memory_slope(yard: dict[str, Path], frames: int) -> float:
    """Growth of resident memory [B a frame] over the last 80 % of as many frames, run as the runner does."""
    service = prepared(yard)
    gc.collect()
    gc.freeze()
    resident = []
    for frame in range(frames):
        observed(service, scene_of(traffic(frame), turning(frame)), frame)
        if frame % TRIM_EVERY == 0:
            service.release_memory()
            trim_memory()
        resident.append(int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGESIZE"))
    levels = np.median(np.reshape(resident, (-1, TRIM_EVERY)), axis=1)
    late = levels[len(levels) // 5 :]
    return float(np.polyfit(np.arange(len(late)) * TRIM_EVERY, late, 1)[0])


@pytest.mark.exhaustive
def test_memory_stays_flat_over_a_thousand_frames(yard: dict[str, Path]) -> None:
    """Less than 1 KB a frame; in a process of its own, where no other test frees or fills memory."""
    assert float(in_a_fresh_process("memory_slope", yard, 1000)) < 1024


def digest(yard: dict[str, Path], threads: int) -> str:
    """SHA-256 of the products of some frames, traced by so many threads."""
    import drjit as dr

    dr.set_thread_count(threads)
    service = prepared(yard)
    state = hashlib.sha256()
    for frame in range(0, 40, 5):
        device = turning(frame, beams=32, azimuth_steps=900)
        header, body = encode_payload(observed(service, scene_of(traffic(frame), device), frame))
        state.update(header)
        state.update(body)
    return state.hexdigest()


def test_two_processes_see_the_same_bits(yard: dict[str, Path]) -> None:
    """With one thread and with two."""
    one, two = (in_a_fresh_process("digest", yard, threads) for threads in (1, 2))
    assert one == two
    assert len(one) == 64
