"""What every world does: the scene payload, and devices that are mounted on what comes and goes."""

from __future__ import annotations

import math
import re
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from world_builders import T_SAM_NS, ScriptedWorld, scene_at, state, wire_bytes

from caviar_protocol.errors import PayloadError, ScenarioError
from caviar_protocol.scenario import DeviceSpec
from caviar_protocol.space.coordinates import euler_from_quaternion, quaternion_from_euler
from caviar_protocol.space.scene import device_pose, device_velocity
from caviar_protocol.topics import AntennaDevice, CameraDevice, LidarDevice
from caviar_protocol.topics.scene import AntennaArray
from caviar_services.service import Frame, Preparation, RunInfo
from caviar_services.world.trajectory import MovingObject, TrajectorySettings, TrajectoryWorld


def antenna(name: str = "rx", on: str = "car.*", **changes: object) -> DeviceSpec:
    return DeviceSpec(name=name, kind="antenna", role="rx", on=on, **changes)


def mounted(world: ScriptedWorld, frames: int) -> list[list[str]]:
    """Names of the devices of each frame."""
    world.reset(0, 1, 0)
    return [[device.name for device in scene_at(world, k).devices] for k in range(frames)]


def test_objects_are_sorted_and_keep_their_own_values() -> None:
    """Whatever order a world yields, rows of the payload are sorted by name and stay together."""
    world = ScriptedWorld(
        [
            [
                state("car.b", position=(1.0, 2.0, 3.0), velocity=(4.0, 5.0, 6.0)),
                state("car.a", class_="ship", position=(-1.0, -2.0, -3.0), dimensions=(9.0, 8.0, 7.0)),
            ]
        ]
    )
    scene = scene_at(world, 0)
    assert scene.names == ("car.a", "car.b")
    assert scene.classes == ("ship", "car")
    assert scene.assets == ("", "objects/car.ply")
    assert scene.position.tolist() == [[-1.0, -2.0, -3.0], [1.0, 2.0, 3.0]]
    assert scene.velocity.tolist() == [[0.0, 0.0, 0.0], [4.0, 5.0, 6.0]]
    assert scene.dimensions.tolist() == [[9.0, 8.0, 7.0], [4.0, 2.0, 1.5]]


@pytest.mark.parametrize("odd", [None, "car", b"car", [("car", 1)]])
def test_what_a_world_returns_that_is_no_object_is_named_with_its_method(odd: object) -> None:
    class Odd(ScriptedWorld):
        def objects_at(self, elapsed_ns: int) -> Any:
            return odd

    wrong = odd[0] if isinstance(odd, list) else odd
    with pytest.raises(
        PayloadError, match=rf"^Odd\.objects_at returned {re.escape(repr(wrong))}.*ObjectState"
    ):
        scene_at(Odd([[]]), 0)


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("position", (1.0, 2.0)),
        ("dimensions", None),
        ("velocity", (0.0, math.nan, 0.0)),
        ("orientation", ("1", "a", 0, 0)),
        ("angular_velocity", 0.5),
        ("mesh", ("objects/car.ply", (4.0, 2.0, 1.5))),
        ("class_", None),
    ],
)
def test_a_wrong_value_is_named_with_its_object_and_field(field: str, value: object) -> None:
    world = ScriptedWorld([[state("car.a"), state("car.b", **{field: value})]])
    with pytest.raises(
        PayloadError, match=rf"^object 'car\.b': {field} is {re.escape(repr(value))}; give it"
    ):
        scene_at(world, 0)


def test_angular_velocities_are_zeros_beside_one_that_turns_and_else_left_out() -> None:
    turning = state("car.b", angular_velocity=(-0.0, 0.5, 0.25))
    world = ScriptedWorld([[state("car.a"), turning], [state("car.a", angular_velocity=(0.0, -0.0, 0.0))]])
    assert scene_at(world, 0).angular_velocity.tolist() == [[0.0, 0.0, 0.0], [0.0, 0.5, 0.25]]
    assert scene_at(world, 1).angular_velocity is None


@pytest.mark.parametrize("method", ["prefixes", "mesh_classes"])
@pytest.mark.parametrize("odd", [None, "car"])
def test_names_that_are_no_series_are_named_with_their_method(method: str, odd: object) -> None:
    made = type("Odd", (ScriptedWorld,), {method: lambda self: odd})([[]])
    with pytest.raises(PayloadError, match=rf"^Odd\.{method} returned {odd!r}; return a list of str"):
        made.scenery() and made.prepare(Preparation(demand={}))


def test_an_empty_world_is_a_scene_too() -> None:
    scene = scene_at(ScriptedWorld([[]]), 0)
    assert scene.names == ()
    assert scene.orientation.shape == (0, 4)
    assert wire_bytes(scene)


def test_negative_zero_does_not_change_the_bytes() -> None:
    """−0.0 equals 0.0, so scenes that differ in it are equal and must have equal digests."""
    plain = ScriptedWorld([[state("car.a", velocity=(0.0, 0.0, 0.0))]])
    signed = ScriptedWorld([[state("car.a", velocity=(-0.0, 0.0, -0.0))]])
    assert wire_bytes(scene_at(plain, 0)) == wire_bytes(scene_at(signed, 0))


def test_names_have_the_characters_that_the_protocol_allows() -> None:
    """A no-break space, which Python does not count as printable, is no control character."""
    assert scene_at(ScriptedWorld([[state("car\u00a01")]]), 0).names == ("car\u00a01",)
    with pytest.raises(PayloadError, match=r"'car\\n'"):
        scene_at(ScriptedWorld([[state("car\n")]]), 0)


def test_two_objects_of_one_name_are_refused_by_name() -> None:
    world = ScriptedWorld([[state("car.a"), state("car.b"), state("car.a", position=(1.0, 0.0, 0.0))]])
    with pytest.raises(PayloadError, match=r"'world'.*'car\.a'"):
        scene_at(world, 0)


def test_time_counts_from_the_start_of_the_episode() -> None:
    world = ScriptedWorld([[state("car.a")], [state("car.b")]])
    world.reset(3, 7, 5_000_000_000)
    assert world.begun == (3, 7)
    assert scene_at(world, 1, t0_ns=5_000_000_000).names == ("car.b",)


def test_names_of_fixed_devices_are_declared_with_the_prefixes() -> None:
    """So that another world's object cannot have the name of the base station."""
    world = ScriptedWorld([[]], [DeviceSpec(name="bs", kind="antenna", role="tx"), antenna()])
    assert world.prepare(Preparation(demand={})).prefixes == ("bs", "car.")


@pytest.mark.parametrize("on", ["cra.1", "cra.*", "*.a", "ca?.*", "car.*"])
def test_a_device_on_what_can_never_come_is_refused(on: str) -> None:
    """The names of the world's objects begin with ``car.``; patterns that may match them pass."""
    world = ScriptedWorld([[]], [antenna(on=on)])
    if not on.startswith("cra"):
        assert world.prepare(Preparation(demand={})).prefixes == ("car.",)
        return
    with pytest.raises(ScenarioError, match=r"'rx' stands on 'cra\..*begin with car\.") as refused:
        world.prepare(Preparation(demand={}))
    assert refused.value.key == "devices.rx.on"
    if on == "cra.1":
        assert "did you mean 'car.'?" in str(refused.value)


@pytest.mark.parametrize(("on", "passes"), [("bus", True), ("b*", True), ("bus2", False), ("cart", False)])
def test_where_all_objects_are_known_a_device_stands_on_one_of_them(on: str, passes: bool) -> None:
    """A typo that begins with an object's name is one, too."""
    objects = [MovingObject(name=name, waypoints=((0.0, 0.0, 0.0, 0.0),)) for name in ("bus", "car")]
    run = RunInfo(name="world", devices=(antenna(on=on),))
    world = TrajectoryWorld(TrajectorySettings(objects=tuple(objects)), run)
    if passes:
        world.prepare(Preparation(demand={}))
        return
    with pytest.raises(
        ScenarioError, match=rf"on '{on}', which .* did you mean '{on[:3]}'\? its objects are"
    ):
        world.prepare(Preparation(demand={}))


def test_a_device_without_an_object_is_counted() -> None:
    world = ScriptedWorld([[], [state("car.a")]], [antenna()])
    world.reset(0, 1, 0)
    frames = [Frame(episode=0, number=k, t_ns=k * T_SAM_NS) for k in range(2)]
    assert [world.step(frame).counts for frame in frames] == [{"device-without-object/rx": 1}, {}]


def test_first_come_keep_their_devices_and_the_next_takes_over() -> None:
    """Two receivers for four cars: the first two to come have one; who leaves frees it for the next."""
    a, b, c, d = (state(f"car.{name}") for name in "abcd")
    world = ScriptedWorld(
        [[b, c], [b, c, a], [b, c, a, d], [c, a, d], [c, a, d], [a, d], [d]], [antenna(count=2)]
    )
    assert mounted(world, 7) == [
        ["car.b/rx", "car.c/rx"],
        ["car.b/rx", "car.c/rx"],
        ["car.b/rx", "car.c/rx"],
        ["car.a/rx", "car.c/rx"],
        ["car.a/rx", "car.c/rx"],
        ["car.a/rx", "car.d/rx"],
        ["car.d/rx"],
    ]


def test_one_that_comes_back_stands_at_the_end_of_the_queue() -> None:
    a, b = state("car.a"), state("car.b")
    world = ScriptedWorld([[a, b], [b], [a, b]], [antenna(count=1)])
    assert mounted(world, 3) == [["car.a/rx"], ["car.b/rx"], ["car.b/rx"]]


def test_an_episode_forgets_who_came_first_in_the_one_before() -> None:
    a, b = state("car.a"), state("car.b")
    world = ScriptedWorld([[b], [a, b]], [antenna(count=1)])
    assert mounted(world, 2)[1] == ["car.b/rx"]
    world.reset(1, 1, 0)
    assert [device.name for device in scene_at(world, 1).devices] == ["car.a/rx"]


@given(st.lists(st.sets(st.sampled_from("abcdef")), min_size=1, max_size=12), st.integers(1, 4))
def test_nobody_loses_a_device_while_present(presence: list[set[str]], count: int) -> None:
    """Whatever comes and goes: as many devices as possible, and none taken from who has one."""
    world = ScriptedWorld(
        [[state(f"car.{name}") for name in sorted(names)] for names in presence], [antenna(count=count)]
    )
    before: set[str] = set()
    for names, devices in zip(presence, mounted(world, len(presence)), strict=True):
        holders = {device.removeprefix("car.").removesuffix("/rx") for device in devices}
        assert holders <= names
        assert len(holders) == min(count, len(names))
        assert before & names <= holders
        before = holders


def test_a_device_on_a_named_object_exists_while_the_object_does() -> None:
    world = ScriptedWorld([[state("car.a")], [state("car.ab")], []], [antenna(on="car.a")])
    assert mounted(world, 3) == [["car.a/rx"], [], []]


def test_a_whole_name_with_brackets_is_no_pattern() -> None:
    world = ScriptedWorld([[state("car[1]"), state("car1")]], [antenna(on="car[1]")])
    assert mounted(world, 1) == [["car[1]/rx"]]


@pytest.mark.parametrize(("mount", "z"), [("centre", 0.4), ("roof", 1.15), ("floor", -0.35)])
def test_mounts_refer_to_the_bounding_box_of_the_parent(mount: str, z: float) -> None:
    world = ScriptedWorld([[state("car.a")]], [antenna(mount=mount, position_m=(1.0, -0.5, 0.4))])
    (device,) = scene_at(world, 0).devices
    assert device.parent == "car.a"
    assert device.position == pytest.approx((1.0, -0.5, z))


def test_a_mounted_device_moves_and_turns_with_its_object() -> None:
    """A bracket ahead and to the left of a turned, tilted car; its pose by plain matrices."""
    yaw, pitch, roll = 0.7, -0.2, 0.1
    world = ScriptedWorld(
        [
            [
                state(
                    "car.a",
                    position=(10.0, -4.0, 2.0),
                    orientation=quaternion_from_euler(yaw, pitch, roll),
                    velocity=(3.0, 2.0, 0.5),
                )
            ]
        ],
        [antenna(position_m=(1.2, 0.3, 0.1), yaw_deg=90.0)],
    )
    scene = scene_at(world, 0)
    (device,) = scene.devices
    pose = device_pose(scene, device)
    rz = np.array([[math.cos(yaw), -math.sin(yaw), 0], [math.sin(yaw), math.cos(yaw), 0], [0, 0, 1]])
    ry = np.array([[math.cos(pitch), 0, math.sin(pitch)], [0, 1, 0], [-math.sin(pitch), 0, math.cos(pitch)]])
    rx = np.array([[1, 0, 0], [0, math.cos(roll), -math.sin(roll)], [0, math.sin(roll), math.cos(roll)]])
    body = rz @ ry @ rx
    assert pose.position == pytest.approx(np.array([10.0, -4.0, 2.0]) + body @ [1.2, 0.3, 0.1], abs=1e-12)
    w, x, y, z = pose.orientation
    boresight = [1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)]
    assert boresight == pytest.approx(body @ [0.0, 1.0, 0.0], abs=1e-12)
    assert device_velocity(scene, device).tolist() == [3.0, 2.0, 0.5]


def test_specifications_become_devices_in_radians() -> None:
    world = ScriptedWorld(
        [[]],
        [
            DeviceSpec(name="a", kind="antenna", role="tx", array=AntennaArray(columns=64), power_dbm=30.0),
            DeviceSpec(
                name="b",
                kind="lidar",
                beams=3,
                azimuth_steps=9,
                elevation_deg=(-30.0, 15.0),
                range_m=(1.0, 50.0),
            ),
            DeviceSpec(name="c", kind="camera", size_px=(320, 200), field_of_view_deg=60.0, pitch_deg=90.0),
        ],
    )
    tx, lidar, camera = scene_at(world, 0).devices
    assert isinstance(tx, AntennaDevice)
    assert (tx.role, tx.array.columns, tx.power_dbm, tx.parent) == ("tx", 64, 30.0, "")
    assert isinstance(lidar, LidarDevice)
    assert (lidar.beams, lidar.azimuth_steps, lidar.min_range, lidar.max_range) == (3, 9, 1.0, 50.0)
    assert (lidar.elevation_min, lidar.elevation_max) == pytest.approx((-math.pi / 6, math.pi / 12))
    assert isinstance(camera, CameraDevice)
    assert (camera.width, camera.height) == (320, 200)
    assert camera.field_of_view == pytest.approx(math.pi / 3)
    assert camera.orientation == pytest.approx((math.sqrt(0.5), 0.0, math.sqrt(0.5), 0.0))


def test_an_antenna_without_a_role_is_refused_with_what_to_write() -> None:
    with pytest.raises(ScenarioError, match=r"'rx'.*role = .tx."):
        ScriptedWorld([[]], [DeviceSpec(name="rx", kind="antenna")])


def test_a_device_that_keeps_its_heading_does_not_turn_with_its_object() -> None:
    turned = state("car.a", orientation=quaternion_from_euler(math.radians(130.0)))
    specs = (
        antenna("turns", yaw_deg=10.0),
        antenna("keeps", yaw_deg=10.0, keeps_heading=True, position_m=(1.0, 0.0, 0.0)),
    )
    world = ScriptedWorld([[turned]], devices=specs)
    world.reset(0, 1, 0)
    scene = scene_at(world, 0)
    yaw = {
        device.name: math.degrees(euler_from_quaternion(device_pose(scene, device).orientation)[0])
        for device in scene.devices
    }
    assert yaw == pytest.approx({"car.a/turns": 140.0, "car.a/keeps": 10.0})
    at = next(device_pose(scene, d).position for d in scene.devices if d.name == "car.a/keeps")
    assert at[:2] == pytest.approx((math.cos(math.radians(130.0)), math.sin(math.radians(130.0))))
