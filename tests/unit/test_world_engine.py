"""A program as a world: its callbacks, meshes before and while the run goes on, and its state."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest

from caviar_protocol.assets import is_mesh_name
from caviar_protocol.errors import AssetError, PayloadError
from caviar_protocol.messages import GrantInput, Status
from caviar_protocol.scenario import DeviceSpec
from caviar_protocol.topics import Action, VelocityCommand
from caviar_services.service import Frame, FrameInput, Preparation, RunInfo, StepResult
from caviar_services.world.base import ObjectState, WorldSettings
from caviar_services.world.engine import Engine, EngineWorld, OfferedMesh, SceneryMesh
from caviar_space.meshes import unit_box
from caviar_space.mitsuba_xml import RadioMaterial

LEVEL, STILL, SIZE = (1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0), (4.0, 2.0, 1.5)
BOX = unit_box()


class Yard(Engine):
    """A car that is driven, and crates of ever other meshes."""

    prefixes = ("car", "crate.")

    def __init__(self, *wrong: tuple[str, Any, Any]) -> None:
        self.times: list[tuple[float, float]] = []
        self.offered: list[OfferedMesh] = []
        self.wrong = wrong

    def prepare(self) -> None:
        self.car = self.offer_mesh("car", BOX.vertices * SIZE + [1.0, 0.0, 0.0], BOX.faces)

    def reset(self, seed: int, t0: float) -> None:
        self.x = float(seed)
        self.t0 = t0

    def step(self, t: float, previous: float, commands: Sequence[Any]) -> list[ObjectState]:
        self.times.append((t, previous))
        for command in commands:
            self.x += command.velocity[0] * (t - previous)
        at = (self.x, 0.0, 0.75)
        car = ObjectState("car", "car", at, LEVEL, STILL, self.car.dimensions, mesh=self.car.mesh)
        found = [car]
        self.offered = [self.offer_mesh(name, *shape) for name, *shape in self.wrong]
        for number, (mesh, size, _) in enumerate(self.offered):
            found.append(ObjectState(f"crate.{number}", "crate", at, LEVEL, STILL, size, mesh=mesh))
        return found

    def save(self) -> bytes:
        return str(self.x).encode()

    def restore(self, state: bytes) -> None:
        self.x = float(state)


def world(engine: Engine, max_faces: int = 100, **run: Any) -> EngineWorld:
    """A world in its first episode."""
    made = EngineWorld.for_engine(engine)(WorldSettings(), RunInfo(name="world", **run))
    made.scenery()
    made.prepare(Preparation(demand={}, max_faces=max_faces))
    made.reset(0, 7, 5_000_000_000)
    return made


def stepped(made: EngineWorld, number: int, *commands: VelocityCommand) -> StepResult:
    """A frame of 0.1 s, with commands."""
    entry = GrantInput(topic="action", source="a", status=Status.FRESH, frame=number)
    inputs = (FrameInput(entry, payload=Action(commands=commands)),) if commands else ()
    t_ns = 5_000_000_000 + number * 100_000_000
    return made.step(Frame(episode=0, number=number, t_ns=t_ns, inputs=inputs))


def scene(result: StepResult) -> Any:
    return result.products["scene"]


def test_it_is_asked_for_objects_with_times_of_the_episode_and_commands() -> None:
    yard = Yard()
    made = world(yard)
    command = VelocityCommand(object="car", velocity=(3.0, 0.0, 0.0))
    for number in (0, 1, 4):
        result = stepped(made, number, *([command] if number else []))
    assert np.array(yard.times) == pytest.approx(np.array([[0.0, 0.0], [0.1, 0.0], [0.4, 0.1]]))
    assert yard.t0 == 5.0
    assert scene(result).position[0, 0] == pytest.approx(7 + 3 * 0.4)
    assert made.prefixes() == ("car", "crate.")


def test_a_mesh_of_prepare_is_scenery_and_tells_size_and_centre() -> None:
    yard = Yard()
    made = world(yard, max_faces=0)
    assert list(made.scenery()) == ["objects/car.ply"]
    assert yard.car == ("objects/car.ply", SIZE, (1.0, 0.0, 0.0))
    # Also in a run that takes no meshes while it goes on.
    assert scene(stepped(made, 0)).assets == ("objects/car.ply",)


def test_a_mesh_that_comes_later_is_announced_once_and_is_a_box_where_the_run_takes_none() -> None:
    crate = ("crate", BOX.vertices, BOX.faces, "wood")
    made = world(Yard(crate))
    first, second = stepped(made, 0), stepped(made, 1)
    assert first.meshes is not None
    (name,) = first.meshes
    assert is_mesh_name(name)
    assert scene(first).assets == ("objects/car.ply", name)
    assert b"\ncomment material wood\n" in bytes(first.meshes[name])  # type: ignore[arg-type]
    assert second.meshes is None
    closed = stepped(world(Yard(crate), max_faces=0), 0)
    assert closed.meshes is None
    assert scene(closed).assets == ("objects/car.ply", "")


@pytest.mark.parametrize(
    ("objects", "said"),
    [
        (None, r"Odd\.step returned None; return a list of ObjectState"),
        ("car", r"Odd\.step returned 'car'; return a list of ObjectState"),
        (["car"], r"Odd\.step returned 'car' among others; the items have to be ObjectState"),
        ([ObjectState("car\n", "car", STILL, LEVEL, STILL, SIZE)], r"named 'car\\n'"),
    ],
)
def test_what_a_step_returns_is_named_where_it_is_no_object(objects: object, said: str) -> None:
    class Odd(Yard):
        def step(self, t: float, previous: float, commands: object) -> Any:
            return objects

    with pytest.raises(PayloadError, match=said):
        stepped(world(Odd()), 0)


def test_prefixes_that_are_one_text_are_refused() -> None:
    """Each letter would be one."""

    class Odd(Yard):
        prefixes = "car"  # type: ignore[assignment]

    with pytest.raises(PayloadError, match=r"Odd\.prefixes.*'car'.*\('car',\)"):
        world(Odd())


def test_a_state_that_is_no_bytes_is_refused() -> None:
    class Odd(Yard):
        def save(self) -> Any:
            return "here"

    made = world(Odd())
    stepped(made, 0)
    with pytest.raises(PayloadError, match=r"Odd\.save returned str"):
        made.checkpoint()


def test_wrong_meshes_while_the_run_goes_on_are_named_once_and_leave_boxes(
    caplog: pytest.LogCaptureFixture,
) -> None:
    many = np.repeat(BOX.faces, 9, axis=0)
    broken = BOX.vertices.astype(float) * 3
    broken[2, 1] = np.nan
    wrong = {
        "nan": (broken, BOX.faces, "a vertex is not finite"),
        "none": (BOX.vertices, BOX.faces[:0], "it has no triangles"),
        "many": (BOX.vertices, many, "it has 108 triangles, and this run takes 100"),
        "corner": (BOX.vertices, [[0, 1, 8]], "a corner that is none of its 8 vertices"),
        "flat": (BOX.vertices * [1, 1, 0], BOX.faces, "flat along z"),
    }
    made = world(Yard(*((name, vertices, faces) for name, (vertices, faces, _) in wrong.items())))
    with caplog.at_level(logging.WARNING):
        results = [stepped(made, number) for number in range(2)]
    assert [scene(result).assets[1:] for result in results] == [("",) * 5] * 2
    assert (scene(results[0]).dimensions > 0).all()
    assert scene(results[0]).dimensions[1].tolist() == [3.0, 3.0, 3.0]
    assert all(not result.meshes for result in results)
    assert [dict(result.counts) for result in results] == [{f"mesh-refused/{name}": 1 for name in wrong}, {}]
    assert len(caplog.messages) == len(wrong)
    for message, (name, (_, _, why)) in zip(caplog.messages, wrong.items(), strict=True):
        assert message.startswith(f"mesh {name!r}: ")
        assert why in message


@pytest.mark.parametrize(
    ("material", "says"),
    [
        ("walls", "has no material 'stone'"),
        ("wall", "there is no material 'wall'; did you mean 'walls'"),
        ("none", "there is no material 'none'; give {'none': RadioMaterial"),
    ],
)
def test_wrong_scenery_is_refused_by_name(material: str, says: str) -> None:
    class House(Yard):
        def prepare(self) -> None:
            kind = "stone" if material == "walls" else "brick"
            house = SceneryMesh("house", BOX.vertices, BOX.faces, material)
            self.offer_scenery([house], {} if material == "none" else {"walls": RadioMaterial(kind)})

    with pytest.raises(AssetError, match=says):
        world(House())


def test_a_state_has_the_engines_its_time_and_who_came_first() -> None:
    device = DeviceSpec(name="rx", kind="antenna", role="rx", on="*", count=1)
    crate = ("crate", BOX.vertices, BOX.faces)
    one = world(Yard(crate), devices=(device,))
    stepped(one, 0)
    stepped(one, 3, VelocityCommand(object="car", velocity=(1.0, 0.0, 0.0)))
    yard = Yard(crate)
    other = world(yard, devices=(device,))
    other.restore(one.checkpoint())
    assert other.checkpoint() == one.checkpoint()
    there = [scene(stepped(made, 5)) for made in (one, other)]
    assert there[0].position.tolist() == there[1].position.tolist()
    assert [d.name for d in there[1].devices] == ["car/rx"]
    assert yard.times == [pytest.approx((0.5, 0.3))]
