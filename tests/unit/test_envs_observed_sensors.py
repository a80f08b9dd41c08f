"""What LIDARs and cameras add to an observation."""

from __future__ import annotations

from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from link_builders import given
from msgspec.structs import replace
from observation_builders import (
    SCENARIOS,
    antenna_spec,
    car_street,
    cars,
    read,
    scenario_of,
)

from caviar_clients.envs.base import BeamSelectionEnv
from caviar_clients.session.embedded import EmbeddedRun
from caviar_protocol.errors import PayloadError, RunError, ScenarioError
from caviar_protocol.observations import Users, part
from caviar_protocol.recording import Recording
from caviar_protocol.scenario import DeviceSpec, Scenario, load_scenario
from caviar_protocol.scenario.conversion import convert_settings
from caviar_protocol.topics import (
    Camera,
    CameraImage,
    Depth,
    DepthImage,
    Intrinsics,
    Lidar,
    LidarScan,
    OccupancyGrid,
)
from caviar_services.sensors.lidar import LidarSettings
from caviar_services.world.trajectory import TrajectoryWorld


@pytest.fixture
def scenario() -> Scenario:
    return car_street()


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
    space = part(scenario, Users(scenario, ("*",)), "lidar_grid").bounds
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


def test_a_lidar_on_several_objects_gives_each_user_the_grid_of_its_own(scenario: Scenario) -> None:
    tops = [replace(d, on="car.*", count=3) if d.name == "top" else d for d in scenario.devices]
    several = replace(scenario, devices=tuple(tops))
    grids = {n: np.full((1, 1, 1), -n, np.int8) for n in (1, 2)}
    lidar = Lidar(object_names=(), scans=tuple(scan(f"car.{n}/top", grid) for n, grid in grids.items()))
    seen = read(several, "lidar_grid", cars(2, 1, 3), given("lidar", lidar))
    users = Users(several, ("*",)).present(cars(2, 1, 3))
    wanted = {place: {"car.1": -1, "car.2": -2, "car.3": 0}[pair.rx.parent] for place, pair in users}
    assert {place: int(seen[place].item()) for place in wanted} == wanted
    elsewhere = replace(
        several, devices=tuple(replace(d, on="bus.*") if d.name == "top" else d for d in several.devices)
    )
    with pytest.raises(ScenarioError, match=r"'top'.*3.*'bus\.\*'"):
        part(elsewhere, Users(elsewhere, ("*",)), "lidar_grid")
    wide = Lidar(object_names=(), scans=(scan("car.1/top", np.zeros((2, 1, 1), np.int8)),))
    with pytest.raises(PayloadError, match=r"car\.1/top.*\[2.*1.*1\].*\[1.*1.*1\]"):
        read(several, "lidar_grid", cars(1), given("lidar", wide))


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


LIDAR = """
[services.lidar]
role = "sensors"
use = "lidar"
budget_ms = 400
[services.lidar.settings]
grid = { minimum_m = [-50, -20, 0], maximum_m = [50, 30, 20], cells = [20, 10, 4] }
[[devices]]
name = "top"
kind = "lidar"
on = "car"
mount = "roof"
position_m = [0, 0, 0.3]
beams = 8
azimuth_steps = 90
"""
SENSORS = """
[services.camera]
role = "sensors"
use = "camera"
budget_ms = 400
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
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("mitsuba", reason="Mitsuba is not installed")
    # As a world whose objects come and go: that of `smoke` refuses a device on an object that cannot come.
    known = TrajectoryWorld.known_objects
    monkeypatch.setattr(TrajectoryWorld, "prefixes", lambda world: tuple(known(world.settings) or ()))
    monkeypatch.setattr(TrajectoryWorld, "mesh_classes", lambda world: ("car", "uav"))
    monkeypatch.setattr(TrajectoryWorld, "known_objects", classmethod(lambda *_: None))
    path = tmp_path / "scenario.toml"
    path.write_text(
        (SCENARIOS / "smoke.toml").read_text().replace("frames = 100", "frames = 4") + LIDAR + SENSORS
    )
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


def test_a_grid_that_is_not_in_the_settings_is_asked_for() -> None:
    scenario = scenario_of(
        antenna_spec("bs", "tx"),
        antenna_spec("rx", "rx", on="car"),
        DeviceSpec(name="top", kind="lidar"),
        sensors={"lidar": {}},
    )
    with pytest.raises(ScenarioError, match=r"\[services\.<lidar>\.settings\.grid\]"):
        part(scenario, Users(scenario, ("*",)), "lidar_grid")


@pytest.mark.channel
def test_a_policy_that_observes_a_lidar_is_served(tmp_path: Path) -> None:
    pytest.importorskip("mitsuba", reason="Mitsuba is not installed")
    torch = pytest.importorskip("torch")
    pytest.importorskip("onnx")
    from caviar_clients.learning.export import card_of, export_module

    class Counted(torch.nn.Module):  # type: ignore[misc]
        """Beam by the number of cells that are taken."""

        def forward(self, grid: Any, position: Any) -> Any:
            beam = (grid == 1).sum() % 16 + 0 * position.sum().to(torch.int64)
            return torch.stack([beam, beam])[None]

    text = (SCENARIOS / "smoke.toml").read_text().replace("frames = 100", "frames = 4") + LIDAR
    path = tmp_path / "scenario.toml"
    path.write_text(text)
    env = BeamSelectionEnv(path, observe=("lidar_grid", "position"))
    export_module(Counted(), env.observation_space, tmp_path / "p.onnx", card_of(env))
    served = 'use = "policy"\nsettings.file = "file:p.onnx"'
    assert 'use = "los-beam"' in text
    path.write_text(text.replace('use = "los-beam"', served, 1).replace('"scene", ', '"scene", "lidar", ', 1))
    (tmp_path / "run").mkdir()
    assert not EmbeddedRun(load_scenario(path), tmp_path / "run").run().error
    recording = Recording(tmp_path / "run")
    for lidar, action in zip(recording["lidar"], recording["action"], strict=True):
        count = int((lidar.scans[0].grid.occupancy == 1).sum())
        assert count > 0
        pairs = [c.tx_beam * (2 if c.rx.startswith("car") else 1) + c.rx_beam for c in action.commands]
        assert pairs[-1] == count % 16
    alone = load_scenario(path)
    without = replace(alone, services={n: s for n, s in alone.services.items() if n != "lidar"})
    (tmp_path / "other").mkdir()
    error = EmbeddedRun(without, tmp_path / "other").run().error
    assert "needs topic 'lidar', which no service of the run produces" in error
