"""Parts of the observation against formulas of their own, on scenes made by hand."""

from __future__ import annotations

import math
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from link_builders import antenna, frame_of, given, scene_of
from msgspec.structs import replace

from caviar_clients.envs.beam_selection import BeamSelectionEnv
from caviar_clients.envs.observations import PARTS, Moment, Part, part
from caviar_clients.envs.users import Users
from caviar_protocol.coordinates import quaternion_from_euler
from caviar_protocol.errors import RunError, ScenarioError
from caviar_protocol.scenario import DeviceSpec, Scenario
from caviar_protocol.scenario_loader import load_scenario
from caviar_protocol.tables import convert_settings
from caviar_protocol.topics import (
    AntennaDevice,
    Camera,
    CameraImage,
    Depth,
    DepthImage,
    Intrinsics,
    Lidar,
    LidarScan,
    Link,
    OccupancyGrid,
    Scene,
)
from caviar_services.sensors.lidar import LidarSettings
from caviar_services.service import FrameInput

SCENARIOS = Path(__file__).parents[2] / "deploy" / "scenarios"
PER_USER = {"aoa": 1, "aod": 1, "position": 3, "velocity": 3, "last_abs_y": 1}
Euler = tuple[float, float, float]
Triple = tuple[float, float, float]


# --- what is observed ----------------------------------------------------------------------------------


@pytest.fixture
def scenario() -> Scenario:
    """A base station and up to three cars with a receiver each, a LIDAR and two cameras."""
    return scenario_of(
        antenna_spec("bs", "tx"),
        antenna_spec("rx", "rx", on="car.*", count=3),
        DeviceSpec(name="top", kind="lidar", on="car.1"),
        DeviceSpec(name="dash", kind="camera", on="car.1", size_px=(32, 20)),
        DeviceSpec(name="wall", kind="camera", size_px=(7, 5)),
        sensors={"lidar": {"grid": {"minimum_m": [0, 0, 0], "maximum_m": [1, 1, 1], "cell_m": [1, 1, 1]}}},
    )


def antenna_spec(name: str, role: str, **more: Any) -> DeviceSpec:
    return DeviceSpec(name=name, kind="antenna", role=role, **more)  # type: ignore[arg-type]  # its literals


def scenario_of(*devices: DeviceSpec, sensors: dict[str, dict[str, Any]] | None = None) -> Scenario:
    """The shipped smoke scenario with other devices, and sensors by name with their settings."""
    base = load_scenario(SCENARIOS / "smoke.toml")
    like = base.services["link"]
    services = {
        name: replace(like, role="sensors", use="lidar", settings=settings)
        for name, settings in (sensors or {}).items()
    }
    return replace(base, devices=devices, services={**base.services, **services})


def moment_of(users: Users, scene: Scene, *inputs: FrameInput, link: Link | None = None) -> Moment:
    return Moment(frame_of(*inputs), scene, link, users.present(scene))


def read(scenario: Scenario, name: str, scene: Scene, *inputs: FrameInput, link: Link | None = None) -> Any:
    """Value of a part, which its space has to hold."""
    users = Users(scenario, ("*",))
    found = part(scenario, users, name)
    value = found.read(moment_of(users, scene, *inputs, link=link))
    if value is not None:
        assert found.space.contains(np.asarray(value)), f"{name} is {value!r}, not in {found.space}"
    return value


# --- geometry, independently ----------------------------------------------------------------------------


def turned(euler: Euler) -> np.ndarray[Any, Any]:
    """Rotation matrix of (yaw, pitch, roll) about z, y, x as three products of elementary ones."""
    yaw, pitch, roll = euler

    def about(axis: int, angle: float) -> np.ndarray[Any, Any]:
        i, j = [(1, 2), (2, 0), (0, 1)][axis]
        matrix = np.eye(3)
        matrix[i, i] = matrix[j, j] = math.cos(angle)
        matrix[j, i], matrix[i, j] = math.sin(angle), -math.sin(angle)
        return matrix

    return about(2, yaw) @ about(1, pitch) @ about(0, roll)


def azimuth(orientation: np.ndarray[Any, Any], way: np.ndarray[Any, Any]) -> float:
    """Azimuth of a way in the axes of a device whose orientation is a matrix."""
    forward, left = orientation[:, 0] @ way, orientation[:, 1] @ way
    return math.atan2(left, forward)


def random_layout(seed: int) -> tuple[Scene, dict[str, Any]]:
    """A scene of one car and a base station, all turned any way, and the facts about it."""
    rng = np.random.default_rng(seed)
    car, tx = rng.uniform(-50, 50, 3), rng.uniform(-50, 50, 3)
    offset = rng.uniform(-2, 2, 3)
    car_euler, tx_euler, rx_euler = (
        (rng.uniform(-math.pi, math.pi), rng.uniform(-1.2, 1.2), rng.uniform(-2, 2)) for _ in range(3)
    )
    velocity = rng.uniform(-20, 20, 3)
    devices = (
        AntennaDevice(
            name="bs", role="tx", position=tuple(tx.tolist()), orientation=quaternion_from_euler(*tx_euler)
        ),
        AntennaDevice(
            name="car.1/rx",
            role="rx",
            parent="car.1",
            position=tuple(offset.tolist()),
            orientation=quaternion_from_euler(*rx_euler),
        ),
    )
    scene = Scene(
        names=("car.1",),
        classes=("car",),
        assets=("",),
        position=car[None],
        orientation=np.array([quaternion_from_euler(*car_euler)]),
        velocity=velocity[None],
        dimensions=np.ones((1, 3)),
        devices=devices,
    )
    rx = car + turned(car_euler) @ offset
    facts = {
        "aod": [azimuth(turned(tx_euler), rx - tx)],
        "aoa": [azimuth(turned(car_euler) @ turned(rx_euler), tx - rx)],
        "position": rx.tolist(),
        "velocity": velocity.tolist(),
    }
    return scene, facts


@pytest.mark.parametrize("name", ["aoa", "aod", "position", "velocity"])
@pytest.mark.parametrize("seed", range(8))
def test_geometry_of_turned_devices_is_that_of_rotation_matrices(
    scenario: Scenario, name: str, seed: int
) -> None:
    scene, facts = random_layout(seed)
    value = read(scenario, name, scene)
    width = PER_USER[name]
    assert value.dtype == np.float32
    assert value.shape == (3 * width,)
    assert value[:width] == pytest.approx(facts[name], rel=1e-5, abs=1e-5)
    assert not value[width:].any(), "two places are empty"


@pytest.mark.parametrize(
    ("yaw_deg", "pitch_deg", "aod_deg"),
    [(0, 0, 45.0), (45, 0, 0.0), (90, 0, -45.0), (-60, 0, 105.0), (0, 60, math.degrees(math.atan2(1, 0.5)))],
)
def test_the_angle_of_departure_of_a_turned_base_station(
    scenario: Scenario, yaw_deg: float, pitch_deg: float, aod_deg: float
) -> None:
    """The receiver is 10 m east and 10 m north of it: a turn to the left takes from the azimuth, and a nose
    that points 60° down leaves cos 60° = ½ of the way east along it."""
    turn = quaternion_from_euler(math.radians(yaw_deg), math.radians(pitch_deg))
    bs = AntennaDevice(name="bs", role="tx", orientation=turn)
    scene = scene_of(bs, antenna("car.1/rx", "rx", parent="car.1"), objects={"car.1": ((10, 10, 0), 0.0)})
    assert math.degrees(read(scenario, "aod", scene)[0]) == pytest.approx(aod_deg, abs=1e-4)


def test_the_angle_of_arrival_turns_with_the_vehicle(scenario: Scenario) -> None:
    """The base station stands west of a car that heads north: to its left."""
    scene = scene_of(
        antenna("bs", "tx"),
        antenna("car.1/rx", "rx", parent="car.1"),
        objects={"car.1": ((30, 0, 0), math.pi / 2)},
    )
    assert read(scenario, "aoa", scene)[0] == pytest.approx(math.pi / 2, abs=1e-6)


# --- who is there ----------------------------------------------------------------------------------------


def cars(*numbers: int) -> Scene:
    """Car n is n tens of metres east and n north; the base station stands at the origin, looking east."""
    return scene_of(
        antenna("bs", "tx"),
        *(antenna(f"car.{n}/rx", "rx", parent=f"car.{n}", position=(0, 0, 1.0)) for n in numbers),
        objects={f"car.{n}": ((10.0 * n, float(n) ** 2, 0.0), 0.0) for n in numbers},
    )


def test_users_fill_the_places_in_the_order_of_their_names(scenario: Scenario) -> None:
    position = read(scenario, "position", cars(3, 1, 2)).reshape(3, 3)
    assert position.tolist() == [[10, 1, 1], [20, 4, 1], [30, 9, 1]]


@pytest.mark.parametrize("name", PER_USER)
def test_a_place_whose_vehicle_left_is_zeros(scenario: Scenario, name: str) -> None:
    users = Users(scenario, ("*",))
    found = part(scenario, users, name)
    width = PER_USER[name]
    for present in ((1, 2, 3), (2, 3), (3,), (), (1, 3)):
        scene = cars(*present)
        link = link_of([("bs", f"car.{n}/rx", 0.5) for n in present])
        value = found.read(moment_of(users, scene, link=link))
        assert value is not None
        assert value.shape == (3 * width,)
        assert not value[width * len(present) :].any()
        if name in ("aod", "position", "last_abs_y"):
            assert value.reshape(3, width)[: len(present)].any(axis=1).all()


def test_a_receiver_that_is_not_served_takes_no_place() -> None:
    both = scenario_of(antenna_spec("bs", "tx"), antenna_spec("rx", "rx", on="car.*", count=3))
    users = Users(both, ("car.2/*",))
    scene = cars(1, 2, 3)
    assert [(place, pair.rx.name) for place, pair in users.present(scene)] == [(0, "car.2/rx")]
    value = part(both, users, "position").read(moment_of(users, scene))
    assert value is not None
    assert value[:3].tolist() == [20, 4, 1]
    assert not value[3:].any()


def test_places_stand_by_transmitter_and_then_by_receiver() -> None:
    two = scenario_of(
        antenna_spec("north", "tx"),
        antenna_spec("east", "tx"),
        antenna_spec("rx", "rx", on="car.*", count=2),
        antenna_spec("mast", "rx"),
    )
    users = Users(two, ("*",))
    scene = scene_of(
        antenna("north", "tx"),
        antenna("east", "tx"),
        antenna("mast", "rx", position=(5, 5, 5)),
        antenna("car.7/rx", "rx", parent="car.7"),
        objects={"car.7": ((1, 2, 3), 0.0)},
    )
    assert len(users) == 6
    assert [
        (place, p.tx.name, p.rx.name) for place, p in sorted(users.present(scene), key=lambda u: u[0])
    ] == [
        (0, "east", "mast"),
        (1, "east", "car.7/rx"),
        (3, "north", "mast"),
        (4, "north", "car.7/rx"),
    ]


@pytest.mark.parametrize(
    ("pattern", "served"),
    [("car.1/rx", 3), ("car*", 3), ("*/rx", 3), ("?ar.1?/rx", 3), ("bus*", 0), ("car.1", 0), ("rx", 0)],
)
def test_a_pattern_serves_what_it_can_match(scenario: Scenario, pattern: str, served: int) -> None:
    if served:
        assert len(Users(scenario, (pattern,))) == served
    else:
        with pytest.raises(ScenarioError) as error:
            Users(scenario, (pattern,))
        assert f"no receiver of the scenario is {pattern}; there are: car.*/rx" in str(error.value)


# --- the link --------------------------------------------------------------------------------------------


def link_of(users: list[tuple[str, str, float]]) -> Link:
    """A link in which only |y| tells the users apart."""
    count = len(users)
    zeros, beams = np.zeros(count), np.zeros(count, np.int32)
    return Link(
        tx=tuple(tx for tx, _, _ in users),
        rx=tuple(rx for _, rx, _ in users),
        carrier=("mmwave",) * count,
        has_path=np.ones(count, np.bool_),
        los=np.ones(count, np.bool_),
        tx_beam=beams,
        rx_beam=beams,
        abs_y=np.array([abs_y for _, _, abs_y in users], np.float64),
        top_tx_beam=beams[:, None],
        top_rx_beam=beams[:, None],
        top_abs_y=np.ones((count, 1)),
        baseline_abs_y=zeros,
        aod_azimuth=zeros,
        aoa_azimuth=zeros,
        snr=zeros,
        snr_best=zeros,
        spectral_efficiency=zeros,
        bit_rate=zeros,
        reward=zeros,
    )


def test_the_last_magnitude_is_of_the_user_and_not_of_the_row(scenario: Scenario) -> None:
    link = link_of([("bs", "car.9/rx", 0.9), ("bs", "car.2/rx", 0.2), ("other", "car.1/rx", 7.0)])
    value = read(scenario, "last_abs_y", cars(1, 2), link=link)
    assert value == pytest.approx([0.0, 0.2, 0.0])


def test_the_last_magnitude_is_the_mean_over_carriers(scenario: Scenario) -> None:
    link = link_of([("bs", "car.1/rx", 0.25), ("bs", "car.1/rx", 0.75)])
    assert read(scenario, "last_abs_y", cars(1), link=link)[0] == pytest.approx(0.5)


def test_the_last_magnitude_is_0_in_frame_0(scenario: Scenario) -> None:
    assert read(scenario, "last_abs_y", cars(1), link=None).tolist() == [0, 0, 0]


# --- sensors ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("grid", "shape"),
    [
        ({"cells": [12, 7, 3], "minimum_m": [0, 0, 0], "maximum_m": [24, 7, 9]}, (12, 7, 3)),
        ({"minimum_m": [-5, 0, 0], "maximum_m": [5, 7, 3], "cell_m": [2, 2, 3]}, (5, 4, 1)),
        ({"minimum_m": [0, 0, 0], "maximum_m": [2.1, 2.7, 0.05], "cell_m": [0.3, 0.3, 0.1]}, (7, 9, 1)),
    ],
)
def test_the_shape_of_the_grid_is_that_of_the_settings_and_of_the_grid_itself(
    grid: dict[str, Any], shape: tuple[int, int, int]
) -> None:
    scenario = scenario_of(
        antenna_spec("bs", "tx"),
        antenna_spec("rx", "rx", on="car.*"),
        DeviceSpec(name="top", kind="lidar"),
        sensors={"lidar": {"grid": grid}},
    )
    space = part(scenario, Users(scenario, ("*",)), "lidar_grid").space
    assert space.shape == shape
    assert space.dtype == np.int8
    settings = convert_settings(LidarSettings, {"grid": grid})
    assert settings.grid is not None
    assert settings.grid.shape == shape, "what the LIDAR makes"


def scan(sensor: str, occupancy: np.ndarray[Any, Any] | None) -> LidarScan:
    none = np.zeros((0, 3), np.float32)
    grid = (
        OccupancyGrid(origin=(0, 0, 0), cell=(1, 1, 1), occupancy=occupancy)
        if occupancy is not None
        else None
    )
    return LidarScan(
        sensor=sensor,
        position=(0, 0, 0),
        orientation=(1, 0, 0, 0),
        ray=np.zeros(0, np.int32),
        points=none,
        points_world=none,
        range=np.zeros(0, np.float32),
        object=np.zeros(0, np.int32),
        grid=grid,
    )


def test_the_grid_is_that_of_the_lidar_that_was_named(scenario: Scenario) -> None:
    mine, other = np.full((1, 1, 1), -2, np.int8), np.full((1, 1, 1), 1, np.int8)
    lidar = Lidar(object_names=(), scans=(scan("car.1/left", other), scan("car.1/top", mine)))
    assert read(scenario, "lidar_grid", cars(1), given("lidar", lidar)).tolist() == [[[-2]]]
    without = Lidar(object_names=(), scans=(scan("car.1/top", None),))
    assert read(scenario, "lidar_grid", cars(1), given("lidar", without)) is None


OPTICS: dict[str, Any] = {
    "intrinsics": Intrinsics(fx=1.0, fy=1.0, cx=0.0, cy=0.0),
    "position": (0.0, 0.0, 0.0),
    "orientation": (1.0, 0.0, 0.0, 0.0),
}


@pytest.mark.parametrize(("sensor", "size"), [("dash", (20, 32)), ("wall", (5, 7))])
def test_images_are_rows_by_columns_of_the_camera_that_is_named(
    scenario: Scenario, sensor: str, size: tuple[int, int]
) -> None:
    rng = np.random.default_rng(1)
    colours = {
        "dash": rng.integers(0, 256, (20, 32, 3), np.uint8),
        "wall": rng.integers(0, 256, (5, 7, 3), np.uint8),
    }
    depths = {name: rgb[..., 0].astype(np.float32) for name, rgb in colours.items()}
    full = {"dash": "car.1/dash", "wall": "wall"}
    camera = Camera(
        images=tuple(CameraImage(sensor=full[n], rgb=rgb, **OPTICS) for n, rgb in colours.items())
    )
    depth = Depth(images=tuple(DepthImage(sensor=full[n], depth=d, **OPTICS) for n, d in depths.items()))
    inputs = given("camera", camera), given("depth", depth)
    picture = read(scenario, f"camera:{sensor}", cars(1), *inputs)
    assert picture.shape == (*size, 3)
    assert picture.dtype == np.uint8
    assert (picture == colours[sensor]).all()
    far = read(scenario, f"depth:{sensor}", cars(1), *inputs)
    assert far.shape == size
    assert far.dtype == np.float32
    assert (far == depths[sensor]).all()


@pytest.mark.parametrize("name", ["camera:dash", "depth:dash", "lidar_grid"])
def test_a_sensor_that_left_is_not_known(scenario: Scenario, name: str) -> None:
    assert read(scenario, name, cars(2)) is None


SENSORS = """
[services.lidar]
role = "sensors"
use = "lidar"
budget_ms = 400
[services.lidar.settings]
grid = { minimum_m = [-50, -20, 0], maximum_m = [50, 30, 20], cells = [20, 10, 4] }
[services.camera]
role = "sensors"
use = "camera"
budget_ms = 400
[[devices]]
name = "top"
kind = "lidar"
on = "car"
mount = "roof"
position_m = [0, 0, 0.3]
beams = 8
azimuth_steps = 90
[[devices]]
name = "wall"
kind = "camera"
position_m = [-40, 0, 4]
yaw_deg = 90
pitch_deg = 16
size_px = [28, 20]
[[devices]]
name = "bird"
kind = "camera"
on = "car-?"
size_px = [9, 6]
"""
"""The camera on the wall looks at the car, which is 12 m north of it at first; a car-1 never comes."""


@pytest.mark.channel
def test_sensors_are_seen_to_the_last_frame_and_what_is_not_known_is_zeros_handed_out_anew(
    tmp_path: Path,
) -> None:
    pytest.importorskip("mitsuba", reason="Mitsuba is not installed")
    path = tmp_path / "scenario.toml"
    path.write_text((SCENARIOS / "smoke.toml").read_text().replace("frames = 100", "frames = 4") + SENSORS)
    observe = ("lidar_grid", "camera:wall", "depth:wall", "camera:bird")
    with closing(BeamSelectionEnv(path, observe=observe)) as env:
        seen = [env.reset(seed=1)[0]]
        for _ in range(4):
            observation, _, _, truncated, _ = env.step(np.array([0, 0]))
            assert env.observation_space.contains(observation)
            assert not observation["camera:bird"].any()
            observation["camera:bird"] += 1
            seen.append(observation)
    assert truncated
    assert seen[0]["lidar_grid"].shape == (20, 10, 4)
    depth = seen[0]["depth:wall"]
    assert 10 < depth[depth > 0].min() < 12.5, "the car is there"
    for name in ("camera:wall", "depth:wall"):
        assert (seen[1][name] != seen[0][name]).any(), "it moves"
    for name in ("lidar_grid", "camera:wall", "depth:wall"):
        assert seen[3][name].any()
        assert (seen[4][name] == seen[3][name]).all(), f"{name} of the last frame"


def test_a_sensor_that_no_service_computes_is_told_with_the_remedy(tmp_path: Path) -> None:
    wall = '[[devices]]\nname = "wall"\nkind = "camera"\nposition_m = [0, 0, 9]\n'
    path = tmp_path / "scenario.toml"
    path.write_text((SCENARIOS / "smoke.toml").read_text() + wall)
    told = "agent 'agent' needs topic 'camera', which no service of the run produces; add one that does"
    env = BeamSelectionEnv(path, observe=("camera",))
    with closing(env), pytest.raises(RunError, match=told):
        env.reset(seed=1)


@pytest.mark.parametrize(
    ("name", "told"),
    [
        ("camera", "there are: camera:dash, camera:wall"),
        ("depth:dsh", "there are: depth:dash, depth:wall"),
        ("camera:top", "names no camera of the scenario"),
        ("lidar_grid:dash", "there are: lidar_grid:top"),
        ("lidargrid", "did you mean 'lidar_grid'?"),
        ("velocity:rx", "write 'velocity'"),
    ],
)
def test_a_mistake_is_named_with_what_to_write(scenario: Scenario, name: str, told: str) -> None:
    with pytest.raises(ScenarioError) as error:
        part(scenario, Users(scenario, ("*",)), name)
    assert repr(name) in str(error.value)
    assert told in str(error.value)


def test_a_grid_that_is_not_in_the_settings_is_asked_for() -> None:
    scenario = scenario_of(
        antenna_spec("bs", "tx"),
        antenna_spec("rx", "rx", on="car"),
        DeviceSpec(name="top", kind="lidar"),
        sensors={"lidar": {}},
    )
    with pytest.raises(ScenarioError, match=r"needs \[services\.<lidar>\.settings\.grid\]"):
        part(scenario, Users(scenario, ("*",)), "lidar_grid")


@pytest.mark.parametrize("name", PARTS)
def test_zeros_are_in_the_space_of_every_part(scenario: Scenario, name: str) -> None:
    sensor = {"camera": ":wall", "depth": ":wall"}.get(name, "")
    found: Part = part(scenario, Users(scenario, ("*",)), name + sensor)
    assert found.space.contains(np.zeros(found.space.shape, found.space.dtype))
