"""The shipped scenarios, as their worlds play them."""

from __future__ import annotations

import importlib.util
from pathlib import Path

import numpy as np
import pytest

from caviar_protocol.scenario import Scenario, load_scenario, rules
from caviar_protocol.scenario.conversion import convert_settings
from caviar_protocol.scenario.rules import settings_place
from caviar_protocol.space.scene import device_pose
from caviar_protocol.topics import AntennaDevice, LidarDevice, Scene
from caviar_services.registry import load
from caviar_services.service import Frame, Preparation, RunInfo
from caviar_services.world.base import World

pytestmark = pytest.mark.slow

NAMES = ("fig2", "geometric", "smoke", "street-canyon", "uav-base-station", "uav-munich")
with_sumo = [
    pytest.mark.sumo,
    pytest.mark.skipif(importlib.util.find_spec("libsumo") is None, reason="needs the world extra"),
]


def scenario_named(repository: Path, name: str) -> Scenario:
    return load_scenario(repository / "deploy" / "caviar_scenarios" / f"{name}.toml")


def world_of(scenario: Scenario) -> World:
    name, spec = next((n, s) for n, s in scenario.services.items() if s.role == "world")
    cls = load("world", spec.use)
    settings = convert_settings(cls.Settings, spec.settings, settings_place(scenario, name))
    world = cls(
        settings,
        RunInfo(
            name=name,
            devices=tuple(d for i, d in enumerate(scenario.devices) if rules.world_of(scenario, i) == name),
            sampling_period_ns=scenario.run.sampling_period_ns,
            frames=scenario.run.frames,
        ),
    )
    assert isinstance(world, World)
    world.prepare(Preparation(demand={}))
    return world


def play(world: World, scenario: Scenario, seed: int, frames: int, stride: int = 1) -> list[Scene]:
    world.reset(0, seed, 0)
    scenes = []
    for k in range(0, frames, stride):
        t_ns = k * scenario.run.sampling_period_ns
        scene = world.step(Frame(episode=0, number=k, previous=k - stride, t_ns=t_ns)).products["scene"]
        assert isinstance(scene, Scene)
        scenes.append(scene)
    return scenes


@pytest.mark.parametrize("name", NAMES)
def test_settings_of_all_services_are_known_to_their_implementations(repository: Path, name: str) -> None:
    scenario = scenario_named(repository, name)
    assert scenario.run.name == name
    for service, spec in scenario.services.items():
        cls = load(spec.role, spec.use)
        convert_settings(cls.Settings, spec.settings, settings_place(scenario, service))


@pytest.mark.parametrize("name", NAMES)
def test_frames_stand_at_the_start_of_a_line(repository: Path, name: str) -> None:
    """So that the number of frames can be found and changed without a TOML parser."""
    text = (repository / "deploy" / "caviar_scenarios" / f"{name}.toml").read_text()
    assert sum(line.startswith("frames = ") for line in text.splitlines()) == 1


@pytest.mark.parametrize("name", ["geometric", "smoke", "uav-munich"])
def test_a_flight_begins_and_ends_at_rest_within_the_run(repository: Path, name: str) -> None:
    scenario = scenario_named(repository, name)
    scenes = play(world_of(scenario), scenario, 1, scenario.run.frames)
    uav = scenes[0].names.index("uav")
    heights = np.array([scene.position[uav, 2] for scene in scenes])
    assert scenes[0].velocity[uav].tolist() == [0.0, 0.0, 0.0]
    assert scenes[-1].velocity[uav].tolist() == [0.0, 0.0, 0.0]
    assert heights.min() == heights[0] == heights[-1]
    assert heights.max() > 10.0
    for scene in scenes:
        for device in scene.devices:
            assert device_pose(scene, device).position[2] > 0.0  # no antenna below the ground


@pytest.mark.parametrize("seed", [1, 2, 3])
@pytest.mark.parametrize("name", [pytest.param("street-canyon", marks=with_sumo)])
def test_the_canyon_is_busy_and_fully_equipped(repository: Path, name: str, seed: int) -> None:
    """At least 12 vehicles in each of 400 frames, ten of them with a receiver, one with a LIDAR;
    none in a façade (buildings stand at y < −8.61 m and y > 9.57 m along the street)."""
    scenario = scenario_named(repository, name)
    world = world_of(scenario)
    try:
        scenes = play(world, scenario, seed, 401, stride=4)
    finally:
        world.close()
    for scene in scenes:
        assert len(scene.names) >= 12
        receivers = [d for d in scene.devices if isinstance(d, AntennaDevice) and d.role == "rx"]
        assert len(receivers) == 10
        assert sum(isinstance(d, LidarDevice) for d in scene.devices) == 1
        in_street = np.abs(scene.position[:, 0]) < 12.0
        assert (scene.position[in_street, 1] - scene.dimensions[in_street, 1] / 2 > -8.0).all()
        assert (scene.position[in_street, 1] + scene.dimensions[in_street, 1] / 2 < 9.0).all()
    assert set(scenes[0].names) - set(scenes[-1].names)
    assert set(scenes[-1].names) - set(scenes[0].names)
