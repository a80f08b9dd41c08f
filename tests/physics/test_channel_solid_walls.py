"""Closed walls, by faces and solid: what passes, against the slabs of ITU-R P.2040."""

from __future__ import annotations

from pathlib import Path

import msgspec
import numpy as np
import pytest

from caviar_protocol.messages import GrantInput, Status
from caviar_protocol.topics import AntennaDevice, Carrier, Channel, Scene
from caviar_scenes.opened import open_scene
from caviar_scenes.repairs import repair
from caviar_services.channel.propagation.utd import slab
from caviar_services.channel.sionna.model import SionnaChannel
from caviar_services.channel.sionna.settings import SionnaSettings
from caviar_services.service import Frame, FrameInput, Preparation, RunInfo
from caviar_space.meshes import Mesh, box, joined
from caviar_space.mitsuba_xml import RadioMaterial, scenery_files

pytestmark = pytest.mark.channel

F = 3.5e9
CONSTANTS = (5.24, 0.0462 * 3.5**0.7822)
WALL = box((4.9, 5.1), (-9.0, 9.0), (-9.0, 9.0))
SHEET = Mesh(np.array([[5.0, -9, -9], [5, 9, -9], [5, 9, 9], [5, -9, 9]]), np.array([[0, 1, 2], [0, 2, 3]]))
HOUSE = box((-30.0, -20.0), (-9.0, 9.0), (-9.0, 9.0))


def passed_db(folder: Path, mesh: Mesh, thickness: float, y: float, **settings: object) -> tuple[float, str]:
    """Path gain through a mesh against free space, and the notes of the model."""
    files = scenery_files("s", {"wall": (mesh, "c")}, {"c": RadioMaterial("concrete", thickness)})
    assets = {}
    for name, content in files.items():
        file = assets[name] = folder / name
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_bytes(content)
    run = RunInfo(name="channel", seed=1, carriers=(Carrier(name="c", frequency_hz=F),))
    given = {"refraction": True, "reflection": False, "samples": 20_000, **settings}
    model = SionnaChannel(msgspec.convert(given, SionnaSettings), run)
    notes = model.prepare(Preparation(demand={"channel": frozenset({"h"})}, assets=assets)).notes
    ends = (
        AntennaDevice(name="r", role="rx", position=(10.0, y, 0.0)),
        AntennaDevice(name="t", role="tx", position=(0.0, 0.0, 0.0)),
    )
    nothing = np.zeros((0, 3))
    scene = Scene(
        names=(), classes=(), assets=(), position=nothing, orientation=np.zeros((0, 4)),
        velocity=nothing, dimensions=nothing, devices=ends,
    )  # fmt: skip
    source = FrameInput(GrantInput(topic="scene", source="world", status=Status.FRESH), payload=scene)
    product = model.step(Frame(episode=0, number=0, t_ns=0, inputs=(source,))).products["channel"]
    model.close()
    assert isinstance(product, Channel)
    free = 299792458.0 / F / (4 * np.pi * np.hypot(10.0, y))
    return float(10 * np.log10((np.abs(product.a[0]) ** 2).sum() / free**2)), "\n".join(notes)


@pytest.mark.parametrize("y", [0.0, 7.0], ids=["across", "aslant"])
def test_a_solid_wall_is_one_slab_of_its_thickness(tmp_path: Path, y: float) -> None:
    cosine = np.array([10.0 / np.hypot(10.0, y)])
    # Vertical antennas: the field is parallel to the wall, across the plane of incidence.
    one = 20 * np.log10(abs(slab(cosine, CONSTANTS, 0.2, F)[1][0, 0]))
    sheet, _ = passed_db(tmp_path / "sheet", SHEET, 0.2, y)
    faces, warned = passed_db(tmp_path / "faces", WALL, 0.2, y)
    solid, notes = passed_db(tmp_path / "solid", WALL, 0.05, y, solid_walls_m=0.5)
    assert sheet == pytest.approx(one, abs=0.02)
    assert faces == pytest.approx(2 * one, abs=0.05)
    assert solid == pytest.approx(one, abs=0.02)
    assert "set solid_walls_m" in warned
    assert "closed walls of 0.2 m in 1 pieces are one slab" in notes


def test_a_house_beside_it_and_changes_of_its_material_stay(tmp_path: Path) -> None:
    change = {"c": {"relative_permittivity": 3.0, "conductivity_s_per_m": 0.0, "thickness_m": 0.7}}
    both = joined([HOUSE, WALL])
    found, _ = passed_db(tmp_path, both, 0.3, 0.0, solid_walls_m=0.5, materials=change)
    through = slab(np.array([1.0]), (3.0, 0.0), 0.2, F)[1][0, 0]
    assert found == pytest.approx(20 * np.log10(abs(through)), abs=0.02)
    with pytest.raises(Exception, match="no material 'd'"):
        passed_db(tmp_path, both, 0.3, 0.0, solid_walls_m=0.5, materials={"d": change["c"]})


def test_received_power_is_that_of_before_where_corners_were_welded(tmp_path: Path) -> None:
    soup = Mesh(HOUSE.vertices[HOUSE.faces].reshape(-1, 3), np.arange(36, dtype=np.int32).reshape(-1, 3))
    shapes = {"house": (soup, "c")}
    for name, content in scenery_files("s", shapes, {"c": RadioMaterial("concrete")}).items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_bytes(content)
    (welded, _), *more = repair(open_scene(str(tmp_path / "scenery/s.xml")))[0]["house"]
    assert (len(welded.vertices), len(welded.faces), more) == (8, 12, [])
    for y in (0.0, 3.0, 7.0):
        gains = [passed_db(tmp_path, mesh, 0.2, y, reflection=True)[0] for mesh in (soup, welded)]
        assert gains[0] == gains[1] != 0.0
