"""Scenes of several worlds as one, and poses of what is mounted on moving objects."""

from __future__ import annotations

import math

import msgspec
import numpy as np
import pytest

from caviar_protocol.errors import PayloadError
from caviar_protocol.space.coordinates import quaternion_from_euler
from caviar_protocol.space.scene import antennas, device_pose, device_velocity, merge_scenes, object_pose
from caviar_protocol.topics import AntennaDevice, CameraDevice, Scene


def scene(*names: str, devices: tuple[AntennaDevice | CameraDevice, ...] = ()) -> Scene:
    """A scene whose objects differ in every number."""
    n = len(names)
    seed = np.arange(n, dtype=float)[:, None] + len(names[0] if names else "")
    return Scene(
        names=names,
        classes=tuple(f"class of {name}" for name in names),
        assets=tuple(f"objects/{name}.ply" for name in names),
        position=seed * [1.0, 2.0, 3.0],
        orientation=np.array([quaternion_from_euler(0.1 * (i + 1)) for i in range(n)]).reshape(n, 4),
        velocity=seed * [4.0, 5.0, 6.0],
        dimensions=seed + np.array([7.0, 8.0, 9.0]),
        devices=devices,
    )


def test_one_scene_merged_is_itself() -> None:
    one = scene("a", "b")
    assert merge_scenes({"w": one}) is one


def test_merged_objects_are_sorted_and_keep_their_own_numbers() -> None:
    first, second = scene("car.1", "car.9"), scene("bus.longer", "car.5")
    merged = merge_scenes({"w1": first, "w2": second})
    assert merged.names == ("bus.longer", "car.1", "car.5", "car.9")
    for name in merged.names:
        origin = first if name in first.names else second
        i, j = merged.names.index(name), origin.names.index(name)
        assert merged.classes[i] == f"class of {name}"
        assert merged.assets[i] == f"objects/{name}.ply"
        for field in ("position", "orientation", "velocity", "dimensions"):
            np.testing.assert_array_equal(getattr(merged, field)[i], getattr(origin, field)[j])


def test_the_order_of_the_worlds_does_not_change_the_merged_scene() -> None:
    scenes = {"w1": scene("a"), "w2": scene("bb", "cc"), "w3": scene()}
    assert merge_scenes(scenes) == merge_scenes(dict(reversed(scenes.items())))


def test_merged_devices_are_sorted() -> None:
    one = scene(devices=(CameraDevice(name="z"),))
    other = scene("car", devices=(CameraDevice(name="car/x", parent="car"),))
    assert [device.name for device in merge_scenes({"w1": one, "w2": other}).devices] == ["car/x", "z"]


@pytest.mark.parametrize(
    "other", [scene("b", "a"), scene(devices=(CameraDevice(name="a"),))], ids=["object", "device"]
)
def test_a_name_of_two_worlds_is_refused_and_both_are_named(other: Scene) -> None:
    with pytest.raises(PayloadError, match=r"'a' .*world 'w1'.*world 'w2'"):
        merge_scenes({"w1": scene("a"), "w2": other})


def test_a_free_device_stands_where_it_says() -> None:
    device = CameraDevice(name="c", position=(1.0, 2.0, 3.0), orientation=(0.0, 1.0, 0.0, 0.0))
    assert device_pose(scene(), device) == ((1.0, 2.0, 3.0), (0.0, 1.0, 0.0, 0.0))
    np.testing.assert_array_equal(device_velocity(scene(), device), np.zeros(3))


def test_a_mounted_device_moves_and_turns_with_its_parent() -> None:
    world = scene("a", "b")
    device = CameraDevice(name="c", parent="b", position=(2.0, 0.0, 0.5))
    pose, parent = device_pose(world, device), object_pose(world, 1)
    expected = np.add(parent.position, (2.0 * math.cos(0.2), 2.0 * math.sin(0.2), 0.5))
    np.testing.assert_allclose(pose.position, expected, rtol=0, atol=1e-12)
    np.testing.assert_allclose(pose.orientation, parent.orientation, rtol=0, atol=1e-15)
    np.testing.assert_array_equal(device_velocity(world, device), world.velocity[1])


def test_a_mounted_device_moves_with_the_turn_of_its_parent() -> None:
    """By hand: the body faces north, turns left by 3 rad/s and about its front by 0.5 rad/s; 2 m to the
    front of it that leads west with 6 m/s, 1 m above it east with 0.5 m/s."""
    still = scene("a", "b")
    world = msgspec.structs.replace(
        still,
        orientation=np.array([[1.0, 0, 0, 0], quaternion_from_euler(math.pi / 2)]),
        angular_velocity=np.array([[9.0, 9.0, 9.0], [0.0, 0.5, 3.0]]),
    )
    device = CameraDevice(name="c", parent="b", position=(2.0, 0.0, 1.0))
    added = device_velocity(world, device) - world.velocity[1]
    np.testing.assert_allclose(added, [-3.0 * 2.0 + 0.5 * 1.0, 0.0, 0.0], rtol=0, atol=1e-12)
    np.testing.assert_array_equal(device_velocity(world, CameraDevice(name="d")), np.zeros(3))


def test_worlds_that_know_how_objects_turn_are_merged_with_those_that_do_not() -> None:
    turning = np.array([[0.0, 0.0, 0.5], [0.1, 0.0, 0.0]])
    knows = msgspec.structs.replace(scene("a", "c"), angular_velocity=turning)
    merged = merge_scenes({"w1": knows, "w2": scene("b")})
    assert merged.angular_velocity is not None
    np.testing.assert_array_equal(merged.angular_velocity, [turning[0], np.zeros(3), turning[1]])
    assert merge_scenes({"w1": scene("a"), "w2": scene("b")}).angular_velocity is None


def test_a_device_without_its_parent_is_named() -> None:
    device = CameraDevice(name="c", parent="gone")
    for function in (device_pose, device_velocity):
        with pytest.raises(PayloadError, match="'c' is mounted on 'gone'"):
            function(scene("a"), device)


def test_antennas_are_those_that_can_do_it_by_name() -> None:
    devices = (
        AntennaDevice(name="d", role="rx"),
        AntennaDevice(name="a", role="both"),
        CameraDevice(name="b"),
        AntennaDevice(name="c", role="tx"),
    )
    assert [d.name for d in antennas(scene(devices=devices), "tx")] == ["a", "c"]
    assert [d.name for d in antennas(scene(devices=devices), "rx")] == ["a", "d"]
