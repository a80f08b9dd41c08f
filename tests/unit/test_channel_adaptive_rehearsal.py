"""The scene that rungs are timed on has all antennas of the scenario, and nothing else."""

from __future__ import annotations

import math

import pytest

from caviar_protocol.coordinates import euler_from_quaternion
from caviar_protocol.scenario import DeviceSpec
from caviar_protocol.scene import antennas
from caviar_protocol.topics import AntennaArray
from caviar_services.channel.adaptive.rehearsal import rehearsal_scene

DEVICES = (
    DeviceSpec(
        name="bs",
        kind="antenna",
        role="tx",
        position_m=(3.0, -8.0, 5.0),
        yaw_deg=90.0,
        array=AntennaArray(columns=64),
        power_dbm=30.0,
    ),
    DeviceSpec(name="rx", kind="antenna", role="rx", on="car.*", count=10),
    DeviceSpec(name="relay", kind="antenna", role="both", on="uav"),
    DeviceSpec(name="lidar", kind="lidar", on="car.*"),
)


def test_it_has_as_many_pairs_as_the_scenario_announces() -> None:
    scene = rehearsal_scene(DEVICES)
    assert len(antennas(scene, "tx")) == 2
    assert len(antennas(scene, "rx")) == 11
    assert len({device.name for device in scene.devices}) == 12
    assert scene.names == ()


def test_fixed_antennas_stand_where_they_are() -> None:
    (bs,) = (device for device in antennas(rehearsal_scene(DEVICES), "tx") if device.name == "bs")
    assert (bs.position, bs.array.columns, bs.power_dbm) == ((3.0, -8.0, 5.0), 64, 30.0)
    assert euler_from_quaternion(bs.orientation)[0] == pytest.approx(math.pi / 2)


def test_the_others_stand_apart_about_the_first_fixed_one() -> None:
    places = [device.position for device in antennas(rehearsal_scene(DEVICES), "rx")]
    between = [math.dist(a, b) for i, a in enumerate(places) for b in places[:i]]
    assert min(between) > 3
    assert all(10 < math.dist(place[:2], (3.0, -8.0)) < 60 for place in places)


def test_without_antennas_it_is_empty() -> None:
    assert rehearsal_scene(DEVICES[3:]).devices == ()
