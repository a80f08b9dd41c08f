"""World ``panda3d``: axes, level, bodies and pictures of the engine against what they have to be."""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

pytest.importorskip("panda3d", reason="needs Panda3D, the extra panda3d")

from caviar_bridges.panda3d.level import PANDA3D, panda3d_core
from caviar_bridges.panda3d.world import DrivenObject, EngineFlownObject, Panda3dSettings, Panda3dWorld
from caviar_protocol.errors import AssetError, PayloadError, ScenarioError
from caviar_protocol.messages import GrantInput, Status
from caviar_protocol.scenario import DeviceSpec
from caviar_protocol.scenario.conversion import Place
from caviar_protocol.space.coordinates import Pose, euler_from_quaternion, rotated, rotation_matrix
from caviar_protocol.topics import Action, AttitudeCommand, Camera, Scene, VelocityCommand, WaypointCommand
from caviar_protocol.topics.link import MotionCommand
from caviar_services.service import Frame, FrameInput, Preparation, RunInfo, StepResult
from caviar_space.mitsuba_xml import read_scenery, world_mesh

pytestmark = pytest.mark.slow

PERIOD_NS = 100_000_000
UAV = EngineFlownObject(name="uav", start_m=(0, 0, 10), max_speed_m_s=10, max_acceleration_m_s2=2)
WALL = """\
<CoordinateSystem> { Z-up }
<Group> yard {
  <Transform> { <Translate> { 12 0 0 } }
  <Group> wall { <Model> { 1 } <Tag> material { %s }
    <VertexPool> p {
      <Vertex> 1 { 12 9 0 } <Vertex> 2 { 12 -9 0 } <Vertex> 3 { 12 -9 20 } <Vertex> 4 { 12 9 20 }
    }
    <Polygon> {
      <Normal> { -1 0 0 } <RGBA> { 0.5 0.25 0.75 1 } <VertexRef> { 1 2 3 4 <Ref> { p } }
    }
  }
}
"""
"""A wall at x = 12 m, which looks to the west, in a node that stands there: vertices of .egg are global."""

coordinates = st.floats(-1.0, 1.0, allow_subnormal=False)
quaternions = st.tuples(coordinates, coordinates, coordinates, coordinates).filter(
    lambda q: math.hypot(*q) > 0.1
)


@pytest.fixture
def wall(tmp_path: Path) -> Path:
    file = tmp_path / "yard.egg"
    file.write_text(WALL % "brick")
    return file


def started(settings: Panda3dSettings, *devices: DeviceSpec, pictures: bool = False) -> Panda3dWorld:
    world = Panda3dWorld(settings, RunInfo(name="world", devices=devices))
    demand = {"scene": frozenset[str]()} | ({"camera": frozenset[str]()} if pictures else {})
    world.prepare(Preparation(demand=demand))
    world.reset(0, 1, 0)
    return world


def stepped(world: Panda3dWorld, number: int, *commands: MotionCommand) -> StepResult:
    inputs = ()
    if commands:
        entry = GrantInput(topic="action", source="pilot", status=Status.FRESH, frame=number - 1)
        inputs = (FrameInput(entry, payload=Action(commands=commands)),)
    return world.step(Frame(episode=0, number=number, t_ns=number * PERIOD_NS, inputs=inputs))


def flight(world: Panda3dWorld, frames: int, command: MotionCommand) -> Iterator[Scene]:
    for number in range(frames):
        scene = stepped(world, number, *([command] if number else [])).products["scene"]
        assert isinstance(scene, Scene)
        yield scene


@given(quaternions, st.tuples(coordinates, coordinates, coordinates))
def test_poses_go_to_the_engine_and_back(
    raw: tuple[float, ...], position: tuple[float, float, float]
) -> None:
    size = math.copysign(math.hypot(*raw), raw[0])
    w, x, y, z = (part / size for part in raw)
    there = PANDA3D.from_enu(Pose(position, (w, x, y, z)))
    back = PANDA3D.to_enu(there)
    assert back.position == position
    np.testing.assert_allclose(rotation_matrix(back.orientation), rotation_matrix((w, x, y, z)), atol=1e-12)


@given(quaternions)
def test_the_engine_sees_front_left_and_up_where_the_run_has_them(raw: tuple[float, ...]) -> None:
    """Its own vectors of a quaternion, in single precision."""
    q = tuple(part / math.hypot(*raw) for part in raw)
    core = panda3d_core()
    there = core.Quat(*PANDA3D.from_enu(Pose((0, 0, 0), q)).orientation)  # type: ignore[arg-type]
    np.testing.assert_allclose(there.getForward(), rotated(q, (1, 0, 0)), atol=1e-6)
    np.testing.assert_allclose(there.getRight(), rotated(q, (0, -1, 0)), atol=1e-6)
    np.testing.assert_allclose(there.getUp(), rotated(q, (0, 0, 1)), atol=1e-6)


def test_a_body_stands_and_heads_as_it_was_placed() -> None:
    uav = EngineFlownObject(
        name="uav", start_m=(1, 2, 3), start_yaw_deg=30, max_speed_m_s=9, max_acceleration_m_s2=2
    )
    scene = stepped(started(Panda3dSettings(flown=(uav,))), 0).products["scene"]
    assert isinstance(scene, Scene)
    assert scene.position.tolist() == [[1, 2, 3]]
    assert math.degrees(euler_from_quaternion(scene.orientation[0])[0]) == pytest.approx(30, abs=1e-4)


def test_a_velocity_is_reached_with_the_acceleration_of_the_uav() -> None:
    """v = a·t, and s = a·t²/2 + a·t·h/2 with steps of h = 10 ms (semi-implicit Euler)."""
    command = VelocityCommand(object="uav", velocity=(0.0, 6.0, 0.0))
    scene = list(flight(started(Panda3dSettings(flown=(UAV,))), 11, command))[-1]
    np.testing.assert_allclose(scene.velocity[0], [0, 2, 0], atol=1e-4)
    np.testing.assert_allclose(scene.position[0], [0, 1.01, 10], atol=1e-4)


def test_a_waypoint_is_reached_within_speed_and_acceleration_and_kept() -> None:
    command = WaypointCommand(object="uav", position=(20.0, -15.0, 4.0), speed=5.0)
    scenes = list(flight(started(Panda3dSettings(flown=(UAV,))), 100, command))
    speeds = np.array([scene.velocity[0] for scene in scenes])
    assert np.linalg.norm(speeds, axis=1).max() <= 5.0 + 1e-3
    assert np.linalg.norm(np.diff(speeds, axis=0), axis=1).max() <= 2.0 * 0.1 + 1e-3
    np.testing.assert_allclose(scenes[-1].position[0], command.position, atol=1e-3)
    np.testing.assert_allclose(scenes[-1].velocity[0], 0, atol=1e-3)
    # It heads along its course.
    yaw = euler_from_quaternion(scenes[-1].orientation[0])[0]
    assert yaw == pytest.approx(math.atan2(-15, 20), abs=0.02)


def test_a_wall_of_the_model_stops_the_uav_and_the_contact_is_counted(wall: Path) -> None:
    world = started(Panda3dSettings(flown=(UAV,), model=str(wall)))
    command = VelocityCommand(object="uav", velocity=(5.0, 0.0, 0.0))
    last = list(flight(world, 60, command))[-1]
    radius = math.hypot(*UAV.dimensions_m) / 2
    assert last.position[0, 0] == pytest.approx(12 - radius, abs=0.05)
    assert stepped(world, 60, command).counts == {"contacts": 1}


def test_a_vehicle_follows_its_path_and_heads_along_it() -> None:
    """With a constant acceleration it cuts a right angle by d/√8, d = v²/(√2·a) = 11.8 m."""
    car = DrivenObject(
        name="car", path_m=((0, 0, 1), (40, 0, 1), (40, 60, 1)), speed_m_s=10, max_acceleration_m_s2=6
    )
    world = started(Panda3dSettings(driven=(car,)))
    scenes = [stepped(world, number).products["scene"] for number in range(120)]
    places = np.array([scene.position[0] for scene in scenes])  # type: ignore[attr-defined]
    assert np.linalg.norm(places - (40, 0, 1), axis=1).min() == pytest.approx(11.8 / 8**0.5, abs=0.5)
    off = np.minimum(np.abs(places[:, 1]), np.abs(places[:, 0] - 40))
    assert off.max() < 3.5
    np.testing.assert_allclose(places[-1], (40, 60, 1), atol=1e-2)
    yaw = euler_from_quaternion(scenes[-1].orientation[0])[0]  # type: ignore[attr-defined]
    assert yaw == pytest.approx(math.pi / 2, abs=0.05)


def test_between_two_ticks_of_the_engine_bodies_go_on() -> None:
    car = DrivenObject(name="car", path_m=((0, 0, 1), (90, 0, 1)), speed_m_s=10)
    world = started(Panda3dSettings(driven=(car,)))
    scene = world.step(Frame(episode=0, number=0, t_ns=14_000_000)).products["scene"]
    assert isinstance(scene, Scene)
    assert scene.position[0, 0] == pytest.approx(0.14, abs=1e-5)


def test_the_model_is_scenery_in_world_coordinates_with_its_materials(wall: Path, tmp_path: Path) -> None:
    world = started(Panda3dSettings(model=str(wall)))
    for name, content in world.scenery().items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_bytes(content if isinstance(content, bytes) else content.read_bytes())
    (shape,) = read_scenery(tmp_path / "scenery" / "yard.xml").shapes
    mesh = world_mesh(shape)
    assert (shape.name, shape.itu_material) == ("wall", "brick")
    assert shape.colour is not None
    # sRGB 0.5, 0.25, 0.75 (IEC 61966-2-1).
    np.testing.assert_allclose(shape.colour, (0.214041, 0.050876, 0.522522), atol=2e-3)
    assert mesh.vertices.min(axis=0).tolist() == [12, -9, 0]
    assert mesh.vertices.max(axis=0).tolist() == [12, 9, 20]
    a, b, c = mesh.vertices[mesh.faces[0]]
    assert np.cross(b - a, c - a)[0] < 0  # faces look to the west, as in the model


def test_a_material_that_is_none_is_refused_by_its_node(tmp_path: Path) -> None:
    file = tmp_path / "yard.egg"
    file.write_text(WALL % "brik")
    with pytest.raises(AssetError, match=r"'wall'.*'brik'.*'brick'"):
        Panda3dWorld(Panda3dSettings(model=str(file)), RunInfo(name="world")).scenery()


def test_what_panda3d_cannot_load_is_refused(tmp_path: Path) -> None:
    file = tmp_path / "yard.bam"
    file.write_text("no model")
    with pytest.raises(AssetError, match="cannot load the model"):
        Panda3dWorld(Panda3dSettings(model=str(file)), RunInfo(name="world")).scenery()


def test_a_picture_has_an_object_where_its_corners_project() -> None:
    """Pinhole: u = cx + fx·right/forward, v = cy + fy·down/forward, within a pixel."""
    car = DrivenObject(
        name="box", kind="crate", dimensions_m=(3, 2, 1), path_m=((14, 4, 5), (99, 30, 5)), speed_m_s=1
    )
    camera = DeviceSpec(
        name="eye", kind="camera", position_m=(-2, 1, 3), yaw_deg=5, pitch_deg=4, size_px=(161, 97),
        field_of_view_deg=70,
    )  # fmt: skip
    world = started(Panda3dSettings(driven=(car,)), camera, pictures=True)
    try:
        products = stepped(world, 0).products
    finally:
        world.close()
    scene, pictures = products["scene"], products["camera"]
    assert isinstance(scene, Scene)
    assert isinstance(pictures, Camera)
    (image,) = pictures.images
    signs = np.array(np.meshgrid((-0.5, 0.5), (-0.5, 0.5), (-0.5, 0.5))).reshape(3, -1).T
    corners = (signs * scene.dimensions[0]) @ rotation_matrix(scene.orientation[0]).T + scene.position[0]
    forward, left, up = ((corners - image.position) @ rotation_matrix(image.orientation)).T
    u = image.intrinsics.cx - image.intrinsics.fx * left / forward
    v = image.intrinsics.cy - image.intrinsics.fy * up / forward
    rows, columns = np.nonzero((image.rgb != image.rgb[-1, -1]).any(axis=2))
    found = [columns.min(), columns.max() + 1, rows.min(), rows.max() + 1]
    np.testing.assert_allclose(found, [u.min(), u.max(), v.min(), v.max()], atol=1.0)
    assert u.max() < 80  # left of the middle
    assert v.max() < 48  # and above it


def test_without_demand_no_picture_is_taken() -> None:
    camera = DeviceSpec(name="eye", kind="camera")
    assert set(stepped(started(Panda3dSettings(flown=(UAV,)), camera), 0).products) == {"scene"}


@pytest.mark.parametrize(
    ("command", "text"),
    [
        (VelocityCommand(object="bird", velocity=(1.0, 0.0, 0.0)), "does not fly; it flies 'uav'"),
        (VelocityCommand(object="uav", velocity=(math.nan, 0.0, 0.0)), "is not finite"),
        (AttitudeCommand(object="uav", orientation=(1.0, 0.0, 0.0, 0.0), thrust=9.8), "send waypoints"),
    ],
)
def test_a_command_that_it_cannot_follow_is_refused(command: MotionCommand, text: str) -> None:
    world = started(Panda3dSettings(flown=(UAV,)))
    stepped(world, 0)
    with pytest.raises(PayloadError, match=text):
        stepped(world, 1, command)


def test_a_model_is_there_and_has_no_scenery_beside_it(wall: Path) -> None:
    place = Place("settings")
    for settings, text in (
        (Panda3dSettings(model="/no/town.egg"), "there is no file /no/town.egg"),
        (Panda3dSettings(model="town.egg"), 'write "file:town.egg"'),
    ):
        with pytest.raises(ScenarioError, match=text):
            Panda3dWorld.check_settings(settings, place)
    Panda3dWorld.check_settings(Panda3dSettings(model=str(wall)), place)
