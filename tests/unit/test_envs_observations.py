"""Parts of the observation against formulas of their own, on scenes made by hand."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from gymnasium.spaces import Box
from link_builders import antenna, scene_of
from msgspec.structs import replace
from observation_builders import (
    PER_USER,
    antenna_spec,
    car_street,
    cars,
    link_of,
    read,
    scenario_of,
)

from caviar_protocol.errors import ScenarioError
from caviar_protocol.observations import OBSERVATION_PARTS, Part, Users, part
from caviar_protocol.scenario import Scenario
from caviar_protocol.space.coordinates import quaternion_from_euler
from caviar_protocol.topics import (
    AntennaDevice,
    Scene,
)

Euler = tuple[float, float, float]


@pytest.fixture
def scenario() -> Scenario:
    return car_street()


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


# --- the link --------------------------------------------------------------------------------------------


def test_the_last_magnitude_is_of_the_user_and_not_of_the_row(scenario: Scenario) -> None:
    link = link_of([("bs", "car.9/rx", 0.9), ("bs", "car.2/rx", 0.2), ("other", "car.1/rx", 7.0)])
    value = read(scenario, "last_abs_y", cars(1, 2), link=link)
    assert value == pytest.approx([0.0, 0.2, 0.0])


def test_the_last_magnitude_is_the_mean_over_carriers(scenario: Scenario) -> None:
    link = link_of([("bs", "car.1/rx", 0.25), ("bs", "car.1/rx", 0.75)])
    assert read(scenario, "last_abs_y", cars(1), link=link)[0] == pytest.approx(0.5)


def test_the_last_magnitude_is_0_in_frame_0(scenario: Scenario) -> None:
    assert read(scenario, "last_abs_y", cars(1), link=None).tolist() == [0, 0, 0]


def test_the_last_rate_is_the_mean_spectral_efficiency_over_carriers(scenario: Scenario) -> None:
    link = link_of([("bs", "car.1/rx", 0.2), ("bs", "car.2/rx", 0.3), ("bs", "car.1/rx", 0.4)])
    link = replace(link, spectral_efficiency=np.array([3.0, 7.5, 4.0]))
    assert read(scenario, "last_rate", cars(1, 2), link=link).tolist() == [3.5, 7.5, 0.0]


def test_the_last_beam_counts_pairs_as_actions_do_and_is_0_where_none_was_chosen() -> None:
    """Of 4 × 2 beams: TX beam 3 and RX beam 1 are pair 7, the last of 8."""
    street = scenario_of(antenna_spec("bs", "tx"), antenna_spec("rx", "rx", on="car.*", count=3))
    scene = scene_of(
        antenna("bs", "tx", array=(1, 4)),
        *(antenna(f"car.{n}/rx", "rx", array=(1, 2), parent=f"car.{n}") for n in (1, 2, 3)),
        objects={f"car.{n}": ((10.0 * n, 0, 0), 0.0) for n in (1, 2, 3)},
    )
    link = replace(
        link_of([("bs", f"car.{n}/rx", 0.1) for n in (1, 2, 3)]),
        tx_beam=np.array([3, 0, -1], np.int32),
        rx_beam=np.array([1, 0, -1], np.int32),
    )
    assert read(street, "last_beam", scene, link=link).tolist() == [1.0, 0.125, 0.0]


def test_packets_are_observed_with_all_carriers_together(scenario: Scenario) -> None:
    """Of car 1 two carriers: buffers and throughputs add up, and the oldest packet is that of either."""
    link = replace(
        link_of([("bs", "car.1/rx", 0.2), ("bs", "car.2/rx", 0.3), ("bs", "car.1/rx", 0.4)]),
        buffered=np.array([3e6, 0.0, 1.5e6]),
        waiting=np.array([0.01, 0.0, 0.25]),
        throughput=np.array([40e6, 7e6, 2e6]),
    )
    found = {
        name: read(scenario, name, cars(1, 2), link=link).tolist()
        for name in ("buffered", "waiting", "last_throughput")
    }
    assert found == {
        "buffered": [4.5, 0.0, 0.0],
        "waiting": [0.25, 0.0, 0.0],
        "last_throughput": [42.0, 7.0, 0.0],
    }


def test_packets_of_a_link_without_any_are_refused(scenario: Scenario) -> None:
    with pytest.raises(ScenarioError, match="'waiting' is of packets"):
        read(scenario, "waiting", cars(1), link=link_of([("bs", "car.1/rx", 0.2)]))


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


@pytest.mark.parametrize("name", OBSERVATION_PARTS)
def test_zeros_are_in_the_space_of_every_part(scenario: Scenario, name: str) -> None:
    sensor = {"camera": ":wall", "depth": ":wall"}.get(name, "")
    found: Part = part(scenario, Users(scenario, ("*",)), name + sensor)
    space = Box(*found.bounds)
    assert space.contains(np.zeros(space.shape, space.dtype))
