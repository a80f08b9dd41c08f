"""Scenarios, scenes and links for the tests of observations, and how a part is read from them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from gymnasium.spaces import Box
from link_builders import antenna, frame_of, scene_of
from msgspec.structs import replace

from caviar_protocol.observations import Moment, Users, part
from caviar_protocol.scenario import DeviceSpec, Scenario, load_scenario
from caviar_protocol.topics import (
    Link,
    Scene,
)
from caviar_services.service import FrameInput

SCENARIOS = Path(__file__).parents[2] / "deploy" / "caviar_scenarios"
PER_USER = {"aoa": 1, "aod": 1, "position": 3, "velocity": 3, "last_abs_y": 1, "last_rate": 1, "last_beam": 1}
"""Parts of the observation that every user has, and how many numbers each is."""


def car_street() -> Scenario:
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
    """The shipped smoke scenario with other devices, a link with packets, and sensors by name with their
    settings."""
    base = load_scenario(SCENARIOS / "smoke.toml")
    like = base.services["link"]
    services = {
        name: replace(like, role="sensors", use="lidar", settings=settings)
        for name, settings in (sensors or {}).items()
    }
    services["link"] = replace(like, use="cell")
    return replace(base, devices=devices, services={**base.services, **services})


def moment_of(users: Users, scene: Scene, *inputs: FrameInput, link: Link | None = None) -> Moment:
    return Moment(frame_of(*inputs), scene, link, users.present(scene))


def read(scenario: Scenario, name: str, scene: Scene, *inputs: FrameInput, link: Link | None = None) -> Any:
    """Value of a part, which its space has to hold."""
    users = Users(scenario, ("*",))
    found = part(scenario, users, name)
    value = found.read(moment_of(users, scene, *inputs, link=link))
    if value is not None:
        space = Box(*found.bounds)
        assert space.contains(np.asarray(value)), f"{name} is {value!r}, not in {space}"
    return value


def cars(*numbers: int) -> Scene:
    """Car n is n tens of metres east and n north; the base station stands at the origin, looking east."""
    return scene_of(
        antenna("bs", "tx"),
        *(antenna(f"car.{n}/rx", "rx", parent=f"car.{n}", position=(0, 0, 1.0)) for n in numbers),
        objects={f"car.{n}": ((10.0 * n, float(n) ** 2, 0.0), 0.0) for n in numbers},
    )


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
