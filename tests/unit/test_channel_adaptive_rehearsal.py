"""The scenes that rungs are timed on have all antennas of the scenario, on bodies that drive."""

from __future__ import annotations

import math

import msgspec
import numpy as np
import pytest

from caviar_protocol.scenario import DeviceSpec
from caviar_protocol.space.coordinates import Vector, euler_from_quaternion
from caviar_protocol.space.scene import antennas, device_pose
from caviar_protocol.topics import AntennaArray
from caviar_services.channel.adaptive.channel import rehearsal_scene

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
    DeviceSpec(
        name="rx", kind="antenna", role="rx", on="car.*", count=10, mount="roof", position_m=(0.0, 0.0, 0.1)
    ),
    DeviceSpec(name="relay", kind="antenna", role="both", on="uav", position_m=(0.0, 0.0, -0.3)),
    DeviceSpec(name="lidar", kind="lidar", on="car.*"),
)


ROOM = {"": 32, "objects/bus.ply": 4, "objects/car.ply": 32}


def test_it_has_as_many_pairs_as_the_scenario_announces() -> None:
    scene = rehearsal_scene(DEVICES, ROOM)
    assert len(antennas(scene, "tx")) == 2
    assert len(antennas(scene, "rx")) == 11
    assert len({device.name for device in scene.devices}) == 12


def test_mounted_antennas_are_on_bodies_and_as_many_bodies_are_without() -> None:
    scene = rehearsal_scene(DEVICES, ROOM)
    assert len(scene.names) == 22
    assert len({device.parent for device in scene.devices}) == 12, "the fixed one has no parent"
    assert set(scene.assets) == {"objects/bus.ply", "objects/car.ply"}, "boxes are for scenes without meshes"
    assert scene.assets.count("objects/bus.ply") == 4
    assert set(rehearsal_scene(DEVICES, {"": 32}).assets) == {""}


def test_bodies_drive_and_take_their_antennas_along() -> None:
    one, other = (rehearsal_scene(DEVICES, ROOM, step=step) for step in (0, 1))
    np.testing.assert_allclose(np.linalg.norm(other.position - one.position, axis=1), 0.5)
    moved = [
        math.dist(device_pose(one, a).position, device_pose(other, b).position)
        for a, b in zip(one.devices, other.devices, strict=True)
        if a.parent
    ]
    np.testing.assert_allclose(moved, 0.5)


def test_without_room_antennas_stand_alone() -> None:
    """A model to which objects are no obstacle; an antenna in the middle of an object, which has no body."""
    scene = rehearsal_scene(DEVICES, {})
    assert scene.names == ()
    assert len(antennas(scene, "rx")) == 11
    assert all(device.parent == "" and device.position[2] > 0 for device in scene.devices)
    (bs, rx, *_) = DEVICES
    inside = msgspec.structs.replace(rx, mount="centre", position_m=(0.0, 0.0, 0.0))
    scene = rehearsal_scene((bs, inside), ROOM)
    assert len(scene.names) == 10
    assert not any(device.parent for device in scene.devices)


def test_bodies_stand_on_the_ground_in_the_open() -> None:
    def is_free(place: Vector) -> bool:
        return place[1] > -8.0

    scene = rehearsal_scene(DEVICES, ROOM, 500.0, is_free)
    assert (scene.position[:, 1] > -8.0).all()
    np.testing.assert_allclose(scene.position[:, 2] - scene.dimensions[:, 2] / 2, 500.0)
    crowded = rehearsal_scene(DEVICES, ROOM, 500.0, lambda place: False)
    assert len(crowded.names) == 22, "where nothing is free they stand all the same"


def test_fixed_antennas_stand_where_they_are() -> None:
    (bs,) = (device for device in antennas(rehearsal_scene(DEVICES, ROOM), "tx") if device.name == "bs")
    assert (bs.position, bs.array.columns, bs.power_dbm) == ((3.0, -8.0, 5.0), 64, 30.0)
    assert euler_from_quaternion(bs.orientation)[0] == pytest.approx(math.pi / 2)


def test_the_others_stand_apart_about_the_first_fixed_one() -> None:
    scene = rehearsal_scene(DEVICES, ROOM)
    places = [device_pose(scene, device).position for device in antennas(scene, "rx")]
    between = [math.dist(a, b) for i, a in enumerate(places) for b in places[:i]]
    assert min(between) > 3
    assert all(10 < math.dist(place[:2], (3.0, -8.0)) < 60 for place in places)


def test_without_antennas_it_is_empty() -> None:
    scene = rehearsal_scene(DEVICES[3:], ROOM)
    assert (scene.devices, scene.names) == ((), ())
